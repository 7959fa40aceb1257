"""Arrays without a header of their own world: headerless raw and NumPy's .npy. Axes are x, y, z unless said otherwise."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.axes import chosen, named
from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, mislabelled, one_line, three_axes
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored


def read_raw(path: Path, given: Given) -> Stored:
    """Voxels and nothing else, x fastest. `dtype` may state a byte order, as in ">i2"."""
    first_bytes(path)
    shape, dtype = given.shape, given.dtype
    if shape is None or dtype is None:
        problem = "headerless data: give shape=(x, y, z) and dtype= such as 'uint8' or '>i2', and spacing= in mm"
        raise VolumeError(path, problem)
    try:
        shape, dtype = tuple(_whole(n) for n in shape), np.dtype(dtype)
    except (TypeError, ValueError) as error:
        raise VolumeError(path, f"shape= must be whole numbers and dtype= a NumPy type: {one_line(error)}") from None
    if not 1 <= len(shape) <= 4 or min(shape) < 1 or dtype.kind not in "biuf":
        raise VolumeError(path, f"shape={shape} and dtype={dtype} must be positive sizes (x, y, z) and a real number type")
    wanted, found = math.prod(shape) * dtype.itemsize, path.stat().st_size
    if wanted != found and first_bytes(path, 2) == b"\x1f\x8b":
        raise VolumeError(path, "the voxels are gzip-compressed: unpack the file first")
    if wanted != found:
        size = " x ".join(str(n) for n in shape)
        raise VolumeError(
            path, f"{size} voxels of {dtype} are {wanted:,} bytes, the file holds {found:,}: correct shape= or dtype="
        )
    check_size(path, shape, dtype.itemsize, found)
    return Stored(np.memmap(path, dtype, "r", shape=three_axes(path, shape), order="F"))


def _whole(number: Any) -> int:
    """A number of voxels. **Raises** `ValueError` for parts of a voxel."""
    if isinstance(number, str) or int(number) != number:
        raise ValueError(f"{number!r} is none")
    return int(number)


def read_npy(path: Path, given: Given) -> Stored:
    """A NumPy array file, never unpickled. The caller's `axes` names its axes, of which `channel` and `time` choose a volume."""
    start = first_bytes(path)
    if not start.startswith(b"\x93NUMPY"):
        raise mislabelled(path, start, "a NumPy array file (.npy)")
    with path.open("rb") as file:
        shape, dtype = npy_header(file, path)
    if dtype.kind not in "biufc":
        problem = "Python objects, which are never unpickled" if dtype.hasobject else f"{dtype}, which is no type of real numbers"
        raise VolumeError(path, f"the array holds {problem}; save it as float32, for example")
    if len(shape) == 0 or min(shape) < 1:
        raise VolumeError(path, f"the array has shape {shape}; a volume needs three non-empty axes")
    # The header is followed by the data and ends at a multiple of 16 bytes; its length is of no account here.
    check_size(path, shape, dtype.itemsize, path.stat().st_size - 10)
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except ValueError as error:
        raise VolumeError(path, f"cut short or damaged: {one_line(error)}; save it again") from None
    return Stored(chosen(path, shape, axes_of(path, shape, given), given).of(values))


def npy_header(file: Any, path: Path) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of a NumPy array file that is open for reading, or of one in an archive at `path`."""
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
    # NumPy parses the header as Python: a damaged one also raises errors of its tokenizer.
    except Exception as error:
        raise VolumeError(path, f"its header is damaged: {one_line(error)}; save it again") from None
    return shape, dtype


def axes_of(path: Path, shape: Sequence[int], given: Given) -> list[str]:
    """Names of the axes of an array that names none: the caller's, or x, y, z of three."""
    longer = len([n for n in shape if n > 1])
    if given.axes is None and len(shape) > 3 and any(n > 1 for n in shape[3:]):
        like = "'tczyx'" if longer > 4 else "'czyx' or 'xyzt'"
        problem = f"shape {tuple(shape)} has {len(shape)} axes, and nothing names them"
        raise VolumeError(path, f"{problem}: name them with axes=, such as {like}, and choose with channel= or time=")
    return named(path, shape, given.axes or "xyz"[: len(shape)])
