"""Axes of a grid in the world: those that a flat image lacks, and those that span no volume."""

from pathlib import Path

import numpy as np

from jvr.io.volumes.errors import VolumeError


def completed(columns: np.ndarray) -> np.ndarray:
    """Columns of a 3x3 matrix where those that are zero become unit vectors square to the others (images have two axes or one)."""
    found = columns.copy()
    for k in np.flatnonzero(~columns.any(axis=0)):
        i, j = (k + 1) % 3, (k + 2) % 3
        normal = np.cross(found[:, i], found[:, j])
        if not normal.any():
            along = found[:, i] if found[:, i].any() else found[:, j]
            normal = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
            normal = normal if normal.any() else np.eye(3)[k]
        found[:, k] = normal / np.linalg.norm(normal)
    return found


def check_volume(path: Path, field: str, columns: np.ndarray) -> None:
    """**Raises** `VolumeError` for axes of no length, or in one plane."""
    lengths = np.linalg.norm(columns, axis=0)
    if not np.isfinite(lengths).all() or not (lengths > 0).all() or abs(np.linalg.det(columns / lengths)) < 1e-6:
        problem = f"its {field} has axes of length 0 or in one plane"
        raise VolumeError(path, f"{problem}: correct it, or give spacing= and direction=")
