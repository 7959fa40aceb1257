"""Volumes behind a header of text or a few numbers: MetaImage, NRRD, NIfTI, VTK, SLC and headerless ones."""

import base64
import bz2
import gzip
import struct
import zlib

import numpy as np

from seeds.seed import SHAPE, Seed, volume, voxels

SIZES, Z = " ".join(map(str, SHAPE)), SHAPE[2]
META = (
    "ObjectType = Image\nNDims = {n}\nBinaryData = {binary}\nBinaryDataByteOrderMSB = False\nCompressedData = {packed}\n"
    "TransformMatrix = {matrix}\nOffset = 10 -20 30.5 0\nElementSpacing = 0.5 1.25 3 1\nAnatomicalOrientation = RAI\n"
    "HeaderSize = {skip}\nElementNumberOfChannels = {channels}\nDimSize = {sizes}\nElementType = MET_SHORT\nElementDataFile = {file}\n"
)


def _meta(n: int = 3, binary: bool = True, packed: bool = False, channels: int = 1, skip: int = 0, file: str = "LOCAL") -> bytes:
    matrix, sizes = " ".join(f"{x:g}" for x in np.eye(n).ravel()), " ".join(map(str, (*SHAPE, 1)[:n]))
    values = {"n": n, "binary": binary, "packed": packed, "channels": channels, "skip": skip, "file": file}
    return META.format(matrix=matrix, sizes=sizes, **values).encode()


NRRD = (
    "NRRD0005\n# a comment\ntype: short\ndimension: 3\nspace: right-anterior-superior\nsizes: {sizes}\n"
    "space directions: (0.5,0,0) (0,1.25,0) (0,0,3)\nkinds: domain domain domain\nendian: little\nencoding: {encoding}\n"
    'space units: "mm" "mm" "mm"\nspace origin: (1,2,3)\nkey:=value\n'
)
NRRD_LIST = (
    'NRRD0004\ntype: uint8\ndimension: 4\nsizes: 2 {sizes}\nspacings: nan 1 1 2\nunits: "" "mm" "mm" "mm"\n'
    "kinds: vector domain domain domain\ncenters: cell cell node node\n"
    "axis mins: nan 1 2 3\nencoding: raw\nbyte skip: -1\ndata file: {file}\n"
)


def _nifti(size: int = 348, magic: bytes = b"n+1\0", offset: int = 352) -> bytes:
    header = bytearray(max(offset, 352 if size == 348 else 544))
    struct.pack_into("<i", header, 0, size)
    if size == 348:
        struct.pack_into("<8h", header, 40, 3, *SHAPE, 1, 1, 1, 1)
        struct.pack_into("<2h", header, 70, 4, 16)
        struct.pack_into("<8f", header, 76, 1, 0.5, 1.25, 3, 1, 1, 1, 1)
        struct.pack_into("<3f", header, 108, offset, 2.0, -5.0)
        header[123] = 2
        struct.pack_into("<2h", header, 252, 1, 1)
        struct.pack_into("<6f", header, 256, 0, 0, 0, 1, 2, 3)
        struct.pack_into("<12f", header, 280, 0.5, 0, 0, 1, 0, 1.25, 0, 2, 0, 0, 3, 3)
        header[344:348] = magic
    else:
        header[4:12] = magic + b"\r\n\x1a\n"
        struct.pack_into("<2h", header, 12, 4, 16)
        struct.pack_into("<8q", header, 16, 3, *SHAPE, 1, 1, 1, 1)
        struct.pack_into("<8d", header, 104, 1, 0.5, 1.25, 3, 1, 1, 1, 1)
        struct.pack_into("<q2d", header, 168, offset, 2.0, -5.0)
        struct.pack_into("<2i", header, 344, 1, 0)
        struct.pack_into("<6d", header, 352, 0, 0, 0, 1, 2, 3)
        struct.pack_into("<i", header, 500, 2)
    return bytes(header)


def _legacy(*, text: bool) -> bytes:
    values = voxels(">i2")
    numbers = lambda a: " ".join(map(str, a.ravel(order="F"))).encode() if text else a.tobytes(order="F")
    start = f"# vtk DataFile Version 3.0\ntitle\n{'ASCII' if text else 'BINARY'}\nDATASET STRUCTURED_POINTS\nDIMENSIONS {SIZES}\n"
    start += f"SPACING 0.5 1.25 3\nORIGIN 10 -20 30\nPOINT_DATA {values.size}\nSCALARS density short 1\nLOOKUP_TABLE default\n"
    field = f"\nMETADATA\nINFORMATION 0\n\nFIELD all 1\nmass 1 {values.size} short\n".encode()
    return start.encode() + numbers(values) + field + numbers(values) + b"\n"


def _vti(kind: str, packed: str = "") -> bytes:
    values = voxels().tobytes(order="F")
    pack = {"": lambda data: data, "ZLib": zlib.compress}[packed]
    body = pack(values)
    head = struct.pack("<4I", 1, len(values), 0, len(body)) if packed else struct.pack("<I", len(values))
    encoded = base64.b64encode(head) + base64.b64encode(body) if packed else base64.b64encode(head + body)
    text = " ".join(map(str, voxels().ravel(order="F"))).encode()
    content = {"ascii": text, "binary": encoded, "appended": b""}[kind]
    compressor = f' compressor="vtk{packed}DataCompressor"' if packed else ""
    start = f'<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt32"{compressor}>\n'
    extent = f"2 {SHAPE[0] + 1} -1 {SHAPE[1] - 2} 0 {SHAPE[2] - 1}"
    start += f'<ImageData WholeExtent="{extent}" Origin="10 -20 30" Spacing="0.5 1.25 3" Direction="1 0 0 0 1 0 0 0 1">\n'
    start += f'<Piece Extent="{extent}">\n<PointData Scalars="density">\n'
    start += f'<DataArray type="Int16" Name="density" format="{kind}" offset="0" NumberOfComponents="1">\n'
    end = b"\n</DataArray>\n</PointData>\n</Piece>\n</ImageData>\n"
    end += b'<AppendedData encoding="raw">\n_' + head + body + b"\n</AppendedData>\n" if kind == "appended" else b""
    return start.encode() + content + end + b"</VTKFile>\n"


def _slc(packed: int) -> bytes:
    values = voxels("u1")
    start = f"11111\n{SIZES} 8\n0.5 1.25 3\n1 6 0 {packed}\n2 2 X".encode() + bytes(12)
    if not packed:
        return start + values.tobytes(order="F")
    area = [values[:, :, k].tobytes(order="F") for k in range(SHAPE[2])]
    runs = lambda data: b"".join(bytes([128 + len(data[i : i + 35])]) + data[i : i + 35] for i in range(0, len(data), 35))
    slices = [runs(data) + b"\0" for data in area]
    return start + b"".join(f"{len(s)} X".encode() + s for s in slices)


def headers() -> dict[str, Seed]:
    raw = voxels().tobytes(order="F")
    names = [f"{k}.raw" for k in range(Z)]
    bytes_ = voxels("u1").tobytes(order="F")
    text = " ".join(map(str, voxels().ravel(order="F"))).encode()
    return {
        "mha": volume({"a.mha": _meta() + raw}),
        "mha, four axes": volume({"a.mha": _meta(4) + raw}),
        "mha, zlib": volume({"a.mha": _meta(packed=True) + zlib.compress(raw)}),
        "mhd, text": volume({"a.mhd": _meta(binary=False, file="a.txt"), "a.txt": text}),
        "mhd, channels": volume({"a.mhd": _meta(channels=2, skip=-1, file="a.raw"), "a.raw": raw + raw}, channel=1),
        "mhd, list": volume({"a.mhd": _meta(file="LIST\n" + "\n".join(f"{k}.raw" for k in range(Z)))}
                             | {f"{k}.raw": raw[: len(raw) // Z] for k in range(Z)}),
        "mhd, pattern": volume({"a.mhd": _meta(file=f"%d.raw 0 {Z - 1} 1")} | {f"{k}.raw": raw[: len(raw) // Z] for k in range(Z)}),
        "nrrd": volume({"a.nrrd": NRRD.format(sizes=SIZES, encoding="raw").encode() + b"\n" + raw}),
        "nrrd, gzip": volume({"a.nrrd": NRRD.format(sizes=SIZES, encoding="gzip").encode() + b"\n" + gzip.compress(raw)}),
        "nrrd, bzip2": volume({"a.nrrd": NRRD.format(sizes=SIZES, encoding="bzip2").encode() + b"\n" + bz2.compress(raw)}),
        "nrrd, text": volume({"a.nrrd": NRRD.format(sizes=SIZES, encoding="ascii").encode() + b"\n" + text}),
        "nrrd, hex": volume({"a.nrrd": NRRD.format(sizes=SIZES, encoding="hex").encode() + b"\n" + raw.hex().encode()}),
        "nhdr, list": volume({"a.nhdr": NRRD_LIST.format(sizes=SIZES, file="\n".join(["LIST", *names])).encode()}
                              | dict.fromkeys(names, bytes_[: len(bytes_) * 2 // Z]), channel=1),
        "nhdr, pattern": volume({"a.nhdr": NRRD_LIST.format(sizes=SIZES, file=f"%d.raw 1 {Z} 1").encode()}
                                 | {f"{k}.raw": bytes_[: len(bytes_) * 2 // Z] for k in range(1, Z + 1)}, channel=1),
        "nii": volume({"a.nii": _nifti() + raw}),
        "nii.gz": volume({"a.nii.gz": gzip.compress(_nifti() + raw)}),
        "nii, second version": volume({"a.nii": _nifti(540, b"n+2\0", 544) + raw}),
        "hdr and img": volume({"a.hdr": _nifti(348, b"ni1\0", 0), "a.img": raw}),
        "vtk": volume({"a.vtk": _legacy(text=False)}),
        "vtk, text": volume({"a.vtk": _legacy(text=True)}),
        "vti, text": volume({"a.vti": _vti("ascii")}),
        "vti, base64": volume({"a.vti": _vti("binary")}),
        "vti, zlib": volume({"a.vti": _vti("binary", "ZLib")}),
        "vti, appended": volume({"a.vti": _vti("appended")}),
        "slc": volume({"a.slc": _slc(0)}),
        "slc, runs": volume({"a.slc": _slc(1)}),
        "raw": volume({"a.raw": raw}, shape=SHAPE, dtype="<i2"),
    }  # fmt: skip
