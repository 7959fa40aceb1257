"""First-order in-scattering: the light of lamps that the medium near a point scatters to it (Hernell, Ljung and Ynnerman, "Interactive
global light propagation in direct volume rendering using local piecewise integration", Volume and Point-Based Graphics 2008; course notes
on GPU-based volume ray-casting, Eurographics 2009, section 6.1.3).
"""

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32

from jvr.effects.grid import Grid
from jvr.effects.nodes import AbstractProjection, project_all, seen_around, surfaces_of, visible_nodes
from jvr.effects.occlusion import resolution_for, resolutions
from jvr.effects.piecewise_shadows import PiecewiseShadows
from jvr.effects.short_rays import Reach, knobs_of_rays, mean_light, short_rays, sources_of_rays
from jvr.march.medium import AbstractVisibility, LightPath, Medium
from jvr.march.secondary import points as points_of
from jvr.march.steps import Point, Transmittances
from jvr.model.clipping import Clipping
from jvr.model.effects import AbstractPrecomputable, AbstractShadows, stale_message
from jvr.model.grids import Shape, fractions_at_voxels, node_shape, nodes_for_each_voxel
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import Knob
from jvr.model.ranges import AT_LEAST_ONE, NOT_NEGATIVE, UNIT_INTERVAL, Interval
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.types import ArrayLike, Channels, Scalar, Triple


class ProjectedInScattering(eqx.Module):
    """In-scattering as it was computed, on the grid of the voxels.

    - `taken`: `(x, y, z, channels)`: `1 - I` of each light that casts shadows, one or three channels of the first, then of the next; also 0
      where nothing is visible and nothing was computed.
    - `cache_key`: checksums of what it was made of (`jvr.model.kept.content`).
    - `pinned`: whether it stays as it is although the scene is another.
    """

    taken: Float[Array, "x y z channels"]
    cache_key: UInt32[Array, "parts 2"]
    pinned: bool = eqx.field(static=True, default=False)


class InScattering(AbstractPrecomputable, AbstractShadows):
    """First-order in-scattering: shadows that are soft, since light reaches a point from the lit medium around it.

        I(x) = 1 / K sum_k 1 / (R - a) integral_a^R T(x + s w_k) exp(-integral_a^s sigma_t du) ds,

    the mean over `K` directions `w_k` of what is scattered to `x` from within a ball, where the transmittance to each light is `T`, by any
    other method: `jvr.LocalOcclusion` with the light of lamps in place of ambient light. Each light that casts shadows is multiplied with
    `bias + (1 - bias) I`, its least being `bias`.

    `T` is found at the nodes of a grid and is trilinear in between, outside of the volume that on its border; `I` at the same nodes where
    something is visible near by, by cubic convolution at the voxels, trilinear in between. Where `R` and `a` are 0 it is `T`.

    **Arguments:**

    - `rays`, `radius`, `offset`, `samples`, `resolution`: `K`, `R`, `a`, segments along each ray and nodes for each voxel, as of
      `jvr.LocalOcclusion`, and with its defaults.
    - `bias`: 0 ... 1.
    - `direct`: how light gets to where it is scattered: `jvr.PiecewiseShadows()`, or another way of shadows.

    Differentiable in transfer function, voxels, lights, `radius`, `offset` and `bias`, in what `direct` is differentiable in, while it is
    not computed beforehand. `jvr.precompute(scene)` does it once and keeps `I`, which is then a constant: `bias` and camera may change,
    what it was made of, lights among it, may not, unless it is `pinned()`. Costs `direct` at each node, and `rays x samples` samples.
    **Raises** `ValueError` for numbers outside their ranges, and for a `direct` that is in-scattering itself.
    """

    rays: int = choice(AT_LEAST_ONE, doc="rays for each node")
    radius: Scalar | None = parameter(NOT_NEGATIVE, doc="of the ball that light is scattered in", unit="mm")
    offset: Scalar | None = parameter(NOT_NEGATIVE, doc="how far from a point its rays begin", unit="mm")
    samples: int = choice(AT_LEAST_ONE, doc="segments along each ray")
    resolution: float | None = choice(
        Interval(0.0, 1.0, "(]"), doc="nodes for each voxel along an axis", hint="0.5 is a good start"
    )
    bias: Scalar = parameter(UNIT_INTERVAL, doc="share of light that nothing takes away")
    direct: AbstractShadows = parameter(doc="a way of shadows such as jvr.PiecewiseShadows()")
    projected: ProjectedInScattering | None = parameter(doc="what has been computed beforehand")

    needs: ClassVar[tuple[str, ...]] = ("light march", "short rays")

    def __init__(
        self,
        rays: int = 32,
        *,
        radius: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        samples: int = 16,
        resolution: float | int | None = None,
        bias: ArrayLike = 0.0,
        direct: AbstractShadows = PiecewiseShadows(),
    ):
        assign(self, rays=rays, radius=radius, offset=offset, samples=samples, resolution=resolution, bias=bias, direct=direct)
        if isinstance(direct, InScattering):
            raise ValueError("in-scattering is of first order: set direct=jvr.PiecewiseShadows() or another way of shadows")
        self.projected = None

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        return knobs_of_rays(self, resolutions(self, scene.volume))

    @property
    def stale_message(self) -> str:
        return stale_message(
            "in-scattering",
            "shadows",
            "light, transfer function, volume, clipping box, geometry, radius, offset or presence of surfaces",
        )

    def sources(self, scene: Scene) -> Any:
        lit = scene.shadow_casters, scene.light_blocker, self.direct
        return *sources_of_rays(scene), surfaces_of(scene), *lit, self.radius, self.offset

    def projection(self, scene: Scene, path: LightPath) -> "InScatteringProjection":
        volume, resolution = scene.volume, resolution_for(self.resolution, scene.volume)
        medium = path(scene.transfer.takes_gradient)
        # Rays read the light also where nothing is visible, up to the ball's radius away from what is.
        everywhere: LightPath = lambda takes_gradient: path(takes_gradient)._replace(occupancy=None)
        incident = IncidentProjection(
            volume=volume,
            medium=medium,
            visibility=self.direct.visibility(scene, everywhere),
            resolution=resolution,
        )
        (found,) = project_all(incident, jnp.ones(len(incident.positions), bool))
        return InScatteringProjection(
            volume=volume,
            clipping=scene.clipping,
            medium=seen_around(scene, medium),
            reach=Reach.of(self, volume),
            incident=Grid.of(found.reshape(*incident.shape, -1)),
            lights=sum(light is not None for light in scene.shadow_casters),
            rays=self.rays,
            resolution=resolution,
        )

    def finished(self, scene: Scene, projection: Any, *nodes: Any) -> ProjectedInScattering:
        return ProjectedInScattering(self._taken(scene.volume, *nodes), jnp.asarray(self.cache_key(scene)))

    def visibility(self, scene: Scene, path: LightPath) -> "InScatteringVisibility":
        kept = self.projected
        taken = self._taken(scene.volume, *visible_nodes(self.projection(scene, path))) if kept is None else kept.taken
        x, y, z = taken.shape[:3]
        casts = tuple(light is not None for light in scene.shadow_casters)
        return InScatteringVisibility(Grid.of(taken), self.bias, casts, nodes_for_each_voxel(scene.volume, (x, y, z)))

    def _taken(self, volume: Volume, nodes: Float[Array, "nodes channels"]) -> Float[Array, "x y z channels"]:
        return fractions_at_voxels(volume, nodes, resolution_for(self.resolution, volume))


class InScatteringVisibility(AbstractVisibility):
    """What reaches a point of the lights that cast shadows. `grid`: nodes that hold `1 - I` of each, one after the other; `casts`: which of
    the scene's lights do."""

    grid: Grid
    bias: Scalar
    casts: tuple[bool, ...] = eqx.field(static=True)
    scale: tuple[float, float, float] = eqx.field(static=True)

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        at = tuple(c * f for c, f in zip(points.p, self.scale, strict=True))
        left = [1 - (1 - self.bias) * taken for taken in self.grid.interpolate(at, wanted)]
        channels, lights = len(left) // sum(self.casts), iter(range(sum(self.casts)))
        of = lambda light: tuple(left[light * channels : (light + 1) * channels])
        return Transmittances(tuple(of(next(lights)) if casts else () for casts in self.casts))

    @property
    def stats(self) -> None:
        return None


class IncidentProjection(AbstractProjection):
    """What of each light reaches the nodes of a scene: `visibility` there."""

    # Shadow rays of many nodes are marched together.
    chunk: ClassVar[int] = 4096

    volume: Volume
    medium: Medium
    visibility: AbstractVisibility
    resolution: float = eqx.field(static=True)

    @property
    def shape(self) -> Shape:
        return node_shape(self.volume, self.resolution)

    def project(self, p: Float[Array, "nodes 3"]) -> tuple[Float[Array, "nodes channels"]]:
        """The channels of the first light, then of the next."""
        at = tuple(c.astype(self.volume.slope.dtype) for c in p.T)
        lights = self.visibility.transmittances(points_of(at, at), jnp.ones(p.shape[0], bool), reverse=True).lights
        return (jnp.stack([channel for light in lights for channel in light], axis=-1),)


class InScatteringProjection(AbstractProjection):
    """All that the nodes of a scene are computed with, `rays` rays from each. `incident`: what of each of the
    `lights` reaches the nodes."""

    # As far as a cubic convolution reads.
    reach_of_nodes: ClassVar[int] = 2

    volume: Volume
    clipping: Clipping
    medium: Medium
    reach: Reach
    incident: Grid
    lights: int = eqx.field(static=True)
    rays: int = eqx.field(static=True)
    resolution: float = eqx.field(static=True)

    @property
    def shape(self) -> Shape:
        return node_shape(self.volume, self.resolution)

    def project(self, p: Float[Array, "nodes 3"]) -> tuple[Float[Array, "nodes channels"]]:
        """`1 - I` at grid positions."""

        # Checkpointed: the reverse pass knows the nodes, and marches their rays again rather than keep them all.
        @jax.checkpoint
        def taken(projection: "InScatteringProjection", p: Float[Array, "nodes 3"]) -> Float[Array, "nodes channels"]:
            volume, clipping, reach = projection.volume, projection.clipping, projection.reach
            rays, scale = short_rays(volume, clipping, projection.rays, p), nodes_for_each_voxel(volume, projection.shape)

            def lights(at: Triple) -> list[Channels]:
                scaled = tuple(c * f for c, f in zip(at, scale, strict=True))
                found = projection.incident.interpolate(scaled, jnp.ones(at[0].shape, bool))
                n = len(found) // projection.lights
                return [found[i : i + n] for i in range(0, len(found), n)]

            means = mean_light(projection.medium, volume, reach, rays, lights=lights)
            return 1 - jnp.stack([jnp.mean(mean.reshape(p.shape[0], -1), axis=1) for mean in means], axis=-1)

        return (taken(self, p),)
