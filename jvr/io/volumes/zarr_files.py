"""Zarr: plain arrays, groups, and OME-Zarr 0.1 to 0.5 with its axes, units and both of its coordinate transformations."""

import dataclasses
import math
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.apart import decoded
from jvr.io.volumes.arrays import axes_of
from jvr.io.volumes.axes import NAMES, Chosen, chosen, named
from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, missing_extra, one_line
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of
from jvr.io.volumes.units import millimetres

MARKERS = ("zarr.json", ".zarray", ".zgroup")
# What turns bytes into numbers and no more; others may hold Python objects, the unpickling of which runs whatever they say.
CODECS = {"bytes", "transpose", "sharding_indexed", "zlib", "gzip", "bz2", "lzma", "blosc", "zstd", "lz4", "shuffle", "delta"}
CODECS |= {"packbits", "fixedscaleoffset", "quantize", "bitround", "astype"}
CODECS |= {"crc32", "crc32c", "adler32", "fletcher32", "jenkins_lookup3"}
# Of these, those that only arrange bytes.
PLAIN = {"bytes", "transpose"}
# Before OME-Zarr 0.3, which names its axes.
OLD_AXES = ("t", "c", "z", "y", "x")


@dataclasses.dataclass(frozen=True)
class Level:
    """One resolution of an OME-Zarr image: path of its array, name, unit, scale and shift of each axis, names of channels."""

    path: str
    names: list[str]
    units: list[str | None]
    scale: np.ndarray
    shift: np.ndarray
    scaled: bool
    channels: list[str]


def is_zarr(path: Path) -> bool:
    """Whether a folder holds a Zarr array or group, whatever its name."""
    return any((path / marker).exists() for marker in MARKERS)


def read_zarr(path: Path, given: Given) -> Stored:
    """A Zarr array, or one in a group: the caller's `array` is its path there. Needs the extra `jvr[zarr]`.

    Axes come from the caller's `axes`, or else from OME-Zarr's metadata (then with scale and translation) or the array's
    dimension names, or else are x, y, z. Of an OME-Zarr the finest level is read, of the layout of bioformats2raw the first image.
    """
    try:
        import zarr
        from zarr.storage import ZipStore
    except ImportError:
        raise missing_extra(path, "zarr", "Zarr") from None
    try:
        store: Any = path if path.is_dir() else ZipStore(_zip(path), mode="r")
        node: Any = zarr.open(store, mode="r")
    except VolumeError:
        raise
    except Exception as error:
        raise VolumeError(path, f"not a Zarr array or group, or damaged: {one_line(error)}") from None
    try:
        found, level = _found(path, zarr, node, given)
        names = _names(path, found, level, given)
    except VolumeError:
        raise
    except Exception as error:
        raise VolumeError(path, f"the metadata of this Zarr are damaged: {one_line(error)}") from None
    place = chosen(path, found.shape, names, given, level.channels if level else ())
    try:
        coded = _check(path, found, place)
        values = _apart(path, found, place) if coded else place.of(found)
    except VolumeError:
        raise
    except Exception as error:
        raise VolumeError(path, f"a chunk of the array is damaged: {one_line(error)}; copy it again") from None
    return Stored(values, _affine(path, level, place, given), missing=_missing(found))


def _zip(path: Path) -> Path:
    if not first_bytes(path).startswith(b"PK"):
        raise VolumeError(path, "this is not a ZIP archive of a Zarr; give the file its right extension")
    return path


def _found(path: Path, zarr: Any, node: Any, given: Given) -> tuple[Any, Level | None]:
    """The array that is asked for, and what OME-Zarr says of it."""
    if not isinstance(node, zarr.Group):
        if given.array is not None:
            raise VolumeError(path, f"it is a single array: leave array='{given.array}' out")
        return node, None
    name = given.array
    if name is None and not _multiscales(node):
        name = _series(path, zarr, node)
    inner = node if name is None else node.get(name.strip("/"))
    if isinstance(inner, zarr.Group):
        level = _level(path, inner, None, given)
        if level is not None:
            return _array(path, zarr, inner, level.path), level
    if name is None or not isinstance(inner, zarr.Array):
        return _array(path, zarr, node, name), None
    _say_coordinates(path, node, name, inner)
    above, _, last = name.strip("/").rpartition("/")
    parent = node.get(above) if above else node
    return inner, _level(path, parent, last, given) if isinstance(parent, zarr.Group) else None


def _say_coordinates(path: Path, node: Any, name: str, array: Any) -> None:
    """Says that arrays beside this one, called like its axes as xarray writes them, hold positions that are not read."""
    above = name.strip("/").rpartition("/")[0]
    group = node.get(above) if above else node
    names = getattr(array.metadata, "dimension_names", None) or array.attrs.get("_ARRAY_DIMENSIONS") or []
    found = [str(axis) for axis in names if str(axis) in group]
    if found:
        problem = f"the coordinates in its arrays {', '.join(found)} are not read: voxels are taken for 1 mm"
        warnings.warn(f"{path}: {problem}; give spacing= and origin= in mm", stacklevel=2)


def _array(path: Path, zarr: Any, group: Any, name: str | None) -> Any:
    arrays = {key: node for key, node in group.members(max_depth=None) if isinstance(node, zarr.Array)}
    shown = ", ".join(f"'{key}'" for key in list(arrays)[:8]) or "none"
    if name is None and len(arrays) == 1:
        return next(iter(arrays.values()))
    if name is None:
        raise VolumeError(path, f"this Zarr group holds {len(arrays)} arrays; choose one with array=: {shown}")
    if name not in arrays:
        raise VolumeError(path, f"this Zarr group holds no array '{name}'; array= may be {shown}")
    return arrays[name]


def _metadata(group: Any) -> dict[str, Any]:
    """OME-Zarr's part of the attributes: under "ome" since 0.5, at the top before."""
    attributes = dict(group.attrs)
    inner = attributes.get("ome")
    return inner if isinstance(inner, dict) else attributes


def _multiscales(group: Any) -> Any:
    return _metadata(group).get("multiscales")


def _series(path: Path, zarr: Any, group: Any) -> str | None:
    """The first image of the layout that bioformats2raw writes, or `None` where the group is of another layout."""
    if "bioformats2raw.layout" not in _metadata(group):
        return None
    listed = [str(name) for name in _metadata(group["OME"]).get("series", [])] if "OME" in group else []
    series = listed or sorted((key for key, node in group.groups() if _multiscales(node)), key=lambda key: (len(key), key))
    if not series:
        return None
    if len(series) > 1:
        shown = ", ".join(f"'{name}'" for name in series[:8])
        warnings.warn(
            f"{path}: it holds {len(series)} images; '{series[0]}' is read: array= chooses another ({shown})", stacklevel=2
        )
    return series[0]


def _level(path: Path, group: Any, name: str | None, given: Given) -> Level | None:
    """What OME-Zarr says of the finest level, or of the one whose array is called `name`; `None` where the group is no OME-Zarr image."""
    scales = _multiscales(group)
    if not scales:
        return None
    image = scales[0]
    datasets = [dataset for dataset in image["datasets"] if name is None or dataset["path"] == name]
    if not datasets:
        return None
    axes = [axis if isinstance(axis, dict) else {"name": axis} for axis in image.get("axes") or OLD_AXES]
    names = [{"time": "t", "channel": "c"}.get(axis.get("type", ""), str(axis["name"])) for axis in axes]
    # The dataset's transformations come first, the image's act on what they give.
    steps = [*datasets[0].get("coordinateTransformations", []), *image.get("coordinateTransformations", [])]
    scale, shift = np.ones(len(axes)), np.zeros(len(axes))
    for step in steps:
        kind = step["type"]
        if kind == "identity":
            continue
        values = np.asarray(step[kind], float) if kind in ("scale", "translation") and kind in step else None
        if (
            values is None
            or values.shape != scale.shape
            or not np.isfinite(values).all()
            or (kind == "scale" and not (values > 0).all())
        ):
            problem = f"its coordinateTransformations hold '{kind}' {step.get(kind, '')}; {len(axes)} finite numbers are read"
            if given.spacing is not None:
                continue
            problem += ", positive where they scale, of kinds 'scale' and 'translation'"
            raise VolumeError(path, f"{problem}: give spacing= and origin= in mm")
        scale, shift = (scale * values, shift * values) if kind == "scale" else (scale, shift + values)
    omero = _metadata(group).get("omero") or group.attrs.get("omero") or {}
    channels = [str(channel.get("label", "")) for channel in omero.get("channels", [])]
    units = [axis.get("unit") for axis in axes]
    scaled = any(step["type"] == "scale" for step in steps)
    return Level(str(datasets[0]["path"]), names, units, scale, shift, scaled, channels if all(channels) else [])


def _names(path: Path, found: Any, level: Level | None, given: Given) -> Sequence[str]:
    """Names of the axes: the caller's, or OME-Zarr's, or those of the array."""
    if given.axes is not None:
        return named(path, found.shape, given.axes)
    if level is not None:
        return level.names
    names = getattr(found.metadata, "dimension_names", None) or found.attrs.get("_ARRAY_DIMENSIONS")
    if not names or all(name is None for name in names):
        return axes_of(path, found.shape, given)
    foreign = [name for name, n in zip(names, found.shape, strict=False) if n > 1 and str(name).lower() not in NAMES]
    if foreign:
        shown = ", ".join(str(name) for name in names)
        raise VolumeError(path, f"its axes are called {shown}: say which are x, y, z, c, t with axes=, such as 'zyx'")
    return [str(name) for name in names]


def _apart(path: Path, found: Any, place: Chosen) -> np.ndarray:
    """The chosen volume, from a process of its own: its decoders, native code, crash on damaged chunks."""
    shape = [n for n, one in zip(found.shape, place.index, strict=True) if isinstance(one, slice)]
    count = math.prod(shape) * found.dtype.itemsize
    task = {"kind": "zarr", "store": str(path), "array": found.path, "dtype": found.dtype.str, "shape": shape}
    task["index"] = [None if isinstance(one, slice) else one for one in place.index]
    task["bytes"] = max(count, 8 * math.prod(found.chunks) * found.dtype.itemsize)
    return place.arranged(decoded(path, task, count).view(found.dtype).reshape(shape))


def _check(path: Path, found: Any, place: Chosen) -> bool:
    """Refuses what is no array of numbers, holds no data or does not fit in memory, before a chunk is decoded: says whether one must be."""
    if found.dtype.kind not in "biufc":
        raise VolumeError(path, f"the array holds {found.dtype}, not numbers; save it as real numbers")
    metadata = found.metadata.to_dict()
    parts = [metadata.get(name) for name in ("codecs", "filters", "compressor")]
    coded = set(_codecs(parts)) - PLAIN
    if foreign := [name for name in coded if name.removeprefix("numcodecs.") not in CODECS]:
        raise VolumeError(path, f"its chunks are coded by '{foreign[0]}', which is not read: save it with zstd, blosc or zlib")
    shape = [n for n, one in zip(found.shape, place.index, strict=True) if isinstance(one, slice)]
    check_size(path, shape, found.dtype.itemsize, None)
    if math.prod(found.chunks) * found.dtype.itemsize > 4 * math.prod(found.shape) * found.dtype.itemsize + 2**26:
        raise VolumeError(path, f"its chunks {found.chunks} are far larger than the array {found.shape}: its metadata are wrong")
    check_size(path, found.chunks, found.dtype.itemsize, None)
    # Absent chunks are the fill value; where every one is absent, the data were left behind.
    if path.is_dir():
        files = [file.name for file in (path / found.path).rglob("*") if file.is_file()]
    else:
        with zipfile.ZipFile(path) as archive:
            files = [name.rsplit("/", 1)[-1] for name in archive.namelist() if name.startswith(found.path)]
    if found.size == 0 or all(name in (*MARKERS, ".zattrs", ".zmetadata", "") for name in files):
        raise VolumeError(path, f"the array of shape {found.shape} holds no data: copy it again with its chunks")
    return bool(coded)


def _codecs(parts: Any) -> Iterator[str]:
    """Names of codecs, and of those within others."""
    if isinstance(parts, dict):
        if "id" in parts or "name" in parts:
            yield str(parts.get("id") or parts.get("name"))
        parts = list(parts.values())
    if isinstance(parts, list | tuple):
        for part in parts:
            yield from _codecs(part)


def _affine(path: Path, level: Level | None, place: Chosen, given: Given) -> np.ndarray:
    """Voxel size and position in mm; the units of time and channels are of no account."""
    if level is None or (given.spacing is not None and given.origin is not None):
        return np.eye(4)
    if len(level.names) != len(place.index):
        raise VolumeError(path, f"its metadata name {len(level.names)} axes, the array has {len(place.index)}: export it again")
    if not level.scaled and given.spacing is None:
        problem = "its metadata give no scale, so that voxels are taken for 1 mm wide"
        warnings.warn(f"{path}: coordinateTransformations: {problem}; give spacing= in mm", stacklevel=2)
    spacing, origin, lengths = np.ones(3), np.zeros(3), {}
    for axis, k in enumerate(place.kept):
        if k is None or not level.scaled:
            continue
        unit = level.units[k]
        if unit not in lengths:
            alike = ", ".join(
                name for name, other in zip(level.names, level.units, strict=True) if other == unit and name not in "ct"
            )
            # With the caller's spacing, the unit matters to the position alone.
            asked = given.spacing is None or any(level.shift[k] for k in place.kept if k is not None)
            lengths[unit] = millimetres(path, f"the unit of its axes {alike}", unit) if asked else 1.0
        spacing[axis], origin[axis] = level.scale[k] * lengths[unit], level.shift[k] * lengths[unit]
    return affine_of(spacing, origin)


def _missing(found: Any) -> float | None:
    """The number that attributes call "no data", by the conventions of CF and xarray."""
    for key in ("_FillValue", "missing_value"):
        value = found.attrs.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
    return None
