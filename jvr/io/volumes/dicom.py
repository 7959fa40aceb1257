"""DICOM: the slices of one series become one volume; SimpleITK (GDCM) decodes them and applies their rescaling.

Where the slices lie comes from their own positions: ITK makes the third axis perpendicular to the slices, which
misplaces a CT with a tilted gantry, and only warns where a slice is missing.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, mislabelled, one_line
from jvr.io.volumes.given import Given
from jvr.io.volumes.itk import affine_of_image, check_pixels, silenced, voxels_of
from jvr.io.volumes.stored import Stored

PIXEL_SPACING, POSITION, SLOPE, INTERCEPT, THICKNESS = "0028|0030", "0020|0032", "0028|1053", "0028|1052", "0018|0050"


@dataclasses.dataclass
class _Slice:
    file: str
    size: tuple[int, ...]
    affine: np.ndarray
    rescale: tuple[str, str]
    thickness: float
    bytes_each: int


def read_dicom_file(path: Path, given: Given) -> Stored:
    """One DICOM file: a single slice, or a multi-frame volume."""
    start = first_bytes(path)
    if start[128:132] != b"DICM":
        raise mislabelled(path, start, "a DICOM file ('DICM' at byte 128)")
    return _read_series(path, [str(path)])


def read_dicom_folder(folder: Path, given: Given) -> Stored:
    """The one series in a folder, or the one whose id is `series`."""
    series = given.series
    import SimpleITK as sitk

    with silenced():
        ids = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
        slices = {name: list(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), name)) for name in ids}
    _check_all_read(folder, slices)
    if not slices:
        raise VolumeError(folder, "the folder holds no DICOM series; give a folder of DICOM slices, or a volume file")
    shown = ", ".join(f"'{name}' ({len(files)} slices)" for name, files in list(slices.items())[:8])
    shown += f" and {len(slices) - 8} more" if len(slices) > 8 else ""
    if series is None and len(slices) > 1:
        raise VolumeError(folder, f"the folder holds {len(slices)} DICOM series; choose one with series=: {shown}")
    if series is not None and series not in slices:
        raise VolumeError(folder, f"the folder holds no DICOM series '{series}'; it holds {shown}")
    return _read_series(folder, slices[series or next(iter(slices))])


def _check_all_read(folder: Path, slices: dict[str, list[str]]) -> None:
    """GDCM drops a damaged slice without a word."""
    known = {os.path.basename(file) for files in slices.values() for file in files}
    for file in sorted(folder.iterdir()):
        if file.name in known or file.name.upper() == "DICOMDIR" or not file.is_file():
            continue
        with file.open("rb") as stream:
            if stream.read(132)[128:] == b"DICM":
                raise VolumeError(file, "this DICOM file is damaged and cannot be read; copy it again or remove it")


def _read_series(path: Path, files: list[str]) -> Stored:
    import SimpleITK as sitk

    with silenced():
        try:
            slices = [_slice(path, file) for file in files]
            affine = _series_affine(path, slices)
            size = (*slices[0].size[:2], len(slices)) if len(slices) > 1 else slices[0].size
            check_size(path, size, 1, sum(os.path.getsize(file) for file in files), compressed=True)
            check_size(path, size, slices[0].bytes_each, None)
            image = _pixels(sitk, files, slices)
        except RuntimeError as error:
            raise VolumeError(path, f"damaged or not supported: {one_line(error)}") from None
    return Stored(voxels_of(image), affine, owner=image)


def _pixels(sitk: Any, files: list[str], slices: list[_Slice]) -> Any:
    if len(files) == 1:
        return sitk.ReadImage(files[0])
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(files)
    if len({s.rescale for s in slices}) > 1:
        # The first slice would decide the type of all: an integer slope there truncates the fractions of the others.
        reader.SetOutputPixelType(sitk.sitkFloat64)
    return reader.Execute()


def _slice(path: Path, file: str) -> _Slice:
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(file)
    reader.SetImageIO("GDCMImageIO")
    reader.ReadImageInformation()
    check_pixels(path, reader)
    tag = lambda key, default: reader.GetMetaData(key).strip() if reader.HasMetaDataKey(key) else default
    if PIXEL_SPACING in reader.GetMetaDataKeys():
        grid_numbers(Path(file), "PixelSpacing", tag(PIXEL_SPACING, "1").split("\\"), positive=True)
    thickness = grid_numbers(Path(file), "SliceThickness", tag(THICKNESS, "") or "1", positive=False)[0]
    affine = affine_of_image(reader)
    if position := tag(POSITION, ""):
        affine[:3, 3] = grid_numbers(Path(file), "ImagePositionPatient", position.split("\\"), positive=False)
    bytes_each = sitk.Image([1] * 3, reader.GetPixelID()).GetSizeOfPixelComponent()
    rescale = (tag(SLOPE, "1"), tag(INTERCEPT, "0"))
    return _Slice(file, reader.GetSize(), affine, rescale, thickness, bytes_each)


def _series_affine(path: Path, slices: list[_Slice]) -> np.ndarray:
    """In-plane axes from the first slice, the third from the positions of the slices, which must be evenly spaced."""
    first, affine = slices[0], slices[0].affine.copy()
    if len(slices) == 1:
        if len(first.size) < 3 or first.size[2] == 1:
            affine[:3, 2] *= (first.thickness if first.thickness > 0 else 1) / np.linalg.norm(affine[:3, 2])
        return affine
    for s in slices:
        if s.size[:2] != first.size[:2] or (len(s.size) > 2 and s.size[2] > 1):
            raise VolumeError(path, f"slices {_name(first)} and {_name(s)} of the series differ in size; remove the odd one")
        if not np.allclose(s.affine[:3, :2], affine[:3, :2], rtol=0, atol=1e-3):
            raise VolumeError(path, f"slices {_name(first)} and {_name(s)} differ in orientation or pixel spacing; separate them")
    normal = np.cross(affine[:3, 0], affine[:3, 1])
    gaps = np.diff([s.affine[:3, 3] @ normal for s in slices]) / np.linalg.norm(normal)
    typical = float(np.median(gaps))
    pair = lambda k: f"{_name(slices[k])} and {_name(slices[k + 1])}"
    closest, odd = int(np.argmin(abs(gaps))), int(np.argmax(abs(gaps - typical)))
    if abs(gaps[closest]) < 1e-4:
        raise VolumeError(path, f"slices {pair(closest)} lie at the same position: keep one time point or echo in the folder")
    if abs(gaps[odd] - typical) > 0.05 * abs(typical) + 1e-3:
        problem = f"slices are unevenly spaced: {gaps[odd]:.4g} mm between {pair(odd)}, {typical:.4g} mm elsewhere"
        raise VolumeError(path, f"{problem}; add the missing slice or resample the series")
    affine[:3, 2] = (slices[-1].affine[:3, 3] - first.affine[:3, 3]) / (len(slices) - 1)
    return affine


def _name(s: _Slice) -> str:
    return os.path.basename(s.file)
