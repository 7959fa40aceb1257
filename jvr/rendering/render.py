"""`jvr.render`: a scene seen by a camera."""

import dataclasses

from jvr.execution.devices import is_spread, is_traced
from jvr.execution.tiles import within_memory
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.rendering.image import Rendering
from jvr.rendering.integrator import compiled_picture, make_picture
from jvr.rendering.settings import Settings


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
    # The step is an argument of the program: with another one nothing is compiled again.
    scene, step, same = scene.current(), settings.step, dataclasses.replace(settings, step=1.0)
    if is_traced() and not is_spread():
        # A part of somebody's program, in which arrays that it closes over are constants.
        return make_picture(scene, camera, same, step)
    if is_traced((scene, camera)) or is_spread() or not settings.sampling.is_tiled:
        # Inside of `jax.grad`, `jax.vmap` or `jax.shard_map` alone: they take a compiled program as a single operation.
        return compiled_picture(scene, camera, same, step)
    return within_memory(lambda tile: compiled_picture(scene, camera, dataclasses.replace(same, tile=tile), step), settings.tile)
