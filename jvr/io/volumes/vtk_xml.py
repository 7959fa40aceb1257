"""VTK XML image data (.vti): arrays as text, in base64 or behind the XML, plain or compressed, after VTK's "File Formats"."""

import base64
import binascii
import dataclasses
import functools
import math
import mmap
import re
import xml.parsers.expat
from pathlib import Path

import numpy as np

from jvr.io.volumes import payload
from jvr.io.volumes.errors import MOST_COMPRESSION, VolumeError, check_size, first_bytes, grid_numbers, mislabelled
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored
from jvr.io.volumes.vtk_arrays import Array, Grid, volume_of

TYPES = {f"{sign}Int{8 * size}": f"{letter}{size}" for sign, letter in (("", "i"), ("U", "u")) for size in (1, 2, 4, 8)}
TYPES |= {"Float32": "f4", "Float64": "f8"}
COMPRESSORS = {"vtkZLibDataCompressor": "zlib", "vtkLZMADataCompressor": "lzma"}
TAG = re.compile(rb"""<(?:"[^"]{0,4096}"|'[^']{0,4096}'|[^>"']){0,8192}>""")
DEEPEST, MOST_ARRAYS = 32, 10_000


class _Enough(Exception):
    """The XML part ends here: bytes follow."""


@dataclasses.dataclass
class _Found:
    """What the tags say, and between which bytes the content of each array lies."""

    root: dict[str, str] = dataclasses.field(default_factory=dict)
    image: dict[str, str] | None = None
    pieces: list[dict[str, str]] = dataclasses.field(default_factory=list)
    # Attributes, whether on cells, whether active, first and last byte of the content.
    arrays: list[tuple[dict[str, str], bool, bool, list[int]]] = dataclasses.field(default_factory=list)
    appended: tuple[str, int] | None = None


def read_vti(path: Path, given: Given) -> Stored:
    """Image data of one piece; `array` names one of several arrays, `channel` one component of it."""
    start = first_bytes(path)
    kind = re.search(rb"<VTKFile[^>]{0,4096}\btype\s*=\s*[\"'](\w{1,64})", start)
    if kind is None:
        raise mislabelled(path, start, "a VTI file (XML with <VTKFile type='ImageData'>)")
    if kind[1] != b"ImageData":
        raise VolumeError(path, f"this is a VTK file of type {kind[1].decode()}; only ImageData is a volume: resample it")
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        found = _tags(path, content)
        grid = _grid(path, found, given)
        return volume_of(path, grid, _arrays(path, content, found, grid.points), given)


def _tags(path: Path, content: mmap.mmap) -> _Found:
    """One pass of expat over the tags. What lies between them stays where it is."""
    found, open_ = _Found(), []
    parser = xml.parsers.expat.ParserCreate()

    def begin(name: str, attributes: dict[str, str]) -> None:
        if len(open_) >= DEEPEST or len(found.arrays) > MOST_ARRAYS:
            raise VolumeError(path, "its XML is nested deeper, or holds more arrays, than image data can: the file is damaged")
        tag = TAG.match(content, parser.CurrentByteIndex)
        end = tag.end() if tag else len(content)
        if name == "VTKFile":
            found.root = attributes
        elif name == "ImageData":
            found.image = attributes
        elif name == "Piece":
            found.pieces.append(attributes)
        elif name == "AppendedData":
            mark = content.find(b"_", end)
            found.appended = (attributes.get("encoding", "raw"), mark + 1 if mark >= 0 else len(content))
            raise _Enough
        elif name == "DataArray" and open_[-1:] and open_[-1][0] in ("PointData", "CellData"):
            side, of_side = open_[-1]
            found.arrays.append(
                (attributes, side == "CellData", attributes.get("Name") == of_side.get("Scalars", ""), [end, end])
            )
        open_.append((name, attributes))

    def finish(name: str) -> None:
        open_.pop()
        if name == "DataArray" and found.arrays and open_[-1:] and open_[-1][0] in ("PointData", "CellData"):
            found.arrays[-1][3][1] = max(parser.CurrentByteIndex, found.arrays[-1][3][0])

    def doctype(*_: object) -> None:
        raise VolumeError(path, "its XML declares a document type or entities, which a VTI file has no use for: it is not read")

    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = begin, finish, doctype
    try:
        for position in range(0, len(content), payload.PIECE):
            parser.Parse(content[position : position + payload.PIECE], position + payload.PIECE >= len(content))
    except _Enough:
        pass
    except xml.parsers.expat.ExpatError as error:
        raise VolumeError(path, f"its XML is damaged or cut short ({error}); copy or export the file again") from None
    return found


def _grid(path: Path, found: _Found, given: Given) -> Grid:
    fields = found.image or {}
    ends = grid_numbers(path, "WholeExtent", fields.get("WholeExtent", ""), positive=False)
    points = [int(high - low) + 1 for low, high in zip(ends[::2], ends[1::2], strict=False)]
    if len(ends) != 6 or min(points) < 1 or max(map(abs, ends)) > 2**40:
        shown = fields.get("WholeExtent", "")[:80]
        raise VolumeError(path, f"WholeExtent is '{shown}'; it must be six numbers, first and last per axis")
    if len(found.pieces) != 1 or found.pieces[0].get("Extent", fields["WholeExtent"]).split() != fields["WholeExtent"].split():
        raise VolumeError(path, f"its image comes in {len(found.pieces)} pieces that are not the whole; save it as one piece")
    three = {"Spacing": "1 1 1", "Origin": "0 0 0", "Direction": "1 0 0 0 1 0 0 0 1"}
    replaced = {"Spacing": given.spacing, "Origin": given.origin, "Direction": given.direction}
    numbers = {}
    for name, default in three.items():
        text = default if replaced[name] is not None else fields.get(name, default)
        numbers[name] = grid_numbers(path, name, text, positive=name == "Spacing")
        if len(numbers[name]) != len(default.split()):
            raise VolumeError(path, f"{name} is '{text[:80]}'; it must be {len(default.split())} numbers")
    if "Spacing" not in fields and given.spacing is None:
        payload.said(path, "the header lacks Spacing: voxels are taken as 1 long in x, y, z; else give spacing=")
    direction = np.reshape(numbers["Direction"], (3, 3))
    return Grid(tuple(points), numbers["Spacing"], numbers["Origin"], direction, [int(x) for x in ends[::2]])


# --- Arrays ----------------------------------------------------------------------------------------------------------


def _arrays(path: Path, content: mmap.mmap, found: _Found, points: tuple[int, ...]) -> list[Array]:
    arrays = []
    for fields, cells, active, (start, end) in found.arrays:
        if (code := TYPES.get(fields.get("type", ""))) is None:
            continue
        order = ">" if found.root.get("byte_order", "LittleEndian") == "BigEndian" else "<"
        dtype = np.dtype(code).newbyteorder(order)
        text = fields.get("NumberOfComponents", "1")
        components = int(text) if re.fullmatch(r"\d{1,4}", text, re.ASCII) else 0
        if components < 1:
            raise VolumeError(path, f"NumberOfComponents is '{text[:40]}'; it must be a whole number of at least 1")
        packed = fields.get("format", "ascii") != "ascii" and "compressor" in found.root
        stored = len(content) * (MOST_COMPRESSION * payload.TIGHTER["lzma"] if packed else dtype.itemsize)
        tuples = math.prod(max(n - cells, 1) for n in points)
        read = functools.partial(_numbers, path, content, found, fields, (start, end), components * tuples, dtype)
        arrays.append(Array(fields.get("Name", ""), components, tuples, dtype, cells, active, stored, read))
    return arrays


def _numbers(
    path: Path, content: mmap.mmap, found: _Found, fields: dict[str, str], place: tuple[int, int], count: int, dtype: np.dtype
) -> np.ndarray:
    kind, (start, end) = fields.get("format", "ascii"), place
    if kind == "ascii":
        check_size(path, [count], 1, end - start)
        return payload.numbers_of(path, payload.parts_of(content, start, end), count, dtype)
    if kind not in ("binary", "appended"):
        raise VolumeError(path, f"an array has the format '{kind[:40]}'; it must be ascii, binary or appended")
    raw = False
    if kind == "appended":
        if found.appended is None:
            raise VolumeError(path, "its appended data are missing: the file is cut short")
        offset = fields.get("offset", "0")
        if not re.fullmatch(r"\d{1,15}", offset, re.ASCII):
            raise VolumeError(path, f"the offset of an array is '{offset[:40]}'; it must be a whole number")
        raw, start, end = found.appended[0] == "raw", found.appended[1] + int(offset), len(content)
    source = _Source(path, content, start, end, raw)
    big = found.root.get("byte_order") == "BigEndian"
    head = np.dtype("u8" if found.root.get("header_type") == "UInt64" else "u4").newbyteorder(">" if big else "<")
    return _unwrapped(path, source, found.root.get("compressor", ""), head, count * dtype.itemsize).view(dtype)


def _unwrapped(path: Path, source: "_Source", compressor: str, head: np.dtype, count: int) -> np.ndarray:
    """`count` bytes behind their own header: their number, or the numbers and sizes of blocks that are compressed each for itself."""
    if not compressor:
        check_size(path, [count], 1, source.room())
        stated = int(source.take(head.itemsize).view(head)[0])
        if stated != count:
            raise VolumeError(
                path, f"an array states {stated:,} bytes, its voxels need {count:,}: the file is cut short or damaged"
            )
        return source.take(count)
    if (kind := COMPRESSORS.get(compressor)) is None:
        raise VolumeError(path, f"its arrays are compressed by {compressor[:60]}; save it with ZLib or without compression")
    check_size(path, [count], 1, source.room() * payload.TIGHTER[kind], compressed=True)
    blocks, size, last = (int(n) for n in source.take(3 * head.itemsize).view(head))
    if blocks * head.itemsize > source.room() or (blocks - 1) * size + (last or size) != count or not 0 < (last or size) <= size:
        raise VolumeError(
            path, f"an array has {blocks:,} blocks of {size:,} bytes for {count:,}: the file is cut short or damaged"
        )
    sizes = [int(n) for n in source.take(blocks * head.itemsize).view(head)]
    source.next_stream()
    buffer = np.empty(count, np.uint8)
    for k, packed in enumerate(sizes):
        part = buffer[k * size : min((k + 1) * size, count)]
        part[:] = payload.unpacked(path, iter([source.take(packed).tobytes()]), kind, len(part))
    return buffer


class _Source:
    """Bytes between two places of a file, as they are or in base64; two streams of base64 may follow each other."""

    def __init__(self, path: Path, content: mmap.mmap, start: int, end: int, raw: bool):
        self.path, self.content, self.position, self.end, self.raw = path, content, start, end, raw
        self.letters, self.decoded = b"", b""

    def room(self) -> int:
        """Bytes that may follow, at most."""
        return max(self.end - self.position, 0) + len(self.letters) + len(self.decoded)

    def take(self, count: int) -> np.ndarray:
        if count > self.room():
            raise VolumeError(self.path, f"an array needs {count:,} bytes more, {self.room():,} follow: the file is cut short")
        if self.raw:
            self.position += count
            return np.frombuffer(self.content[self.position - count : self.position], np.uint8)
        buffer, filled = np.empty(count, np.uint8), 0
        while filled < count:
            self.decoded = self.decoded or self._group(count - filled)
            part, self.decoded = self.decoded[: count - filled], self.decoded[count - filled :]
            buffer[filled : filled + len(part)] = np.frombuffer(part, np.uint8)
            filled += len(part)
        return buffer

    def next_stream(self) -> None:
        """The sizes of blocks and the blocks are encoded apart: what padded the first stream is not in the second."""
        self.decoded = b""

    def _group(self, wanted: int) -> bytes:
        """Decoded groups of four letters, of three bytes each, no more than are wanted."""
        letters = 4 * min((wanted + 2) // 3, payload.PIECE // 4)
        while len(self.letters) < letters and self.position < self.end:
            piece = self.content[self.position : min(self.position + letters, self.end)]
            self.position += len(piece)
            self.letters += b"".join(piece.split())
        group, self.letters = self.letters[:letters], self.letters[letters:]
        try:
            found = base64.b64decode(group, validate=True)
        except binascii.Error:
            found = b""
        if not found:
            raise VolumeError(self.path, "an array in base64 is cut short or damaged; copy or export the file again")
        return found
