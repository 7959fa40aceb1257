"""Animated pictures."""

import os
from collections.abc import Sequence

import numpy as np

from jvr.atomic import replacing
from jvr.pictures import srgb_from_linear


def write_animation(path: str | os.PathLike, frames: Sequence[np.ndarray], *, seconds: float) -> None:
    """Writes pictures `(height, width, 3)`, linear radiance, as an animated GIF that goes on for ever; `seconds` in all. Each has 256
    colours of its own. The file is replaced at once or not at all."""
    from PIL import Image

    codes = [np.round(255 * np.clip(srgb_from_linear(frame), 0, 1)).astype(np.uint8) for frame in frames]
    pictures = [Image.fromarray(picture).quantize(256, Image.Quantize.MEDIANCUT) for picture in codes]
    each = max(round(1000 * seconds / len(frames)), 20)
    with replacing(path) as temporary:
        pictures[0].save(temporary, "GIF", save_all=True, append_images=pictures[1:], duration=each, loop=0)
