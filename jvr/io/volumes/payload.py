"""The voxels behind a header: exactly the bytes or numbers that it announces, out of a file that may hold fewer, more or anything else.

Nothing is allocated before `errors.check_size` has compared what is announced with what is there, and packed data are
unpacked no further than announced.
"""

import bz2
import lzma
import mmap
import os
import re
import stat
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import VolumeError, one_line

# Compressed input is unpacked by pieces of at most so many bytes, which bounds what a bomb can take.
PIECE = 1 << 20
MOST_FILES = 100_000
MOST_SKIPPED = 1 << 26
LONGEST_NUMBER = 64
# How many times tighter than a deflate stream the others may be, about.
TIGHTER = {"zlib": 1, "gzip": 1, "lzma": 8, "bz2": 64}
OPENED: dict[str, Callable[[], Any]] = {
    "zlib": lambda: zlib.decompressobj(47),
    "gzip": lambda: zlib.decompressobj(31),
    "bz2": bz2.BZ2Decompressor,
    # The dictionary of the strongest preset takes 64 MiB.
    "lzma": lambda: lzma.LZMADecompressor(memlimit=1 << 27),
}


def data_file(path: Path, name: str) -> Path:
    """The regular file that a header means, relative to its own folder. A device or a pipe, which might never end, is refused."""
    file = path.parent / name
    try:
        mode = os.stat(file).st_mode if name else None
    # A name with a zero byte is a ValueError.
    except (OSError, ValueError):
        mode = None
    if mode is None:
        raise VolumeError(path, f"its voxels should be in '{name[:200]}', which is not in the same folder: put it there")
    if not stat.S_ISREG(mode):
        raise VolumeError(path, f"its voxels should be in '{name[:200]}', which is no ordinary file: correct the header")
    return file


def numbered(path: Path, words: Sequence[str], count: int) -> list[str]:
    """The names that a pattern such as `slice%03d.raw` means, with first, last and step; without them `count` names from 1 on."""
    pattern, numbers, shown = words[0], words[1:4], " ".join(words)[:80]
    if not re.fullmatch(r"[^%]*%0?\d{0,2}[du][^%]*", pattern) or not all(re.fullmatch(r"[+-]?\d{1,9}", n) for n in numbers):
        raise VolumeError(path, f"'{shown}' must be a name with one number, such as a%03d.raw 1 20 1: correct it")
    first = int(numbers[0]) if numbers else 1
    last = int(numbers[1]) if len(numbers) > 1 else first + count - 1
    step = int(numbers[2]) if len(numbers) > 2 else 1
    if step == 0 or not 1 <= (last - first) // step + 1 <= MOST_FILES:
        raise VolumeError(path, f"'{shown}' counts no files: correct first, last and step")
    return [pattern % k for k in range(first, last + (1 if step > 0 else -1), step)]


def room(path: Path, files: Sequence[Path], offsets: Sequence[int]) -> int:
    """Bytes of all `files` behind their offsets."""
    total = 0
    for file, offset in zip(files, offsets, strict=True):
        size = os.stat(file).st_size
        if offset > size:
            raise VolumeError(path, f"the voxels begin at byte {offset:,}, the file ends at {size:,}: it is cut short")
        total += size - offset
    return total


def slabs(path: Path, files: Sequence[Path], offsets: Sequence[int] | None, count: int) -> np.ndarray:
    """`count` bytes, an equal part from each of `files` behind its offset, or from its end where `offsets` is `None`."""
    each, rest = divmod(count, len(files))
    if rest:
        raise VolumeError(
            path, f"{count:,} bytes of voxels are no whole part for each of {len(files):,} files: correct the header"
        )
    buffer = np.empty(count, np.uint8)
    surplus = 0
    for k, file in enumerate(files):
        size = os.stat(file).st_size
        start = max(size - each, 0) if offsets is None else offsets[k]
        part = buffer[k * each : (k + 1) * each]
        with file.open("rb") as source:
            source.seek(start)
            found = source.readinto(part.data)
        if found < each:
            raise VolumeError(path, f"the header announces {each:,} bytes in {file.name}, it holds {found:,}: it is cut short")
        surplus += size - start - each
    if surplus > 0:
        said(
            path,
            f"{surplus:,} bytes behind the {count:,} bytes of voxels that the header announces are left out: check its sizes",
        )
    return buffer


def unpacked(path: Path, pieces: Iterator[bytes], kind: str, count: int, skip: int = 0, *, quiet: bool = False) -> np.ndarray:
    """`count` bytes behind the first `skip` of a stream that is compressed with `kind` (zlib, gzip, bz2 or lzma).

    What is packed beyond them is said, unless `quiet`.
    """
    buffer, filled = np.empty(count, np.uint8), -skip
    try:
        # One byte more than announced shows that there is more.
        for part in _parts(pieces, kind, skip + count + 1):
            kept = part[max(-filled, 0) : max(count - filled, 0)]
            start = max(filled, 0)
            buffer[start : start + len(kept)] = np.frombuffer(kept, np.uint8)
            filled += len(part)
    # zlib and bz2 raise their own and the system's errors, LZMA one of its own.
    except (zlib.error, OSError, EOFError, ValueError, lzma.LZMAError) as error:
        raise VolumeError(path, f"the compressed data are damaged ({one_line(error)}); copy or export it again") from None
    if filled < count:
        problem = f"the compressed data unpack to {max(filled, 0):,} bytes, the header announces {count:,}"
        raise VolumeError(path, f"{problem}: cut short or damaged, copy or export it again")
    if filled > count and not quiet:
        said(path, f"more is packed than the {count:,} bytes that the header announces; the rest is left out: check its sizes")
    return buffer


def _parts(pieces: Iterator[bytes], kind: str, most: int) -> Iterator[bytes]:
    """At most so many bytes of the unpacked stream; one of gzip may have several members, as those of bgzip."""
    stream, pending = OPENED[kind](), b""
    while most > 0:
        hungry = getattr(stream, "needs_input", True) and not pending
        if hungry:
            pending = next(pieces, b"")
        part = stream.decompress(pending, min(PIECE, most))
        most -= len(part)
        yield part
        if stream.eof:
            # What follows the last member is padding where it does not look like another one.
            pending = stream.unused_data or next(pieces, b"")
            if kind != "gzip" or not pending.startswith(b"\x1f"):
                return
            stream = OPENED[kind]()
        elif hungry and not pending and not part:
            raise EOFError("it ends early")
        else:
            pending = getattr(stream, "unconsumed_tail", b"")


def pieces_of(file: Path, offset: int = 0, end: int | None = None) -> Iterator[bytes]:
    """A file from `offset` to `end`."""
    with file.open("rb") as source:
        source.seek(offset)
        while chunk := source.read(PIECE if end is None else min(PIECE, end - source.tell())):
            yield chunk


def parts_of(content: mmap.mmap, start: int, end: int) -> Iterator[bytes]:
    """A mapped file from `start` to `end`."""
    for position in range(start, end, PIECE):
        yield content[position : min(position + PIECE, end)]


def text_of(files: Sequence[Path], offsets: Sequence[int]) -> Iterator[bytes]:
    """Files from their offsets on, one behind the other, their words apart."""
    for file, offset in zip(files, offsets, strict=True):
        yield from pieces_of(file, offset)
        yield b"\n"


def bytes_of_hex(path: Path, pieces: Iterator[bytes], count: int) -> np.ndarray:
    """`count` bytes of two hexadecimal digits each."""
    buffer, filled, rest = np.empty(count, np.uint8), 0, b""
    for piece in pieces:
        digits = rest + b"".join(piece.split())
        whole, rest = digits[: len(digits) // 2 * 2], digits[len(digits) // 2 * 2 :]
        try:
            found = bytes.fromhex(whole.decode("latin-1"))[: count - filled]
        except ValueError:
            raise VolumeError(
                path, "its voxels are no hexadecimal digits: the file is damaged, copy or export it again"
            ) from None
        buffer[filled : filled + len(found)] = np.frombuffer(found, np.uint8)
        filled += len(found)
    if filled < count:
        raise VolumeError(path, f"the header announces {count:,} bytes of voxels, the file holds {filled:,}: it is cut short")
    return buffer


def numbers_of(path: Path, pieces: Iterator[bytes], count: int, dtype: np.dtype) -> np.ndarray:
    """`count` numbers in text, apart by white space or commas. **Raises** `VolumeError` for fewer, and integers out of range."""
    values, filled = np.empty(count, dtype.newbyteorder("=")), 0
    for words in _words(pieces):
        found = _parsed(path, words, dtype)[: count - filled]
        values[filled : filled + len(found)] = found
        filled += len(found)
        if filled == count:
            return values
    problem = f"the header announces {count:,} voxels, fewer numbers ({filled:,}) follow"
    raise VolumeError(path, f"{problem}: the file is cut short or its header is wrong")


def _words(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """Text by pieces of whole words; of one that is too long for a number the end is lost."""
    rest = b""
    for piece in pieces:
        for start in range(0, len(piece), 1 << 16):
            text = rest + piece[start : start + (1 << 16)].replace(b",", b" ")
            cut = max(text.rfind(space) for space in (b" ", b"\n", b"\t", b"\r")) + 1
            rest = text[cut:][: 2 * LONGEST_NUMBER]
            yield text[:cut]
    yield rest


def _parsed(path: Path, text: bytes, dtype: np.dtype) -> np.ndarray:
    """Numbers of a text up to the first word that is none."""
    kind = dtype.kind
    wide = np.dtype(float) if kind == "f" else np.dtype("u8") if kind == "u" and dtype.itemsize == 8 else np.dtype("i8")
    words = text.split()
    # An array of words takes the length of the longest for each.
    short = next((k for k, word in enumerate(words) if len(word) > LONGEST_NUMBER), len(words))
    found = _converted(words[:short], wide)
    if kind in "iu" and found.size and (found.min() < np.iinfo(dtype).min or found.max() > np.iinfo(dtype).max):
        raise VolumeError(path, f"a voxel is out of the range of {dtype}, the type that the header states: correct it")
    return found


def _converted(words: list[bytes], dtype: np.dtype) -> np.ndarray:
    try:
        return np.array(words, "S").astype(dtype)
    except (ValueError, OverflowError):
        pass
    if len(words) == 1:
        return np.empty(0, dtype)
    # The first word that is no number lies in one of two halves.
    half = len(words) // 2
    found = _converted(words[:half], dtype)
    return found if len(found) < half else np.concatenate([found, _converted(words[half:], dtype)])


def said(path: Path, problem: str) -> None:
    """One line about what was guessed, or is odd."""
    warnings.warn(f"{path}: {problem}", stacklevel=2)
