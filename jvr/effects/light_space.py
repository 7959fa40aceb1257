"""Light space: coordinates as a light sees the volume, and what lies along its rays.

`(u, v)` in [-1, 1]^2 is a ray of the light and `w` in [0, 1] how far along it a point lies, from where the volume may begin to where it
ends. For directional light rays are parallel. Those of a point are fanned out over the cone that holds the volume, or over all directions
where the light is inside of it, by Lambert's azimuthal equal-area projection about the direction to the middle of the volume.
"""

import abc
import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.execution.devices import over_rays, shares
from jvr.march.medium import Medium
from jvr.march.secondary import SecondaryRays, channel_count, secondary_rays, take_midpoint
from jvr.model.clipping import Line
from jvr.model.light import AbstractDeltaLight, DirectionalLight
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import clamp, direction_and_length, dot, perpendicular
from jvr.types import Channels, Scalar, Triple, Vector

Result = TypeVar("Result")

# Optical depth of a sample of a sweep behind geometry.
OPAQUE = 100.0
# A light nearer to the bounding sphere of the volume than this fraction of its radius shines in all directions.
NEAR = 1.01
# Samples of a sweep that are taken at a time: enough to outweigh what it costs to start an operation and to share it between cores.
SWEPT = 65536


class AbstractLightSpace(eqx.Module):
    """The coordinates of one light."""

    @abc.abstractmethod
    def coordinates(self, x: Triple) -> Triple:
        """`(u, v, w)` of a world position."""

    @property
    @abc.abstractmethod
    def upstream(self) -> Scalar | float:
        """How far light has come where its rays begin (`w = 0`)."""

    @abc.abstractmethod
    def ray(self, u: Scalar, v: Scalar) -> tuple[Triple, Triple, Scalar]:
        """Where the ray `(u, v)` begins (`w = 0`), its unit direction, and its length (to `w = 1`)."""


class ParallelSpace(AbstractLightSpace):
    """The light space of directional light: `center + half_u u U + half_v v V + half_w (2 w - 1) A`."""

    center: Vector
    axes: Float[Array, "3 3"]
    half: Vector

    @property
    def upstream(self) -> float:
        return math.inf

    def coordinates(self, x: Triple) -> Triple:
        offset = tuple(c - self.center[i] for i, c in enumerate(x))
        u, v, a = (dot(offset, tuple(row)) / self.half[i] for i, row in enumerate(self.axes))
        return u, v, (a + 1) / 2

    def ray(self, u: Scalar, v: Scalar) -> tuple[Triple, Triple, Scalar]:
        across, up, along = self.axes
        steps = (u * self.half[0], v * self.half[1], -self.half[2])
        start = tuple(self.center[i] + steps[0] * across[i] + steps[1] * up[i] + steps[2] * along[i] for i in range(3))
        return start, tuple(along), 2 * self.half[2]


class FanSpace(AbstractLightSpace):
    """The light space of a point: unit directions lie at `rho = sin(theta / 2) / rim` about the axis, 1 at the edge of the cone of its
    rays, which go from `near` to `far`."""

    position: Vector
    axes: Float[Array, "3 3"]
    rim: Scalar
    near: Scalar
    far: Scalar

    @property
    def upstream(self) -> Scalar:
        return self.near

    def coordinates(self, x: Triple) -> Triple:
        d, distance = direction_and_length(tuple(c - self.position[i] for i, c in enumerate(x)))
        across, up, along = (dot(d, tuple(row)) for row in self.axes)
        # sin(theta / 2) / sin(theta) = 1 / (2 cos(theta / 2)), smooth about the axis; behind the light `sin(theta / 2)` itself, whose
        # direction across the axis is any where there is none.
        ahead = along > 0
        scale = 1 / jnp.sqrt(2 * (1 + jnp.where(ahead, along, 1.0)))
        (a, b, _), sideways = direction_and_length((across, up, jnp.zeros_like(along)))
        a = jnp.where(sideways > 0, a, 1.0)
        rho = jnp.sqrt(0.5 * (1 - jnp.where(ahead, 0.0, along)))
        u, v = (jnp.where(ahead, c * scale, rho * d) / self.rim for c, d in ((across, a), (up, b)))
        return u, v, (distance - self.near) / (self.far - self.near)

    def ray(self, u: Scalar, v: Scalar) -> tuple[Triple, Triple, Scalar]:
        across, up, along = self.axes
        square = jnp.minimum((u * u + v * v) * self.rim**2, 1.0)
        # The clamp keeps the root's derivative finite in the corners of the square, which stand for no direction.
        sideways = 2 * self.rim * jnp.sqrt(jnp.maximum(1 - square, 1e-6))
        d = tuple((1 - 2 * square) * along[i] + sideways * (u * across[i] + v * up[i]) for i in range(3))
        d, _ = direction_and_length(d)
        return tuple(self.position[i] + self.near * d[i] for i in range(3)), d, self.far - self.near


def light_space(light: AbstractDeltaLight, volume: Volume) -> AbstractLightSpace:
    """The coordinates of a light around a volume; differentiable in both."""
    if isinstance(light, DirectionalLight):
        along, _ = direction_and_length((light.direction[0], light.direction[1], light.direction[2]))
        axes = jnp.stack([jnp.stack(side) for side in (*perpendicular(along), along)])
        corners = jnp.asarray([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)], axes.dtype)
        extent = jnp.maximum(jnp.asarray(volume.shape, axes.dtype) - 1, 1) / 2
        half = jnp.max(jnp.abs((corners * extent) @ volume.world_from_grid[:3, :3].T @ axes.T), axis=0)
        return ParallelSpace(volume.center, axes, half)
    position = getattr(light, "position", None)
    if position is None:
        raise TypeError(
            f"shadow maps and volumes know directional and point lights, not a {type(light).__name__}: use ShadowRays()"
        )
    along, distance = direction_and_length(tuple(volume.center[i] - position[i] for i in range(3)))
    along = tuple(jnp.where(distance > 0, a, b) for a, b in zip(along, (0.0, 0.0, 1.0), strict=True))
    axes = jnp.stack([jnp.stack(side) for side in (*perpendicular(along), along)])
    radius = volume.radius
    outside = distance > NEAR * radius
    half_angle = jnp.where(outside, jnp.arcsin(radius / jnp.where(outside, distance, 2 * radius)), math.pi) / 2
    return FanSpace(position, axes, jnp.sin(half_angle), jnp.maximum(distance - radius, 0.0), distance + radius)


class LightRays(NamedTuple):
    """A batch of a light's rays, which go on without an end, their lengths from `w = 0` to `w = 1`, and how far from `w = 0` geometry ends
    them, `None` where none is in the scene."""

    rays: SecondaryRays
    length: Float[Array, "rays"]
    ends: Float[Array, "rays"] | None = None


def rays_through(space: AbstractLightSpace, scene: Scene, u: Float[Array, "rays"], v: Float[Array, "rays"]) -> LightRays:
    """The rays `(u, v)` of a light."""

    def one(u: Scalar, v: Scalar) -> tuple[LightRays, Line]:
        x, direction, length = space.ray(u, v)
        grid = scene.volume.grid_from_world(x), scene.volume.grid_from_world(direction, direction=True)
        return LightRays(secondary_rays(scene.volume, scene.clipping, (x, direction), grid), length), (x, direction)

    light, line = jax.vmap(one)(u, v)
    if scene.light_blocker is None:
        return light
    begin = jnp.broadcast_to(-space.upstream, light.length.shape)
    return light._replace(ends=scene.light_blocker.hit(line, 0.0, begin, None).distance)


def depth_nodes(
    space: AbstractLightSpace, scene: Scene, medium: Medium, texels: int, layers: int, samples: int
) -> Float[Array, "nodes u v channels"]:
    """Optical depth from the light to `layers + 1` equally distant depths of `texels^2` rays, by the midpoint rule with `samples` samples a
    layer, swept away from the light."""
    nodes = of_swept(lambda depths: depths, space, scene, medium, texels, layers, samples)
    return jnp.moveaxis(nodes, 2, 0)


def of_swept(
    function: Callable[[Float[Array, "rays nodes channels"]], Result],
    space: AbstractLightSpace,
    scene: Scene,
    medium: Medium,
    texels: int,
    layers: int,
    samples: int,
) -> Result:
    """What a function makes of the depths along each ray that `depth_nodes` has, for each device of its own rays: arrays
    `(texels, texels, ...)`."""
    axis = jnp.linspace(-1.0, 1.0, texels)
    coordinates = jnp.stack([c.ravel() for c in jnp.meshgrid(axis, axis, indexing="ij")], axis=1)
    coordinates = jnp.pad(coordinates, ((0, -(texels**2) % shares()), (0, 0)), mode="edge")

    def share(shared: tuple[AbstractLightSpace, Scene, Medium], coordinates: Float[Array, "rays 2"]) -> Result:
        return function(_swept(*shared, coordinates, layers, samples))

    found = over_rays(share, (space, scene, medium), coordinates)
    return jax.tree.map(lambda x: x[: texels**2].reshape(texels, texels, *x.shape[1:]), found)


def _swept(
    space: AbstractLightSpace,
    scene: Scene,
    medium: Medium,
    coordinates: Float[Array, "rays 2"],
    layers: int,
    samples: int,
) -> Float[Array, "rays nodes channels"]:
    """`depth_nodes` of the rays at some coordinates `(u, v)`."""
    u, v = coordinates.T
    light = rays_through(space, scene, u, v)
    together = min(max(1, SWEPT // (u.size * samples)), layers)
    blocks = -(-layers // together)
    rays, length, ends = jax.tree.map(lambda x: jnp.tile(x, together * samples), light)

    # Checkpointed: the reverse pass computes a block of layers again rather than keep all of its voxels.
    @jax.checkpoint
    def sweep(tau: Channels, block: Array) -> tuple[Channels, Channels]:
        steps = block * together * samples + jnp.arange(together * samples, dtype=u.dtype)
        begin, end = (jnp.repeat(steps + one, u.size) / (samples * layers) * length for one in (0, 1))
        dtau = take_midpoint(medium, scene.volume, rays, begin, end, True)[0]
        dtau = dtau if ends is None else tuple(jnp.where(end > ends, OPAQUE, d) for d in dtau)
        depths = tuple(
            t + jnp.cumsum(jnp.sum(d.reshape(together, samples, -1), axis=1), axis=0) for t, d in zip(tau, dtau, strict=True)
        )
        return tuple(d[-1] for d in depths), depths

    zero = (jnp.zeros_like(light.length),) * channel_count(medium, scene.volume, rays)
    _, depths = jax.lax.scan(sweep, zero, jnp.arange(blocks, dtype=u.dtype))
    swept = [jnp.concatenate([z[None], d.reshape(-1, u.size)[:layers]]) for z, d in zip(zero, depths, strict=True)]
    return jnp.moveaxis(jnp.stack(swept, axis=-1), 0, 1)


def bilinear(texels: int, u: Scalar, v: Scalar) -> list[tuple[Array, Scalar]]:
    """The four texels around `(u, v)`, as flat indices, with their weights; positions beyond the border count as on it."""
    at = [clamp((c + 1) / 2 * (texels - 1), 0, texels - 1) for c in (u, v)]
    low = [jnp.clip(jnp.floor(c), 0, texels - 2) for c in at]
    (fu, fv), (i, j) = [c - b for c, b in zip(at, low, strict=True)], [b.astype(jnp.int32) for b in low]
    return [((i + a) * texels + j + b, (fu if a else 1 - fu) * (fv if b else 1 - fv)) for a in (0, 1) for b in (0, 1)]
