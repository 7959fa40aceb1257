"""Reading volumes: one function for every format, one line of explanation for every file that cannot be read.

`read_volume` looks at the name, calls the reader of that format and makes a `Volume` of what it found. Nothing heavy is
imported before a file asks for it.
"""

import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.arrays import read_npy, read_raw
from jvr.io.volumes.dicom import looks_like_dicom, read_dicom_file, read_dicom_folder
from jvr.io.volumes.errors import VolumeError, first_bytes
from jvr.io.volumes.given import Given
from jvr.io.volumes.metaimage import read_metaimage
from jvr.io.volumes.nifti import read_nifti
from jvr.io.volumes.nrrd import read_nrrd
from jvr.io.volumes.slc import read_slc
from jvr.io.volumes.slices import is_slices, read_slices
from jvr.io.volumes.stored import Stored, replaced, to_volume
from jvr.io.volumes.tiff import read_tiff
from jvr.io.volumes.vtk_legacy import read_legacy_vtk
from jvr.io.volumes.vtk_xml import read_vti
from jvr.io.volumes.zarr_files import is_zarr, read_zarr
from jvr.model.volume import Volume

__all__ = ["VolumeError", "read_volume"]

Number = float | int | np.number
Numbers = Number | Sequence[Number] | np.ndarray

RAW = (".raw", ".bin", ".dat")
# For each ending: the reader and the keywords of `read_volume` that it takes, beside those that place and scale every volume.
READERS: dict[str, tuple[Callable[[Path, Given], Stored], tuple[str, ...]]] = {
    ".mhd": (read_metaimage, ("channel", "time")),
    ".mha": (read_metaimage, ("channel", "time")),
    ".nrrd": (read_nrrd, ("channel", "time")),
    ".nhdr": (read_nrrd, ("channel", "time")),
    ".nii": (read_nifti, ("channel", "time")),
    ".nii.gz": (read_nifti, ("channel", "time")),
    ".hdr": (read_nifti, ("channel", "time")),
    ".hdr.gz": (read_nifti, ("channel", "time")),
    ".img": (read_nifti, ("channel", "time")),
    ".img.gz": (read_nifti, ("channel", "time")),
    ".dcm": (read_dicom_file, ("channel", "time")),
    ".vtk": (read_legacy_vtk, ("array", "channel")),
    ".vti": (read_vti, ("array", "channel")),
    ".slc": (read_slc, ()),
    ".tif": (read_tiff, ("array", "axes", "channel", "time")),
    ".tiff": (read_tiff, ("array", "axes", "channel", "time")),
    ".lsm": (read_tiff, ("array", "axes", "channel", "time")),
    ".stk": (read_tiff, ("array", "axes", "channel", "time")),
    ".npy": (read_npy, ("axes", "channel", "time")),
    ".zarr": (read_zarr, ("array", "axes", "channel", "time")),
    ".zarr.zip": (read_zarr, ("array", "axes", "channel", "time")),
    ".ozx": (read_zarr, ("array", "axes", "channel", "time")),
} | {ending: (read_raw, ("shape", "dtype")) for ending in RAW}
# Formats that are not read, and what makes one of them that is.
REMEDIES: dict[tuple[str, ...], str] = {
    (".mgz", ".mgh"): "FreeSurfer's format is not read: convert it by `mri_convert a.mgz a.nii.gz`",
    (".mnc", ".mnc2"): "MINC is not read: convert it by `mnc2nii`",
    (".par", ".rec"): "Philips PAR/REC is not read: convert it by `dcm2niix`",
    (
        ".czi",
        ".nd2",
        ".lif",
        ".oib",
        ".oif",
        ".ims",
        ".vsi",
    ): "microscopes' own formats are not read: export OME-TIFF, as Fiji does",
    (".h5", ".hdf5", ".hdf", ".nc", ".mat"): "HDF5, NetCDF and MATLAB files are not read: save one array by numpy.save as .npy",
    (".npz",): "an archive of several arrays: save one of them by numpy.save as .npy",
    (".mrc", ".map", ".ccp4"): "MRC is not read: save the array by numpy.save as .npy, and give spacing= in mm",
    (".vtu", ".vts", ".vtr", ".pvti", ".vtm", ".pvd"): "only image data (.vti, .vtk) is a volume: resample it, as ParaView does",
    (".vdb",): "sparse OpenVDB grids are not read: save a dense array by numpy.save as .npy",
    (".png", ".jpg", ".jpeg", ".bmp"): "one picture is no volume: give the folder of all slices",
    (".ome",): "a companion file that describes others: read one of its .ome.tif files, or export all as one OME-TIFF",
    (
        ".zip",
        ".tar",
        ".tar.gz",
        ".tgz",
        ".7z",
        ".rar",
        ".xz",
        ".bz2",
        ".zst",
        ".gz",
    ): "packed files are not read: unpack it first",
}
MEANING = {
    "shape": "shape= and dtype= describe headerless raw files, this file has a header",
    "dtype": "shape= and dtype= describe headerless raw files, this file has a header",
    "array": "array= names an array in a .vtk, .vti, .zarr or an image of a .tif, this file holds a single one",
    "series": "series= chooses among the DICOM series of a folder",
    "axes": "axes= names the axes of .npy, .tif and .zarr, this format defines its own",
    "channel": "channel= chooses one of several channels, this format has none",
    "time": "time= chooses one of several points in time, this format has none",
}


def read_volume(
    path: str | bytes | os.PathLike,
    *,
    shape: Sequence[int] | None = None,
    dtype: Any = None,
    spacing: Numbers | None = None,
    origin: Numbers | None = None,
    array: str | None = None,
    series: str | None = None,
    axes: str | Sequence[str] | None = None,
    channel: int | np.integer | str | None = None,
    time: int | np.integer | None = None,
    direction: Sequence[Sequence[float]] | np.ndarray | None = None,
    slope: Number | None = None,
    intercept: Number | None = None,
    missing: Number | bool | None = None,
    nan_value: Number | None = None,
) -> Volume:
    """Reads a scalar volume and where it lies in the world (millimetres, LPS, as ITK reads it).

    Formats: MetaImage (.mhd, .mha), NRRD (.nrrd, .nhdr), NIfTI (.nii, .nii.gz), a folder of DICOM slices or one .dcm,
    legacy VTK structured points (.vtk), VTK image data (.vti), TIFF, ImageJ and OME-TIFF (.tif, .tiff), a folder of PNG, TIFF, BMP
    or JPEG slices, NumPy (.npy, never unpickled), Zarr and OME-Zarr (.zarr, .zarr.zip, .ozx) and headerless
    raw (.raw, .bin, .dat, or any ending where `shape` and `dtype` are given).

    Integer voxels stay integers (32 and 64-bit ones as narrow as their values fit), floats become float32 unless x64 is
    on. A file's slope and intercept become those of the `Volume`, or are applied where DICOM slices have their own.
    A 2-D image becomes one voxel thick.

    **Arguments:**

    - `path`: the file, or the folder of a DICOM series or a Zarr.
    - `shape`, `dtype`: voxels along x, y, z (x fastest in the file) and NumPy type of a headerless file; ">i2" is big-endian.
    - `spacing`: millimetres between voxels along x, y, z, or one number for all, in place of what the file says (default 1).
    - `origin`: world position of voxel (0, 0, 0) in mm, in place of what the file says (default 0, 0, 0).
    - `direction`: 3x3, unit vectors along x, y, z of the grid in its columns, in place of what the file says.
    - `slope`, `intercept`: data units are `slope * stored + intercept`, in place of what the file says.
    - `array`: which array of a VTK file or Zarr group, or image of a TIFF.
    - `series`: which DICOM series of a folder, by its id.
    - `axes`: names of a NumPy, TIFF or Zarr array's axes in their order, such as "zyx", or "tczyx" with channel and time; default "xyz",
      or what the file says.
    - `channel`, `time`: which of several channels (its index from 0 or its name) and points in time (its index).
    - `missing`: the number, in data units, that means "no data"; `False` where none does. Default: what the file says, or a number that
      scanners and simulations write for it (-2000, -3024, -32768, -9999, ...) where it lies far from all others, with a warning. NaN
      and numbers beyond 1e30 mean that by themselves. What is missing stays empty.
    - `nan_value`: number, in data units, that takes the place of NaN and infinite voxels.

    **Raises** `VolumeError` (a `ValueError`) with one line that names the file, what is wrong and what would be right, for
    anything that is not a whole, finite, scalar volume on a regular grid, and the system's own `OSError` (such as
    `FileNotFoundError`) where a file cannot be opened. Warns where float32 loses what sets float64 voxels apart.
    """
    path = _path(path)
    given = Given(
        shape=shape,
        dtype=dtype,
        spacing=_three(path, "spacing", spacing, positive=True),
        origin=_three(path, "origin", origin, positive=False),
        direction=_direction(path, direction),
        slope=_number(path, "slope", slope),
        intercept=_number(path, "intercept", intercept),
        array=array,
        series=series,
        axes=axes if axes is None or isinstance(axes, str) else "".join(map(str, axes)),
        channel=channel,
        time=time,
        missing=False if missing is False else _number(path, "missing", missing, ", or False for none; NaN means that by itself"),
        nan_value=_number(path, "nan_value", nan_value),
    )
    reader, takes = _reader(path, raw=shape is not None and dtype is not None)
    if superfluous := [key for key in MEANING if getattr(given, key) is not None and key not in takes]:
        raise VolumeError(path, f"{MEANING[superfluous[0]]}: leave {superfluous[0]}= out")
    stored = replaced(reader(path, given), given)
    return to_volume(path, stored, given)


def _path(path: Any) -> Path:
    """The name of a file or folder."""
    if not isinstance(path, str | bytes | os.PathLike):
        raise TypeError(
            f"read_volume takes the name of a file or folder, not {type(path).__name__}; an array becomes a volume by jvr.Volume"
        )
    name = os.fsdecode(path)
    if re.match(r"[a-z][a-z0-9+]+://", name):
        raise VolumeError(name, "this is an address, and only files are read: download it")
    if not name or "\0" in name:
        raise VolumeError(repr(name), "this is no name of a file")
    # Unlike the method of Path, this leaves "~name" as it is where there is no such user.
    return Path(os.path.expanduser(name))


def _three(path: Path, name: str, numbers: Any, *, positive: bool) -> np.ndarray | None:
    """Three numbers of a keyword as an array."""
    if numbers is None:
        return None
    try:
        values = np.asarray(numbers, float)
    except (TypeError, ValueError):
        values = np.empty(0)
    # One distance stands for all three.
    values = np.full(3, values) if positive and values.ndim == 0 else values
    if values.shape != (3,) or not np.isfinite(values).all() or (positive and not (values > 0).all()):
        wanted = "three positive finite numbers" if positive else "three finite numbers"
        raise VolumeError(path, f"{name}={numbers} must be {wanted}, in mm along x, y, z")
    return values


def _number(path: Path, name: str, value: Any, also: str = "") -> float | int | None:
    """A finite number of a keyword."""
    if value is None:
        return None
    if np.ndim(value) or isinstance(value, bool) or np.asarray(value).dtype.kind not in "iuf" or not math.isfinite(value):
        raise VolumeError(path, f"{name}={value!r} must be a finite number{also}")
    return np.asarray(value).item()


def _direction(path: Path, matrix: Any) -> np.ndarray | None:
    """Unit vectors of the grid's axes, in the columns of a 3x3 matrix."""
    if matrix is None:
        return None
    try:
        values = np.asarray(matrix, float)
    except (TypeError, ValueError):
        values = np.empty(0)
    regular = values.shape == (3, 3) and np.isfinite(values).all() and abs(np.linalg.det(values)) > 1e-6
    if not regular or not np.allclose(np.linalg.norm(values, axis=0), 1, atol=1e-3):
        raise VolumeError(
            path, "direction= must be 3x3 numbers: in its columns unit vectors of the axes x, y, z, none in the plane of others"
        )
    return values


def _reader(path: Path, *, raw: bool) -> tuple[Callable[[Path, Given], Stored], tuple[str, ...]]:
    """The reader for a name, and the keywords it takes."""
    name = path.name.lower()
    endings = ("".join(path.suffixes[-2:]).lower(), path.suffix.lower())
    ending = next((ending for ending in endings if ending in READERS), None)
    if path.is_dir():
        if ending == ".zarr" or is_zarr(path):
            return READERS[".zarr"]
        return (read_slices, ()) if is_slices(path) else (read_dicom_folder, ("series", "channel", "time"))
    first_bytes(path, 1)
    if ending == ".zarr":
        raise VolumeError(path, "a Zarr is a folder, this is a file; unpack it first")
    # An .img may be headerless too.
    if ending is not None and not (raw and ending == ".img"):
        return READERS[ending]
    if raw:
        return read_raw, ("shape", "dtype")
    if looks_like_dicom(first_bytes(path, 160)):
        return READERS[".dcm"]
    if remedy := next((remedy for endings, remedy in REMEDIES.items() if name.endswith(endings)), None):
        raise VolumeError(path, remedy)
    shown = "".join(path.suffixes[-2:]) if name.endswith(".gz") else path.suffix
    known = ", ".join(ending for ending in READERS)
    problem = f"unsupported extension '{shown}'; supported: {known}, a folder of DICOM, PNG, TIFF, BMP or JPEG slices"
    raise VolumeError(path, f"{problem}, and headerless data of any extension with shape= and dtype=")
