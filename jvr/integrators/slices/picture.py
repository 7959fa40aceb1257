"""Adaptive sampling: pictures from samples that are far apart where a volume allows it, along the view and across it (Kraus, Strengert,
Klein and Ertl, "Adaptive sampling in three dimensions for volume rendering on GPUs"; `jvr.integrators.slices.march` is the loop)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.integrators.image_plane import ImagePlane, image_plane
from jvr.integrators.slices.adjoint import replay_slices
from jvr.integrators.slices.march import NEVER, Lattice, Sliced, SliceOptions
from jvr.integrators.slices.oracle import AbstractOracle, DistanceField, LocalError, distance_field, thickness
from jvr.march.differentiation import Replay
from jvr.march.quadrature import PreIntegrated
from jvr.march.steps import Rays
from jvr.model.camera import AbstractCamera
from jvr.model.interpolation import Trilinear
from jvr.model.parameters import assign, choice, parameter
from jvr.model.preintegration import PreIntegratedTable
from jvr.model.ranges import Interval
from jvr.model.scene import Scene
from jvr.model.transfer import LinearTransfer, LutTransfer
from jvr.rendering.image import Rendering, RenderStats
from jvr.rendering.integrator import AbstractIntegrator, View
from jvr.rendering.marching import radiance_of
from jvr.rendering.settings import Settings
from jvr.rendering.trace import ahead, enter
from jvr.types import Channels, Scalar

# Bricks across which the oracle is asked to look: a picture whose pixels are larger than that is coarser than the volume anyway.
FARTHEST = 32
UNIFORM = "leave Settings(sampling=...) at jvr.Uniform()"


class SliceStats(eqx.Module):
    """What `Slices` sampled.

    - `samples`: samples of the volume taken on each level of the pyramid, the finest first, `(levels + 1,)`.
    - `full`: slices between entry and end of each pixel, all pixels together: the samples if none is left out. The finest level
      may take one more a pixel, behind its exit.
    """

    samples: Int[Array, "levels"]
    full: Int[Array, ""]


class Slices(AbstractIntegrator):
    """Adaptive sampling on slices across the view, far apart where an oracle allows it, along the view and across it; between them the
    scalar is interpolated, by B-splines across the view and by pre-integration along it (`jvr.integrators.slices`).

    **Arguments:** `oracle`: says how far apart samples may be, within its tolerance: `jvr.LocalError()` (default),
    `jvr.OpacityChange()`, `jvr.BrickRange()`, `jvr.Finest()`, which allows nothing, `jvr.PixelSize()`, which looks at the view as well,
    `jvr.GivenDistances()`, which knows them beforehand, or one of your own. `levels`: samples are at most `2^levels` slices
    and pixels apart, 0 ... 5; 0 leaves none out. **Raises** `ValueError` for levels out of range.

    Samples lie on slices `settings.step` voxels apart, the first where the first ray enters: planes for an orthographic camera, spheres
    around the eye for a perspective one, so that slices are equally far apart along every ray. Where a ray enters and leaves, samples
    are clamped to the volume. With `levels=0` this is `jvr.render` with `jvr.PreIntegrated()` up to where on each ray the slices lie.
    The wanted distance is divided by the larger of the distance between slices and the one between pixels, so a step near the size of
    a pixel saves most.

    Differentiable in all that `jvr.render` is, in reverse mode. Detached: which samples are taken, and where pixels end. `stats.steps`
    counts segments, `stats.sampling` is a `SliceStats`. `settings.tile` and `skipping` play no part: all pixels are in one batch. Memory:
    about 200 bytes a pixel; with derivatives another 100 for each of the `2^levels` slices of a block. A picture **raises** `ValueError`
    for what cannot be rendered: nearest-neighbour volumes, transfer functions that are not tables, light, cameras other than jvr's own,
    adjoints other than `jvr.Replay()`.
    """

    oracle: AbstractOracle = parameter(doc="jvr.LocalError() or another oracle")
    levels: int = choice(Interval(0.0, 5.0), doc="samples are up to 2^levels slices and pixels apart")

    def __init__(self, oracle: AbstractOracle = LocalError(), *, levels: int = 3):
        assign(self, oracle=oracle, levels=levels)

    @property
    def explanation(self) -> str:
        return f"slices, samples up to {2**self.levels} slices and pixels apart where {type(self.oracle).__name__} allows it"

    def picture(self, view: View) -> Rendering:
        return picture_of(view, self)


def picture_of(view: View, sampling: Slices, *, distances: DistanceField | None = None) -> Rendering:
    """The picture of a view, from samples that `sampling` chooses; `distances`: to choose by in place of what its oracle says."""
    scene, camera, settings, dt = view
    table, plane = _table(scene, settings), image_plane(camera, ahead(scene, camera))
    period = 2**sampling.levels
    width, height = (-(-n // period) * period for n in (camera.width, camera.height))
    options = SliceOptions(sampling.levels, width, height, settings.termination, _evaluate_segments)
    lattice, finest, t_in = _lattice(scene, camera, plane, options, dt)
    if distances is None:
        farthest = _farthest(scene, sampling, options, lattice, dt)
        distances = distance_field(sampling.oracle, scene.volume, table, scene.optical, plane, farthest)

    parts = settings.quadrature.parts if isinstance(settings.quadrature, PreIntegrated) else 1
    shading = (PreIntegratedTable(table, parts), scene.optical)
    marched: Any = replay_slices(options, Sliced(scene.volume, shading, lattice, dt, distances))
    gathered, ended, samples = marched

    crop = lambda x: x.reshape(*options.shape(0), *x.shape[1:])[1 : camera.height + 1, 1 : camera.width + 1]
    found = radiance_of(scene, gathered, finest)
    rgb, alpha, depth, steps = jax.tree.map(crop, (found.rgb, found.alpha, found.depth(t_in), found.steps))
    full = jnp.where(lattice.last >= 0, jnp.minimum(ended, lattice.last) - lattice.first + 1, 0)
    return Rendering(rgb, alpha, depth, RenderStats(steps, SliceStats(samples, jnp.sum(full, dtype=jnp.int32))))


def _table(scene: Scene, settings: Settings) -> LinearTransfer | LutTransfer:
    """The transfer function; says what cannot be rendered, rather than leaving it out."""
    if scene.volume.gaps is not None:
        raise ValueError(f"jvr.Slices() interpolates between samples, of which some are missing in this volume: {UNIFORM}")
    if not isinstance(scene.volume.interpolation, Trilinear):
        name = type(scene.volume.interpolation).__name__
        raise ValueError(f"jvr.Slices() interpolates between samples, which {name}() volumes do not allow: {UNIFORM}")
    if scene.shows_light:
        raise ValueError(f"jvr.Slices() does not know light: {UNIFORM}, or take shading and scattering out of the scene")
    if scene.surfaces is not None:
        raise ValueError(f"jvr.Slices() does not know surfaces: {UNIFORM}")
    if scene.geometry is not None:
        raise ValueError(f"jvr.Slices() does not know geometry, at whose edges rays end apart: {UNIFORM}")
    if not isinstance(settings.adjoint, Replay):
        raise ValueError(
            f"jvr.Slices() needs Settings(adjoint=jvr.Replay()), not jvr.{type(settings.adjoint).__name__}(): {UNIFORM}"
        )
    if not isinstance(scene.transfer, LinearTransfer | LutTransfer):
        name = type(scene.transfer).__name__
        raise ValueError(
            f"jvr.Slices() pre-integrates a LinearTransfer or a LutTransfer, not a {name}: tabulate it as a LutTransfer"
        )
    return scene.transfer


def _evaluate_segments(shading: Any, segments: tuple[Array, Array, Array]) -> tuple[Channels, Channels]:
    """Radiance and optical depth of segments along which the scalar changes linearly."""
    table, optical = shading
    return jax.vmap(lambda front, back, length: table.evaluate_segment(optical, front, back, length))(*segments)


def _farthest(scene: Scene, sampling: Slices, options: SliceOptions, lattice: Lattice, dt: Scalar) -> Scalar:
    """How far the oracle has to look for a picture to make use of it."""
    last = jnp.maximum(jnp.max(lattice.last), 0)
    largest = jnp.maximum(dt, lattice.unit + last * lattice.unit_slope)
    across = thickness(scene.volume, sampling.oracle.brick)
    # A sample with twice the largest distance is the coarsest there is.
    return jnp.minimum(2 * options.period * largest, FARTHEST * jnp.minimum(jnp.minimum(across[0], across[1]), across[2]))


def _lattice(
    scene: Scene, camera: AbstractCamera, plane: ImagePlane, options: SliceOptions, dt: Scalar
) -> tuple[Lattice, Rays, Float[Array, "pixels"]]:
    """Where slices cut rays; the rays of the finest level, ring and padding included, and the distance from the eye to their entry."""
    levels = [_level(scene, plane, options, level) for level in range(options.levels + 1)]
    column, row, finest, t_in, _ = levels[0]
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (finest.length > 0)
    far = jnp.finfo(dt.dtype).max
    nearest = jnp.min(jnp.where(inside, t_in, far))
    nearest = jnp.where(nearest < far, nearest, 0.0)

    rays = []
    for _, _, level, _, whole in levels:
        hits = level.length > 0
        t, *whole = whole
        rows = [jnp.where(hits, a, b) for a, b in zip((*level.entry, *level.direction), whole, strict=True)]
        # On slice k the distance from the entry is u = (nearest - t) + k dt: the large numbers cancel once, not on every slice.
        rays.append(jnp.stack([*rows, nearest - t, jnp.where(hits, level.length, far)], axis=1))
    slice_of = lambda u: jax.lax.stop_gradient((u - nearest) / dt)
    first, last = jnp.floor(slice_of(t_in)).astype(jnp.int32), jnp.ceil(slice_of(t_in + finest.length)).astype(jnp.int32)
    apart, spread = plane.size
    unit, unit_slope = jax.lax.stop_gradient((apart + spread * (nearest - plane.ahead), spread * dt))
    lattice = Lattice(tuple(rays), jnp.where(inside, first, NEVER), jnp.where(inside, last, -1), unit, unit_slope)
    return lattice, finest, t_in


def _level(
    scene: Scene, plane: ImagePlane, options: SliceOptions, level: int
) -> tuple[Array, Array, Rays, Array, tuple[Array, ...]]:
    """Column and row of each pixel of a level in units of the finest, its ray inside the volume, the distance to its entry, and the
    whole ray: the distance from the eye to where it starts, its entry if it has one, and in grid coordinates start, then direction."""
    height, width = options.shape(level)
    # Pixel x of a level is centred on 2^l (x + 1/2) - 1/2 (figure 5 of the paper); the ring begins at -1.
    place = lambda n: 2**level * (jnp.arange(n) - 0.5) - 0.5
    row, column = (x.reshape(-1) for x in jnp.meshgrid(place(height), place(width), indexing="ij"))
    origin, direction, behind = plane.rays(column, row)
    rays, t_in = enter(scene, origin, direction, behind, limits=plane.limits(direction))
    along = scene.volume.grid_from_world(direction, direction=True)
    starts = jnp.where(rays.length > 0, t_in, behind)
    return column, row, rays, t_in, (starts, *scene.volume.grid_from_world(origin), *along)
