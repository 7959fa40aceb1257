"""MetaImage (.mhd, .mha): a header of `key = value` lines and voxels behind it, in one other file or in many.

Voxels lie where ITK puts them: position `Offset + sum_i index_i * ElementSpacing_i * row_i(TransformMatrix)`, LPS, millimetres.
"""

import math
import re
from pathlib import Path

import numpy as np

from jvr.io.volumes import payload
from jvr.io.volumes.axes import chosen
from jvr.io.volumes.directions import check_volume
from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, grid_shape, mislabelled
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of
from jvr.io.volumes.units import millimetres

TYPES = {"CHAR": "i1", "UCHAR": "u1", "SHORT": "i2", "USHORT": "u2", "INT": "i4", "UINT": "u4", "LONG": "i4", "ULONG": "u4"}
TYPES |= {"LONG_LONG": "i8", "ULONG_LONG": "u8", "FLOAT": "f4", "DOUBLE": "f8"}
# Several names for one thing, the first of them wins.
ORIGINS = ("Offset", "Position", "Origin")
DIRECTIONS = ("TransformMatrix", "Rotation", "Orientation")
SPACINGS = ("ElementSpacing", "ElementSize")

Fields = dict[str, str]


def read_metaimage(path: Path, given: Given) -> Stored:
    """A MetaImage of up to four axes, the last of them time, and of several channels.

    Its intensity function becomes slope and intercept.
    """
    start = first_bytes(path)
    end = re.search(rb"^[ \t]*ElementDataFile[ \t]*=.*$\n?", start, re.MULTILINE)
    if end is None:
        raise mislabelled(path, start, "a MetaImage (its header ends with the line 'ElementDataFile = ...')")
    lines = [line.split("=", 1) for line in start[: end.end()].decode("latin-1").splitlines() if "=" in line]
    fields = {key.strip(): value.strip() for key, value in lines}
    if missing := [key for key in ("DimSize", "ElementType") if key not in fields]:
        raise VolumeError(path, f"the header lacks '{missing[0]} = ...'")
    if (kind := fields.get("ObjectType", "Image")).lower() != "image":
        raise VolumeError(path, f"ObjectType is '{kind[:40]}'; only Image is a volume")
    shape = _shape(path, fields)
    channels = max(_whole(path, fields, "ElementNumberOfChannels"), 1)
    of_all = chosen(path, (channels, *shape), "cxyzt"[: 1 + len(shape)], given)
    values = _values(path, fields, shape, channels, end.end()).reshape((channels, *shape), order="F")
    slope, intercept = (f"ElementToIntensityFunction{name}" for name in ("Slope", "Offset"))
    return Stored(
        of_all.of(values),
        _affine(path, fields, shape, given),
        1.0 if given.slope is not None else _first(path, slope, fields.get(slope, "1")),
        0.0 if given.intercept is not None else _first(path, intercept, fields.get(intercept, "0")),
    )


def _shape(path: Path, fields: Fields) -> tuple[int, ...]:
    words = fields["DimSize"].split()
    axes = _whole(path, fields, "NDims") or len(words)
    if not 1 <= axes <= 4:
        raise VolumeError(path, f"NDims is {axes}; a volume has 2 or 3 axes, and 4 with time")
    if len(words) != axes:
        raise VolumeError(path, f"DimSize is '{fields['DimSize'][:80]}', NDims {axes}: it must be as many whole numbers")
    return grid_shape(path, "DimSize", words)


def _whole(path: Path, fields: Fields, name: str) -> int:
    """An integer of a header, 0 where it is absent."""
    text = fields.get(name, "0")
    if not re.fullmatch(r"[+-]?\d{1,18}", text, re.ASCII):
        raise VolumeError(path, f"{name} is '{text[:40]}'; it must be a whole number")
    return int(text)


def _first(path: Path, name: str, text: str) -> float:
    return (grid_numbers(path, name, text, positive=False) or [0.0])[0]


def _yes(path: Path, fields: Fields, *names: str, default: str = "False") -> bool:
    name = next((name for name in names if name in fields), names[0])
    text = fields.get(name, default).lower()
    if text[:1] not in ("t", "f", "1", "0"):
        raise VolumeError(path, f"{name} is '{text[:40]}'; it must be True or False")
    return text[0] in "t1"


# --- Voxels ----------------------------------------------------------------------------------------------------------


def _values(path: Path, fields: Fields, shape: tuple[int, ...], channels: int, header_bytes: int) -> np.ndarray:
    code = TYPES.get(fields["ElementType"].removeprefix("MET_").removesuffix("_ARRAY"))
    if code is None:
        raise VolumeError(path, f"ElementType {fields['ElementType'][:40]} is no number type; MET_SHORT or MET_FLOAT would be")
    big = _yes(path, fields, "BinaryDataByteOrderMSB", "ElementByteOrderMSB")
    dtype = np.dtype(code).newbyteorder(">" if big else "<")
    announced = (channels, *shape) if channels > 1 else shape
    count = math.prod(announced)
    files = _files(path, fields, shape, header_bytes)
    text = not _yes(path, fields, "BinaryData", default="True")
    packed = _yes(path, fields, "CompressedData")
    if packed and (len(files) > 1 or text):
        raise VolumeError(path, "CompressedData stands for one file of binary voxels: it must be False here")
    skip = _whole(path, fields, "HeaderSize")
    local = files == [path]
    offset = skip if skip > 0 else header_bytes if local else 0
    offsets = [offset] * len(files)
    stored = payload.room(path, files, offsets)
    check_size(path, announced, 1 if text else dtype.itemsize, stored, compressed=packed)
    if text:
        check_size(path, announced, dtype.itemsize, None)
        return payload.numbers_of(path, payload.text_of(files, offsets), count, dtype)
    if packed:
        if (said := _whole(path, fields, "CompressedDataSize")) > stored:
            raise VolumeError(path, f"the header announces {said:,} compressed bytes, the file holds {stored:,}: it is cut short")
        pieces = payload.pieces_of(files[0], offset)
        return payload.unpacked(path, pieces, "zlib", count * dtype.itemsize).view(dtype)
    return payload.slabs(path, files, None if skip < 0 else offsets, count * dtype.itemsize).view(dtype)


def _files(path: Path, fields: Fields, shape: tuple[int, ...], header_bytes: int) -> list[Path]:
    """Where the voxels are: this file, another one, or a list of slices or volumes."""
    name = fields["ElementDataFile"]
    words = name.split()
    if name.upper() == "LOCAL":
        return [path]
    if words[:1] == ["LIST"]:
        with path.open("rb") as file:
            file.seek(header_bytes)
            lines = file.read(1 << 22).decode("latin-1").splitlines()
        each = int(words[1][0]) if words[1:] and words[1][0] in "123" else len(shape) - 1
        names = [line.strip() for line in lines if line.strip()]
        wanted = math.prod(shape[each:])
        if len(names) < wanted:
            raise VolumeError(path, f"its list names {len(names):,} files for {wanted:,} parts of the volume: it is cut short")
        return [payload.data_file(path, name) for name in names[: min(wanted, payload.MOST_FILES)]]
    if "%" in name:
        return [payload.data_file(path, name) for name in payload.numbered(path, words, shape[-1])]
    return [payload.data_file(path, name)]


# --- Where they lie --------------------------------------------------------------------------------------------------


def _affine(path: Path, fields: Fields, shape: tuple[int, ...], given: Given) -> np.ndarray:
    n, axes = len(shape), min(len(shape), 3)
    spacing, origin, direction = np.ones(3), np.zeros(3), np.eye(3)
    unit = 1.0
    if "DistanceUnits" in fields and (given.spacing is None or given.origin is None):
        unit = millimetres(path, "DistanceUnits", fields["DistanceUnits"])
    if given.spacing is None:
        found = _numbers(path, fields, SPACINGS, axes, positive=True)
        if found is None:
            payload.said(path, "the header lacks 'ElementSpacing = ...': voxels are taken as 1 mm; else give spacing=")
        spacing[:axes] = unit * np.array(found or [1.0] * axes)
    if given.origin is None:
        origin[:axes] = unit * np.array(_numbers(path, fields, ORIGINS, axes, positive=False) or [0.0] * axes)
    if given.direction is None:
        # Each row of the header is the direction of one axis.
        if (found := _numbers(path, fields, DIRECTIONS, n * n, positive=False)) is not None:
            direction[:axes, :axes] = np.reshape(found, (n, n))[:axes, :axes].T
        _check_direction(path, fields, direction)
    return affine_of(spacing, origin, direction)


def _numbers(path: Path, fields: Fields, names: tuple[str, ...], count: int, *, positive: bool) -> list[float] | None:
    """The first `count` numbers of the first of `names` that is there; more may follow, such as the step in time."""
    found = [name for name in names if name in fields]
    if not found:
        return None
    name, words = found[0], fields[found[0]].split()
    if len(words) < count:
        raise VolumeError(path, f"{name} is '{fields[name][:80]}'; it must be {count} numbers")
    numbers = grid_numbers(path, name, words[:count], positive=positive)
    for other in found[1:]:
        if names is not SPACINGS and fields[other].split() != words:
            payload.said(path, f"{name} and {other} contradict each other; {name} = {fields[name][:80]} is taken")
    return numbers


def _check_direction(path: Path, fields: Fields, direction: np.ndarray) -> None:
    check_volume(path, "TransformMatrix", direction)
    lengths = np.linalg.norm(direction, axis=0)
    if not np.allclose(lengths, 1, rtol=0, atol=1e-3):
        shown = ", ".join(f"{x:.4g}" for x in lengths)
        payload.said(
            path, f"the axes in TransformMatrix have lengths {shown}, which multiply the voxel size; else give direction="
        )
    stated, largest = fields.get("AnatomicalOrientation", "").upper(), np.abs(direction).argmax(axis=0)
    # A letter says where an axis comes from: x runs from right to left. Between two axes a letter says nothing.
    clear = (np.abs(direction).max(axis=0) > 0.8 * lengths).all()
    code = "".join(("RL", "AP", "IS")[row][int(direction[row, column] < 0)] for column, row in enumerate(largest))
    if clear and re.fullmatch(r"[RLAPIS]{3}", stated) and stated != code:
        problem = f"AnatomicalOrientation says {stated}, the axes' directions {code}; the directions are taken"
        payload.said(path, f"{problem} (give direction= where they are wrong)")
