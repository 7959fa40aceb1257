"""Voxels that hold no data: what a header says of them, what the caller says, and what is known of scanners and of simulations."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jvr.io.volumes.errors import VolumeError
from jvr.io.volumes.given import Given

if TYPE_CHECKING:
    from jvr.io.volumes.stored import Stored

# What CT scanners write outside of the circle that they reconstruct (as stored, and in HU), and others where there is nothing.
PADDING = (-2000.0, -3024.0, -32768.0, -999.0, -9999.0, -99999.0, -999999.0, -2147483648.0)
ENORMOUS = 1e20
# By how much of its own size a padding is set apart from the smallest voxel beside it.
APART = 0.1


def missing_number(path: Path, stored: "Stored", kept: np.ndarray, given: Given) -> float | None:
    """The stored number that means "no data", or `None`: as the caller says in data units (`False`: none), else as the file does, else one
    that is known for it, with a warning.

    **Raises** `VolumeError` where every voxel is missing.
    """
    if given.missing is False:
        return None
    if given.missing is not None:
        number = (float(given.missing) - stored.intercept) / stored.slope
        number = float(round(number)) if kept.dtype.kind in "iu" else number
        _count(path, kept, number)
        return number
    number, why = stored.missing, "by which the file marks missing data"
    if number is None:
        number, why = _guessed(stored, kept), "far from all others, as padding is"
    if number is None or np.isnan(number):
        return None
    count = _count(path, kept, number)
    if count:
        problem = f"{count:,} of {kept.size:,} voxels are {stored.slope * number + stored.intercept:g}, {why}"
        warnings.warn(f"{path}: {problem}; they stay empty: missing=False (--missing none) keeps them", stacklevel=5)
    return number


def _count(path: Path, kept: np.ndarray, number: float) -> int:
    same = kept == (np.asarray(number).astype(kept.dtype) if kept.dtype.kind == "f" else number)
    count = int(np.count_nonzero(same))
    if count == kept.size:
        raise VolumeError(path, f"every voxel is {number:g}, which means that there are no data; missing=False keeps them")
    return count


def _enormous(kept: np.ndarray) -> float | None:
    """1e20, as models of oceans and the air write where there is nothing, or its negative."""
    for number in (float(np.nanmin(kept)), float(np.nanmax(kept))):
        if kept.dtype.type(ENORMOUS) == abs(number) and np.abs(kept[kept != number]).max(initial=0) < 1e-3 * ENORMOUS:
            return number
    return None


def _guessed(stored: "Stored", kept: np.ndarray) -> float | None:
    """The smallest number where it is known to be a padding, and far from the next."""
    if kept.dtype.kind == "f" and kept.dtype.itemsize > 2 and (found := _enormous(kept)) is not None:
        return found
    number = float(np.nanmin(kept))
    if number not in PADDING and round(stored.slope * number + stored.intercept, 3) not in PADDING:
        return None
    others = kept[kept > number]
    return number if others.size and float(others.min()) - number > APART * abs(number) else None
