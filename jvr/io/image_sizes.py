"""What the headers of pictures announce, looked at before a library sees the file: too many pixels, and parts that lie outside of it."""

import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import available_memory
from jvr.pictures import ImageError, quiet

# Bytes of pixels that a byte of the file may stand for, at most: deflate and JPEG about 1000, a wavelet of a black picture more; the black
# frame of a cropped picture takes no byte.
TIGHTEST = {"png": 1100, "jpeg": 1100, "radiance": 64, "exr": 10_000, "frame": math.inf}
# Rows of a block, by OpenEXR's number of the compression: none, RLE, ZIPS, ZIP, PIZ, PXR24, B44, B44A, DWAA, DWAB.
ROWS = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)
TILED, DEEP, SEVERAL = 0x200, 0x800, 0x1000
MOST_HEADER = 1 << 22
LARGEST = 1 << 20
# Pixels of a tile that may be larger than its picture: decoders take memory for all of them.
LARGEST_TILE = 1 << 18


def check_pixels(path: Path, kind: str, width: int, height: int, bytes_each: float | int) -> None:
    """**Raises** `ImageError` for pixels that the file cannot hold, or the memory cannot take."""
    announced, stored = int(width * height * bytes_each), path.stat().st_size
    size = f"{width:,} x {height:,} pixels"
    if not (0 < width <= LARGEST and 0 < height <= LARGEST) or announced > stored * TIGHTEST[kind]:
        problem = f"the header is damaged or the file cut short: {stored:,} bytes cannot hold {size}"
        raise ImageError(path, f"{problem}; copy or export it again")
    # In memory a pixel is three float32 at least.
    needed, available = int(width * height * max(bytes_each, 12)), available_memory()
    if available is not None and needed > available:
        raise ImageError(path, f"its {needed:,} bytes of pixels exceed the {available:,} bytes of free memory; crop or shrink it")


def check_radiance(path: Path) -> None:
    """Looks at the line of a Radiance header that gives the resolution, such as "-Y 512 +X 1024"."""
    with path.open("rb") as file:
        header = file.read(1 << 16)
    found = re.search(rb"\n[-+][XY] (\d{1,9}) [-+][XY] (\d{1,9})\n", header)
    if found is None:
        raise ImageError(path, "the Radiance header is damaged or cut short (no resolution); copy or export it again")
    check_pixels(path, "radiance", int(found[2]), int(found[1]), 4)


def check_exr(path: Path) -> None:
    """Walks through the headers of an OpenEXR file (each a list of name, type, size and value) and the offsets of its blocks of rows."""
    with path.open("rb") as file:
        content = file.read(MOST_HEADER)
    flags, position, parts = int.from_bytes(content[4:8], "little"), 8, 0
    while parts == 0 or (flags & SEVERAL and content[position : position + 1] != b"\0"):
        fields, position = _attributes(path, content, position)
        _check_part(path, fields)
        parts += 1
        if not flags & (TILED | DEEP | SEVERAL):
            _check_offsets(path, fields, content, position)


def _damaged(path: Path, what: str) -> ImageError:
    return ImageError(path, f"the OpenEXR header is damaged or cut short ({what}); export it again")


def _attributes(path: Path, content: bytes, position: int) -> tuple[dict[str, bytes], int]:
    """One header by name, and the place behind it."""
    fields: dict[str, bytes] = {}
    entry = re.compile(rb"([^\0]{1,255})\0([^\0]{1,255})\0(.{4})", re.DOTALL)
    while content[position : position + 1] != b"\0":
        match = entry.match(content, position)
        size = int.from_bytes(match[3], "little") if match else 0
        if match is None or match.end() + size > len(content):
            raise _damaged(path, "an attribute ends outside of it")
        fields[match[1].decode("latin-1")] = content[match.end() : match.end() + size]
        position = match.end() + size
    return fields, position + 1


def _check_part(path: Path, fields: dict[str, bytes]) -> None:
    windows = {}
    for name in ("dataWindow", "displayWindow"):
        if len(fields.get(name, b"")) != 16:
            raise _damaged(path, f"it has no {name}")
        low_x, low_y, high_x, high_y = struct.unpack("<4i", fields[name])
        windows[name] = high_x - low_x + 1, high_y - low_y + 1
    if len(fields.get("compression", b"")) != 1 or not fields.get("channels"):
        raise _damaged(path, "it has no compression or channels")
    width, height = windows["dataWindow"]
    check_pixels(path, "exr", width, height, _bytes_each(path, fields["channels"]))
    columns, rows = struct.unpack("<2I", fields.get("tiles", bytes(8))[:8].ljust(8, b"\0"))
    if columns * rows > 4 * width * height + LARGEST_TILE:
        raise _damaged(path, f"its tiles of {columns:,} x {rows:,} pixels are larger than the image")
    width, height = windows["displayWindow"]
    check_pixels(path, "frame", width, height, 12)


def _bytes_each(path: Path, channels: bytes) -> int:
    """Bytes of a pixel: each channel is a name, its type (1 half, else four bytes), and 12 bytes on sampling."""
    position, total = 0, 0
    while channels[position : position + 1] != b"\0":
        end = channels.find(b"\0", position)
        if end < 0 or end + 17 > len(channels):
            raise _damaged(path, "its list of channels is cut short")
        try:
            channels[position:end].decode()
        except UnicodeDecodeError:
            raise _damaged(path, "the name of a channel is no text") from None
        kind, *sampling = struct.unpack_from("<i4x2i", channels, end + 1)
        if kind not in (0, 1, 2) or min(sampling) < 1:
            raise _damaged(path, "a channel has an unknown type or sampling")
        total += 2 if kind == 1 else 4
        position = end + 17
    return max(total, 1)


def _check_offsets(path: Path, fields: dict[str, bytes], content: bytes, position: int) -> None:
    low_y, high_y = struct.unpack("<4i", fields["dataWindow"])[1::2]
    number = fields["compression"][0]
    if number >= len(ROWS):
        return
    count = (high_y - low_y) // ROWS[number] + 1
    if position + 8 * count > len(content):
        raise _damaged(path, "the table of its rows is cut short")
    offsets = np.frombuffer(content, "<u8", count, position)
    if offsets.min() < position + 8 * count or offsets.max() > path.stat().st_size - 8:
        raise ImageError(path, "the pixels are damaged or cut short: some rows lie outside of the file; copy or export it again")


def sixteen_bits(path: Path) -> Any:
    """Codes of a PNG of 16 bits, as they are: its alpha is not multiplied with its colours."""
    import OpenImageIO

    wishes = OpenImageIO.ImageSpec()
    wishes.attribute("oiio:UnassociatedAlpha", 1)
    # libpng writes on the terminal what it finds.
    with quiet():
        file = OpenImageIO.ImageInput.open(str(path), wishes)
        pixels = None if file is None else file.read_image(OpenImageIO.UINT16)
    if pixels is None:
        raise ValueError(OpenImageIO.geterror() or "no pixels")
    return pixels
