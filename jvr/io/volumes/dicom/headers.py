"""DICOM headers: which files hold pictures, parsed by pydicom without ever believing a length that the file does not have.

The file is mapped, so that an element that announces 4 GB yields the bytes that are there; deflated ones are inflated up
to a limit. pydicom decodes lazily: whatever asks a dataset for a value runs inside of `quiet` and of `guarded`.
"""

import contextlib
import dataclasses
import io
import math
import mmap
import re
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jvr.io.volumes.errors import VolumeError, first_bytes, one_line

DEFLATED, DEFLATED_HEADER = b"1.2.840.10008.1.2.1.99", 1 << 24
IMPLICIT_LITTLE = "1.2.840.10008.1.2"
# Endings of slices.
SLICES = (".dcm", ".dicom", ".ima")
ENDS_IN_PICTURE = ("Rows", "Columns")
# Elements that hold pixels: the first of them, and those of floating-point numbers.
PIXELS, FLOAT_PIXELS = 0x7FE00008, (0x7FE00008, 0x7FE00009)


@dataclasses.dataclass(eq=False)
class Header:
    """One file with a picture: its dataset up to the pixel data, and whether these are floating-point numbers."""

    file: Path
    dataset: Any
    bytes_stored: int
    is_float: bool = False

    @property
    def syntax(self) -> str:
        return str(getattr(self.dataset, "file_meta", {}).get("TransferSyntaxUID", "") or IMPLICIT_LITTLE)

    def text(self, name: str) -> str:
        value = self.dataset.get(name)
        return " ".join(str("" if value is None else value).split())[:80]

    def numbers(self, name: str, value: Any, count: int, *, positive: bool = False, ignored: bool = False) -> list[float] | None:
        """`count` finite numbers of an element; `None` where it is absent or empty, or wrong and `ignored`."""
        if value is None or value == "" or (isinstance(value, list | tuple) and not value):
            return None
        try:
            several = hasattr(value, "__iter__") and not isinstance(value, str)
            listed: Any = value if several else [value]
            numbers = [float(x) for x in listed]
        except (TypeError, ValueError, OverflowError):
            numbers = []
        if len(numbers) == count and all(math.isfinite(x) and (x > 0 or not positive) for x in numbers):
            return numbers
        if ignored:
            return None
        wanted = f"{count} {'positive ' if positive else ''}finite number{'s' if count > 1 else ''}"
        raise VolumeError(self.file, f"{name} is '{str(value)[:60]}'; it must be {wanted}: correct it, or give {_keyword(name)}")

    def integer(self, name: str, default: int | None = None) -> int:
        value = self.numbers(name, self.dataset.get(name, default), 1)
        if value is None or value[0] != int(value[0]) or value[0] < 0:
            raise VolumeError(self.file, f"{name} is '{self.text(name)}'; it must be a whole number: the file is damaged")
        return int(value[0])


def _keyword(name: str) -> str:
    """The keyword of `read_volume` that replaces an element."""
    kinds = {
        "Position": "origin=",
        "Orientation": "direction=",
        "Intercept": "intercept=",
        "Slope": "slope=",
        "Scaling": "slope=",
    }
    return next((keyword for part, keyword in kinds.items() if part in name), "spacing=")


@contextlib.contextmanager
def quiet():
    """pydicom says on the terminal what it repairs; what matters here is checked here."""
    from pydicom import config

    mode = config.settings.reading_validation_mode
    config.settings.reading_validation_mode = config.IGNORE
    level, config.logger.disabled = config.logger.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        config.settings.reading_validation_mode = mode
        config.logger.disabled = level


@contextlib.contextmanager
def guarded(path: Path):
    """A damaged file makes pydicom raise errors of many kinds, RecursionError of a deep nesting among them."""
    try:
        yield
    except (VolumeError, OSError):
        raise
    except Exception as error:
        raise VolumeError(path, f"damaged, cut short or not supported: {one_line(error)}; copy it again") from None


def looks_like_dicom(start: bytes) -> bool:
    """'DICM' at byte 128, or elements of group 2 or 8 from the first byte on, as old files have them."""
    if start[128:132] == b"DICM":
        return True
    explicit = re.match(rb"[\x02\x08]\x00[\x00-\x20]\x00(UL|UI|CS|DA|TM|LO|SH|OB)", start, re.DOTALL)
    implicit = re.match(rb"[\x02\x08]\x00[\x00-\x20]\x00.\x00\x00\x00", start, re.DOTALL) and start[4] % 2 == 0 < start[4] <= 64
    return bool(explicit or implicit)


def parsed(file: Path, *, pixels: int | None = None, ends: Callable[[int], Any] = lambda _: None) -> Any:
    """The dataset of a file, up to the pixel data, or with these where `pixels` says how many bytes they may have; `ends` is told the tag
    of what it ends before."""
    import pydicom
    from pydicom.dataset import FileMetaDataset
    from pydicom.filereader import read_dataset, read_partial
    from pydicom.uid import UID

    def stop(tag: Any, vr: str | None, length: int) -> bool:
        if tag >= PIXELS:
            ends(int(tag))
        return tag >= PIXELS

    with guarded(file), file.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        start = content[:1024]
        preamble = 132 if start[128:132] == b"DICM" else 0
        if DEFLATED in start and start[preamble : preamble + 6] == b"\x02\x00\x00\x00UL":
            begin = preamble + 12 + int.from_bytes(start[preamble + 8 : preamble + 12], "little")
            inflated = zlib.decompressobj(-zlib.MAX_WBITS).decompress(content[begin:], DEFLATED_HEADER + (pixels or 0))
            dataset = read_dataset(io.BytesIO(inflated), False, True, stop_when=stop if pixels is None else None)
            dataset.file_meta = FileMetaDataset()
            dataset.file_meta.TransferSyntaxUID = UID(DEFLATED.decode())
            return dataset
        if pixels is None:
            return read_partial(content, stop_when=stop, force=True)  # pyright: ignore[reportArgumentType]
        return pydicom.dcmread(content, force=True)  # pyright: ignore[reportArgumentType]


def header(file: Path) -> Header | None:
    """The header of a file that holds a picture; `None` for reports, plans, presentation states, directories."""
    tags: list[int] = []
    dataset = parsed(file, ends=tags.append)
    with guarded(file):
        if not all(name in dataset for name in ENDS_IN_PICTURE):
            if "SOPClassUID" not in dataset and "MediaStorageSOPClassUID" not in getattr(dataset, "file_meta", {}):
                raise VolumeError(file, "this DICOM file is damaged and cannot be read; copy it again or remove it")
            return None
        return Header(file, dataset, file.stat().st_size, bool(tags) and tags[0] in FLOAT_PIXELS)


def headers_in(folder: Path, notes: list[str]) -> tuple[list[Header], dict[str, int]]:
    """The pictures of a folder and of those below it, and how many files of other kinds of DICOM objects there are.

    Files that should be slices and are not, since they were cut short or are links that lead nowhere, are noted: the first or last slice of
    a series is missed by nobody.
    """
    pictures, others, odd = [], {}, []
    for file in sorted(folder.rglob("*")):
        if file.is_dir() or file.name.startswith(".") or file.name.upper() == "DICOMDIR":
            continue
        if not file.is_file() or file.stat().st_size == 0 or not looks_like_dicom(first_bytes(file, 160)):
            empty = file.is_symlink() or (file.is_file() and file.stat().st_size == 0)
            odd += [file.name] if empty or file.suffix.lower() in SLICES or not file.suffix else []
            continue
        found = header(file)
        if found is not None:
            pictures.append(found)
        else:
            others["objects without a picture"] = others.get("objects without a picture", 0) + 1
    if odd and pictures:
        shown = ", ".join(odd[:3]) + (f" and {len(odd) - 3} more" if len(odd) > 3 else "")
        notes.append(f"it holds files that are empty or no DICOM, and left out: {shown}; copy them again where they are slices")
    return pictures, others
