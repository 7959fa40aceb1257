"""TIFF stacks, read by tifffile: pages are z, rows y, columns x; ImageJ's and OME's voxel sizes are honoured."""

import contextlib
import logging
import re
from pathlib import Path
from typing import Any

from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, mislabelled, one_line
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of
from jvr.io.volumes.units import MILLIMETRES

MAGIC = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
COMPRESSION_NONE, COMPRESSION_DEFLATE = 1, (8, 32946)


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


def read_tiff(path: Path, given: Given) -> Stored:
    """A stack of equal grey pages; one page is a volume one voxel thick."""
    import tifffile

    start = first_bytes(path)
    if not start.startswith(MAGIC):
        raise mislabelled(path, start, "a TIFF image")
    with _recorded() as messages:
        try:
            with tifffile.TiffFile(path) as file:
                series = _stack(path, file, messages)
                values, spacing = series.asarray(), _spacing(path, file)
        except VolumeError:
            raise
        except Exception as error:
            raise VolumeError(path, f"damaged, cut short or not supported: {one_line(error)}") from None
    if messages:
        raise VolumeError(path, f"cut short or damaged: {one_line(messages[0])}; copy or export it again")
    return Stored(values.reshape(-1, *values.shape[-2:]).T, affine_of(spacing))


def _stack(path: Path, file: Any, messages: list[str]) -> Any:
    pages = len(file.pages)
    if messages:
        raise VolumeError(path, f"cut short or damaged: {one_line(messages[0])}; copy or export it again")
    if len(file.series) != 1:
        shapes = ", ".join(str(series.shape) for series in file.series[:4])
        raise VolumeError(path, f"its {pages} pages form {len(file.series)} images of different kinds {shapes}; save one stack")
    series = file.series[0]
    if "S" in series.axes or series.keyframe.photometric == 3:
        raise VolumeError(path, f"its pages are in colour (shape {series.shape}, axes {series.axes}); convert them to grey")
    if sum(n > 1 for n in series.shape[:-2]) > 1 or not series.axes.endswith("YX"):
        problem = f"shape {series.shape} with axes {series.axes}"
        raise VolumeError(path, f"{problem} is no stack of pages (z, y, x); save one time point or channel")
    bytes_stored = path.stat().st_size
    known = series.keyframe.compression in (COMPRESSION_NONE, *COMPRESSION_DEFLATE)
    compressed = series.keyframe.compression != COMPRESSION_NONE
    check_size(path, series.shape, series.dtype.itemsize, bytes_stored if known else None, compressed=compressed)
    for page in series.pages:
        ends = [offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)] if page else []
        if ends and max(ends) > bytes_stored:
            raise VolumeError(path, f"the pages end at byte {max(ends):,}, the file at {bytes_stored:,}: it is cut short")
    return series


def _spacing(path: Path, file: Any) -> list[float]:
    """Voxel size in mm along x, y, z; 1 where the file does not say, or where its unit is not a length."""
    if file.is_ome:
        fields = dict(re.findall(r'PhysicalSize(\w+)="([^"]*)"', file.ome_metadata or ""))
        sizes = [grid_numbers(path, f"PhysicalSize{axis}", fields.get(axis, "1"), positive=True)[0] for axis in "XYZ"]
        units = [MILLIMETRES.get(fields.get(f"{axis}Unit", "µm"), 1.0) if axis in fields else 1.0 for axis in "XYZ"]
        return [size * unit for size, unit in zip(sizes, units, strict=True)]
    if file.is_imagej:
        metadata, tags = file.imagej_metadata or {}, file.pages[0].tags
        per_unit = [tags[f"{axis}Resolution"].value if f"{axis}Resolution" in tags else (1, 1) for axis in "XY"]
        # ImageJ counts pixels per unit along x and y.
        sizes = [below / above if above else 0.0 for above, below in per_unit] + [float(metadata.get("spacing", 1.0))]
        unit = MILLIMETRES.get(str(metadata.get("unit", "")).lower(), 1.0)
        return [x * unit for x in grid_numbers(path, "the voxel size", [str(size) for size in sizes], positive=True)]
    return [1.0, 1.0, 1.0]
