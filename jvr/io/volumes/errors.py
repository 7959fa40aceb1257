"""What may be refused before a single voxel is read: missing, empty, mislabelled and impossible files."""

import difflib
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path

# A deflate stream cannot shrink its input further than about 1030 : 1.
MOST_COMPRESSION = 1100

SIGNATURES = (
    (b"\x89PNG", "a PNG image"),
    (b"\xff\xd8\xff", "a JPEG image"),
    (b"\x93NUMPY", "a NumPy array (.npy)"),
    (b"PK\x03\x04", "a ZIP archive"),
    (b"\x1f\x8b", "gzip-compressed data"),
    (b"NRRD", "a NRRD file (.nrrd)"),
    (b"# vtk DataFile", "a legacy VTK file (.vtk)"),
    (b"II*\x00", "a TIFF image (.tif)"),
    (b"MM\x00*", "a TIFF image (.tif)"),
    (b"II+\x00", "a TIFF image (.tif)"),
    (b"%PDF", "a PDF document"),
    (b"\x89HDF", "an HDF5 file"),
    (b"version https://git-lfs", "a Git LFS pointer, not the data (run `git lfs pull`)"),
    (b"ObjectType", "a MetaImage header (.mhd, .mha)"),
    (b"NDims", "a MetaImage header (.mhd, .mha)"),
    (b"<?xml", "an XML document"),
    (b"<VTKFile", "a VTK XML file"),
)


class VolumeError(ValueError):
    """A volume that cannot be read: one line that names the file, what is wrong and what would be right."""

    def __init__(self, path: str | os.PathLike, problem: str):
        super().__init__(" ".join(f"{path}: {problem}".split()))


def first_bytes(path: Path, count: int = 65536) -> bytes:
    """The beginning of a file that exists, may be read and is not empty."""
    if not path.exists():
        if path.is_symlink():
            raise FileNotFoundError(f"{path}: a link to {os.readlink(path)}, which is not there; copy or fetch the file itself")
        folder = os.listdir(path.parent) if path.parent.is_dir() else []
        near = difflib.get_close_matches(path.name, folder, 1, 0.6)
        raise FileNotFoundError(f"{path}: no such file" + (f"; did you mean {near[0]!r}?" if near else ""))
    # A pipe or a device may never end.
    if not path.is_file():
        raise VolumeError(path, "this is no ordinary file; give the name of one")
    with path.open("rb") as file:
        start = file.read(count)
    if not start:
        raise VolumeError(path, "the file is empty (0 bytes); copy or export it again")
    return start


def mislabelled(path: Path, start: bytes, wanted: str) -> VolumeError:
    """The error for content that is not what the file's name says."""
    printable = all(byte in b"\t\n\r" or byte >= 32 for byte in start[:512])
    found = next((name for magic, name in SIGNATURES if start.startswith(magic)), "text" if printable else "something else")
    return VolumeError(path, f"this is not {wanted}, the content looks like {found}; give the file its right extension")


def grid_numbers(path: str | os.PathLike, name: str, text: str | Sequence[str], *, positive: bool) -> list[float]:
    """Finite numbers of a header line or a keyword, such as spacing, which must be positive too."""
    words = text.split() if isinstance(text, str) else text
    wanted = "positive and finite" if positive else "finite"
    shown = text if isinstance(text, str) else " ".join(text)
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise VolumeError(path, f"{name} is '{shown}'; it must be numbers, {wanted}") from None
    if not all(math.isfinite(x) and (x > 0 or not positive) for x in numbers):
        raise VolumeError(path, f"{name} is '{shown}'; every number must be {wanted}: correct it")
    return numbers


def grid_shape(path: str | os.PathLike, name: str, words: Sequence[str]) -> tuple[int, ...]:
    """A shape in voxels as a header announces it: positive integers."""
    try:
        shape = tuple(int(word) for word in words)
    except ValueError:
        shape = ()
    if not shape or min(shape) < 1:
        raise VolumeError(path, f"{name} is '{' '.join(words)}'; it must be whole numbers of at least 1")
    return shape


def three_axes(path: str | os.PathLike, shape: Sequence[int]) -> tuple[int, int, int]:
    """A shape as (x, y, z): 1-D and 2-D images are one voxel thick, trailing axes of length one are dropped."""
    shape = tuple(int(n) for n in shape)
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) > 3:
        raise VolumeError(path, f"shape {shape} has {len(shape)} axes; save one time point or channel as a 3-D volume")
    padded = shape + (1,) * (3 - len(shape))
    return padded[0], padded[1], padded[2]


def check_size(path: Path, shape: Sequence[int], itemsize: int, stored: int | None, *, compressed: bool = False) -> None:
    """Refuses voxels that the file cannot hold or the memory cannot take, before anything is allocated.

    **Arguments:** `shape` and `itemsize` as the header announces them, `stored` bytes that the file has for them (`None`
    where unknown, as for chunks that may be absent), `compressed` where these are smaller than the voxels.
    """
    announced = math.prod(shape) * itemsize
    size = " x ".join(str(n) for n in shape)
    if stored is not None and announced > stored * (MOST_COMPRESSION if compressed else 1):
        problem = f"the header announces {size} voxels, {announced:,} bytes, but the file holds {stored:,} bytes"
        raise VolumeError(path, problem + (" compressed" if compressed else "") + ": it is cut short or its header is wrong")
    if math.prod(shape) >= 2**31:
        raise VolumeError(
            path, f"{size} voxels are 2^31 or more, which 32-bit indices cannot address: crop or coarsen the volume"
        )
    available = available_memory()
    if available is not None and announced > available:
        raise VolumeError(
            path, f"{size} voxels need {announced:,} bytes, {available:,} are free in memory: crop or coarsen the volume"
        )


def available_memory() -> int | None:
    """Bytes of main memory that are free, or `None` where the system does not tell."""
    try:
        match = re.search(r"MemAvailable:\s+(\d+) kB", Path("/proc/meminfo").read_text())
        return int(match[1]) * 1024 if match else None
    except OSError:
        return None


def one_line(error: BaseException | str) -> str:
    """A library's message, often many lines with source files and addresses, as one line that a person can read."""
    text = re.split(r"ERROR:|Reason:", str(error))[-1]
    text = re.sub(r"\w*\(0x[0-9a-f]+\):?", "", text)
    return " ".join(text.split())[:240] or type(error).__name__


def missing_extra(path: Path, extra: str, kind: str) -> VolumeError:
    """The error for a reader whose library is not installed."""
    return VolumeError(path, f"reading {kind} needs the package {extra}: pip install 'jvr[{extra}]'")
