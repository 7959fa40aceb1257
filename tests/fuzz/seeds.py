"""A small whole file of every format, and what reads it."""

import base64
import bz2
import dataclasses
import gzip
import os
import signal
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.environment import read_environment
from jvr.io.images import ImageError, read_image
from jvr.io.volumes import VolumeError, read_volume
from jvr.pictures import write_image

SHAPE = (7, 5, 3)


@dataclasses.dataclass
class Seed:
    """Files by name, the one that is read first, and what reads it and raises `errors` (or `OSError`) where it cannot."""

    files: dict[str, bytes]
    main: str
    read: Callable[[Path], Any]
    errors: tuple[type[Exception], ...]


def _voxels(dtype: str = "<i2") -> np.ndarray:
    return (np.arange(np.prod(SHAPE)) * 3 % 251).reshape(SHAPE).astype(dtype)


def _volume(files: dict[str, bytes], **keywords: Any) -> Seed:
    return Seed(files, next(iter(files)), lambda path: read_volume(path, **keywords), (VolumeError,))


# --- Volumes ---------------------------------------------------------------------------------------------------------

META = (
    "ObjectType = Image\nNDims = {n}\nBinaryData = {binary}\nBinaryDataByteOrderMSB = False\nCompressedData = {packed}\n"
    "TransformMatrix = {matrix}\nOffset = 10 -20 30.5 0\nElementSpacing = 0.5 1.25 3 1\nAnatomicalOrientation = RAI\n"
    "HeaderSize = {skip}\nElementNumberOfChannels = {channels}\nDimSize = {sizes}\nElementType = MET_SHORT\nElementDataFile = {file}\n"
)


def _meta(n: int = 3, binary: bool = True, packed: bool = False, channels: int = 1, skip: int = 0, file: str = "LOCAL") -> bytes:
    matrix, sizes = " ".join(f"{x:g}" for x in np.eye(n).ravel()), "7 5 3 1"[: 2 * n - 1]
    values = {"n": n, "binary": binary, "packed": packed, "channels": channels, "skip": skip, "file": file}
    return META.format(matrix=matrix, sizes=sizes, **values).encode()


NRRD = (
    "NRRD0005\n# a comment\ntype: short\ndimension: 3\nspace: right-anterior-superior\nsizes: 7 5 3\n"
    "space directions: (0.5,0,0) (0,1.25,0) (0,0,3)\nkinds: domain domain domain\nendian: little\nencoding: {encoding}\n"
    'space units: "mm" "mm" "mm"\nspace origin: (1,2,3)\nkey:=value\n'
)
NRRD_LIST = (
    'NRRD0004\ntype: uint8\ndimension: 4\nsizes: 2 7 5 3\nspacings: nan 1 1 2\nunits: "" "mm" "mm" "mm"\n'
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
    values = _voxels(">i2")
    numbers = lambda a: " ".join(map(str, a.ravel(order="F"))).encode() if text else a.tobytes(order="F")
    start = f"# vtk DataFile Version 3.0\ntitle\n{'ASCII' if text else 'BINARY'}\nDATASET STRUCTURED_POINTS\nDIMENSIONS 7 5 3\n"
    start += f"SPACING 0.5 1.25 3\nORIGIN 10 -20 30\nPOINT_DATA {values.size}\nSCALARS density short 1\nLOOKUP_TABLE default\n"
    field = f"\nMETADATA\nINFORMATION 0\n\nFIELD all 1\nmass 1 {values.size} short\n".encode()
    return start.encode() + numbers(values) + field + numbers(values) + b"\n"


def _vti(kind: str, packed: str = "") -> bytes:
    values = _voxels().tobytes(order="F")
    pack = {"": lambda data: data, "ZLib": zlib.compress}[packed]
    body = pack(values)
    head = struct.pack("<4I", 1, len(values), 0, len(body)) if packed else struct.pack("<I", len(values))
    encoded = base64.b64encode(head) + base64.b64encode(body) if packed else base64.b64encode(head + body)
    text = " ".join(map(str, _voxels().ravel(order="F"))).encode()
    content = {"ascii": text, "binary": encoded, "appended": b""}[kind]
    compressor = f' compressor="vtk{packed}DataCompressor"' if packed else ""
    start = f'<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt32"{compressor}>\n'
    start += '<ImageData WholeExtent="2 8 -1 3 0 2" Origin="10 -20 30" Spacing="0.5 1.25 3" Direction="1 0 0 0 1 0 0 0 1">\n'
    start += '<Piece Extent="2 8 -1 3 0 2">\n<PointData Scalars="density">\n'
    start += f'<DataArray type="Int16" Name="density" format="{kind}" offset="0" NumberOfComponents="1">\n'
    end = b"\n</DataArray>\n</PointData>\n</Piece>\n</ImageData>\n"
    end += b'<AppendedData encoding="raw">\n_' + head + body + b"\n</AppendedData>\n" if kind == "appended" else b""
    return start.encode() + content + end + b"</VTKFile>\n"


def _slc(packed: int) -> bytes:
    values = _voxels("u1")
    start = f"11111\n7 5 3 8\n0.5 1.25 3\n1 6 0 {packed}\n2 2 X".encode() + bytes(12)
    if not packed:
        return start + values.tobytes(order="F")
    slices = [bytes([128 + 35]) + values[:, :, k].tobytes(order="F") + b"\0" for k in range(3)]
    return start + b"".join(f"{len(s)} X".encode() + s for s in slices)


def volumes(folder: Path) -> dict[str, Seed]:
    import tifffile

    raw = _voxels().tobytes(order="F")
    bytes_ = _voxels("u1").tobytes(order="F")
    text = " ".join(map(str, _voxels().ravel(order="F"))).encode()
    seeds = {
        "a.mha": _volume({"a.mha": _meta() + raw}),
        "mha, four axes": _volume({"a.mha": _meta(4) + raw}),
        "mha, zlib": _volume({"a.mha": _meta(packed=True) + zlib.compress(raw)}),
        "mhd, text": _volume({"a.mhd": _meta(binary=False, file="a.txt"), "a.txt": text}),
        "mhd, channels": _volume({"a.mhd": _meta(channels=2, skip=-1, file="a.raw"), "a.raw": raw + raw}, channel=1),
        "mhd, list": _volume({"a.mhd": _meta(file="LIST\n" + "\n".join(f"{k}.raw" for k in range(3)))}
                             | {f"{k}.raw": raw[:70] for k in range(3)}),
        "mhd, pattern": _volume({"a.mhd": _meta(file="%d.raw 0 2 1")} | {f"{k}.raw": raw[:70] for k in range(3)}),
        "nrrd": _volume({"a.nrrd": NRRD.format(encoding="raw").encode() + b"\n" + raw}),
        "nrrd, gzip": _volume({"a.nrrd": NRRD.format(encoding="gzip").encode() + b"\n" + gzip.compress(raw)}),
        "nrrd, bzip2": _volume({"a.nrrd": NRRD.format(encoding="bzip2").encode() + b"\n" + bz2.compress(raw)}),
        "nrrd, text": _volume({"a.nrrd": NRRD.format(encoding="ascii").encode() + b"\n" + text}),
        "nrrd, hex": _volume({"a.nrrd": NRRD.format(encoding="hex").encode() + b"\n" + raw.hex().encode()}),
        "nhdr, list": _volume({"a.nhdr": NRRD_LIST.format(file="LIST\na.raw\nb.raw\nc.raw").encode()}
                              | {f"{k}.raw": bytes_[:70] for k in "abc"}, channel=1),
        "nhdr, pattern": _volume({"a.nhdr": NRRD_LIST.format(file="%d.raw 1 3 1").encode()}
                                 | {f"{k}.raw": bytes_[:70] for k in (1, 2, 3)}, channel=1),
        "nii": _volume({"a.nii": _nifti() + raw}),
        "nii.gz": _volume({"a.nii.gz": gzip.compress(_nifti() + raw)}),
        "nii, second version": _volume({"a.nii": _nifti(540, b"n+2\0", 544) + raw}),
        "hdr and img": _volume({"a.hdr": _nifti(348, b"ni1\0", 0), "a.img": raw}),
        "vtk": _volume({"a.vtk": _legacy(text=False)}),
        "vtk, text": _volume({"a.vtk": _legacy(text=True)}),
        "vti, text": _volume({"a.vti": _vti("ascii")}),
        "vti, base64": _volume({"a.vti": _vti("binary")}),
        "vti, zlib": _volume({"a.vti": _vti("binary", "ZLib")}),
        "vti, appended": _volume({"a.vti": _vti("appended")}),
        "slc": _volume({"a.slc": _slc(0)}),
        "slc, runs": _volume({"a.slc": _slc(1)}),
        "raw": _volume({"a.raw": raw}, shape=SHAPE, dtype="<i2"),
    }  # fmt: skip
    np.save(folder / "a.npy", _voxels())
    seeds["npy"] = _volume({"a.npy": (folder / "a.npy").read_bytes()})
    for name, compression in (("tif", None), ("tif, deflate", "deflate")):
        tifffile.imwrite(folder / "a.tif", np.ascontiguousarray(_voxels().T), compression=compression, photometric="minisblack")
        seeds[name] = _volume({"a.tif": (folder / "a.tif").read_bytes()})
    return {("mha" if name == "a.mha" else name): seed for name, seed in seeds.items()}


# --- Pictures, reflectance, tables, fits -----------------------------------------------------------------------------


def pictures(folder: Path) -> dict[str, Seed]:
    from PIL import Image

    pixels = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    for name in ("a.exr", "a.png"):
        write_image(folder / name, pixels)
    Image.fromarray((255 * pixels).astype(np.uint8)).save(folder / "a.jpg")
    hdr = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=1\n\n-Y 8 +X 16\n"
    runs = b"".join(
        b"\x02\x02\x00\x10" + b"".join(bytes([16, *(10 * k + c for k in range(16))]) for c in range(4)) for _ in range(8)
    )
    contents = {name: (folder / name).read_bytes() for name in ("a.exr", "a.png", "a.jpg")} | {"a.hdr": hdr + runs}
    seeds = {name[2:]: Seed({name: content}, name, read_image, (ImageError,)) for name, content in contents.items()}
    for ending in ("exr", "hdr"):
        name = f"a.{ending}"
        seeds[f"map, {ending}"] = Seed({name: contents[name]}, name, read_environment, (ImageError,))
    return seeds


def _merl() -> Seed:
    from jvr.io import merl

    # A whole table has 35 MB: damage does not need so many cells.
    merl.CELLS = (3, 2, 4)
    content = struct.pack("<3i", *merl.CELLS) + np.linspace(0, 900, 72).astype("<f8").tobytes()
    return Seed({"a.binary": content}, "a.binary", merl.read_merl, (merl.MerlError,))


def _checkpoint(folder: Path) -> Seed:
    from jvr.fitting import checkpoint

    state, fingerprint = {"x": np.arange(6.0), "k": np.array(3)}, {"camera": "abc"}
    checkpoint.save(folder / "a.npz", state, [{"loss": 1.0}], fingerprint)
    read = lambda path: checkpoint.load(path, state, fingerprint)
    return Seed({"a.npz": (folder / "a.npz").read_bytes()}, "a.npz", read, (checkpoint.CheckpointError,))


def tables(folder: Path) -> dict[str, Seed]:
    from jvr.io.config import ConfigError, read_config, read_transfer

    configs = Path(__file__).parents[2] / "configs"
    seeds = {
        f"config, {path.stem}": Seed({"a.toml": path.read_bytes()}, "a.toml", read_config, (ConfigError,))
        for path in sorted(configs.glob("*.toml"))
    }
    transfer = b'kind = "linear"\npositions = [0, 1, 2]\nrgb = [[0, 0, 0], [1, 1, 1], [1, 0.5, 0]]\nsigma_t = [0, 1, 2]\n'
    preset = b'[volume]\nbuiltin = "demo"\n[transfer]\nkind = "preset"\npreset = "ct_bone"\n[camera]\neye = [1, 2, 3]\n'
    seeds["config, preset"] = Seed({"a.toml": preset}, "a.toml", read_config, (ConfigError,))
    seeds["transfer"] = Seed({"a.toml": transfer}, "a.toml", read_transfer, (ConfigError,))
    seeds["merl"] = _merl()
    seeds["checkpoint"] = _checkpoint(folder)
    return seeds


# --- Readers that fail, for the tests of the fuzzer itself ------------------------------------------------------------


def faulty() -> dict[str, Seed]:
    held = []

    def waits(path: Path) -> None:
        end = time.process_time() + 2.2
        while time.process_time() < end:
            pass

    readers = {
        "faulty: signal": lambda path: os.kill(os.getpid(), signal.SIGSEGV),
        "faulty: exception": lambda path: {}["key"],
        "faulty: time": waits,
        "faulty: memory": lambda path: held.append(np.ones(10**7)),
    }
    return {name: Seed({"a.txt": b"text\n"}, "a.txt", read, (VolumeError,)) for name, read in readers.items()}


def all_seeds(folder: Path) -> dict[str, Seed]:
    return volumes(folder) | pictures(folder) | tables(folder)
