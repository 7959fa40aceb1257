"""Local ambient occlusion: how much of the ambient light the medium near a point takes away (Hernell, Ljung and Ynnerman, "Local ambient
occlusion in direct volume rendering", IEEE TVCG 16(4), 2010; course notes on GPU-based volume ray-casting, Eurographics 2009,
section 6.1).
"""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from jvr.effects.grid import Grid
from jvr.effects.nodes import AbstractProjection, seen_around, surfaces_of, visible_nodes
from jvr.effects.short_rays import Reach, knobs_of_rays, mean_light, short_rays, sources_of_rays
from jvr.march.medium import AbstractVisibility, LightPath, Medium
from jvr.march.steps import Point, Transmittances
from jvr.model.clipping import Clipping
from jvr.model.effects import AbstractNodeOcclusion, stale_message
from jvr.model.grids import Shape, node_shape, nodes_for_each_voxel, resampled_cubic
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import Knob, multiples
from jvr.model.ranges import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, UNIT_INTERVAL, Interval
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import larger
from jvr.types import ArrayLike, Scalar

# Voxels at most of which each is a node where a scene says no resolution.
NODES = 2**19
# What is left of ambient light where all of it is taken, for the sake of derivatives.
DARKEST = 1e-6


class ProjectedOcclusion(eqx.Module):
    """Occlusion as it was computed, on the grid of the voxels.

    - `darkness`: `(x, y, z, 1)`, or `(x, y, z, 3)` for coloured extinction: `1 - sqrt(I)`, which is also 0 where nothing is visible and
      nothing was computed.
    - `cache_key`: checksums of what it was made of (`jvr.model.kept.content`).
    - `pinned`: whether it stays as it is although the scene is another.
    """

    darkness: Float[Array, "x y z channels"]
    cache_key: UInt32[Array, "parts 2"]
    pinned: bool = eqx.field(static=True, default=False)


class LocalOcclusion(AbstractNodeOcclusion):
    """Local ambient occlusion: the mean over directions of the light that is scattered to a point from within a ball around it.

        I(x) = 1 / K sum_k 1 / (R - a) integral_a^R exp(-integral_a^s sigma_t du) ds        (notes, equations 6.1 and 6.3)

    along `K` rays from `x`, so that shadows fade in with distance. Ambient light is multiplied with `(bias + (1 - bias) I)^gamma`, which
    is 1 where nothing is near and `bias^gamma` where everything is opaque (equation 6.4 has `(bias + I)^gamma`, which exceeds 1).
    Coloured extinction has an `I` for each channel. Where the volume or its clipping box ends there is nothing more.

    With a `glow` the medium lights what is near it by its emission (emissive tissue, equation 6.5): the integrand of each colour is
    multiplied with `1 + c_E(s)`, `c_E` being `glow` times the emission that the transfer function names, and `I` may exceed 1. It is the
    radiance that arrives where `glow = (R - a) / L` under ambient radiance `L`, of which it is a multiple: without ambient light nothing
    glows.

    `I` is found at the nodes of a grid near which something is visible, by cubic convolution at the voxels, and its root is trilinear in
    between: `I` falls into what is opaque ever more slowly, and straight lines between its values let light in.
    Along a ray extinction is constant in each of `samples` segments, whose integral is exact: what is homogeneous has no error of the
    quadrature.

    **Arguments:**

    - `rays`: `K`, for each node, on a spiral of equal areas, the same at all nodes.
    - `radius`, `offset`: `R` and `a`, world lengths, not negative; by default 16 and 1 times the smallest spacing. With `radius` no larger
      than `offset` nothing is occluded, which is the limit of ever smaller balls.
    - `samples`: segments along each ray.
    - `resolution`: nodes for each voxel along an axis, above 0 and at most 1. `None`: 1 in volumes of at most 2^19 voxels, which may be few
      across what is in them, and 0.5 in others.
    - `bias`: 0 ... 1; `gamma`: positive, or `None` for 1.
    - `glow`: not negative, or `None` where nothing does.

    Differentiable in transfer function, voxels, `radius`, `offset`, `bias`, `gamma` and `glow` while it is not computed beforehand; then
    each picture does it anew. `jvr.precompute(scene)` does it once and keeps `I`, which is then a constant: `bias`, `gamma`, camera and
    lights may change, what it was made of may not, unless it is `pinned()`. Costs `rays x samples` samples for each node. **Raises**
    `ValueError` for numbers outside their ranges, and for a `glow` without emission.
    """

    rays: int = choice(AT_LEAST_ONE, doc="rays for each node")
    radius: Scalar | None = parameter(NOT_NEGATIVE, doc="of the ball that rays see", unit="mm")
    offset: Scalar | None = parameter(NOT_NEGATIVE, doc="how far from a point its rays begin", unit="mm")
    samples: int = choice(AT_LEAST_ONE, doc="segments along each ray")
    resolution: float | None = choice(
        Interval(0.0, 1.0, "(]"), doc="nodes for each voxel along an axis", hint="0.5 is a good start"
    )
    bias: Scalar = parameter(UNIT_INTERVAL, doc="share of ambient light that nothing takes away")
    gamma: Scalar | None = parameter(POSITIVE, doc="exponent of what is left of ambient light")
    glow: Scalar | None = parameter(
        NOT_NEGATIVE, doc="light of its own that the medium sends to what is near", unit="mm / radiance"
    )
    projected: ProjectedOcclusion | None = parameter(doc="what has been computed beforehand")

    def __init__(
        self,
        rays: int = 32,
        *,
        radius: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        samples: int = 16,
        resolution: float | int | None = None,
        bias: ArrayLike = 0.0,
        gamma: ArrayLike | None = None,
        glow: ArrayLike | None = None,
    ):
        assign(self, rays=rays, radius=radius, offset=offset, samples=samples, resolution=resolution, bias=bias, gamma=gamma)
        assign(self, glow=glow)
        self.projected = None

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        return knobs_of_rays(self, resolutions(self, scene.volume))

    @property
    def stale_message(self) -> str:
        return stale_message(
            "occlusion", "occlusion", "transfer function, volume, clipping box, radius, offset, glow or presence of surfaces"
        )

    def sources(self, scene: Scene) -> Any:
        return *sources_of_rays(scene), surfaces_of(scene), self.radius, self.offset, self.glow

    def projection(self, scene: Scene, path: LightPath) -> "OcclusionProjection":
        return OcclusionProjection(
            volume=scene.volume,
            clipping=scene.clipping,
            medium=seen_around(scene, path(scene.transfer.takes_gradient)),
            reach=Reach.of(self, scene.volume),
            glow=self.glow,
            rays=self.rays,
            nodes_along=nodes_along(self.resolution, scene.volume),
        )

    def finished(self, scene: Scene, projection: "OcclusionProjection", *nodes: Any) -> ProjectedOcclusion:
        coarse = nodes[0].reshape(*projection.shape, -1)
        # What glows may bring more light than there was.
        least = 0.0 if self.glow is None else -jnp.inf
        return ProjectedOcclusion(darkness_at_voxels(coarse, scene.volume, least), jnp.asarray(self.cache_key(scene)))

    def visibility(self, scene: Scene, path: LightPath) -> "OcclusionVisibility":
        kept = self.projected
        if kept is None:
            projection = self.projection(scene, path)
            kept = self.finished(scene, projection, *visible_nodes(projection))
        return occlusion_visibility(self, scene.volume, kept.darkness)


class OcclusionVisibility(AbstractVisibility):
    """What arrives of ambient light, `(bias + (1 - bias) I)^gamma`. `grid`: nodes that hold `1 - sqrt(I)`."""

    grid: Grid
    bias: Scalar
    gamma: Scalar | None
    scale: tuple[float, float, float] = eqx.field(static=True)

    def transmittances(self, points: Point, wanted: Any, *, reverse: bool) -> Transmittances:
        at = tuple(c * f for c, f in zip(points.p, self.scale, strict=True))
        left = (self.bias + (1 - self.bias) * jnp.square(1 - dark) for dark in self.grid.interpolate(at, wanted))
        return Transmittances(ambient=tuple(x if self.gamma is None else jnp.power(x, self.gamma) for x in left))

    @property
    def stats(self) -> None:
        return None


def occlusion_visibility(occlusion: Any, volume: Volume, darkness: Float[Array, "x y z channels"]) -> OcclusionVisibility:
    """What a grid of `1 - sqrt(I)` leaves of ambient light, by the `bias` and `gamma` of an occlusion."""
    x, y, z = darkness.shape[:3]
    return OcclusionVisibility(Grid.of(darkness), occlusion.bias, occlusion.gamma, nodes_for_each_voxel(volume, (x, y, z)))


def darkness_at_voxels(
    taken: Float[Array, "x y z channels"], volume: Volume, least: float = 0.0
) -> Float[Array, "x2 y2 z2 channels"]:
    """`1 - sqrt(I)` on the grid of the voxels, of nodes that hold `1 - I`, at `least` and at most 1."""
    left = 1 - jnp.clip(resampled_cubic(taken, volume.shape), least, 1.0)
    # The slope of a root at zero is infinite.
    return 1 - jnp.sqrt(larger(left, DARKEST))


def nodes_along(resolution: float | None, volume: Volume) -> Shape:
    """Nodes along each axis, for a resolution or none."""
    return node_shape(volume, resolution_for(resolution, volume))


def resolution_for(resolution: float | None, volume: Volume) -> float:
    """Nodes for each voxel along an axis, for a resolution or none."""
    if resolution is not None:
        return resolution
    return 1.0 if math.prod(volume.shape) <= NODES else 0.5


def resolutions(part: Any, volume: Volume) -> Knob:
    """The knob of a part's resolution, chosen or not."""
    return multiples("resolution", resolution_for(part.resolution, volume), (1 / 2, 1), 2, most=1.0)


class OcclusionProjection(AbstractProjection):
    """All that the nodes of a scene are computed with, `rays` rays from each."""

    # As far as a cubic convolution reads.
    reach_of_nodes: ClassVar[int] = 2

    volume: Volume
    clipping: Clipping
    medium: Medium
    reach: Reach
    glow: Scalar | None
    rays: int = eqx.field(static=True)
    nodes_along: Shape = eqx.field(static=True)

    @property
    def shape(self) -> Shape:
        return self.nodes_along

    def project(self, p: Float[Array, "nodes 3"]) -> tuple[Float[Array, "nodes channels"]]:
        """`1 - I` at grid positions."""

        # Checkpointed: the reverse pass knows the nodes, and marches their rays again rather than keep them all.
        @jax.checkpoint
        def taken(projection: "OcclusionProjection", p: Float[Array, "nodes 3"]) -> Float[Array, "nodes channels"]:
            rays = short_rays(projection.volume, projection.clipping, projection.rays, p)
            means = mean_light(projection.medium, projection.volume, projection.reach, rays, glow=projection.glow)
            return 1 - jnp.stack([jnp.mean(mean.reshape(p.shape[0], -1), axis=1) for mean in means], axis=-1)

        return (taken(self, p),)
