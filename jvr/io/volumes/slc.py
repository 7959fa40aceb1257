"""VolVis SLC (.slc): 8 bits, slices plain or in runs."""

import re
from pathlib import Path

import numpy as np

from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, grid_shape, mislabelled
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of

# Length of a unit in mm: metre, millimetre, micron, foot.
UNITS = {"0": 1000.0, "1": 1.0, "2": 0.001, "3": 304.8}
# Magic number, size, bits, spacing, unit, three numbers on origin and packing, size of an icon (of three bytes a pixel).
HEADER = re.compile(rb"\s*11111\s+" + rb"(\S{1,32})\s+" * 13 + rb"X")
# A slice begins with its length. A run of two bytes stands for up to 127.
SLICE, MOST_PACKED = re.compile(rb"\s*(\d{1,10})\s+X"), 64


def read_slc(path: Path, given: Given) -> Stored:
    """An SLC volume of bytes, its slices plain or run-length encoded."""
    start = first_bytes(path)
    header = HEADER.match(start)
    if header is None:
        raise mislabelled(path, start, "a VolVis SLC file (its first line is 11111)")
    words = [word.decode("latin-1") for word in header.groups()]
    shape = grid_shape(path, "the size", words[:3])
    if words[3] != "8":
        raise VolumeError(path, f"its voxels have {words[3]} bits; only 8 are read: save it as another format")
    spacing = [1.0] * 3 if given.spacing is not None else grid_numbers(path, "the voxel size", words[4:7], positive=True)
    if words[7] not in UNITS and given.spacing is None:
        raise VolumeError(path, f"its unit of length has the number {words[7]}, which is not known: give spacing= in mm")
    if words[10] not in ("0", "1"):
        raise VolumeError(
            path, f"its slices are packed in a way with the number {words[10]}; only 0 (plain) and 1 (runs) are read"
        )
    if not all(re.fullmatch(r"\d{1,6}", word, re.ASCII) for word in words[11:13]):
        raise VolumeError(path, f"the icon's size is {' x '.join(words[11:13])}; it must be whole numbers: the file is damaged")
    stored = path.stat().st_size - header.end() - 3 * int(words[11]) * int(words[12])
    check_size(path, shape, 1, stored * (MOST_PACKED if words[10] == "1" else 1))
    if not 0 < stored <= path.stat().st_size:
        raise VolumeError(path, "its icon is larger than the file: it is cut short or damaged")
    content = path.read_bytes()[-stored:]
    plain = content[: shape[0] * shape[1] * shape[2]] if words[10] == "0" else _unpacked(path, content, shape)
    values = np.frombuffer(plain, np.uint8).reshape(shape, order="F")
    return Stored(values, affine_of(np.array(spacing) * UNITS.get(words[7], 1.0)))


def _unpacked(path: Path, content: bytes, shape: tuple[int, ...]) -> bytes:
    area, position, voxels = shape[0] * shape[1], 0, bytearray()
    for k in range(shape[2]):
        head = SLICE.match(content, position)
        if head is None or head.end() + int(head[1]) > len(content):
            raise VolumeError(path, f"slice {k} of {shape[2]} is missing: the file is cut short or damaged")
        position = head.end() + int(head[1])
        found = _runs(content[head.end() : position], area)
        if len(found) != area:
            raise VolumeError(path, f"slice {k} has {len(found):,} voxels, the header announces {area:,}: the file is damaged")
        voxels += found
    return bytes(voxels)


def _runs(data: bytes, most: int) -> bytearray:
    """Bytes of one slice: a count, with the highest bit before so many bytes as they are, without it before one that repeats."""
    voxels, k = bytearray(), 0
    while k < len(data) and (count := data[k] & 127) and len(voxels) <= most:
        literal = data[k] & 128
        voxels += data[k + 1 : k + 1 + count] if literal else data[k + 1 : k + 2] * count
        k += 1 + (count if literal else 1)
    return voxels
