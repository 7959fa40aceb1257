"""Arrays without a header of their own world: headerless raw, NumPy's .npy, Zarr. Axes are x, y, z unless said otherwise."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, mislabelled, missing_extra, one_line, three_axes
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of
from jvr.io.volumes.units import MILLIMETRES


def read_raw(path: Path, given: Given) -> Stored:
    """Voxels and nothing else, x fastest. `dtype` may state a byte order, as in ">i2"."""
    first_bytes(path)
    shape, dtype = given.shape, given.dtype
    if shape is None or dtype is None:
        problem = "headerless data: give shape=(x, y, z) and dtype= such as 'uint8' or '>i2', and spacing= in mm"
        raise VolumeError(path, problem)
    try:
        shape, dtype = tuple(int(n) for n in shape), np.dtype(dtype)
    except (TypeError, ValueError) as error:
        raise VolumeError(path, f"shape= must be whole numbers and dtype= a NumPy type: {one_line(error)}") from None
    if not 1 <= len(shape) <= 4 or min(shape) < 1 or dtype.kind not in "biuf":
        raise VolumeError(path, f"shape={shape} and dtype={dtype} must be positive sizes (x, y, z) and a real number type")
    wanted, found = math.prod(shape) * dtype.itemsize, path.stat().st_size
    if wanted != found:
        size = " x ".join(str(n) for n in shape)
        raise VolumeError(
            path, f"{size} voxels of {dtype} are {wanted:,} bytes, the file holds {found:,}: correct shape= or dtype="
        )
    check_size(path, shape, dtype.itemsize, found)
    return Stored(np.memmap(path, dtype, "r", shape=three_axes(path, shape), order="F"))


def read_npy(path: Path, given: Given) -> Stored:
    """A NumPy array file, never unpickled. `axes` of the caller names the order of its axes."""
    start = first_bytes(path)
    if not start.startswith(b"\x93NUMPY"):
        raise mislabelled(path, start, "a NumPy array file (.npy)")
    shape, dtype = _npy_header(path)
    if dtype.kind not in "biufc":
        problem = f"the array holds {'Python objects' if dtype.hasobject else dtype}, which are never unpickled"
        raise VolumeError(path, f"{problem}; save an array of real numbers")
    if len(shape) == 0 or min(shape) < 1:
        raise VolumeError(path, f"the array has shape {shape}; a volume needs three non-empty axes")
    # The header is followed by the data and ends at a multiple of 16 bytes; its length is of no account here.
    check_size(path, shape, dtype.itemsize, path.stat().st_size - 10)
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except ValueError as error:
        raise VolumeError(path, f"cut short or damaged: {one_line(error)}; save it again") from None
    return Stored(in_xyz(path, values, given.axes or "xyz"))


def _npy_header(path: Path) -> tuple[tuple[int, ...], np.dtype]:
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(file)
    # NumPy parses the header as Python: a damaged one also raises errors of its tokenizer.
    except Exception as error:
        raise VolumeError(path, f"its header is damaged: {one_line(error)}; save it again") from None
    return shape, dtype


def in_xyz(path: Path, values: Any, axes: str) -> Any:
    """`values`, whose axes are called `axes`, with its axes in the order x, y, z (trailing axes of length one dropped)."""
    shape = values.shape
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) > 3:
        three_axes(path, shape)
    wanted = "xyz"[: len(shape)]
    if axes == "xyz" or sorted(axes) != sorted(wanted):
        if sorted(axes) != ["x", "y", "z"]:
            raise VolumeError(path, f"axes='{axes}' must be the letters of {wanted} in the order of the array's axes")
        axes = "".join(letter for letter in axes if letter in wanted)
    return values.reshape(shape).transpose([axes.index(letter) for letter in wanted])


def read_zarr(path: Path, given: Given) -> Stored:
    """A Zarr array, or one in a group: the caller's `array` is its path there. Needs the extra `jvr[zarr]`.

    Axes come from the caller's `axes`, or else from the array's dimension names or OME-Zarr's metadata (then with scale and
    translation), or else are x, y, z.
    """
    try:
        import zarr
    except ImportError:
        raise missing_extra(path, "zarr", "Zarr") from None
    try:
        node: Any = zarr.open(path, mode="r")
    except Exception as error:
        raise VolumeError(path, f"not a Zarr array or group, or damaged: {one_line(error)}") from None
    ome = _multiscale(node) if isinstance(node, zarr.Group) else {}
    found: Any = _zarr_array(path, zarr, node, given.array or ome.get("path")) if isinstance(node, zarr.Group) else node
    names = ome.get("axes") or getattr(found.metadata, "dimension_names", None) or found.attrs.get("_ARRAY_DIMENSIONS")
    # Time and channels of length one say nothing about where a voxel lies.
    kept = [k for k, n in enumerate(found.shape) if names is None or n > 1 or str(names[k]).lower() in ("x", "y", "z")]
    shape = tuple(found.shape[k] for k in kept)
    if names is not None:
        three_axes(path, shape)
    check_size(path, shape, found.dtype.itemsize, None)
    # Absent chunks are the fill value; where every one is absent, the data were left behind.
    files = (file for file in (path / found.path).rglob("*") if file.is_file())
    if found.size == 0 or all(file.name in ("zarr.json", ".zarray", ".zattrs", ".zmetadata") for file in files):
        raise VolumeError(path, f"the array of shape {found.shape} holds no data: copy it again with its chunks")
    try:
        values = np.asarray(found[...]).reshape(shape)
    except Exception as error:
        raise VolumeError(path, f"a chunk of the array is damaged: {one_line(error)}") from None
    letters = "".join(str(names[k]).lower() for k in kept) if names is not None else "xyz"
    known = len(letters) == len(shape) and set(letters) <= set("xyz")
    order = given.axes or (letters if known else "xyz")
    return Stored(in_xyz(path, values, order), _ome_affine(ome, kept, order) if ome else np.eye(4))


def _zarr_array(path: Path, zarr: Any, group: Any, name: str | None) -> Any:
    arrays = {key: node for key, node in group.members(max_depth=None) if isinstance(node, zarr.Array)}
    shown = ", ".join(f"'{key}'" for key in list(arrays)[:8]) or "none"
    if name is None and len(arrays) == 1:
        return next(iter(arrays.values()))
    if name is None:
        raise VolumeError(path, f"this Zarr group holds {len(arrays)} arrays; choose one with array=: {shown}")
    if name not in arrays:
        raise VolumeError(path, f"this Zarr group holds no array '{name}'; array= may be {shown}")
    return arrays[name]


def _multiscale(group: Any) -> dict[str, Any]:
    """OME-Zarr's finest level: its path, axes, and scale and translation of each axis in millimetres."""
    try:
        scales = (group.attrs.get("ome") or group.attrs)["multiscales"][0]
        level, axes = scales["datasets"][0], scales["axes"]
        steps = {step["type"]: step.get(step["type"]) for step in level.get("coordinateTransformations", [])}
        units = [MILLIMETRES.get(axis.get("unit", ""), 1.0) for axis in axes]
        scale, shift = steps.get("scale") or [1] * len(axes), steps.get("translation") or [0] * len(axes)
        return {
            "path": level["path"],
            "axes": [axis["name"] for axis in axes],
            "scale": [float(a) * b for a, b in zip(scale, units, strict=True)],
            "shift": [float(a) * b for a, b in zip(shift, units, strict=True)],
        }
    except (KeyError, IndexError, TypeError, ValueError, AttributeError):
        return {}


def _ome_affine(ome: dict[str, Any], kept: list[int], order: str) -> np.ndarray:
    spacing, origin = np.ones(3), np.zeros(3)
    for letter, k in zip(order, kept, strict=False):
        spacing["xyz".index(letter)], origin["xyz".index(letter)] = ome["scale"][k], ome["shift"][k]
    return affine_of(spacing, origin)
