"""Work-precision measurements: pictures and gradients under several settings, against a reference."""

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.lib.stride_tricks import sliding_window_view

from jvr.march.differentiation import Replay
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.rendering.render import render
from jvr.rendering.settings import FINER, Settings


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
    """Renders a reference (double precision, a quarter of the finest step, every sample to the end of each ray, as many rays a pixel as the
    most of `settings` and by their filter), then the same picture under each of `settings`, taken in turns so that a slow moment of the
    machine hits all alike.

    **Arguments:** `unknowns`: what a gradient is measured for, as in `jvr.fit`: that of half the mean squared radiance;
    `reference_step`: step of the reference, in voxels; `repeats`: pictures timed for each setting.
    **Returns** one `Measurement` for each of `settings`. Not traceable. **Raises** `ValueError` without settings, and for settings of
    different pixel filters, whose pictures have no reference in common.
    """
    if not settings:
        raise ValueError("measure needs at least one jvr.Settings to compare with the reference")
    step = min(s.step for s in settings) / FINER if reference_step is None else reference_step
    most = max(s.pixel_samples for s in settings)
    filters = [s.pixel_filter for s in settings if s.pixel_samples > 1] or [settings[0].pixel_filter]
    if any(one != filters[0] for one in filters):
        raise ValueError(
            "settings have different pixel filters, each of which makes another picture: measure those of one at a time"
        )
    exact = Settings(step, termination=0.0, skipping=False, pixel_samples=most, pixel_filter=filters[0])
    truth = reference(scene, camera, exact, unknowns)
    timed = timed_pictures([(scene, one) for one in settings], camera, unknowns, repeats=repeats)
    return tuple(compared(truth, one, picture) for one, picture in zip(settings, timed, strict=True))


class TimedPicture(NamedTuple):
    """A picture, the number of its samples, its gradient (or `None`), the median and the least of its times, and that of compiling it."""

    rgb: np.ndarray
    samples: int
    gradient: Any
    seconds: float
    least_seconds: float
    compile_seconds: float


def timed_pictures(
    variants: Sequence[tuple[Scene, Settings]],
    camera: AbstractCamera,
    unknowns: Callable[[Scene], Any] | None = None,
    *,
    repeats: int = 5,
) -> list[TimedPicture]:
    """The pictures of several scenes under their settings, timed in turns, so that a slow moment of the machine hits all alike."""
    first, images = [], []
    for scene, settings in variants:
        began = time.perf_counter()
        rgb, samples, gradient = jax.block_until_ready(_picture(scene, camera, settings, unknowns))
        first.append(time.perf_counter() - began)
        images.append((np.asarray(rgb), int(samples), gradient))
    times: list[list[float]] = [[] for _ in variants]
    for _ in range(repeats):
        for (scene, settings), seconds in zip(variants, times, strict=True):
            began = time.perf_counter()
            jax.block_until_ready(_picture(scene, camera, settings, unknowns))
            seconds.append(time.perf_counter() - began)
    found = []
    for (rgb, samples, gradient), some, once in zip(images, times, first, strict=True):
        median = statistics.median(some)
        found.append(TimedPicture(rgb, samples, gradient, median, min(some), max(once - median, 0.0)))
    return found


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


def reference(
    scene: Scene, camera: AbstractCamera, settings: Settings, unknowns: Callable[[Scene], Any] | None = None
) -> tuple[np.ndarray, Any]:
    """Picture and gradient (or `None`) in double precision."""
    double = lambda x: jnp.asarray(np.asarray(x, np.float64)) if eqx.is_inexact_array(x) else x
    with jax.enable_x64(True):
        scene, camera = jax.tree.map(double, (scene, camera))
        settings = eqx.tree_at(lambda s: s.adjoint, settings, Replay())
        rgb, _, gradient = _picture(scene, camera, settings, unknowns)
        return np.asarray(rgb), jax.tree.map(np.asarray, gradient)


def psnr(true: np.ndarray, found: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two pictures, in decibels of radiance 1, over what is finite in `true`: the rest is not known."""
    error = float(np.mean(np.square(np.asarray(found, np.float64) - true)[np.isfinite(true)]))
    return -10 * np.log10(error) if error > 0 else np.inf


def similarity(true: np.ndarray, found: np.ndarray, bright: float = 1.0) -> float:
    """Structural similarity (Wang et al. 2004) of two pictures `(height, width, 3)` with radiance 0 ... `bright`; 1 where they are equal.

    Windows are 7 pixels wide, or the most that fit; pictures of less than 3 pixels are continued by their edge. Where `true` is
    not finite it is not known: windows with such pixels do not count, and where no others are left the answer is NaN.
    """
    from skimage.metrics import structural_similarity

    known = np.all(np.isfinite(true), axis=-1)
    if not np.any(known):
        return np.nan
    true = np.where(known[..., None], true, found)
    if np.array_equal(true, found):
        return 1.0
    missing = [(0, max(3 - n, 0)) for n in true.shape[:2]]
    true, found = (np.pad(image, [*missing, (0, 0)], mode="edge") for image in (true, found))
    window = min(7, (min(true.shape[:2]) - 1) // 2 * 2 + 1)
    ssim: Any = structural_similarity(true, found, data_range=bright, channel_axis=-1, win_size=window, full=True)
    whole: Any = sliding_window_view(np.pad(known, missing, mode="edge"), (window, window)).all(axis=(2, 3))
    of_windows = ssim[1][window // 2 :, window // 2 :][: whole.shape[0], : whole.shape[1]]
    return float(np.mean(of_windows[whole], dtype=np.float64)) if np.any(whole) else np.nan


def compared(truth: tuple[np.ndarray, Any], settings: Settings, found: TimedPicture) -> Measurement:
    """A picture, and its gradient where it has one, beside the `reference`."""
    (true_rgb, true_gradient), gradient = truth, found.gradient
    rgb = np.asarray(found.rgb, np.float64)
    difference = rgb - true_rgb
    bright = max(float(true_rgb.max() - true_rgb.min()), np.finfo(float).tiny)
    error = None
    if gradient is not None:
        flat = lambda tree: np.concatenate([np.ravel(np.asarray(x, np.float64)) for x in jax.tree.leaves(tree)])
        error = float(np.linalg.norm(flat(gradient) - flat(true_gradient)) / np.linalg.norm(flat(true_gradient)))
    rmse, largest = float(np.sqrt(np.mean(difference**2))), float(np.abs(difference).max())
    ssim = similarity(true_rgb, rgb, bright)
    return Measurement(settings, found.seconds, found.compile_seconds, found.samples, rmse, largest, ssim, error)
