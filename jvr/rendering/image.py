"""`jvr.render`: a scene seen by a camera."""

import functools
import warnings
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.march.march import Marched, MarchOptions
from jvr.march.medium import AbstractVisibility
from jvr.march.occupancy import Occupancy
from jvr.march.steps import Rays
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.numerics import divide_or_zero, one_minus_exp, ray_box
from jvr.rendering.medium import medium, natural, occupancy, visibility
from jvr.rendering.parts import in_parts, is_traced
from jvr.rendering.sampling import RefinementStats, SliceStats
from jvr.rendering.settings import Settings
from jvr.types import Image, Scalar, Triple


class RenderStats(eqx.Module):
    """What a rendering took: `steps`, segments sampled for each pixel, `(height, width)`; what `Settings(sampling=...)` left out, and what
    `Scene(shadows=...)` has to report (`jvr.DeepShadowMap`), each `None` where that is nothing."""

    steps: Int[Array, "height width"]
    sampling: SliceStats | RefinementStats | None = None
    shadows: Any = None

    @property
    def samples(self) -> Int[Array, ""]:
        """Samples taken for the whole picture, counted once where segments share them."""
        return jnp.sum(self.sampling.samples if isinstance(self.sampling, SliceStats) else self.steps)


class Rendering(eqx.Module):
    """A picture, row 0 at the top.

    - `rgb`: `(height, width, 3)`, linear radiance; includes `T * background` where the scene has one.
    - `alpha`: `(height, width)`, opacity of the medium, `1 - mean(T)`.
    - `depth`: `(height, width)`, `sum T (1 - exp(-dtau)) t / alpha`, distance from the eye along the ray; 0 where alpha is 0.
    - `stats`: `RenderStats`.
    """

    rgb: Image
    alpha: Float[Array, "height width"]
    depth: Float[Array, "height width"]
    stats: RenderStats


def render(scene: Scene, camera: AbstractCamera, settings: Settings = Settings()) -> Rendering:
    """Renders `scene` as `camera` sees it, by emission and absorption along the ray of each pixel.

    Differentiable in every floating-point array of `scene` and `camera`: transfer function, voxels, pose, background, and where rays
    enter and leave the volume. Detached: the number of segments, early termination, and which samples `settings.sampling` takes.
    `settings.adjoint` says in which mode.
    Traceable; `jax.jit(jvr.render)` compiles once for each structure of the scene, size of the picture and settings. A camera
    with non-finite numbers gives NaN pixels. **Raises** `ValueError` where `settings.sampling` does not support the scene.
    """
    if scene.radiance_transfer is not None and not is_traced(scene):
        for problem in scene.radiance_transfer.outdated(scene.transfer, scene.material):
            warnings.warn(problem, RuntimeWarning, stacklevel=2)
    return settings.sampling.render(scene, camera, settings)


def render_uniform(scene: Scene, camera: AbstractCamera, settings: Settings) -> Rendering:
    """`render` with every ray and every visible sample."""
    if is_traced((scene, camera)):
        pixels = jnp.arange(camera.width * camera.height, dtype=jnp.int32)
        where = seen(scene, settings)
        march = _render_pixels if pixels.size <= settings.tile else _render_tiles
        rgb, alpha, depth, steps = march(scene, camera, settings, where, pixels)
    else:
        where = _compiled_seen(scene, settings)
        part = functools.partial(_compiled_pixels, scene, camera, settings, where)
        rgb, alpha, depth, steps = in_parts(part, camera.height, camera.width, settings.tile)
    shape = (camera.height, camera.width)
    stats = RenderStats(steps.reshape(shape), shadows=where.shadow_stats)
    return Rendering(rgb.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape), stats)


class Seen(NamedTuple):
    """What is computed once for all rays of a picture: visible bricks, what is in the way of light, and the material under light from
    all around; each `None` where the scene asks for none."""

    occupancy: Occupancy | None = None
    shadows: AbstractVisibility | None = None
    natural: Any = None

    @property
    def shadow_stats(self) -> Any:
        return None if self.shadows is None else self.shadows.stats


def seen(scene: Scene, settings: Settings) -> Seen:
    """What rays through a scene need to know beforehand."""
    (scene,) = one_precision(scene)
    where = occupancy(scene, settings)
    return Seen(where, visibility(scene, where), natural(scene))


def trace(
    scene: Scene,
    camera: AbstractCamera,
    settings: Settings,
    pixels: Int[Array, "rays"],
    *,
    where: Seen = Seen(),
    distance: bool = False,
) -> tuple[Marched, Rays, Float[Array, "rays"]]:
    """Marches the rays of some pixels, only `where` there is something to see; returns what they gathered, the rays, and the distance
    from the eye to their entry."""
    scene, camera = one_precision(scene, camera)
    rays, t_in = enter(scene, *camera.rays(pixels))
    options = MarchOptions(settings.termination, distance)
    return settings.adjoint.march(options, medium(scene, settings, *where), rays, step_length(scene, settings)), rays, t_in


def one_precision(scene: Scene, *others: Any) -> Any:
    """A scene and whatever else with every floating-point array in the widest precision among them, as the state of the loop needs; with
    x64 on, parts of a scene may differ. Voxels stay as they are in memory."""
    voxels = lambda tree: tree[0].volume.values
    floats, rest = eqx.partition(eqx.tree_at(voxels, (scene, *others), None), eqx.is_inexact_array)
    widest = jnp.result_type(*jax.tree.leaves(floats))
    promoted = eqx.combine(jax.tree.map(lambda x: x.astype(widest), floats), rest)
    return eqx.tree_at(voxels, promoted, scene.volume.values, is_leaf=lambda x: x is None)


def step_length(scene: Scene, settings: Settings) -> Scalar:
    """World length of a segment."""
    return settings.step * jnp.min(scene.volume.spacing)


def enter(scene: Scene, origin: Triple, direction: Triple) -> tuple[Rays, Float[Array, "rays"]]:
    """World rays inside the volume (and its clipping box), and the distance from their origin to where they enter.

    A ray with non-finite numbers gets the length NaN, which `composite` turns into a NaN pixel.
    """
    start = scene.volume.grid_from_world(origin)
    along = scene.volume.grid_from_world(direction, direction=True)
    t_in, t_out = ray_box(start, along, *scene.volume.domain)
    if scene.clipping is not None:
        near, far = ray_box(origin, direction, tuple(scene.clipping.lower), tuple(scene.clipping.upper))
        t_in, t_out = jnp.maximum(t_in, near), jnp.minimum(t_out, far)
    t_in = jnp.maximum(t_in, 0.0)
    hit = t_out > t_in
    # A ray that misses gets harmless numbers before any arithmetic, so that its derivative is zero and not 0 * inf.
    t_in, t_out = jnp.where(hit, t_in, 0.0), jnp.where(hit, t_out, 0.0)
    keep = lambda v: tuple(jnp.where(hit, x, 0.0) for x in v)
    poison = jnp.where(jnp.isfinite(sum(start) + sum(along)), 0.0, jnp.nan)
    start, along = keep(start), keep(along)
    entry = tuple(s + t_in * d for s, d in zip(start, along, strict=True))
    return Rays(entry, along, t_out - t_in + poison), t_in


def composite(scene: Scene, gathered: Marched, length: Float[Array, "rays"]) -> tuple[Triple, Float[Array, "rays"]]:
    """Colour of each ray with the background behind the medium, and the medium's opacity."""
    transmittances = tuple(jnp.exp(-tau) for tau in gathered.tau)
    zero = jnp.where(jnp.isnan(length), jnp.nan, 0.0)
    rgb = tuple(zero + L for L in gathered.radiance or (0.0, 0.0, 0.0))
    if scene.background is not None:
        clear = transmittances * (3 // len(transmittances)) if transmittances else (1.0, 1.0, 1.0)
        rgb = tuple(c + T * b for c, T, b in zip(rgb, clear, scene.background, strict=True))
    # Not 1 - T: thin media keep their digits.
    alpha = sum((one_minus_exp(tau) for tau in gathered.tau), zero) / max(len(gathered.tau), 1)
    return rgb, alpha


def _render_pixels(scene: Scene, camera: AbstractCamera, settings: Settings, where: Seen, pixels: Int[Array, "rays"]):
    gathered, rays, t_in = trace(scene, camera, settings, pixels, where=where, distance=True)
    rgb, alpha = composite(scene, gathered, rays.length)
    weighted = sum(gathered.distance, jnp.zeros_like(alpha)) / max(len(gathered.distance), 1)
    depth = jnp.where(alpha > 0, t_in + divide_or_zero(weighted, alpha), 0.0)
    assert gathered.steps is not None
    return jnp.stack(rgb, axis=-1), alpha, depth, gathered.steps


def _render_tiles(scene: Scene, camera: AbstractCamera, settings: Settings, where: Seen, pixels: Int[Array, "rays"]):
    count = -(-pixels.size // settings.tile)
    # The last tile repeats the last pixel; what it computes for it is dropped.
    padded = jnp.minimum(jnp.arange(count * settings.tile, dtype=jnp.int32), pixels.size - 1).reshape(count, settings.tile)
    tiles = jax.lax.map(lambda tile: _render_pixels(scene, camera, settings, where, tile), padded)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[: pixels.size], tiles)


_compiled_pixels = jax.jit(_render_pixels, static_argnums=2)
_compiled_seen = jax.jit(seen, static_argnums=1)
