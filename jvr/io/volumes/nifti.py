"""NIfTI-1 and NIfTI-2, one file or a pair of header and image, after https://nifti.nimh.nih.gov/nifti-1 and nifti-2."""

import dataclasses
import math
import re
import struct
from pathlib import Path

import numpy as np

from jvr.io.volumes import payload
from jvr.io.volumes.axes import chosen
from jvr.io.volumes.directions import check_volume, completed
from jvr.io.volumes.errors import VolumeError, check_size, first_bytes, grid_numbers, mislabelled
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored
from jvr.io.volumes.units import millimetres

TYPES = {2: "u1", 4: "i2", 8: "i4", 16: "f4", 64: "f8", 256: "i1", 512: "u2", 768: "u4", 1024: "i8", 1280: "u8"}
NOT_SCALAR = {32: "complex numbers", 1792: "complex numbers", 128: "RGB colours", 2304: "RGBA colours"}
UNITS = {0: "", 1: "m", 2: "mm", 3: "um"}
GZIP = b"\x1f\x8b"


@dataclasses.dataclass
class _Header:
    dim: tuple[int, ...]
    pixdim: tuple[float, ...]
    datatype: int
    order: str
    offset: int
    slope: float
    intercept: float
    qform: tuple[float, ...] | None
    sform: np.ndarray | None
    units: int
    alone: bool


def read_nifti(path: Path, given: Given) -> Stored:
    """A NIfTI file, plain or gzipped. Integers stay as stored, their slope and intercept beside them; `time` and `channel` (dim[5]) choose.

    Voxels lie where the sform says, or else the qform, or else one behind the other by pixdim.
    """
    name = path.name.lower()
    start = first_bytes(path, 1024)
    if (image := re.search(r"\.img(\.gz)?$", name)) is not None:
        return read_nifti(_sibling(path, image[0], "hdr"), given)
    zipped = name.endswith(".gz")
    if zipped != start.startswith(GZIP):
        raise mislabelled(path, start, "a gzip-compressed NIfTI file (.nii.gz)" if zipped else "a NIfTI file (.nii)")
    header = _header(path, _unzipped_start(path) if zipped else start)
    if header.datatype not in TYPES:
        kind = NOT_SCALAR.get(header.datatype, "not supported")
        raise VolumeError(path, f"the voxels are {kind} (NIfTI data type {header.datatype}); save them as one real number each")
    of_all = chosen(path, header.dim, ("x", "y", "z", "t", "c", "dim[6]", "dim[7]")[: len(header.dim)], given)
    affine = _affine(path, header, given)
    ending = next((end for end in (".hdr", ".hdr.gz") if name.endswith(end)), "")
    file = path if header.alone else _sibling(path, ending, "img")
    values = _values(path, file, header).reshape(header.dim, order="F")
    scaled = math.isfinite(header.slope) and header.slope != 0
    slope, intercept = (header.slope, header.intercept) if scaled else (1.0, 0.0)
    return Stored(of_all.of(values), affine, slope, intercept)


def _sibling(path: Path, ending: str, other: str) -> Path:
    """The other file of a pair: the same name with `hdr` or `img`, in the case of letters that is there."""
    stem = path.name[: len(path.name) - len(ending)] if ending else path.stem
    zipped = ending.lower().endswith(".gz")
    for name in (f"{other}.gz" if zipped else other, other.upper(), other, f"{other}.gz"):
        if (path.parent / f"{stem}.{name}").is_file():
            return path.parent / f"{stem}.{name}"
    raise VolumeError(path, f"the pair of header and image lacks '{stem}.{other}', which must lie beside it")


def _unzipped_start(path: Path) -> bytes:
    """The first bytes of a gzip file that may be shorter."""
    # Longer than a header and shorter than the voxels of any file that is read.
    for count in (540, 348):
        try:
            return payload.unpacked(path, payload.pieces_of(path), "gzip", count, quiet=True).tobytes()
        except VolumeError as error:
            problem = error
    raise problem


def _header(path: Path, start: bytes) -> _Header:
    sizes = {struct.pack(order + "i", size): (order, size) for order in "<>" for size in (348, 540)}
    if start[:4] not in sizes or len(start) < sizes[start[:4]][1]:
        raise mislabelled(path, start, "a NIfTI file (header size 348 or 540)")
    order, size = sizes[start[:4]]
    at = lambda kinds, offset: struct.unpack_from(order + kinds, start, offset)
    magic = start[344:348] if size == 348 else start[4:8]
    if not magic.startswith((b"n+1", b"n+2", b"ni1", b"ni2")):
        raise VolumeError(
            path, "its header is that of Analyze 7.5, which does not say where left is; convert it to a single .nii file"
        )
    if size == 348:
        dim, pixdim, (datatype,) = at("8h", 40), at("8f", 76), at("h", 70)
        offset, slope, intercept = at("3f", 108)
        (qform_code, sform_code), quaternion, srow, units = at("2h", 252), at("6f", 256), at("12f", 280), start[123]
    else:
        dim, pixdim, (datatype,) = at("8q", 16), at("8d", 104), at("h", 12)
        (offset,), (slope, intercept), (qform_code, sform_code) = at("q", 168), at("2d", 176), at("2i", 344)
        quaternion, srow, units = at("6d", 352), at("12d", 400), at("i", 500)[0]
    alone = magic.startswith(b"n+")
    # Zeros stand for axes that a file does not use, also within the number of axes that it states.
    used = tuple(max(n, 1) if k >= 3 and n == 0 else n for k, n in enumerate(dim[1 : dim[0] + 1]))
    if not 1 <= dim[0] <= 7 or min(used) < 1 or not (size if alone else 0) <= offset < 2**40:
        raise VolumeError(
            path, f"the header is damaged: dim is {dim}, the voxels begin at byte {offset:g}; export the file again"
        )
    sform = np.reshape(srow, (3, 4)).astype(float) if sform_code > 0 else None
    qform = quaternion if qform_code > 0 else None
    return _Header(used, pixdim, datatype, order, int(offset), slope, intercept, qform, sform, units & 7, alone)


def _values(path: Path, file: Path, header: _Header) -> np.ndarray:
    dtype = np.dtype(header.order + TYPES[header.datatype])
    zipped = first_bytes(file, 2) == GZIP
    count, stored = math.prod(header.dim) * dtype.itemsize, file.stat().st_size
    check_size(path, header.dim, dtype.itemsize, stored if zipped else stored - header.offset, compressed=zipped)
    if not zipped:
        return payload.slabs(path, [file], [header.offset], count).view(dtype)
    if header.offset > payload.MOST_SKIPPED:
        raise VolumeError(
            path, f"the voxels begin at byte {header.offset:,} behind a header of 348 or 540: export the file again"
        )
    return payload.unpacked(path, payload.pieces_of(file), "gzip", count, header.offset).view(dtype)


# --- Where the voxels lie --------------------------------------------------------------------------------------------


def _affine(path: Path, header: _Header, given: Given) -> np.ndarray:
    """LPS, in millimetres; NIfTI's world is RAS."""
    n = min(len(header.dim), 3)
    sizes = [1.0, 1.0, 1.0]
    if given.spacing is None:
        for axis in range(n):
            if header.dim[axis] > 1:
                size = f"{header.pixdim[axis + 1]:g}"
                sizes[axis] = grid_numbers(path, f"pixdim[{axis + 1}]", [size], positive=True)[0] and header.pixdim[axis + 1]
    unit = 1.0
    if given.spacing is None or given.origin is None:
        unit = millimetres(path, "xyzt_units", UNITS.get(header.units, f"code {header.units}"))
    matrix = np.eye(4)
    if given.spacing is not None and given.direction is not None:
        placed = None
    elif header.sform is not None and _spans(path, header):
        placed = header.sform
        _compare(path, header, sizes, given)
    else:
        placed = None if header.qform is None else _of_quaternion(header, sizes)
    if placed is None:
        if given.direction is None:
            payload.said(
                path, "neither sform nor qform says where the voxels lie: the axes are taken for LPS; else give direction="
            )
        matrix[:3, :3] = np.diag(sizes) * unit
        return matrix
    lps = unit * np.diag([-1, -1, 1]) @ placed
    if not np.isfinite(lps).all():
        raise VolumeError(path, "its sform or qform is not finite: export the file again, or give spacing= and direction=")
    matrix[:3, :3], matrix[:3, 3] = completed(lps[:, :3]), lps[:, 3]
    check_volume(path, "sform" if placed is header.sform else "qform", matrix[:3, :3])
    return matrix


def _spans(path: Path, header: _Header) -> bool:
    """Whether the sform has a direction for each axis; one of zeros with a code that announces it is said, and not taken."""
    assert header.sform is not None
    axes = [axis for axis in range(min(len(header.dim), 3)) if header.dim[axis] > 1]
    if header.sform[:, axes].any(axis=0).all():
        return True
    payload.said(path, "its sform has axes of length 0; it is left out, and the qform or pixdim taken")
    return False


def _of_quaternion(header: _Header, sizes: list[float]) -> np.ndarray:
    """Method 2 of NIfTI: a rotation by the quaternion (a, b, c, d), the third axis turned around where pixdim[0] (qfac) is negative."""
    b, c, d, *origin = header.qform or (0.0,) * 6
    square = b * b + c * c + d * d
    if square > 1:
        b, c, d = (x / math.sqrt(square) for x in (b, c, d))
    a = math.sqrt(max(1 - square, 0))
    turn = [
        [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
        [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
        [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
    ]
    signs = [1, 1, -1 if header.pixdim[0] < 0 else 1]
    return np.column_stack([np.array(turn) * sizes * signs, origin])


def _compare(path: Path, header: _Header, sizes: list[float], given: Given) -> None:
    """Says where pixdim and the sform give the voxel other sizes, or the qform puts voxels elsewhere."""
    assert header.sform is not None
    lengths = np.linalg.norm(header.sform[:, :3], axis=0)
    axes = [axis for axis in range(min(len(header.dim), 3)) if header.dim[axis] > 1]
    if given.spacing is None and any(abs(lengths[k] - sizes[k]) > 1e-2 * sizes[k] for k in axes):
        stated, found = (" x ".join(f"{x[k]:.4g}" for k in axes) for x in (sizes, lengths))
        payload.said(
            path, f"pixdim says voxels of {stated}, the sform {found}; the sform is taken (give spacing= where it is wrong)"
        )
    if header.qform is None or given.spacing is not None or (given.direction is not None and given.origin is not None):
        return
    corners = np.array([[i, j, k, 1] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    corners[:, :3] *= [header.dim[axis] - 1 if axis < len(header.dim) else 0 for axis in range(3)]
    apart = np.linalg.norm(corners @ (_of_quaternion(header, sizes) - header.sform).T, axis=1).max()
    if apart > 0.5 * lengths[axes].min(initial=np.inf):
        problem = f"the qform puts voxels up to {apart:.4g} away from where the sform does; the sform is taken"
        payload.said(path, f"{problem} (direction= and origin= replace it)")
