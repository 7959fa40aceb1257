"""NIfTI: SimpleITK says where the voxels lie, the voxels themselves are read here.

ITK turns integers with a slope into doubles, and fills up a file that was cut short without a word.
"""

import dataclasses
import gzip
import math
import struct
import zlib
from pathlib import Path

import numpy as np

from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, mislabelled, one_line, three_axes
from jvr.io.volumes.given import Given
from jvr.io.volumes.itk import affine_of_image, silenced
from jvr.io.volumes.stored import Stored

TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
NOT_SCALAR = {32: "complex numbers", 1792: "complex numbers", 128: "RGB colours", 2304: "RGBA colours"}
MILLIMETRES = {1: 1000.0, 2: 1.0, 3: 0.001}


@dataclasses.dataclass
class _Header:
    dim: tuple[int, ...]
    pixdim: tuple[float, ...]
    datatype: int
    order: str
    offset: int
    slope: float
    intercept: float
    sform: np.ndarray | None
    units: int


def read_nifti(path: Path, given: Given) -> Stored:
    """A NIfTI-1 or NIfTI-2 file, plain or gzipped. Integers stay as stored, their slope and intercept beside them."""
    start = first_bytes(path, 1024)
    zipped = path.name.lower().endswith(".gz")
    if zipped != start.startswith(b"\x1f\x8b"):
        wanted = "a gzip-compressed NIfTI file (.nii.gz)" if zipped else "a NIfTI file (.nii)"
        raise mislabelled(path, start, wanted)
    header = _header(path, _unzipped_start(path) if zipped else start)
    shape = three_axes(path, header.dim)
    for axis, (size, n) in enumerate(zip(header.pixdim, shape, strict=False)):
        if n > 1:
            grid_numbers(path, f"pixdim[{axis + 1}]", [f"{size:g}"], positive=True)
    if header.datatype not in TYPES:
        kind = NOT_SCALAR.get(header.datatype, "not supported")
        raise VolumeError(path, f"the voxels are {kind} (NIfTI data type {header.datatype}); save them as one real number each")
    dtype = np.dtype(header.order + TYPES[header.datatype])
    file_bytes = path.stat().st_size
    check_size(path, shape, dtype.itemsize, file_bytes if zipped else file_bytes - header.offset, compressed=zipped)
    voxels = _voxels(path, header.offset, math.prod(shape) * dtype.itemsize, zipped).view(dtype).reshape(shape, order="F")
    scaled = math.isfinite(header.slope) and header.slope != 0
    slope, intercept = (header.slope, header.intercept) if scaled else (1.0, 0.0)
    return Stored(voxels, _affine(path, header), slope, intercept)


def _unzipped_start(path: Path) -> bytes:
    try:
        with gzip.open(path) as file:
            return file.read(1024)
    except (EOFError, OSError, zlib.error) as error:
        raise VolumeError(path, f"the gzip data are damaged ({one_line(error)}); copy or export the file again") from None


def _header(path: Path, start: bytes) -> _Header:
    sizes = {struct.pack(order + "i", size): (order, size) for order in "<>" for size in (348, 540)}
    if start[:4] not in sizes or len(start) < sizes[start[:4]][1]:
        raise mislabelled(path, start, "a NIfTI file (header size 348 or 540)")
    order, size = sizes[start[:4]]
    at = lambda kinds, offset: struct.unpack_from(order + kinds, start, offset)
    magic = start[344:348] if size == 348 else start[4:8]
    if not magic.startswith((b"n+1", b"n+2")):
        raise VolumeError(path, "its header is that of an .hdr/.img pair or of Analyze 7.5; convert it to a single .nii file")
    if size == 348:
        dim, pixdim, (datatype,) = at("8h", 40), at("8f", 76), at("h", 70)
        offset, slope, intercept = at("3f", 108)
        (sform_code,), srow, units = at("h", 254), at("12f", 280), start[123]
    else:
        dim, pixdim, (datatype,) = at("8q", 16), at("8d", 104), at("h", 12)
        (offset,), (slope, intercept), (sform_code,), srow = at("q", 168), at("2d", 176), at("i", 348), at("12d", 400)
        units = at("i", 500)[0]
    if not 1 <= dim[0] <= 7 or min(dim[1 : dim[0] + 1]) < 1 or not size <= offset < 2**40:
        raise VolumeError(
            path, f"the header is damaged: dim is {dim}, the voxels begin at byte {offset:g}; export the file again"
        )
    sform = np.reshape(srow, (3, 4)).astype(float) if sform_code > 0 else None
    return _Header(dim[1 : dim[0] + 1], pixdim[1:], datatype, order, int(offset), slope, intercept, sform, units & 7)


def _voxels(path: Path, offset: int, count: int, zipped: bool) -> np.ndarray:
    """Exactly `count` bytes from `offset` on."""
    buffer = np.empty(count, np.uint8)
    view, filled = buffer.data, 0
    try:
        with gzip.open(path) if zipped else path.open("rb") as file:
            file.seek(offset)
            while filled < count and (got := file.readinto(view[filled:])):
                filled += got
            # The checksum of a gzip file is verified where the file ends.
            file.read(1)
    except (EOFError, OSError, zlib.error) as error:
        problem = f"the gzip data end early or are damaged ({one_line(error)}), after {filled:,} of {count:,} bytes"
        raise VolumeError(path, f"{problem}; copy or export the file again") from None
    if filled < count:
        raise VolumeError(path, f"the header announces {count:,} bytes of voxels, the file holds {filled:,}: it is cut short")
    return buffer


def _affine(path: Path, header: _Header) -> np.ndarray:
    """Where ITK puts the voxels; a sheared sform, which ITK refuses, as the file states it."""
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO("NiftiImageIO")
    try:
        with silenced():
            reader.ReadImageInformation()
        return affine_of_image(reader)
    except RuntimeError as error:
        if header.sform is None or "orthonormal" not in str(error):
            raise VolumeError(path, f"damaged or not supported: {one_line(error)}") from None
    scale = MILLIMETRES.get(header.units, 1.0)
    # NIfTI's world is RAS.
    return np.vstack([np.diag([-scale, -scale, scale]) @ header.sform, [0, 0, 0, 1]])
