"""What VTK's two formats share: a grid with arrays on its points and cells, of which one is chosen."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jvr.io.volumes.axes import chosen
from jvr.io.volumes.directions import check_volume
from jvr.io.volumes.errors import VolumeError, check_size
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of


@dataclasses.dataclass
class Grid:
    """Points along x, y, z, the first of them, and what places point (0, 0, 0)."""

    points: tuple[int, ...]
    spacing: Sequence[float] = (1.0, 1.0, 1.0)
    origin: Sequence[float] = (0.0, 0.0, 0.0)
    direction: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    first: Sequence[int] = (0, 0, 0)


@dataclasses.dataclass
class Array:
    """An array that is not read yet: `read` gives its `tuples * components` numbers, the components of a point side by side.

    `stored`: bytes that the file may have for it, at most.
    """

    name: str
    components: int
    tuples: int
    dtype: np.dtype
    cells: bool
    active: bool
    stored: int
    read: Callable[[], np.ndarray]


def volume_of(path: Path, grid: Grid, arrays: list[Array], given: Given) -> Stored:
    """The array that the caller names, or the active scalars, or the only array of scalars."""
    array = _array(path, arrays, given)
    shape = tuple(max(n - 1, 1) for n in grid.points) if array.cells else grid.points
    if array.tuples != (voxels := math.prod(shape)):
        problem = f"array '{array.name[:80]}' has {array.tuples:,} values for {voxels:,} voxels"
        raise VolumeError(path, f"{problem}: it is cut short or its header is wrong")
    of_all = chosen(path, (array.components, *shape), "cxyz", given)
    check_size(path, (array.components, *shape) if array.components > 1 else shape, array.dtype.itemsize, array.stored)
    values = array.read().reshape((array.components, *shape), order="F")
    direction = grid.direction if given.direction is None else given.direction
    check_volume(path, "Direction", direction)
    affine = affine_of(grid.spacing if given.spacing is None else given.spacing, grid.origin, direction)
    # The value of a cell sits at its centre.
    affine[:3, 3] += affine[:3, :3] @ (np.array(grid.first) + (0.5 * (np.array(grid.points) > 1) if array.cells else 0.0))
    return Stored(of_all.of(values), affine)


def _array(path: Path, arrays: list[Array], given: Given) -> Array:
    wide = [array for array in arrays if array.components > 1]
    scalars = [array for array in arrays if array.components == 1]
    names = lambda found: ", ".join(f"'{array.name[:80]}'" for array in found[:8]) or "none"
    if given.array is not None:
        named = [array for array in arrays if array.name == given.array]
        if not named:
            raise VolumeError(path, f"it holds no array '{given.array[:80]}'; array= may be {names(scalars + wide)}")
        return named[0]
    # A channel can only be that of an array that has several.
    candidates = wide if given.channel is not None and wide else scalars
    active = sorted((array for array in candidates if array.active), key=lambda array: array.cells)
    if active:
        return active[0]
    if not candidates:
        problem = (
            f"it holds no scalar array, only {len(wide)} of vectors or colours ({names(wide)})" if wide else "it holds no array"
        )
        remedy = (
            "; choose array= and one component of it with channel=0, or save a scalar array, their length for example"
            if wide
            else ""
        )
        raise VolumeError(path, problem + remedy)
    if len(candidates) > 1:
        kind = "arrays of several components" if candidates is wide else "scalar arrays"
        raise VolumeError(path, f"it holds {len(candidates)} {kind}; choose one with array=: {names(candidates)}")
    return candidates[0]
