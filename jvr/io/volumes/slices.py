"""A folder of pictures, one for each slice: PNG, TIFF, BMP or JPEG, in the order of the numbers in their names."""

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.apart import Decoder
from jvr.io.volumes.errors import VolumeError, check_size, one_line
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of
from jvr.io.volumes.tiff import read_tiff

KINDS = {".png": "PNG", ".bmp": "BMP", ".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF", ".tiff": "TIFF"}
# What file managers leave behind.
LITTER = ("thumbs.db", "desktop.ini")


def is_slices(path: Path) -> bool:
    """Whether pictures are what a folder holds: some, and more of them than of other files."""
    files = _visible(path)
    pictures = [file for file in files if file.suffix.lower() in KINDS]
    return 2 * len(pictures) > len(files)


def _visible(path: Path) -> list[Path]:
    return [
        file for file in path.iterdir() if not file.name.startswith(".") and file.name.lower() not in LITTER and file.is_file()
    ]


def read_slices(path: Path, given: Given) -> Stored:
    """Slices along z, rows along y, columns along x. Colour pictures are read where their channels are equal.

    The distance of voxels and slices is said to be unknown unless `given.spacing` is there.
    """
    files = sorted((file for file in _visible(path) if file.suffix.lower() in KINDS), key=natural)
    kinds = {KINDS[file.suffix.lower()]: file for file in files}
    if len(kinds) > 1:
        (one, first), (other, second) = list(kinds.items())[:2]
        raise VolumeError(
            path, f"it holds pictures of several kinds, such as {first.name} ({one}) and {second.name} ({other}): keep one kind"
        )
    _say_gaps(path, files)
    with Decoder() as decoder:
        values = _stacked(path, files, decoder)
    if given.spacing is None:
        problem = "pictures do not say how far apart voxels and slices are: 1 mm is taken along x, y and z"
        warnings.warn(f"{path}: {problem}; give spacing= in mm", stacklevel=2)
    return Stored(values, affine_of(np.ones(3)))


def _stacked(path: Path, files: list[Path], decoder: Decoder) -> np.ndarray:
    first = _slice(files[0], decoder)
    check_size(path, (*first.shape, len(files)), first.dtype.itemsize, None)
    values = np.empty((*first.shape, len(files)), first.dtype, order="F")
    for k, file in enumerate(files):
        found = _slice(file, decoder) if k else first
        if found.shape != first.shape or found.dtype != first.dtype:
            sizes = [f"{picture.shape[0]} x {picture.shape[1]} {picture.dtype}" for picture in (first, found)]
            raise VolumeError(
                path, f"its slices differ: {files[0].name} is {sizes[0]}, {file.name} is {sizes[1]}; make them alike"
            )
        values[..., k] = found
    return values


def natural(file: Path) -> list[tuple[int, int, str]]:
    """Key by which "slice2" comes before "slice10"."""
    parts = re.split(r"([0-9]+)", file.stem)
    return [(0, int(part), part) if k % 2 else (1, 0, part.lower()) for k, part in enumerate(parts)]


def _say_gaps(path: Path, files: list[Path]) -> None:
    """Warns of names that follow several patterns and of numbers that are not there."""
    patterns = {re.sub(r"[0-9]+", "#", file.stem): file.name for file in files}
    if len(patterns) > 1:
        shown = " and ".join(list(patterns.values())[:2])
        warnings.warn(
            f"{path}: names follow {len(patterns)} patterns, such as {shown}: all are read as slices of one volume", stacklevel=3
        )
        return
    numbers = np.array([[int(part) for part in re.findall(r"[0-9]+", file.stem)] for file in files], dtype=object)
    varying = [k for k in range(numbers.shape[1]) if len(set(numbers[:, k])) > 1]
    if len(varying) > 1:
        problem = f"names such as {files[0].name} and {files[-1].name} differ in {len(varying)} numbers"
        warnings.warn(f"{path}: {problem}: all are read as slices of one volume, in the order of their numbers", stacklevel=3)
    if len(varying) != 1:
        return
    steps = np.diff(numbers[:, varying[0]])
    # Names such as 1 and 01 have the same number.
    usual = min(step for step in steps if step > 0)
    gaps = [k for k, step in enumerate(steps) if step not in (0, usual)]
    if gaps:
        k = gaps[0]
        where = f"no slice lies between {files[k].name} and {files[k + 1].name}" + (
            f", and {len(gaps) - 1} more gaps" if len(gaps) > 1 else ""
        )
        warnings.warn(f"{path}: the numbering of its slices has gaps: {where}; they are read as if it had none", stacklevel=3)


def _slice(file: Path, decoder: Decoder) -> np.ndarray:
    """One picture as `[x, y]`."""
    if KINDS[file.suffix.lower()] == "TIFF":
        values = read_tiff(file, Given(spacing=np.ones(3)), decoder).values
        if values.shape[2] != 1:
            raise VolumeError(
                file, f"it holds {values.shape[2]} pages, where a folder's slices hold one each; read it by its own name"
            )
        return values[..., 0]
    from PIL import Image, ImageOps

    try:
        # The size is read from the header; Pillow refuses bombs before it decodes.
        with warnings.catch_warnings(), Image.open(file, formats=[KINDS[file.suffix.lower()]]) as picture:
            warnings.simplefilter("ignore")
            check_size(file, picture.size, 4, None)
            # A byte is eight pixels at most, before it is compressed.
            check_size(file, picture.size, 1, 8 * file.stat().st_size, compressed=True)
            return _grey(file, ImageOps.exif_transpose(picture)).T
    except VolumeError:
        raise
    except Exception as error:
        raise VolumeError(file, f"damaged, cut short or no {KINDS[file.suffix.lower()]}: {one_line(error)}") from None


def _grey(file: Path, picture: Any) -> np.ndarray:
    """Rows and columns of a picture that is grey, if need be in equal channels and opaque."""
    with file.open("rb") as opened:
        start = opened.read(26)
    # Pillow keeps 8 of 16 bits where there is more than one channel.
    deep = start.startswith(b"\x89PNG") and start[24] == 16 and start[25] != 0
    if picture.mode in ("1", "L", "I", "F") or (picture.mode.startswith("I;16") and not deep):
        return np.asarray(picture)
    if picture.mode in ("P", "PA", "RGB", "RGBA", "LA") and not deep:
        values = np.asarray(picture.convert("RGBA"))
        if (values[..., :1] == values[..., :3]).all() and (values[..., 3] == 255).all():
            return values[..., 0]
    raise VolumeError(file, f"the slice is in colour or transparent (mode {picture.mode}): convert all slices to grey")
