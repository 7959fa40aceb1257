"""Voxels as a reader found them, and the `Volume` that they become: data types, rescaling, missing values."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jvr.io.volumes.errors import VolumeError, three_axes
from jvr.io.volumes.given import Given
from jvr.model.volume import Volume


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
    # Whose memory `values` looks into: a view of a SimpleITK image does not keep the image alive.
    owner: Any = None


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


def to_volume(path: Path, stored: Stored, nan_value: float | int | None) -> Volume:
    """The `Volume` of what a reader found; `nan_value`, in data units, takes the place of voxels that are not finite."""
    values = stored.values.reshape(three_axes(path, stored.values.shape))
    if not all(np.isfinite([stored.slope, stored.intercept])) or stored.slope == 0:
        raise VolumeError(path, f"slope {stored.slope} and intercept {stored.intercept} must be finite, the slope not 0")
    dtype = _memory_type(path, values)
    # One copy, which also owns its memory: JAX may share an array's memory instead of copying it.
    with np.errstate(over="ignore"):
        kept = np.array(values, dtype=dtype, order="C")
    if np.issubdtype(dtype, np.floating):
        _replace_non_finite(path, values, kept, None if nan_value is None else (nan_value - stored.intercept) / stored.slope)
        _warn_of_lost_detail(path, values, kept)
    try:
        return Volume(kept, stored.world_from_grid, slope=stored.slope, intercept=stored.intercept)
    except ValueError as error:
        raise VolumeError(path, f"{error}") from None


def _memory_type(path: Path, values: np.ndarray) -> np.dtype:
    """The type that voxels get in memory: integers stay integers, wide ones as narrow as they fit; floats become float32."""
    kind = values.dtype.kind
    if kind == "b":
        return np.dtype(np.uint8)
    if kind == "f":
        return np.dtype(np.float64 if _x64() and values.dtype.itemsize >= 8 else np.float32)
    if kind not in "iu":
        kinds = {"c": "complex numbers", "O": "Python objects", "V": "records of several fields"}
        problem = f"the voxels are {kinds.get(kind, 'not numbers')} ({values.dtype}); save them as real numbers"
        raise VolumeError(path, problem + (", their magnitude for example" if kind == "c" else ""))
    if values.dtype.itemsize <= 2:
        return values.dtype.newbyteorder("=")
    low, high = int(values.min()), int(values.max())
    types = [np.uint8, np.int8, np.int16, np.uint16, np.int32, np.uint32, *([np.int64, np.uint64] if _x64() else [])]
    for dtype in types:
        if np.iinfo(dtype).min <= low and high <= np.iinfo(dtype).max:
            return np.dtype(dtype)
    raise VolumeError(path, f"integers from {low} to {high} do not fit 32 bits; rescale them or enable x64 in JAX")


def _x64() -> bool:
    return jax.dtypes.canonicalize_dtype(np.float64) == np.float64


def _replace_non_finite(path: Path, found: np.ndarray, kept: np.ndarray, replacement: float | None) -> None:
    """Writes `replacement` over NaN and infinity in `kept`, or raises where there is none."""
    bad = ~np.isfinite(kept)
    count = int(bad.sum())
    if count == 0:
        return
    too_large = count - int((~np.isfinite(found)).sum())
    if too_large:
        raise VolumeError(path, f"{too_large:,} voxels exceed the range of float32 (3.4e38); rescale them or enable x64 in JAX")
    if replacement is None:
        nans = int(np.isnan(kept).sum())
        problem = f"{count:,} of {kept.size:,} voxels are not finite ({nans:,} NaN, {count - nans:,} infinite)"
        raise VolumeError(path, f"{problem}; nan_value=0 (--nan-value 0), or another number, replaces them")
    kept[bad] = replacement


def _warn_of_lost_detail(path: Path, found: np.ndarray, kept: np.ndarray) -> None:
    """float64 voxels with a large offset (1e9 + something small) lose in float32 what sets them apart."""
    if found.dtype.itemsize <= kept.dtype.itemsize:
        return
    low, high = float(kept.min()), float(kept.max())
    finest = float(np.finfo(np.float32).eps) * max(abs(low), abs(high))
    if finest > 1e-3 * (high - low) and not np.array_equal(found, kept, equal_nan=True):
        message = f"{path}: float32 resolves only {finest:.2g} in values from {low:.9g} to {high:.9g}"
        warnings.warn(f"{message}; subtract the offset or enable x64 in JAX", stacklevel=4)
