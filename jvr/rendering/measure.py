"""Work-precision measurements: pictures and gradients under several settings, against a reference."""

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jvr.march.differentiation import Replay
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.rendering.image import render
from jvr.rendering.settings import Settings

# Segments of the reference for each of the finest setting's.
FINER = 4


@dataclasses.dataclass(frozen=True)
class Measurement:
    """What one setting costs and how far its picture is from the reference, in linear radiance.

    `seconds`: median time of a picture (of picture and gradient, where a gradient was asked for), compilation apart
    (`compile_seconds`, about 0 where it was compiled already); `samples`: segments sampled for the picture; `rmse`, `largest`: root
    mean square and largest difference over pixels and channels; `ssim`: structural similarity (1 is identical); `gradient_error`:
    norm of the difference of the gradients over the norm of the reference's, or `None`.
    """

    settings: Settings
    seconds: float
    compile_seconds: float
    samples: int
    rmse: float
    largest: float
    ssim: float
    gradient_error: float | None


def measure(
    scene: Scene,
    camera: AbstractCamera,
    settings: Sequence[Settings],
    *,
    unknowns: Callable[[Scene], Any] | None = None,
    reference_step: float | None = None,
    repeats: int = 5,
) -> tuple[Measurement, ...]:
    """Renders a reference (double precision, a quarter of the finest step, every sample to the end of each ray), then the same picture
    under each of `settings`, taken in turns so that a slow moment of the machine hits all alike.

    **Arguments:** `unknowns`: what a gradient is measured for, as in `jvr.fit`: that of half the mean squared radiance;
    `reference_step`: step of the reference, in voxels; `repeats`: pictures timed for each setting.
    **Returns** one `Measurement` for each of `settings`. Not traceable. **Raises** `ValueError` without settings.
    """
    if not settings:
        raise ValueError("measure needs at least one jvr.Settings to compare with the reference")
    step = min(s.step for s in settings) / FINER if reference_step is None else reference_step
    truth = _reference(scene, camera, Settings(step, termination=0.0, skipping=False), unknowns)
    first, images = [], []
    for one in settings:
        began = time.perf_counter()
        images.append(jax.block_until_ready(_picture(scene, camera, one, unknowns)))
        first.append(time.perf_counter() - began)
    times: list[list[float]] = [[] for _ in settings]
    for _ in range(repeats):
        for one, seconds in zip(settings, times, strict=True):
            began = time.perf_counter()
            jax.block_until_ready(_picture(scene, camera, one, unknowns))
            seconds.append(time.perf_counter() - began)
    rows = zip(settings, map(statistics.median, times), first, images, strict=True)
    return tuple(_compare(truth, s, median, once - median, image) for s, median, once, image in rows)


def _picture(
    scene: Scene, camera: AbstractCamera, settings: Settings, unknowns: Callable[[Scene], Any] | None
) -> tuple[Array, Array, Any]:
    """Picture, number of samples and gradient, a scene of `None` but for the unknowns, or `None`."""
    if unknowns is None:
        image = render(scene, camera, settings)
        return image.rgb, image.stats.samples, None
    # A tree says which arrays are unknown, and not the function: that may be another one each time, for which all would be compiled anew.
    is_unknown = eqx.tree_at(
        unknowns, jax.tree.map(lambda _: False, scene), replace_fn=lambda node: jax.tree.map(lambda _: True, node)
    )
    (_, picture), gradient = _with_gradient(*eqx.partition(scene, is_unknown), camera, settings)
    return *picture, gradient


def _brightness(unknown: Scene, known: Scene, camera: AbstractCamera, settings: Settings) -> tuple[Array, tuple[Array, Array]]:
    image = render(eqx.combine(unknown, known), camera, settings)
    return 0.5 * jnp.mean(jnp.square(image.rgb)), (image.rgb, image.stats.samples)


_with_gradient = jax.jit(jax.value_and_grad(_brightness, has_aux=True), static_argnums=3)


def _reference(scene: Scene, camera: AbstractCamera, settings: Settings, unknowns: Callable[[Scene], Any] | None) -> Any:
    """Picture and gradient in double precision."""
    double = lambda x: jnp.asarray(np.asarray(x, np.float64)) if eqx.is_inexact_array(x) else x
    with jax.enable_x64(True):
        scene, camera = jax.tree.map(double, (scene, camera))
        settings = eqx.tree_at(lambda s: s.adjoint, settings, Replay())
        rgb, _, gradient = _picture(scene, camera, settings, unknowns)
        return np.asarray(rgb), jax.tree.map(np.asarray, gradient)


def similarity(true: np.ndarray, found: np.ndarray, bright: float = 1.0) -> float:
    """Structural similarity (Wang et al. 2004) of two pictures `(height, width, 3)` with radiance 0 ... `bright`; 1 where they are equal.

    Windows are 7 pixels wide, or the most that fit; pictures of less than 3 pixels are continued by their edge.
    """
    from skimage.metrics import structural_similarity

    if np.array_equal(true, found):
        return 1.0
    missing = [(0, max(3 - n, 0)) for n in true.shape[:2]]
    true, found = (np.pad(image, [*missing, (0, 0)], mode="edge") for image in (true, found))
    window = min(7, (min(true.shape[:2]) - 1) // 2 * 2 + 1)
    ssim: Any = structural_similarity(true, found, data_range=bright, channel_axis=-1, win_size=window)
    return float(ssim)


def _compare(truth: Any, settings: Settings, seconds: float, compile_seconds: float, found: Any) -> Measurement:
    (true_rgb, true_gradient), (rgb, samples, gradient) = truth, found
    rgb = np.asarray(rgb, np.float64)
    difference = rgb - true_rgb
    bright = max(float(true_rgb.max() - true_rgb.min()), np.finfo(float).tiny)
    error = None
    if gradient is not None:
        flat = lambda tree: np.concatenate([np.ravel(np.asarray(x, np.float64)) for x in jax.tree.leaves(tree)])
        error = float(np.linalg.norm(flat(gradient) - flat(true_gradient)) / np.linalg.norm(flat(true_gradient)))
    rmse, largest = float(np.sqrt(np.mean(difference**2))), float(np.abs(difference).max())
    return Measurement(
        settings, seconds, max(compile_seconds, 0.0), int(samples), rmse, largest, similarity(true_rgb, rgb, bright), error
    )
