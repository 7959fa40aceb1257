"""`jvr.render`: a scene seen by a camera."""

import dataclasses
import math
import os
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.execution.devices import everywhere, is_spread, is_traced, over_rays, program, shares
from jvr.execution.tiles import block_shape, dealt_blocks, in_tiles, picture_of, pixels_of, within_memory
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.rendering.sampling import RefinementStats, SliceStats
from jvr.rendering.settings import Settings
from jvr.rendering.trace import Pixels, Prepared, prepare, resolve, trace
from jvr.types import Image, Scalar


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

    def save(self, path: str | os.PathLike, *, transparent: bool = False) -> None:
        """Writes the picture: `.png` as sRGB, or `.exr` as linear radiance with the depth as channel Z.

        `transparent`: with alpha, for pictures of a scene without a background, whose `rgb` is light over black.
        **Raises** what `jvr.write_image` raises.
        """
        from jvr.pictures import write_image

        is_exr = str(path).lower().endswith(".exr")
        write_image(path, self.rgb, self.alpha if transparent else None, depth=self.depth if is_exr else None)

    def _repr_png_(self) -> bytes:
        """What notebooks show; pixels that are not finite in magenta."""
        from jvr.pictures import shown

        return shown(self.rgb)


def render(scene: Scene, camera: AbstractCamera, settings: Settings = Settings()) -> Rendering:
    """Renders `scene` as `camera` sees it, by emission and absorption along the ray of each pixel.

    Differentiable in every floating-point array of `scene` and `camera`: transfer function, voxels, pose, background, and where rays
    enter and leave the volume. Detached: the number of segments, early termination, and which samples `settings.sampling` takes.
    `settings.adjoint` says in which mode.
    Traceable; `jax.jit(jvr.render)` compiles once for each structure of the scene, size of the picture and settings. A camera
    with non-finite numbers gives NaN pixels. **Raises** `ValueError` where `settings.sampling` does not support the scene, and where its
    radiance transfer was computed for another (within a compiled program, an error when that runs).
    """
    if not (isinstance(scene, Scene) and isinstance(camera, AbstractCamera)):
        raise TypeError(f"jvr.render takes a scene and a camera, not {type(scene).__name__} and {type(camera).__name__}")
    return settings.sampling.render(scene.current(), camera, settings)


def render_uniform(scene: Scene, camera: AbstractCamera, settings: Settings) -> Rendering:
    """`render` with every ray and every visible sample."""
    if is_traced() and not is_spread():
        # A part of somebody's program, in which arrays that it closes over are constants.
        return _render(scene, camera, settings)
    # The step is an argument of the program: with another one nothing is compiled again.
    same = dataclasses.replace(settings, step=1.0)
    if is_traced((scene, camera)) or is_spread():
        # Inside of `jax.grad`, `jax.vmap` or `jax.shard_map` alone: they take a compiled program as a single operation.
        return _picture(scene, camera, same, settings.step)
    return within_memory(lambda tile: _picture(scene, camera, dataclasses.replace(same, tile=tile), settings.step), settings.tile)


def _render(scene: Scene, camera: AbstractCamera, settings: Settings, step: Scalar | float | None = None) -> Rendering:
    height, width = camera.height, camera.width
    most = settings.tile // math.prod(block_shape(height, width))

    def share(shared: tuple[Scene, AbstractCamera, Prepared], blocks: Int[Array, "blocks"]) -> tuple[Pixels, Int[Array, "rays"]]:
        return in_tiles(lambda tile: _render_blocks(*shared, settings, tile), blocks, most)

    prepared, dealt = prepare(scene, settings, step), dealt_blocks(height, width, shares())
    rays = everywhere(over_rays(share, (scene, camera, prepared), dealt))
    (rgb, alpha, depth), steps = picture_of(rays, height, width, shares())
    return Rendering(rgb, alpha, depth, RenderStats(steps, shadows=everywhere(prepared.shadow_stats)))


def _render_blocks(
    scene: Scene, camera: AbstractCamera, prepared: Prepared, settings: Settings, blocks: Int[Array, "blocks"]
) -> tuple[Pixels, Int[Array, "rays"]]:
    pixels = pixels_of(blocks, camera.height, camera.width)
    gathered, rays, t_in = trace(scene, camera, settings, pixels, prepared=prepared, distance=True)
    assert gathered.steps is not None
    return resolve(scene, gathered, rays, t_in), gathered.steps


_picture = program(_render, static_argnums=2)
