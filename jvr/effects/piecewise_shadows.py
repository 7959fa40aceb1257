"""Shadows in two pieces: what is near a sample exactly, what is beyond from a coarse grid (course notes on GPU-based volume ray-casting,
Eurographics 2009, section 6.1.3).
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.grid import Grid
from jvr.effects.nodes import AbstractProjection, seen_around, visible_nodes
from jvr.effects.shadow_rays import RayVisibility, ways_to
from jvr.march.march import MarchOptions
from jvr.march.medium import AbstractVisibility, LightPath, Medium
from jvr.march.secondary import points as points_of
from jvr.march.segments import classify_at
from jvr.march.steps import Point, Transmittances
from jvr.model.clipping import Clipping
from jvr.model.effects import AbstractShadows
from jvr.model.grids import Shape, node_shape, nodes_for_each_voxel
from jvr.model.light import AbstractDeltaLight
from jvr.model.parameters import assign, choice
from jvr.model.parts import Knob, multiples
from jvr.model.ranges import NOT_NEGATIVE, Interval
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import larger, rounded_into, smaller
from jvr.types import Channels, Scalar

# Length of a step along the near piece, in voxels of the smallest spacing.
STEP = 1.0
# How far from a corner of the volume a line is taken to touch it, in voxels of the smallest spacing.
TOUCHING = 1e-3


class PiecewiseShadows(AbstractShadows):
    """Piecewise shadows: an exact piece towards the light at every sample, and a coarse grid for what is beyond it.

        T(x) = exp(-integral_0^h sigma_t(x + u l) du) sum_i w_i exp(-m_i (D(x) - h)),        m_i = 1 / (D_i - h) integral_h^D_i sigma_t du

    with the unit direction `l` to the light, the length `D` of the way to it inside of the medium, and the trilinear weights `w_i` of the
    nodes around `x`. (The notes multiply transmittances of pieces of length `h` for each node, which are one integral, and interpolate
    the product one piece further on; nodes here hold the mean extinction of all pieces but the first, and so are right in a homogeneous
    medium, however far apart they are, and as right as transmittances behind what is opaque.) What shades a point from nearby is therefore
    exact, and shadows of what is far are blurred by the distance between nodes; the error falls with the square of it in smooth scenes.

    **Arguments:** `piece`: the length `h` in voxels of the smallest spacing, not negative; 0 leaves the grid alone. `resolution`: nodes for
    each voxel along an axis, above 0 and at most 1. The near piece is sampled every voxel, what is beyond every two voxels or less.

    Nodes are those of the volume, whatever the light, and only those near which something is visible are computed. For all lights that
    cast shadows; geometry throws exact ones. Differentiable in transfer function, voxels, lights and pose. Costs `piece` samples for each
    sample of the picture and light, and half of the voxels of the volume's diagonal for each node and light, in each picture.
    """

    piece: float = choice(NOT_NEGATIVE, doc="length that is exact", unit="voxels of the smallest spacing")
    resolution: float = choice(Interval(0.0, 1.0, "(]"), doc="nodes for each voxel along an axis", hint="0.25 is a good start")

    def __init__(self, piece: float | int = 8, resolution: float | int = 1 / 4):
        assign(self, piece=piece, resolution=resolution)

    def visibility(self, scene: Scene, path: LightPath) -> "PiecewiseVisibility":
        volume, medium, lights = scene.volume, path(scene.transfer.takes_gradient), scene.shadow_casters
        spacing, options = jnp.min(volume.spacing), MarchOptions(0.0, distance=False)
        reach = self.piece * spacing
        near = RayVisibility(scene.clipping, lights, medium, STEP * spacing, options, scene.light_blocker, reach)
        casting = tuple(light for light in lights if light is not None)
        samples = math.ceil(math.sqrt(sum((n - 1) ** 2 for n in volume.shape)) / 2)
        beyond = BeyondProjection(
            volume=volume,
            clipping=scene.clipping,
            medium=seen_around(scene, medium),
            lights=casting,
            reach=reach,
            samples=max(samples, 1),
            resolution=self.resolution,
        )
        shape = beyond.shape
        grids = iter(Grid.of(nodes.reshape(*shape, -1)) for nodes in visible_nodes(beyond))
        far = tuple(None if light is None else next(grids) for light in lights)
        return PiecewiseVisibility(near, far, reach, nodes_for_each_voxel(volume, shape))

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        return (
            multiples("piece", self.piece, (1 / 4, 1 / 2, 1, 2), 4),
            multiples("resolution", self.resolution, (1 / 4, 1 / 2, 1, 2), 4, most=1.0),
        )


class PiecewiseVisibility(AbstractVisibility):
    """Visibility by a near piece and, for each light, nodes that hold the mean extinction beyond it, or `None` where nothing shades it.
    `reach`: world length of the near piece."""

    near: RayVisibility
    far: tuple[Grid | None, ...]
    reach: Scalar
    scale: tuple[float, float, float] = eqx.field(static=True)

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        near = self.near.transmittances(points, wanted, reverse=reverse).lights
        at = tuple(c * f for c, f in zip(points.p, self.scale, strict=True))

        def one(light: AbstractDeltaLight | None, grid: Grid | None, close: Channels) -> Channels:
            if light is None or grid is None:
                return ()
            rest = larger(ways_to(light, self.near.volume, self.near.clipping, points.p).end - self.reach, 0.0)
            beyond = grid.interpolate(at, wanted, lambda means: jnp.exp(-means * rest[:, None]))
            return tuple(a * b for a, b in zip(close, beyond, strict=True))

        return Transmittances(tuple(map(one, self.near.lights, self.far, near)))

    @property
    def stats(self) -> None:
        return None


class BeyondProjection(AbstractProjection):
    """All that the nodes of a scene are computed with: the mean extinction on the way to each light, from `reach` on."""

    volume: Volume
    clipping: Clipping
    medium: Medium
    lights: tuple[AbstractDeltaLight, ...]
    reach: Scalar
    samples: int = eqx.field(static=True)
    resolution: float = eqx.field(static=True)

    @property
    def shape(self) -> Shape:
        return node_shape(self.volume, self.resolution)

    def project(self, p: Float[Array, "nodes 3"]) -> tuple[Float[Array, "nodes channels"], ...]:
        # Checkpointed: the reverse pass knows the nodes, and samples their ways again rather than keep all of the voxels.
        @jax.checkpoint
        def means(projection: "BeyondProjection", light: AbstractDeltaLight, p: Float[Array, "nodes 3"]) -> Array:
            return jnp.stack(projection.mean_extinction(light, p), axis=-1)

        return tuple(means(self, light, p) for light in self.lights)

    def mean_extinction(self, light: AbstractDeltaLight, p: Float[Array, "nodes 3"]) -> Channels:
        """At grid positions. Where nothing is left, that where the way ends, its limit."""
        origin = tuple(c.astype(self.reach.dtype) for c in p.T)
        ways = ways_to(light, self.volume, self.clipping, origin)
        # From a node where the volume is cut away the line to the light may leave what is left of it behind the node, or miss it. That
        # from an edge of the volume touches it, by a rounding.
        hit = ways.end >= ways.begin - TOUCHING * jnp.min(self.volume.spacing)
        end = jnp.where(hit, ways.end, 0.0)
        begin = smaller(larger(jnp.where(hit, larger(ways.begin, 0.0), 0.0), self.reach), end)
        fractions = (jnp.arange(self.samples, dtype=end.dtype) + 0.5) / self.samples
        u = (begin + fractions[:, None] * (end - begin)).ravel()
        along = tuple(jnp.tile(d, self.samples) for d in ways.along)
        there = (jnp.tile(c, self.samples) + u * d for c, d in zip(origin, along, strict=True))
        there = tuple(rounded_into(c, first, last) for c, first, last in zip(there, *self.volume.domain, strict=True))
        classified, _ = classify_at(self.medium, points_of(there, along), jnp.ones_like(u, bool))
        return tuple(jnp.where(hit, jnp.mean(s.reshape(self.samples, -1), axis=0), 0.0) for s in classified.sigma_t)
