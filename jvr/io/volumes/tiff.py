"""TIFF, read by tifffile: stacks of pages, ImageJ's hyperstacks and OME-TIFF, with the voxel sizes, channels and times they name."""

import contextlib
import importlib.util
import logging
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from jvr.io.volumes.apart import decoded
from jvr.io.volumes.axes import Chosen, chosen, named
from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, mislabelled, one_line
from jvr.io.volumes.given import Given
from jvr.io.volumes.jpeg import jpeg_size
from jvr.io.volumes.ome_xml import OmeImage, completed, ome_images, ome_spacing
from jvr.io.volumes.stored import Stored, affine_of
from jvr.io.volumes.tiff_makers import makers_spacing
from jvr.io.volumes.units import length_of, millimetres

MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
JPEG, LZW = 7, 5
# Compressions by their numbers: how far each may shrink its input (LZW: 4096 bytes in 12 bits), where there is a small bound.
COMPRESSIONS = {1: 1, 5: 2731, 8: 1100, 32946: 1100, 32773: 64, JPEG: None, 2: None, 3: None, 4: None, 34925: None, 50000: None}
GREY = (0, 1)
PALETTE = 3
RGB = (2, 6)
COLOURS = ("red", "green", "blue")
# Of the tag ResolutionUnit, in mm; 1 is none.
RESOLUTION_UNITS = {2: 25.4, 3: 10.0}

Result = TypeVar("Result")


@contextlib.contextmanager
def _recorded():
    """What tifffile logs about a damaged file, which it then reads as if it were shorter, instead of on the terminal."""
    logger, messages = logging.getLogger("tifffile"), []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: messages.append(record.getMessage())
    propagate, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield messages
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


def read_tiff(path: Path, given: Given, decoder: Callable[[Path, dict[str, Any], int], np.ndarray] = decoded) -> Stored:
    """A stack of equal grey pages, or the volume that `given.channel` and `given.time` choose of ImageJ's or OME's axes.

    `given.array` is the number or name of one of several images; `given.axes` names the axes in place of what the file says.
    `decoder` is what decodes LZW: a `Decoder`, for many files.
    """
    return opened(path, lambda file, messages: _read(path, file, given, decoder, messages))


def opened(path: Path, read: Callable[[Any, list[str]], Result]) -> Result:
    """What `read` makes of a file of tifffile and of the messages that come of it.

    **Raises** `VolumeError` for a file that is no TIFF, damaged or cut short.
    """
    import tifffile

    start = first_bytes(path)
    if not start.startswith(MAGIC):
        raise mislabelled(path, start, "a TIFF image")
    with _recorded() as messages:
        try:
            with tifffile.TiffFile(path) as file:
                found = read(file, messages)
        except VolumeError:
            raise
        except Exception as error:
            if "imagecodecs" in str(error):
                problem = f"its compression needs the package imagecodecs ({one_line(error)}): pip install imagecodecs"
                raise VolumeError(path, problem) from None
            raise VolumeError(path, f"damaged, cut short or not supported: {one_line(error)}") from None
    _refuse_damage(path, messages)
    return found


def _refuse_damage(path: Path, messages: list[str]) -> None:
    # A no-data value that the voxels' type cannot hold is no damage.
    damage = [message for message in messages if "GDAL_NODATA" not in message]
    if damage:
        raise VolumeError(path, f"cut short or damaged: {one_line(damage[0])}; copy or export it again")


def _read(path: Path, file: Any, given: Given, decoder: Any, messages: list[str]) -> Stored:
    # OME-XML is checked before tifffile parses it.
    images = ome_images(path, file.ome_metadata or "") if file.is_ome else []
    number, series = _series(path, file, images, given, messages)
    check_pages(path, series)
    image = images[number] if len(images) == len(file.series) else None
    names = _axes(path, series, given)
    found = chosen(path, series.shape, names, given, _channels(series, names, image))
    values = found.of(numbers_of(path, number, series, decoder))
    orientation = int(series.keyframe.tags.valueof(274, 1) or 1)
    if orientation != 1:
        problem = f"its tag Orientation is {orientation}: row 0 is not the top, or column 0 not the left"
        warnings.warn(f"{path}: {problem}; voxels are read in the order that they are stored in", stacklevel=2)
    if series.keyframe.photometric == 0:
        warnings.warn(
            f"{path}: its pages say that 0 is white (WhiteIsZero); the numbers are read as they are stored", stacklevel=2
        )
    return Stored(values, affine_of(_spacing(path, file, series, image, found, given)), missing=_missing(series))


def numbers_of(path: Path, number: int, series: Any, decoder: Any = decoded) -> np.ndarray:
    """All pages of a series that has been checked, those of LZW from a process of its own: its decoder, native code, crashes on damaged
    ones."""
    if series.keyframe.compression != LZW:
        values = series.asarray()
        # Where tags contradict each other, it is what it is.
        if values.shape != tuple(series.shape):
            raise VolumeError(path, f"its pages are {values.shape} where it says {tuple(series.shape)}: export it again")
        return values
    if importlib.util.find_spec("imagecodecs") is None:
        raise VolumeError(path, "its compression (LZW) needs the package imagecodecs: pip install imagecodecs")
    count = math.prod(series.shape) * series.dtype.itemsize
    task = {"kind": "tiff", "file": str(path), "series": number, "bytes": count}
    return decoder(path, task, count).view(series.dtype).reshape(series.shape)


def _series(path: Path, file: Any, images: list[OmeImage], given: Given, messages: list[str]) -> tuple[int, Any]:
    """The image that `given.array` names, by its number or name, or the only one."""
    pages, found = len(file.pages), list(file.series)
    _refuse_damage(path, messages)
    names = [image.name for image in images] if len(images) == len(found) else [series.name for series in found]
    # Thumbnails and pictures of lower resolution are marked as such.
    whole = [k for k, series in enumerate(found) if not series.keyframe.is_reduced]
    if given.array is None and (len(whole) == 1 or len(found) == 1):
        number = whole[0] if whole else 0
        return number, found[number]
    shown = ", ".join(f"{k} '{name}' {series.shape}" for k, (name, series) in enumerate(zip(names[:4], found[:4], strict=True)))
    if given.array is None:
        raise VolumeError(path, f"its {pages} pages form {len(found)} images: {shown}; choose one with array=, by its number")
    if given.array.isdecimal() and int(given.array) < len(found):
        return int(given.array), found[int(given.array)]
    if names.count(given.array) == 1:
        return names.index(given.array), found[names.index(given.array)]
    raise VolumeError(path, f"it holds no single image '{given.array}'; array= may be {shown}")


def check_pages(path: Path, series: Any) -> None:
    """Refuses, before anything is decoded, what is cut short, in other files that are missing, or larger decoded than it says."""
    page = series.keyframe
    most = COMPRESSIONS.get(int(page.compression), 0)
    if most == 0:
        raise VolumeError(
            path, f"its compression ({one_line(str(page.compression))}) is not read; save it with LZW, Deflate or none"
        )
    if math.prod(series.shape) == 0:
        raise VolumeError(path, f"its image of shape {series.shape} is empty; export it again")
    check_size(path, series.shape, series.dtype.itemsize, None)
    whole, stored = True, 0
    for one in series.pages:
        if one is None:
            raise VolumeError(
                path, "it places some of its pages in other files, which are missing: put them beside it, or export one file"
            )
        ends = [offset + count for offset, count in zip(one.dataoffsets, one.databytecounts, strict=True)]
        size = one.parent.filehandle.size
        if ends and max(ends) > size:
            raise VolumeError(path, f"the pages end at byte {max(ends):,}, the file at {size:,}: it is cut short")
        whole, stored = whole and bool(ends), stored + sum(one.databytecounts)
    if series.dataoffset is not None and most == 1:
        # Planes may lie behind the one page that there is.
        stored = max(stored, page.parent.filehandle.size - series.dataoffset)
    if most is not None and whole:
        bits = page.bitspersample if page.bitspersample < 8 else 8 * series.dtype.itemsize
        announced = math.prod(series.shape) * bits // 8
        if announced > (stored + 64) * most:
            problem = f"the header announces {' x '.join(map(str, series.shape))} voxels, but the file holds {stored:,} bytes"
            raise VolumeError(path, f"{problem}: it is cut short or its header is wrong")
    if page.is_tiled and page.tilewidth * page.tilelength > 4 * page.imagewidth * page.imagelength + 2**20:
        raise VolumeError(
            path, f"its tiles of {page.tilewidth} x {page.tilelength} are larger than the image: its header is wrong"
        )
    if page.compression == JPEG:
        _check_jpeg(path, series)


def _check_jpeg(path: Path, series: Any) -> None:
    """The decoder allocates what each piece announces: it must be what the page announces."""
    for page in series.pages:
        width, height = (page.tilewidth, page.tilelength) if page.is_tiled else (page.imagewidth, page.rowsperstrip)
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            if count:
                page.parent.filehandle.seek(offset)
                size = jpeg_size(page.parent.filehandle.read(count))
                if size is None or size[0] > width or size[1] > min(height, page.imagelength if not page.is_tiled else height):
                    raise VolumeError(path, f"damaged: a JPEG of size {size} in pages of {width} x {height}; export it again")


def _axes(path: Path, series: Any, given: Given) -> list[str]:
    """Names of the axes, of which one that TIFF leaves nameless (a sequence of pages) is z. Colour is refused."""
    if given.axes is not None:
        return named(path, series.shape, given.axes)
    letters, photometric = list(series.axes.upper()), int(series.keyframe.photometric)
    if photometric == PALETTE or ("S" in letters and photometric not in GREY and given.channel is None):
        shape = f"(shape {series.shape}, axes {series.axes})"
        remedy = "convert them to grey" + (", or choose channel=0 (red), 1 (green) or 2 (blue)" if photometric in RGB else "")
        raise VolumeError(path, f"its pages are in colour {shape}: {remedy}")
    letters = ["c" if letter == "S" and "C" not in letters else letter for letter in letters]
    long = [k for k, (letter, n) in enumerate(zip(letters, series.shape, strict=True)) if n > 1 and letter not in "XYc"]
    if len(long) == 1 and letters[long[0]] in "IQ" and "Z" not in letters:
        letters[long[0]] = "z"
    if [letter for letter in letters if letter in "IQ"] and any(letters[k] in "IQ" for k in long):
        problem = f"shape {series.shape}, the file names some of its axes ({series.axes}) not"
        raise VolumeError(path, f"{problem}: name them with axes=, such as 'czyx' or 'tzyx', and choose with channel= or time=")
    return [letter if letter not in "IQ" else "-" for letter in letters]


def _channels(series: Any, names: list[str], image: OmeImage | None) -> list[str]:
    count = dict(zip("".join(name[0] for name in names).upper(), series.shape, strict=True)).get("C", 0)
    if image is not None and len(image.channels) == count:
        return image.channels
    if int(series.keyframe.photometric) in RGB and series.axes.endswith("S"):
        return list(COLOURS[: series.shape[-1]])
    return []


def _missing(series: Any) -> float | None:
    """What GDAL's tag of "no data" says."""
    tag = series.keyframe.tags.get(42113)
    try:
        return None if tag is None else float(str(tag.value).strip("\x00 "))
    except ValueError:
        return None


def _spacing(path: Path, file: Any, series: Any, image: OmeImage | None, found: Chosen, given: Given) -> list[float]:
    """Voxel size in mm along x, y, z; what is not said, or is no length, is guessed and said."""
    depth = 1 if found.kept[2] is None else series.shape[found.kept[2]]
    if given.spacing is not None:
        return [1.0, 1.0, 1.0]
    if image is not None:
        return ome_spacing(path, image.pixels, depth, given)
    if (sizes := makers_spacing(path, file, depth)) is not None:
        return sizes
    tags = series.keyframe.tags
    sizes = [_pixel(tags, "XResolution"), _pixel(tags, "YResolution")]
    unit = RESOLUTION_UNITS.get(int(tags["ResolutionUnit"].value)) if "ResolutionUnit" in tags else 25.4
    if file.is_imagej:
        return _imagej_spacing(path, file.imagej_metadata or {}, sizes, unit, depth)
    if unit is None or None in sizes:
        return completed(path, [None, None, None], depth, "its ResolutionUnit is none, or its resolution is missing")
    return completed(path, [*(size * unit for size in sizes if size), None], depth, "TIFF has a resolution along x and y alone")


def _pixel(tags: Any, name: str) -> float | None:
    """Units between pixels: the tag counts pixels per unit."""
    value = tags[name].value if name in tags else (0, 1)
    pixels, units = value if isinstance(value, tuple) else (float(value), 1)
    size = units / pixels if pixels else 0.0
    return size if math.isfinite(size) and size > 0 else None


def _imagej_spacing(
    path: Path, metadata: dict[str, Any], sizes: list[float | None], unit: float | None, depth: int
) -> list[float]:
    """ImageJ's calibration: pixels per `unit` along x and y, units between slices. The sign of `spacing` only says how they were taken."""
    name = metadata.get("unit")
    if name is None and unit is not None:
        scales = [unit, unit, unit]
    else:
        scale = millimetres(path, "ImageJ's unit", None if name is None else str(name))
        others = [metadata.get(f"{axis}unit") for axis in "yz"]
        scales = [scale] + [scale if other is None else millimetres(path, "ImageJ's unit", str(other)) for other in others]
    try:
        between = abs(float(metadata["spacing"])) if "spacing" in metadata else None
    except (TypeError, ValueError):
        between = math.nan
    if between is not None and not (math.isfinite(between) and between > 0):
        raise VolumeError(
            path, f"ImageJ's spacing is '{metadata['spacing']}'; it must be a number that is not 0: give spacing= in mm"
        )
    if between is None and depth > 1 and (length_of(name) is not None or (name is None and unit is not None)):
        problem = f"no spacing between slices is given: {scales[2]:.6g} mm is taken, one unit, as ImageJ does"
        warnings.warn(f"{path}: {problem}; give spacing= in mm", stacklevel=2)
    along = [1.0 if size is None else size for size in sizes] + [1.0 if between is None else between]
    return [size * scale for size, scale in zip(along, scales, strict=True)]
