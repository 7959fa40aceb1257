"""The target images of a fit, from files: how they are read, which of their pixels count, and which of them are held out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jvr.io.config.errors import ConfigError, blame
from jvr.io.config.load import Config
from jvr.io.config.schema.whole import FitTable
from jvr.model.camera import AbstractCamera
from jvr.model.light import AbstractLight

Cameras = tuple[AbstractCamera, ...]
Lights = tuple[tuple[AbstractLight, ...], ...]


class Views(NamedTuple):
    """Cameras with an image and, where something weighs them, a weight for each pixel; their lights, where they are not the scene's. Pixels
    without weight are NaN."""

    cameras: Cameras
    images: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray, ...] | None
    lights: Lights | None = None


def views_in_files(
    config: Config, fit: FitTable, cameras: Cameras, lights: Lights | None, read_image: Callable[..., np.ndarray] | None
) -> tuple[Views, Views]:
    """The views that take part, and those that are held out.

    **Raises** `ConfigError` for a file that is not there, cannot be read or does not fit its camera.
    """
    if read_image is None:
        from jvr.io.images import read_image
    choices = {"encoding": fit.encoding, "alpha": fit.alpha, "layer": fit.layer}
    # Only what is said: the rest is found in the files.
    choices = {name: value for name, value in choices.items() if value is not None}
    table = config.tables.background or [0.0, 0.0, 0.0]
    # Where nothing is behind the volume, light over black is what a picture holds; where that is to be found, nobody knows yet.
    background = table if isinstance(table, list) and not (fit.exposure and any(table)) else None
    is_known = "background" not in fit.unknowns
    images = _read(
        config, fit.images or [], "fit.images", cameras, read_image, background=background if is_known else None, **choices
    )
    weights = (
        None
        if fit.weights is None
        else [_grey(config, i, image) for i, image in enumerate(_masks(config, fit, cameras, read_image))]
    )
    if weights is not None:
        images = [np.where(weight[..., None] > 0, image, np.nan) for image, weight in zip(images, weights, strict=True)]
    chosen = held_out_indices(config, fit.held_out, len(cameras))
    inside, outside = ([i for i in range(len(cameras)) if (i in chosen) == which] for which in (False, True))
    taken = lambda values, indices: tuple(values[i] for i in indices)
    given = lambda values, indices: None if values is None else taken(values, indices)
    views = lambda indices: Views(
        taken(cameras, indices), taken(images, indices), given(weights, indices), given(lights, indices)
    )
    return views(inside), views(outside)


def _masks(config: Config, fit: FitTable, cameras: Cameras, read_image: Callable[..., np.ndarray]) -> list[np.ndarray]:
    # The numbers as they are: half of the codes is half of the weight.
    asis = {"encoding": "linear", "alpha": "straight", "background": (0.0, 0.0, 0.0)}
    return _read(config, fit.weights or [], "fit.weights", cameras, read_image, **asis)


def _grey(config: Config, i: int, image: np.ndarray) -> np.ndarray:
    if np.any(np.ptp(image, axis=-1) > 0):
        key = f"fit.weights[{i}]"
        raise ConfigError(
            config.where(key), key, "is coloured: a weight is grey, 0 where a pixel does not count and 1 where it does"
        )
    return image[..., 0]


def _read(
    config: Config, names: list[str], key: str, cameras: Cameras, read_image: Callable[..., np.ndarray], **choices: Any
) -> list[np.ndarray]:
    """One picture for each camera, of its size."""
    images = []
    for i, name in enumerate(names):
        with blame(config.where(f"{key}[{i}]"), f"{key}[{i}]"):
            path: Path = config.find(name, f"{key}[{i}]")
            images.append(np.asarray(read_image(path, **choices)))
    if len(images) != len(cameras):
        raise ConfigError(config.where(key), key, f"{len(images)} images for {len(cameras)} cameras: give one for each camera")
    for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        if image.shape[:2] != (camera.height, camera.width):
            size = f"{image.shape[1]} x {image.shape[0]}"
            problem = f"is {size} pixels, its camera sees {camera.width} x {camera.height}: resize one of them"
            raise ConfigError(config.where(f"{key}[{i}]"), f"{key}[{i}]", problem)
    return images


def held_out_indices(config: Config, held_out: Any, count: int) -> set[int]:
    """The views that a list holds out, none for a number of extra ones."""
    chosen = set(held_out) if isinstance(held_out, list) else set()
    if any(i >= count for i in chosen) or len(chosen) >= count:
        where = config.where("fit.held_out")
        raise ConfigError(
            where, "fit.held_out", f"{sorted(chosen)} must be indices from 0 to {count - 1} and leave one view over"
        )
    return chosen
