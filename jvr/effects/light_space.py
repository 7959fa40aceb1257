"""Coordinates as a light sees the volume, and what lies along its rays.

`(u, v)` in [-1, 1]^2 is a ray of the light and `w` in [0, 1] how far along it a point lies, from where the volume may begin to where it
ends. For directional light rays are parallel. Those of a point are fanned out over the cone that holds the volume, or over all directions
where the light is inside of it, by Lambert's azimuthal equal-area projection about the direction to the middle of the volume.
"""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.march.march import Medium
from jvr.march.steps import Point
from jvr.model.light import AbstractLight, DirectionalLight, perpendicular
from jvr.model.scene import Scene
from jvr.model.volume import ClippingBox, Volume
from jvr.numerics import direction_and_length, dot
from jvr.types import Channels, Scalar, Triple, Vector

# A light nearer to the bounding sphere of the volume than this share of its radius shines in all directions.
NEAR = 1.01


class AbstractLightSpace(eqx.Module):
    """The coordinates of one light."""

    @abc.abstractmethod
    def place(self, x: Triple) -> Triple:
        """`(u, v, w)` of a world position."""

    @abc.abstractmethod
    def ray(self, u: Scalar, v: Scalar) -> tuple[Triple, Triple, Scalar]:
        """Where the ray `(u, v)` begins (`w = 0`), its unit direction, and its length (to `w = 1`)."""


class ParallelSpace(AbstractLightSpace):
    """Directional light: `center + half_u u U + half_v v V + half_w (2 w - 1) A`."""

    center: Vector
    axes: Float[Array, "3 3"]
    half: Vector

    def place(self, x: Triple) -> Triple:
        offset = tuple(c - self.center[i] for i, c in enumerate(x))
        u, v, a = (dot(offset, tuple(row)) / self.half[i] for i, row in enumerate(self.axes))
        return u, v, (a + 1) / 2

    def ray(self, u: Scalar, v: Scalar) -> tuple[Triple, Triple, Scalar]:
        across, up, along = self.axes
        steps = (u * self.half[0], v * self.half[1], -self.half[2])
        start = tuple(self.center[i] + steps[0] * across[i] + steps[1] * up[i] + steps[2] * along[i] for i in range(3))
        return start, tuple(along), 2 * self.half[2]


class FanSpace(AbstractLightSpace):
    """A point: unit directions are placed at `rho = sin(theta / 2) / reach` about the axis, and rays go from `near` to `far`."""

    position: Vector
    axes: Float[Array, "3 3"]
    reach: Scalar
    near: Scalar
    far: Scalar

    def place(self, x: Triple) -> Triple:
        d, distance = direction_and_length(tuple(c - self.position[i] for i, c in enumerate(x)))
        across, up, along = (dot(d, tuple(row)) for row in self.axes)
        # sin(theta / 2) / sin(theta) = 1 / (2 cos(theta / 2)), which is smooth about the axis.
        scale = 1 / (jnp.sqrt(2 * jnp.maximum(1 + along, 1e-6)) * self.reach)
        return across * scale, up * scale, (distance - self.near) / (self.far - self.near)

    def ray(self, u: Scalar, v: Scalar) -> tuple[Triple, Triple, Scalar]:
        across, up, along = self.axes
        square = jnp.minimum((u * u + v * v) * self.reach**2, 1.0)
        # The clamp keeps the root's derivative finite in the corners of the square, which stand for no direction.
        sideways = 2 * self.reach * jnp.sqrt(jnp.maximum(1 - square, 1e-6))
        d = tuple((1 - 2 * square) * along[i] + sideways * (u * across[i] + v * up[i]) for i in range(3))
        d, _ = direction_and_length(d)
        return tuple(self.position[i] + self.near * d[i] for i in range(3)), d, self.far - self.near


def light_space(light: AbstractLight, volume: Volume) -> AbstractLightSpace:
    """The coordinates of a light around a volume. Differentiable in the light; detached: how far they reach."""
    if isinstance(light, DirectionalLight):
        along, _ = direction_and_length((light.direction[0], light.direction[1], light.direction[2]))
        axes = jnp.stack([jnp.stack(side) for side in (*perpendicular(along), along)])
        corners = jnp.asarray([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)], axes.dtype)
        extent = jnp.maximum(jnp.asarray(volume.shape, axes.dtype) - 1, 1) / 2
        half = jnp.max(jnp.abs((corners * extent) @ volume.world_from_grid[:3, :3].T @ axes.T), axis=0)
        return ParallelSpace(volume.center, axes, jax.lax.stop_gradient(half))
    position = getattr(light, "position", None)
    if position is None:
        raise TypeError(
            f"shadow maps and volumes know directional and point lights, not a {type(light).__name__}: use ShadowRays()"
        )
    along, distance = direction_and_length(tuple(volume.center[i] - position[i] for i in range(3)))
    along = tuple(jnp.where(distance > 0, a, b) for a, b in zip(along, (0.0, 0.0, 1.0), strict=True))
    axes = jnp.stack([jnp.stack(side) for side in (*perpendicular(along), along)])
    radius, distance = jax.lax.stop_gradient((volume.radius, distance))
    outside = distance > NEAR * radius
    half_angle = jnp.where(outside, jnp.arcsin(radius / jnp.where(outside, distance, 2 * radius)), math.pi) / 2
    return FanSpace(position, axes, jnp.sin(half_angle), jnp.maximum(distance - radius, 0.0), distance + radius)


def extinction_along(
    space: AbstractLightSpace, scene: Scene, medium: Medium, u: Float[Array, "..."], v: Float[Array, "..."], w: Scalar
) -> tuple[Channels, Float[Array, "..."]]:
    """Extinction of the medium at depth `w` of rays, in each of its channels, 0 outside of the volume; and the rays' lengths."""
    volume, clipping = scene.volume, scene.clipping

    def one(u: Scalar, v: Scalar) -> tuple[Channels, Scalar]:
        start, direction, length = space.ray(u, v)
        x = tuple(s + w * length * d for s, d in zip(start, direction, strict=True))
        p = volume.grid_from_world(x)
        lower, upper = volume.domain
        inside = jnp.all(jnp.stack([(c >= low) & (c <= high) for c, low, high in zip(p, lower, upper, strict=True)]))
        if clipping is not None:
            inside &= _inside(clipping, x)
        # Outside of the domain nothing may be read.
        p = tuple(jnp.clip(c, low, high) for c, low, high in zip(p, lower, upper, strict=True))
        point = Point(p, p, jnp.int32(0), jnp.int32(0))
        sample = medium.shader.prepare(medium.transfer, medium.field.resample(point), point)
        sigma_t = medium.shader.classify(medium.transfer, sample).sigma_t
        return tuple(jnp.where(inside, sigma, 0.0) for sigma in sigma_t), length

    flat, length = jax.vmap(one)(u.ravel(), v.ravel())
    return tuple(sigma.reshape(u.shape) for sigma in flat), length.reshape(u.shape)


def depth_nodes(
    space: AbstractLightSpace, scene: Scene, medium: Medium, texels: int, layers: int, samples: int
) -> Float[Array, "u v nodes channels"]:
    """Optical depth from the light to `layers + 1` equally distant depths of `texels^2` rays, by the midpoint rule with `samples` samples a
    layer, swept away from the light."""
    axis = jnp.linspace(-1.0, 1.0, texels)
    u, v = jnp.meshgrid(axis, axis, indexing="ij")

    # Checkpointed: the way back computes a layer again rather than keep all of its voxels.
    @jax.checkpoint
    def sweep(tau: Channels, layer: Array) -> tuple[Channels, Channels]:
        for k in range(samples):
            w = (layer + (k + 0.5) / samples) / layers
            sigma_t, length = extinction_along(space, scene, medium, u, v, w)
            tau = tuple(t + sigma * length / (layers * samples) for t, sigma in zip(tau, sigma_t, strict=True))
        return tau, tau

    channels = jax.eval_shape(lambda: extinction_along(space, scene, medium, u, v, axis[0]))[0]
    zero = tuple(jnp.zeros(u.shape, c.dtype) for c in channels)
    _, depths = jax.lax.scan(sweep, zero, jnp.arange(layers, dtype=axis.dtype))
    rows = jnp.stack([jnp.concatenate([z[None], d]) for z, d in zip(zero, depths, strict=True)], axis=-1)
    return jnp.moveaxis(rows, 0, 2)


def _inside(clipping: ClippingBox, x: Triple) -> Array:
    within = [(c >= clipping.lower[i]) & (c <= clipping.upper[i]) for i, c in enumerate(x)]
    return within[0] & within[1] & within[2]


def bilinear(texels: int, u: Scalar, v: Scalar) -> list[tuple[Array, Scalar]]:
    """The four texels around `(u, v)`, as flat indices, with their weights; positions beyond the border count as on it."""
    at = [jnp.clip((c + 1) / 2 * (texels - 1), 0, texels - 1) for c in (u, v)]
    low = [jnp.clip(jnp.floor(c), 0, texels - 2) for c in at]
    (fu, fv), (i, j) = [c - b for c, b in zip(at, low, strict=True)], [b.astype(jnp.int32) for b in low]
    return [((i + a) * texels + j + b, (fu if a else 1 - fu) * (fv if b else 1 - fv)) for a in (0, 1) for b in (0, 1)]
