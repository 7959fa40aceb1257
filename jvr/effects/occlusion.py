"""Local ambient occlusion: how much of the ambient light the medium near a point takes away (Hernell, Ljung and Ynnerman, "Local ambient
occlusion in direct volume rendering", IEEE TVCG 16(4), 2010; course notes on GPU-based volume ray-casting, Eurographics 2009,
section 6.1).
"""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from jvr.effects.grid import Grid
from jvr.effects.nodes import AbstractProjection, project_all, seen_around
from jvr.march.medium import AbstractVisibility, LightPath, Medium
from jvr.march.rules import perturbed
from jvr.march.secondary import SecondaryRays, channel_count, secondary_rays, take_midpoint
from jvr.march.steps import Point, Transmittances
from jvr.model.clipping import Clipping
from jvr.model.effects import AbstractOcclusion, stale_message
from jvr.model.grids import Shape, node_shape, nodes_for_each_voxel, resampled_cubic
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import Knob, multiples
from jvr.model.ranges import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, UNIT_INTERVAL, Interval
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import clamp, divide_or_zero, larger, mean_transmittance
from jvr.types import ArrayLike, Channels, Scalar

# Radius and offset where a scene says none, in voxels of the smallest spacing.
RADIUS, OFFSET = 16.0, 1.0
# Azimuth between one direction and the next, the golden angle.
GOLDEN = math.pi * (3 - math.sqrt(5))


class ProjectedOcclusion(eqx.Module):
    """Occlusion as it was computed, on the grid of the voxels.

    - `taken`: `(x, y, z, 1)`, or `(x, y, z, 3)` for coloured extinction: `1 - I`, which is also 0 where nothing is visible and nothing was
      computed.
    - `cache_key`: checksums of what it was made of (`jvr.model.kept.content`).
    - `pinned`: whether it stays as it is although the scene is another.
    """

    taken: Float[Array, "x y z channels"]
    cache_key: UInt32[Array, "parts 2"]
    pinned: bool = eqx.field(static=True, default=False)


class LocalOcclusion(AbstractOcclusion):
    """Local ambient occlusion: the mean over directions of the light that is scattered to a point from within a ball around it.

        I(x) = 1 / K sum_k 1 / (R - a) integral_a^R exp(-integral_a^s sigma_t du) ds        (notes, equations 6.1 and 6.3)

    along `K` rays from `x`, so that shadows fade in with distance. Ambient light is multiplied with `(bias + (1 - bias) I)^gamma`, which
    is 1 where nothing is near and `bias^gamma` where everything is opaque (equation 6.4 has `(bias + I)^gamma`, which exceeds 1).
    Coloured extinction has an `I` for each channel. Where the volume or its clipping box ends there is nothing more.

    `I` is found at the nodes of a grid near which something is visible, by cubic convolution at the voxels, and is trilinear in between.
    Along a ray extinction is constant in each of `samples` segments, whose integral is exact: what is homogeneous has no error of the
    quadrature.

    **Arguments:**

    - `rays`: `K`, for each node, on a spiral of equal areas, the same at all nodes.
    - `radius`, `offset`: `R` and `a`, world lengths, not negative; by default 16 and 1 times the smallest spacing. With `radius` no larger
      than `offset` nothing is occluded, which is the limit of ever smaller balls.
    - `samples`: segments along each ray.
    - `resolution`: nodes for each voxel along an axis, above 0 and at most 1.
    - `bias`: 0 ... 1; `gamma`: positive, or `None` for 1.

    Differentiable in transfer function, voxels, `radius`, `offset`, `bias` and `gamma` while it is not computed beforehand; then each
    picture does it anew. `jvr.precompute(scene)` does it once and keeps `I`, which is then a constant: `bias`, `gamma`, camera and lights
    may change, what it was made of may not, unless it is `pinned()`. Costs `rays x samples` samples for each node. **Raises** `ValueError`
    for numbers outside their ranges.
    """

    rays: int = choice(AT_LEAST_ONE, doc="rays for each node")
    radius: Scalar | None = parameter(NOT_NEGATIVE, doc="of the ball that rays see", unit="mm")
    offset: Scalar | None = parameter(NOT_NEGATIVE, doc="how far from a point its rays begin", unit="mm")
    samples: int = choice(AT_LEAST_ONE, doc="segments along each ray")
    resolution: float = choice(Interval(0.0, 1.0, "(]"), doc="nodes for each voxel along an axis", hint="0.5 is a good start")
    bias: Scalar = parameter(UNIT_INTERVAL, doc="share of ambient light that nothing takes away")
    gamma: Scalar | None = parameter(POSITIVE, doc="exponent of what is left of ambient light")
    projected: ProjectedOcclusion | None = parameter(doc="what has been computed beforehand")

    def __init__(
        self,
        rays: int = 32,
        *,
        radius: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        samples: int = 16,
        resolution: float | int = 0.5,
        bias: ArrayLike = 0.0,
        gamma: ArrayLike | None = None,
    ):
        assign(self, rays=rays, radius=radius, offset=offset, samples=samples, resolution=resolution, bias=bias, gamma=gamma)
        self.projected = None

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        # Of what has been computed beforehand nothing can be saved.
        if self.is_frozen:
            return ()
        return (
            multiples("rays", self.rays, (1 / 4, 1 / 2, 1), 4, least=1),
            multiples("samples", self.samples, (1 / 4, 1 / 2, 1), 2, least=1),
            multiples("resolution", self.resolution, (1 / 2, 1), 2, most=1.0),
        )

    @property
    def stale_message(self) -> str:
        return stale_message(
            "occlusion", "occlusion", "transfer function, volume, clipping box, radius, offset or presence of surfaces"
        )

    def sources(self, scene: Scene) -> Any:
        volume, graded = scene.volume, scene.transfer.takes_gradient
        parts = [volume.values, volume.gaps, volume.slope, volume.intercept, volume.world_from_grid, volume.interpolation]
        # Where there are surfaces, nodes away from the visible medium are computed, too.
        parts.append(np.array([scene.surfaces is not None]))
        return parts, scene.transfer, scene.clipping, scene.normals if graded else None, self.radius, self.offset

    def projection(self, scene: Scene, path: LightPath) -> "OcclusionProjection":
        return OcclusionProjection(
            volume=scene.volume,
            clipping=scene.clipping,
            medium=seen_around(scene, path(scene.transfer.takes_gradient)),
            reach=Reach.of(self, scene.volume),
            rays=self.rays,
            resolution=self.resolution,
        )

    def finished(self, scene: Scene, *nodes: Any) -> ProjectedOcclusion:
        return ProjectedOcclusion(self._taken(scene.volume, *nodes), jnp.asarray(self.cache_key(scene)))

    def visibility(self, scene: Scene, path: LightPath) -> "OcclusionVisibility":
        kept = self.projected
        taken = self._taken(scene.volume, *_all_nodes(self.projection(scene, path))) if kept is None else kept.taken
        return occlusion_visibility(self, scene.volume, taken)

    def _taken(self, volume: Volume, nodes: Float[Array, "nodes channels"]) -> Float[Array, "x y z channels"]:
        """What all nodes take of ambient light, on the grid of the voxels: straight lines between nodes would let light into whatever is
        not much thicker than they are apart."""
        coarse = nodes.reshape(*node_shape(volume, self.resolution), -1)
        return jnp.clip(resampled_cubic(coarse, volume.shape), 0.0, 1.0)


class OcclusionVisibility(AbstractVisibility):
    """What arrives of ambient light, `(bias + (1 - bias) I)^gamma`. `grid`: nodes that hold `1 - I`."""

    grid: Grid
    bias: Scalar
    gamma: Scalar | None
    scale: tuple[float, float, float] = eqx.field(static=True)

    def transmittances(self, points: Point, wanted: Any, *, reverse: bool) -> Transmittances:
        at = tuple(c * f for c, f in zip(points.p, self.scale, strict=True))
        left = (1 - (1 - self.bias) * taken for taken in self.grid.interpolate(at, wanted))
        return Transmittances(ambient=tuple(x if self.gamma is None else jnp.power(x, self.gamma) for x in left))

    @property
    def stats(self) -> None:
        return None


def occlusion_visibility(occlusion: Any, volume: Volume, taken: Float[Array, "x y z channels"]) -> OcclusionVisibility:
    """Where nodes take so much of ambient light, what is left of it by the `bias` and `gamma` of an occlusion."""
    x, y, z = taken.shape[:3]
    return OcclusionVisibility(Grid.of(taken), occlusion.bias, occlusion.gamma, nodes_for_each_voxel(volume, (x, y, z)))


class Reach(eqx.Module):
    """How far rays go. `ends`: of their segments, distances from where they begin, all the same where there is nothing between `offset` and
    `radius` of an occlusion; `length`: from the one to the other; `beyond`: the fraction of it that lies behind the last segment, out of
    the volume, which no ray is longer than."""

    ends: Float[Array, "ends"]
    length: Scalar
    beyond: Scalar

    @classmethod
    def of(cls, occlusion: Any, volume: Volume) -> "Reach":
        spacing = jnp.min(volume.spacing)
        offset = OFFSET * spacing if occlusion.offset is None else occlusion.offset
        radius = RADIUS * spacing if occlusion.radius is None else occlusion.radius
        length = larger(radius - offset, 0.0)
        inside = clamp(2 * volume.radius - offset, jnp.zeros_like(length), length)
        ends = offset + inside * jnp.linspace(0.0, 1.0, occlusion.samples + 1, dtype=spacing.dtype)
        return cls(ends, length, divide_or_zero(length - inside, length))


class OcclusionProjection(AbstractProjection):
    """All that the nodes of a scene are computed with, `rays` rays from each."""

    # As far as a cubic convolution reads.
    reach_of_nodes: ClassVar[int] = 2

    volume: Volume
    clipping: Clipping
    medium: Medium
    reach: Reach
    rays: int = eqx.field(static=True)
    resolution: float = eqx.field(static=True)

    @property
    def shape(self) -> Shape:
        return node_shape(self.volume, self.resolution)

    def project(self, p: Float[Array, "nodes 3"]) -> tuple[Float[Array, "nodes channels"]]:
        """`1 - I` at grid positions."""

        # Checkpointed: the reverse pass knows the nodes, and marches their rays again rather than keep them all.
        @jax.checkpoint
        def taken(projection: "OcclusionProjection", p: Float[Array, "nodes 3"]) -> Float[Array, "nodes channels"]:
            rays = short_rays(projection.volume, projection.clipping, projection.rays, p)
            means = _mean_transmittances(projection, rays)
            return 1 - jnp.stack([jnp.mean(mean.reshape(p.shape[0], -1), axis=1) for mean in means], axis=-1)

        return (taken(self, p),)


def short_rays(volume: Volume, clipping: Clipping, number: int, p: Float[Array, "nodes 3"]) -> SecondaryRays:
    """A `number` of rays from each of some grid positions in all directions, those of a position one after the other."""
    dtype = volume.slope.dtype
    origin = tuple(jnp.repeat(c.astype(dtype), number) for c in p.T)
    along = tuple(jnp.tile(jnp.asarray(d, dtype), p.shape[0]) for d in _sphere(number).T)
    grid = origin, volume.grid_from_world(along, direction=True)
    return secondary_rays(volume, clipping, (volume.world_from_point(origin), along), grid)


def _sphere(rays: int) -> Float[np.ndarray, "rays 3"]:
    """Unit directions on a spiral of equal areas."""
    index = np.arange(rays)
    cosine = 1 - (2 * index + 1) / rays
    sine = np.sqrt((1 - cosine) * (1 + cosine))
    return np.stack([sine * np.cos(GOLDEN * index), sine * np.sin(GOLDEN * index), cosine], axis=1)


def _mean_transmittances(projection: OcclusionProjection, rays: SecondaryRays) -> Channels:
    """The mean transmittance of each ray over its length."""
    volume, medium, reach = projection.volume, projection.medium, projection.reach

    def step(state: tuple[Channels, Channels], ends: tuple[Scalar, Scalar]) -> tuple[tuple[Channels, Channels], None]:
        tau, total = state
        begin, end = ends
        dtau, _, _ = take_midpoint(medium, volume, rays, begin, end, True)
        before, inside = fractions_inside(rays, begin, end)
        behind = 1 - before - inside
        seen = (
            jnp.exp(-t) * (before + inside * mean_transmittance(d) + behind * jnp.exp(-d)) for t, d in zip(tau, dtau, strict=True)
        )
        total = tuple(a + b for a, b in zip(total, seen, strict=True))
        return (tuple(t + d for t, d in zip(tau, dtau, strict=True)), total), None

    zero = (jnp.zeros_like(rays.t_out),) * channel_count(medium, volume, rays)
    (tau, total), _ = jax.lax.scan(jax.checkpoint(step), (zero, zero), (reach.ends[:-1], reach.ends[1:]))
    segments = reach.ends.shape[0] - 1
    return tuple((1 - reach.beyond) * c / segments + reach.beyond * jnp.exp(-t) for c, t in zip(total, tau, strict=True))


def fractions_inside(rays: SecondaryRays, begin: Scalar, end: Scalar) -> tuple[Float[Array, "rays"], Float[Array, "rays"]]:
    """What of a segment of each ray lies before the medium, and in it."""
    enters, leaves = clamp(rays.t_in, begin, end), clamp(rays.t_out, begin, end)
    length = jnp.broadcast_to(end - begin, enters.shape)
    return divide_or_zero(enters - begin, length), divide_or_zero(larger(leaves - enters, 0.0), length)


@jax.custom_jvp
def _all_nodes(projection: OcclusionProjection) -> tuple[Array, ...]:
    """What the active nodes of a scene hold. Where it is differentiated all of them do: what is not visible may become so, and has a
    derivative in the light that reaches it."""
    return projection.all_nodes()


def _all_nodes_rule(primals: Any, tangents: Any) -> tuple[Any, Any]:
    tangents = perturbed(primals, tangents)
    moving, still = eqx.partition(primals, jax.tree.map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None))

    def whole(moving: Any) -> tuple[Array, ...]:
        (projection,) = eqx.combine(moving, still)
        return project_all(projection, jnp.ones(math.prod(projection.shape), bool))

    return jax.jvp(whole, (moving,), (tangents,))


_all_nodes.defjvp(_all_nodes_rule, symbolic_zeros=True)
