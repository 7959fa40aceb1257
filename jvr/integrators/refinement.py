"""Progressive refinement: pictures from rays that are far apart where the picture is smooth.

Pixels are visited on grids whose spacing is halved from one to the next. A pixel between those of the grid before is predicted by
bilinear interpolation. All pixels of the first two grids are traced, after that only those next to one whose prediction was wrong by
more than the tolerance; the others keep their prediction. Halving the distance divides the error of a smooth picture by four, so what is
predicted between good predictions is good; a feature that falls between the pixels of the second grid is missed.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.integrators.image_plane import ImagePlane, image_plane
from jvr.model.parameters import assign, choice
from jvr.model.ranges import NOT_NEGATIVE, Interval
from jvr.numerics import divide_or_zero
from jvr.rendering.image import Rendering, RenderStats
from jvr.rendering.integrator import AbstractIntegrator, View
from jvr.rendering.marching import Uniform
from jvr.rendering.medium import Prepared, prepare
from jvr.rendering.trace import ahead, enter

TILES = (2, 4, 8, 16, 32, 64)


class RefinementStats(eqx.Module):
    """What `Refinement` traced: `traced`, the pixels, and `rays`, their number and that of the rays around the picture that its border
    is interpolated from."""

    traced: Bool[Array, "height width"]
    rays: Int[Array, ""]


class Refinement(AbstractIntegrator):
    """Progressive refinement, rays far apart where the picture is smooth: first every `tile`-th and `tile / 2`-th pixel, in rows and in
    columns, then those between where interpolation was wrong by more than `tolerance` (`jvr.integrators.refinement`).

    **Arguments:** `tolerance`: in radiance and opacity, 0 (every ray) or more. It bounds what interpolation was wrong by on the grid
    before, so the picture's root mean square error stays well below it; single pixels at an edge may be farther off. `tile`: a
    power of two, 2 ... 64; features smaller than half of it are missed where none of its rays meets them. **Raises** `ValueError` for
    values out of range.

    Colour and opacity are interpolated bilinearly, depth weighted by opacity. Differentiable in all that `jvr.render` is, through what
    is traced and interpolated; detached: which rays are traced. `stats.steps` is 0 for pixels that were not, and `stats.sampling` a
    `RefinementStats`. All rays are in one batch: `settings.tile` plays no part, and memory is that of a picture in one tile. A picture
    **raises** `ValueError` for a camera of another kind than jvr's own.
    """

    tolerance: float = choice(NOT_NEGATIVE, doc="radiance and opacity, 0 for every ray", hint="0.005 is a good start")
    tile: int = choice(Interval(2.0, 64.0), doc="pixels from one ray of the coarsest grid to the next", hint="8 is a good start")

    def __init__(self, tolerance: float | int = 0.005, *, tile: int = 8):
        assign(self, tolerance=tolerance, tile=tile)
        if tile not in TILES:
            raise ValueError(f"tile must be a power of two from 2 to 64 pixels, not {tile!r}; 8 is a good start")

    @property
    def explanation(self) -> str:
        return f"every {self.tile // 2}th ray, those between where interpolation is wrong by more than {self.tolerance:g}"

    def picture(self, view: View) -> Rendering:
        return _refined(view, self.tolerance, self.tile)


class _Grid(NamedTuple):
    """Columns and rows of all pixels, row by row, of a picture that ends with a pixel of the coarsest grid on each side."""

    column: Int[Array, "pixels"]
    row: Int[Array, "pixels"]
    shape: tuple[int, int]


class _Picture(NamedTuple):
    """Colour, opacity and opacity-weighted depth of each pixel; which may be traced next, and which were."""

    values: Float[Array, "pixels 5"]
    wanted: Bool[Array, "pixels"]
    traced: Bool[Array, "pixels"]


def _refined(view: View, tolerance: float, tile: int) -> Rendering:
    scene, camera = view.scene, view.camera
    plane, prepared = image_plane(camera, ahead(scene, camera)), prepare(scene, view.settings, view.dt)
    # The border of the picture is interpolated from real rays around it.
    height, width = (-(-(n - 1) // tile) * tile + 1 for n in (camera.height, camera.width))
    row, column = (x.reshape(-1) for x in jnp.meshgrid(*(jnp.arange(n, dtype=jnp.int32) for n in (height, width)), indexing="ij"))
    grid = _Grid(column, row, (height, width))

    def refine(picture: _Picture, spacing: Int[Array, ""]) -> tuple[_Picture, Int[Array, "pixels"]]:
        fine, coarse = (~((row % s > 0) | (column % s > 0)) for s in (spacing, 2 * spacing))
        between, mask = fine & ~coarse, fine & picture.wanted & ~picture.traced
        found, steps = _trace(prepared, plane, grid, mask)
        # On the first pass the grid that predictions are made from is new, too.
        values = jnp.where((mask & coarse)[:, None], found, picture.values)
        values = jnp.where(between[:, None], _predict(values, grid, 2 * spacing), values)
        # Not "more than": a NaN is never good.
        good = jnp.all(jnp.abs(jax.lax.stop_gradient(found - values))[:, :4] <= tolerance, axis=1)
        wanted = _near((mask & between & ~good).reshape(height, width), grid, spacing)
        if tolerance == 0:
            wanted = jnp.ones_like(wanted)
        values = jnp.where((mask & between)[:, None], found, values)
        return _Picture(values, wanted, picture.traced | mask), steps

    blank = jnp.zeros((row.size, 5), scene.volume.slope.dtype)
    start = _Picture(blank, jnp.ones(row.size, bool), jnp.zeros(row.size, bool))
    spacings = jnp.array([2**j for j in range(tile.bit_length() - 2, -1, -1)], jnp.int32)
    picture, steps = jax.lax.scan(refine, start, spacings)

    crop = lambda x: x.reshape(height, width, *x.shape[1:])[: camera.height, : camera.width]
    values, traced, steps = crop(picture.values), crop(picture.traced), crop(jnp.sum(steps, axis=0, dtype=jnp.int32))
    alpha = values[..., 3]
    depth = jnp.where(alpha > 0, divide_or_zero(values[..., 4], alpha), 0.0)
    stats = RefinementStats(traced, jnp.sum(picture.traced, dtype=jnp.int32))
    return Rendering(values[..., :3], alpha, depth, RenderStats(steps, stats, prepared.shadow_stats))


def _trace(
    prepared: Prepared, plane: ImagePlane, grid: _Grid, mask: Bool[Array, "pixels"]
) -> tuple[Float[Array, "pixels 5"], Int[Array, "pixels"]]:
    """Colour, opacity and opacity-weighted depth of the pixels of a mask, and their steps."""
    column, row = (x.astype(prepared.scene.volume.slope.dtype) for x in (grid.column, grid.row))
    origin, direction, behind = plane.rays(column, row)
    rays, t_in = enter(prepared.scene, origin, direction, behind, limits=plane.limits(direction))
    # A ray without length is not marched.
    found = Uniform().radiance(prepared, rays._replace(length=jnp.where(mask, rays.length, 0.0)))
    depth = t_in * found.alpha + found.distance
    return jnp.concatenate([found.rgb, jnp.stack([found.alpha, depth], axis=1)], axis=1), found.steps


def _predict(values: Float[Array, "pixels 5"], grid: _Grid, coarse: Int[Array, ""]) -> Float[Array, "pixels 5"]:
    """Bilinear interpolation half-way between pixels of a grid of spacing `coarse`."""
    height, width = grid.shape
    rows = [grid.row // coarse * coarse, jnp.minimum(-(-grid.row // coarse) * coarse, height - 1)]
    columns = [grid.column // coarse * coarse, jnp.minimum(-(-grid.column // coarse) * coarse, width - 1)]
    return sum((values[r * width + c] for r in rows for c in columns), jnp.zeros_like(values)) / 4


def _near(wrong: Bool[Array, "h w"], grid: _Grid, spacing: Int[Array, ""]) -> Bool[Array, "pixels"]:
    """Pixels no farther, in rows and in columns, than `spacing` from one that is `wrong`, which lie on the grid of that spacing."""
    around = lambda x, n: [jnp.clip(i * spacing, 0, n - 1) for i in (-(-x // spacing) - 1, x // spacing, x // spacing + 1)]
    result = jnp.zeros_like(grid.row, bool)
    for r in around(grid.row, grid.shape[0]):
        for c in around(grid.column, grid.shape[1]):
            result |= wrong[r, c]
    return result
