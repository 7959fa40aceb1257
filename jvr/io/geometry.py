"""Opaque geometry as a picture with its depth, in an OpenEXR file."""

import os

from jvr.io.exr import read_depth
from jvr.io.images import read_image
from jvr.pictures import Pixels, Plane


def read_depth_image(path: str | os.PathLike) -> tuple[Plane, Pixels]:
    """Distances from the eye, the channel Z, and radiance; an alpha plays no part. **Raises** as `jvr.read_image`, and `ImageError` (a
    `ValueError`) where there is no depth."""
    return read_depth(path), read_image(path, alpha="ignored")
