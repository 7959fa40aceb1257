"""Voxel sizes that makers of microscopes and their programs write beside TIFF's own tags: Zeiss LSM, MetaMorph STK, Micro-Manager."""

import math
import warnings
from pathlib import Path
from typing import Any

from jvr.io.volumes.errors import VolumeError
from jvr.io.volumes.ome_xml import completed
from jvr.io.volumes.units import millimetres

# What others write is not read: attributes of tifffile that tell them, and their names.
OTHERS = {"is_fluoview": "FluoView", "is_sis": "Olympus SIS", "is_scanimage": "ScanImage", "is_metaseries": "MetaSeries"}
OTHERS |= {"is_ndtiff": "NDTiff", "is_nih": "NIH Image", "is_scn": "Leica SCN", "is_geotiff": "GeoTIFF", "is_andor": "Andor"}


def makers_spacing(path: Path, file: Any, depth: int) -> list[float] | None:
    """Voxel size in mm along x, y, z of a file of one of the makers, or `None` where it is of none of them.

    A size that is missing is completed from the others, and said; so is that there are sizes which are not read.
    """
    readers = {"is_lsm": _zeiss, "is_stk": _metamorph, "is_micromanager": _micro_manager}
    for flag, reader in readers.items():
        if getattr(file, flag):
            name, sizes = reader(path, file)
            return completed(path, [_positive(size) for size in sizes], depth, name)
    for flag, name in OTHERS.items():
        if getattr(file, flag, False):
            warnings.warn(f"{path}: what {name} writes of voxel sizes is not read; give spacing= in mm", stacklevel=2)
    if any({"spacing", "unit"} & set(described) for described in file.shaped_metadata or ()):
        warnings.warn(f"{path}: spacing and unit in its JSON description are not read; give spacing= in mm", stacklevel=2)
    return None


def _positive(size: Any) -> float | None:
    try:
        number = float(size)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _zeiss(path: Path, file: Any) -> tuple[str, list[Any]]:
    """In metres."""
    found = file.lsm_metadata or {}
    return "VoxelSizeX, VoxelSizeY, VoxelSizeZ of CZ_LSMINFO", [1e3 * found.get(f"VoxelSize{axis}", 0.0) for axis in "XYZ"]


def _metamorph(path: Path, file: Any) -> tuple[str, list[Any]]:
    """Along x and y in the unit of the calibration, between planes in micrometres."""
    found = file.stk_metadata or {}
    unit = millimetres(path, "CalibrationUnits", str(found.get("CalibrationUnits", "")))
    along = [unit * (_positive(found.get(f"{axis}Calibration")) or 0.0) for axis in "XY"]
    between = {round(abs(float(x)), 9) for x in found.get("ZDistance", ())}
    if len(between - {0.0}) > 1:
        shown = ", ".join(f"{x:g}" for x in sorted(between)[:4])
        raise VolumeError(path, f"its planes are unevenly spaced (ZDistance {shown}): give spacing= in mm to take them as even")
    return "XCalibration, YCalibration, ZDistance of MetaMorph", [*along, 1e-3 * max(between, default=0.0)]


def _micro_manager(path: Path, file: Any) -> tuple[str, list[Any]]:
    """In micrometres, as the summary of the acquisition says, or else the first plane."""
    summary = (file.micromanager_metadata or {}).get("Summary") or {}
    plane = file.pages.first.tags.valueof(51123)
    known = {**(plane if isinstance(plane, dict) else {}), **{key: x for key, x in summary.items() if x}}
    pixel = _positive(known.get("PixelSizeUm", known.get("PixelSize_um")))
    step = _positive(known.get("z-step_um", known.get("ZStepUm")))
    sizes = [None if size is None else 1e-3 * size for size in (pixel, pixel, step)]
    return "PixelSizeUm, z-step_um of Micro-Manager", sizes
