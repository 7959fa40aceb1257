"""Environment maps: the light that arrives from all directions, as an image of latitude and longitude.

Row 0 is the pole above, the last row the pole below. Columns go once around as in OpenEXR: +X at a quarter of the width, +Z at its middle,
-X at three quarters, -Z at both edges.
"""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from jvr.io.images import read_image
from jvr.pictures import ImageError


def read_environment(path: str | os.PathLike) -> Float32[np.ndarray, "height width 3"]:
    """Linear radiance of a latitude-longitude map, `.exr` or `.hdr`, row 0 at the top.

    **Raises** `FileNotFoundError`, or `ImageError` (a `ValueError`) as `jvr.io.images.read_image`, and for a map that is not twice as wide
    as it is high or has pixels that are negative or not finite.
    """
    path = Path(path)
    if path.suffix.lower() not in (".exr", ".hdr"):
        raise ImageError(
            path, f"an environment map is .exr or .hdr (linear radiance), not {path.suffix or 'a name without an extension'}"
        )
    radiance = read_image(path)
    height, width, _ = radiance.shape
    if width != 2 * height:
        raise ImageError(
            path, f"it is {width} x {height} pixels; a latitude-longitude map is twice as wide as high: crop or convert it"
        )
    _refuse(path, ~np.isfinite(radiance), "are not finite")
    _refuse(path, radiance < 0, "are negative, which radiance cannot be")
    return radiance


def _refuse(path: Path, bad: Bool[np.ndarray, "height width 3"], what: str) -> None:
    places = np.unique(np.argwhere(bad)[:, :2], axis=0)
    if len(places):
        row, column = places[0]
        problem = f"pixels that {what}: {len(places):,}, the first at column {column}, row {row}; repair them in an image editor"
        raise ImageError(path, problem)
