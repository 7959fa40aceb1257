"""Reading through SimpleITK: MetaImage and NRRD, whose headers are checked here first, because ITK repairs them silently.

ITK takes a negative spacing for a mirrored axis, a missing one for 1 mm, and says on the terminal, in C++, what is wrong.
"""

import contextlib
import math
import os
import re
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import (
    VolumeError,
    check_size,
    first_bytes,
    grid_numbers,
    grid_shape,
    mislabelled,
    one_line,
    three_axes,
)
from jvr.io.volumes.given import Given
from jvr.io.volumes.stored import Stored, affine_of

META_TYPES = {"CHAR": "i1", "UCHAR": "u1", "SHORT": "i2", "USHORT": "u2", "INT": "i4", "UINT": "u4", "LONG": "i4", "ULONG": "u4"}
META_TYPES |= {"LONG_LONG": "i8", "ULONG_LONG": "u8", "FLOAT": "f4", "DOUBLE": "f8"}
NRRD_COMPRESSED = ("gz", "gzip", "bz2", "bzip2", "zrl")


@contextlib.contextmanager
def silenced():
    """Nothing that C++ libraries print on stderr gets through (the whole process: the file descriptor is redirected)."""
    sys.stderr.flush()
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def read_image(path: Path, reader_name: str, voxels: np.ndarray | None = None) -> Stored:
    """One file through the named ITK reader, which gives the grid alone where the `voxels` are known already.

    Raises `VolumeError` for vectors, colours, time series and damaged files.
    """
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO(reader_name)
    with silenced():
        try:
            reader.ReadImageInformation()
            check_pixels(path, reader)
            if voxels is not None:
                return Stored(voxels.reshape(three_axes(path, reader.GetSize()), order="F"), affine_of_image(reader))
            image = reader.Execute()
        except RuntimeError as error:
            raise VolumeError(path, f"damaged or not supported: {one_line(error)}") from None
    return Stored(voxels_of(image), affine_of_image(image), owner=image)


def check_pixels(path: Path, header: Any) -> None:
    """Refuses what is no scalar volume, or too large for the memory, knowing the header alone."""
    import SimpleITK as sitk

    shape = three_axes(path, header.GetSize())
    if (components := header.GetNumberOfComponents()) > 1:
        raise VolumeError(path, f"every voxel has {components} components (colour, vector or complex); save a scalar volume")
    check_size(path, shape, sitk.Image([1] * 3, header.GetPixelID()).GetSizeOfPixelComponent(), None)


def voxels_of(image: Any) -> np.ndarray:
    """The voxels `[x, y, z]`, a view into the memory of a SimpleITK image, which must be kept alive."""
    import SimpleITK as sitk

    return sitk.GetArrayViewFromImage(image).T


def affine_of_image(image: Any) -> np.ndarray:
    """Where a SimpleITK image, or the reader of one, says that its voxels lie; 2-D images lie in the plane z = 0."""
    n = min(image.GetDimension(), 3)
    spacing, origin, direction = np.ones(3), np.zeros(3), np.eye(3)
    spacing[:n], origin[:n] = image.GetSpacing()[:n], image.GetOrigin()[:n]
    direction[:n, :n] = np.reshape(image.GetDirection(), (image.GetDimension(),) * 2)[:n, :n]
    return affine_of(spacing, origin, direction)


def read_metaimage(path: Path, given: Given) -> Stored:
    """A MetaImage, header and voxels in one file (.mha) or two (.mhd). ITK ignores its intensity function; kept here."""
    start = first_bytes(path)
    end = re.search(rb"^\s*ElementDataFile\s*=.*$\n?", start, re.MULTILINE)
    if end is None:
        raise mislabelled(path, start, "a MetaImage (its header ends with the line 'ElementDataFile = ...')")
    lines = [line.split("=", 1) for line in start[: end.end()].decode("latin-1").splitlines() if "=" in line]
    fields = {key.strip(): value.strip() for key, value in lines}
    if missing := [key for key in ("DimSize", "ElementType") if key not in fields]:
        raise VolumeError(path, f"the header lacks '{missing[0]} = ...'")
    if "ElementSpacing" in fields:
        grid_numbers(path, "ElementSpacing", fields["ElementSpacing"], positive=True)
    shape = grid_shape(path, "DimSize", fields["DimSize"].split())
    stored = read_image(path, "MetaImageIO", _compressed_voxels(path, fields, shape, end.end()))
    slope, intercept = (f"ElementToIntensityFunction{name}" for name in ("Slope", "Offset"))
    stored.slope, stored.intercept = (
        grid_numbers(path, name, fields.get(name, default), positive=False)[0]
        for name, default in ((slope, "1"), (intercept, "0"))
    )
    return stored


def _compressed_voxels(path: Path, fields: dict[str, str], shape: tuple[int, ...], header_bytes: int) -> np.ndarray | None:
    """Checks that the voxels are all there, and unpacks compressed ones, `None` where they are not compressed.

    MetaIO (ITK 5.4) stops where the header's CompressedDataSize ends or the file is cut short, and leaves in the last
    voxels whatever lay in the memory before. A size that is too small does no harm here: the stream knows its own end.
    """
    name = fields["ElementDataFile"]
    if name.split()[0:1] == ["LIST"] or "%" in name:
        check_size(path, shape, 1, None)
        return None
    local = name.upper() == "LOCAL"
    file = path if local else path.parent / name
    if not file.is_file():
        raise VolumeError(path, f"its voxels should be in '{name}', which is not in the same folder")
    stored = file.stat().st_size - (header_bytes if local else max(_whole(path, fields, "HeaderSize"), 0))
    code = META_TYPES.get(fields["ElementType"].removeprefix("MET_").removesuffix("_ARRAY"))
    if code is None:
        raise VolumeError(path, f"ElementType {fields['ElementType']} is no number type; MET_SHORT or MET_FLOAT would be")
    compressed = fields.get("CompressedData", "").lower().startswith("t")
    announced = _whole(path, fields, "CompressedDataSize") if compressed else 0
    if announced > stored:
        raise VolumeError(
            path, f"the header announces {announced:,} compressed bytes, the file holds {stored:,}: it is cut short"
        )
    itemsize = np.dtype(code).itemsize
    text = fields.get("BinaryData", "True").lower().startswith("f")
    check_size(path, shape, itemsize, stored * itemsize if text else stored, compressed=compressed)
    if not compressed:
        return None
    big = fields.get("BinaryDataByteOrderMSB", fields.get("ElementByteOrderMSB", "")).lower().startswith("t")
    voxels = _unpacked(path, file, file.stat().st_size - stored, math.prod(shape) * itemsize)
    return voxels.view(np.dtype(code).newbyteorder(">" if big else "<"))


def _whole(path: Path, fields: dict[str, str], name: str) -> int:
    """A whole number of a header, 0 where it is absent."""
    text = fields.get(name, "0")
    if not re.fullmatch(r"[+-]?\d{1,18}", text, re.ASCII):
        raise VolumeError(path, f"{name} is '{text[:40]}'; it must be a whole number")
    return int(text)


def _unpacked(path: Path, file: Path, offset: int, announced: int) -> np.ndarray:
    """The bytes of a zlib stream, exactly as many as the header announces."""
    stream, filled = zlib.decompressobj(wbits=47), 0
    buffer = np.empty(announced, np.uint8)
    try:
        with file.open("rb") as source:
            source.seek(offset)
            while not stream.eof and filled <= announced:
                chunk = stream.unconsumed_tail or source.read(1 << 20)
                # Without input, too: zlib may still hold output back.
                part = stream.decompress(chunk, 1 << 24)
                if not chunk and not part:
                    break
                kept = part[: announced - filled]
                buffer[filled : filled + len(kept)] = np.frombuffer(kept, np.uint8)
                filled += len(part)
    except zlib.error as error:
        raise VolumeError(path, f"the compressed data are damaged ({one_line(error)}); copy or export it again") from None
    if filled != announced or not stream.eof:
        problem = f"the compressed data unpack to {filled:,} bytes, the header announces {announced:,}"
        raise VolumeError(path, f"{problem}: cut short or damaged, copy or export it again")
    return buffer


def read_nrrd(path: Path, given: Given) -> Stored:
    """A NRRD, with its voxels attached (.nrrd) or in files of their own (.nhdr)."""
    start = first_bytes(path)
    if not start.startswith(b"NRRD"):
        raise mislabelled(path, start, "a NRRD file (its content begins with 'NRRD')")
    blank = re.search(rb"\r?\n\r?\n", start)
    header = start[: blank.start() if blank else len(start)].decode("latin-1")
    pairs = re.findall(r"^([A-Za-z][\w ]*):[ =]?(.*)$", header, re.MULTILINE)
    fields = {key.lower().replace(" ", ""): value.strip() for key, value in pairs}
    if missing := [key for key in ("sizes", "type", "encoding") if key not in fields]:
        raise VolumeError(path, f"the header lacks the line '{missing[0]}: ...'")
    _check_nrrd_spacing(path, fields)
    shape = grid_shape(path, "sizes", fields["sizes"].split())
    stored = _nrrd_bytes(path, fields, blank.end() if blank else len(start))
    encoding = fields["encoding"].lower()
    itemsize = _nrrd_itemsize(path, fields["type"])
    itemsize = 1 if encoding in ("text", "txt", "ascii") else itemsize
    check_size(path, shape, itemsize, stored, compressed=encoding in NRRD_COMPRESSED)
    return read_image(path, "NrrdImageIO")


def _check_nrrd_spacing(path: Path, fields: dict[str, str]) -> None:
    # "nan" marks an axis without a spacing, such as the components of a colour, where a space direction says "none".
    grid_numbers(path, "spacings", fields.get("spacings", ""), positive=True)
    for vector in re.findall(r"\(([^)]*)\)", fields.get("spacedirections", "")):
        if not any(grid_numbers(path, "space directions", vector.split(","), positive=False)):
            raise VolumeError(path, f"space directions hold ({vector}), a spacing of zero: correct it")


def _nrrd_bytes(path: Path, fields: dict[str, str], header_bytes: int) -> int | None:
    name = fields.get("datafile", fields.get("data file"))
    if name is None:
        return path.stat().st_size - header_bytes
    if name.startswith("LIST") or "%" in name:
        return None
    if not (path.parent / name).is_file():
        raise VolumeError(path, f"its voxels should be in '{name}', which is not in the same folder")
    return (path.parent / name).stat().st_size - max(_whole(path, fields, "byteskip"), 0)


def _nrrd_itemsize(path: Path, name: str) -> int:
    """Bytes of one voxel: NRRD spells a type in up to six ways ("unsigned short int", "ushort", "uint16_t", ...)."""
    for pattern, size in (("char|int8", 1), ("short|int16", 2), ("long ?long|int64|double", 8), ("int|float", 4)):
        if re.search(pattern, name.lower()):
            return size
    raise VolumeError(path, f"type '{name}' is no number type; short or float would be")
