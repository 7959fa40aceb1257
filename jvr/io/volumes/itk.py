"""What the DICOM reader takes of SimpleITK: a header's voxels and grid, and silence while it works."""

import contextlib
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import VolumeError, check_size, three_axes
from jvr.io.volumes.stored import affine_of


@contextlib.contextmanager
def silenced():
    """Nothing that C++ libraries print on stderr gets through (the whole process: the file descriptor is redirected)."""
    sys.stderr.flush()
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def check_pixels(path: Path, header: Any) -> None:
    """Refuses what is no scalar volume, or too large for the memory, knowing the header alone."""
    import SimpleITK as sitk

    shape = three_axes(path, header.GetSize())
    if (components := header.GetNumberOfComponents()) > 1:
        raise VolumeError(path, f"every voxel has {components} components (colour, vector or complex); save a scalar volume")
    check_size(path, shape, sitk.Image([1] * 3, header.GetPixelID()).GetSizeOfPixelComponent(), None)


def voxels_of(image: Any) -> np.ndarray:
    """The voxels `[x, y, z]`, a view into the memory of a SimpleITK image, which must be kept alive."""
    import SimpleITK as sitk

    return sitk.GetArrayViewFromImage(image).T


def affine_of_image(image: Any) -> np.ndarray:
    """Where a SimpleITK image, or the reader of one, says that its voxels lie; 2-D images lie in the plane z = 0."""
    n = min(image.GetDimension(), 3)
    spacing, origin, direction = np.ones(3), np.zeros(3), np.eye(3)
    spacing[:n], origin[:n] = image.GetSpacing()[:n], image.GetOrigin()[:n]
    direction[:n, :n] = np.reshape(image.GetDirection(), (image.GetDimension(),) * 2)[:n, :n]
    return affine_of(spacing, origin, direction)
