"""Voxels as a reader found them, and the `Volume` that they become: data types, rescaling, missing values."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import VolumeError, three_axes
from jvr.io.volumes.given import Given
from jvr.io.volumes.missing import missing_number
from jvr.model.volume import Volume
from jvr.model.voxels import integer_type


@dataclasses.dataclass
class Stored:
    """Voxels `[x, y, z]`, where voxel (0, 0, 0) and its neighbours lie, and the slope and intercept of the file.

    `missing`: the stored number by which the file marks voxels without data; `unit`: of the data, such as "HU", where the file says so.
    """

    values: np.ndarray
    world_from_grid: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))
    slope: float = 1.0
    intercept: float = 0.0
    missing: float | None = None
    unit: str = ""


def affine_of(spacing: Any, origin: Any = (0, 0, 0), direction: Any = None) -> np.ndarray:
    """4x4 affine of a grid: `direction` holds the unit vectors of the grid's axes in its columns."""
    matrix = np.eye(4)
    matrix[:3, :3] = (np.eye(3) if direction is None else np.asarray(direction)) * np.asarray(spacing, float)
    matrix[:3, 3] = origin
    return matrix


def replaced(stored: Stored, given: Given) -> Stored:
    """What a reader found, with the lengths and directions of its axes, the position of its first voxel, slope and intercept replaced."""
    matrix = stored.world_from_grid.copy()
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    if given.direction is not None:
        matrix[:3, :3] = given.direction * lengths
    if given.spacing is not None:
        matrix[:3, :3] *= given.spacing / lengths
    if given.origin is not None:
        matrix[:3, 3] = given.origin
    slope = stored.slope if given.slope is None else given.slope
    intercept = stored.intercept if given.intercept is None else given.intercept
    return dataclasses.replace(stored, world_from_grid=matrix, slope=slope, intercept=intercept)


def to_volume(path: Path, stored: Stored, given: Given) -> Volume:
    """The `Volume` of what a reader found; `nan_value`, in data units, takes the place of voxels that are not finite."""
    values = stored.values.reshape(three_axes(path, stored.values.shape))
    if not all(np.isfinite([stored.slope, stored.intercept])) or stored.slope == 0:
        problem = f"slope {stored.slope} and intercept {stored.intercept} must be finite, the slope not 0"
        raise VolumeError(path, f"{problem}; slope= and intercept= replace them")
    # One copy, which also owns its memory: JAX may share an array's memory instead of copying it.
    kept = np.array(values, dtype=_memory_type(path, values), order="C")
    if kept.dtype.kind == "f":
        _replace_non_finite(path, kept, None if given.nan_value is None else _stored(stored, given.nan_value))
    missing = missing_number(path, stored, kept, given)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            volume = Volume(
                kept, stored.world_from_grid, slope=stored.slope, intercept=stored.intercept, missing=missing, unit=stored.unit
            )
    except ValueError as error:
        raise VolumeError(path, f"{error}") from None
    for warning in caught:
        warnings.warn(f"{path}: {warning.message}", stacklevel=3)
    return volume


def _stored(stored: Stored, number: float | int) -> float:
    """A number in data units as it is stored."""
    return (number - stored.intercept) / stored.slope


def _memory_type(path: Path, values: np.ndarray) -> np.dtype:
    """The type that voxels are handed on in: integers as narrow as they fit, floats as they are."""
    kind = values.dtype.kind
    if kind == "b":
        return np.dtype(np.uint8)
    if kind not in "iuf":
        kinds = {"c": "complex numbers", "O": "Python objects", "V": "records of several fields"}
        problem = f"the voxels are {kinds.get(kind, 'not numbers')} ({values.dtype}); save them as real numbers"
        raise VolumeError(path, problem + (", their magnitude for example" if kind == "c" else ""))
    try:
        return integer_type(values)
    except ValueError as error:
        raise VolumeError(path, f"{error}") from None


def _replace_non_finite(path: Path, kept: np.ndarray, replacement: float | None) -> None:
    """Writes `replacement` over NaN and infinity; without one NaN stays, which means that there are no data."""
    bad = ~np.isfinite(kept)
    count = int(bad.sum())
    if count == 0:
        return
    nans = int(np.isnan(kept).sum())
    if replacement is not None:
        kept[bad] = replacement
    elif nans < count:
        problem = f"{count:,} of {kept.size:,} voxels are not finite ({nans:,} NaN, {count - nans:,} infinite)"
        raise VolumeError(path, f"{problem}; nan_value=0 (--nan-value 0), or another number, replaces them")
    elif nans == kept.size:
        raise VolumeError(path, "every voxel is NaN: there are no data; export it again, or nan_value=0 (--nan-value 0)")
    else:
        problem = f"{nans:,} of {kept.size:,} voxels are NaN; they count as missing and stay empty"
        warnings.warn(f"{path}: {problem}: nan_value=0 (--nan-value 0) gives them a value", stacklevel=4)
