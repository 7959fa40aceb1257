"""Pictures and environment maps: every layout and compression that OpenEXR writes, Radiance, PNG, JPEG."""

import functools
import struct
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.environment import read_environment
from jvr.io.images import ImageError, read_image
from jvr.pictures import write_image
from seeds.seed import SHAPE, SLOW, Seed

ROWS = 8 * -(-SHAPE[0] // 8) * -(-SHAPE[2] // 16)
PIXELS = np.random.default_rng(0).random((ROWS, 2 * ROWS, 3)).astype(np.float32)
# Of files that are read by it.
LAYERS = {"exr, parts": "second", "exr, layers": "key"}
REFUSED = ("exr, deep", "exr, subsampled")


def pictures(folder: Path) -> dict[str, Seed]:
    from PIL import Image

    write_image(folder / "a.exr", PIXELS)
    write_image(folder / "a.png", PIXELS)
    codes = (255 * PIXELS).astype(np.uint8)
    Image.fromarray(codes).save(folder / "a.jpg")
    Image.fromarray(codes).save(folder / "b.jpg", progressive=True)
    Image.fromarray(codes).quantize(16).save(folder / "b.png", transparency=3)
    (folder / "c.png").write_bytes(_sixteen_bits(folder, PIXELS))
    (folder / "d.png").write_bytes(_sixteen_bits(folder, PIXELS[..., :2]))
    contents = {name: (folder / name).read_bytes() for name in ("a.exr", "a.png", "b.png", "c.png", "d.png", "a.jpg", "b.jpg")}
    contents |= {"a.hdr": _radiance()} | _openexr(folder)
    names = {"a.exr": "exr", "a.png": "png", "b.png": "png, palette", "c.png": "png, 16 bits"}
    names |= {"d.png": "png, 16 bits, grey with alpha"}
    names |= {"a.jpg": "jpg", "b.jpg": "jpg, progressive", "a.hdr": "hdr"}
    seeds = {names.get(name, name): _picture(name, content) for name, content in contents.items()}
    seeds |= _tiffs(folder, codes)
    for ending in ("exr", "hdr"):
        name = f"a.{ending}"
        seeds[f"map, {ending}"] = Seed({name: contents[name]}, name, read_environment, (ImageError,))
    return seeds


def _tiffs(folder: Path, codes: np.ndarray) -> dict[str, Seed]:
    import tifffile
    from PIL import Image

    path, seeds = folder / "a.tif", {}
    for name, pixels, keywords in (
        ("colours", codes, {"compression": "deflate", "planarconfig": "contig"}),
        ("alpha", codes[..., [0, 1, 2, 0]], {"extrasamples": ["unassalpha"]}),
        ("floats", PIXELS, {"compression": "lzw", "predictor": True}),
    ):
        tifffile.imwrite(path, pixels, photometric="rgb", **keywords)
        share = SLOW if keywords.get("compression") == "lzw" else 1
        seeds[f"picture, tif, {name}"] = Seed({"a.tif": path.read_bytes()}, "a.tif", read_image, (ImageError,), share)
    Image.fromarray(codes).quantize(16).save(path)
    seeds["picture, tif, palette"] = Seed({"a.tif": path.read_bytes()}, "a.tif", read_image, (ImageError,))
    return seeds


def _picture(name: str, content: bytes) -> Seed:
    file = "a" + name[name.rindex(".") :] if "." in name else "a.exr"
    read = functools.partial(read_image, layer=LAYERS.get(name))
    return Seed({file: content}, file, read, (ImageError,), refused=name in REFUSED)


def _radiance() -> bytes:
    start = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=1\n\n-Y %d +X %d\n" % (ROWS, 2 * ROWS)
    channel = b"".join(bytes([16, *range(k % 90, k % 90 + 160, 10)]) for k in range(ROWS // 8))
    return start + ROWS * (b"\x02\x02" + (2 * ROWS).to_bytes(2, "big") + 4 * channel)


def _sixteen_bits(folder: Path, pixels: np.ndarray) -> bytes:
    """A PNG of 16 bits with several channels, which Pillow cannot write."""
    import OpenImageIO

    file = OpenImageIO.ImageOutput.create(str(folder / "c.png"))
    file.open(str(folder / "c.png"), OpenImageIO.ImageSpec(2 * ROWS, ROWS, pixels.shape[2], OpenImageIO.UINT16))
    file.write_image((65535 * pixels).astype(np.uint16))
    file.close()
    return (folder / "c.png").read_bytes()


def _openexr(folder: Path) -> dict[str, bytes]:
    """Files by what is special about them."""
    import OpenEXR

    planes = {name: np.ascontiguousarray(PIXELS[..., k]) for k, name in enumerate("RGB")}
    halves = {name: plane.astype(np.float16) for name, plane in planes.items()}
    lines = {"type": OpenEXR.scanlineimage}

    def written(*given: Any) -> bytes:
        # OpenEXR puts objects of its own in the place of arrays.
        with OpenEXR.File(*(dict(part) if isinstance(part, dict) else part for part in given)) as file:
            file.write(str(folder / "b.exr"))
        return (folder / "b.exr").read_bytes()

    def tiles(mode: Any, compression: Any) -> dict[str, Any]:
        found = OpenEXR.TileDescription()
        found.xSize, found.ySize, found.mode = 4, 4, mode
        return {"type": OpenEXR.tiledimage, "tiles": found, "compression": compression}

    kinds = ("NO", "RLE", "ZIPS", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
    contents = {
        f"exr, {kind}": written(lines | {"compression": getattr(OpenEXR, f"{kind}_COMPRESSION")}, halves) for kind in kinds
    }
    contents["exr, tiles"] = written(tiles(OpenEXR.ONE_LEVEL, OpenEXR.ZIP_COMPRESSION), planes)
    contents["exr, PIZ tiles"] = written(tiles(OpenEXR.ONE_LEVEL, OpenEXR.PIZ_COMPRESSION), halves)
    contents["exr, parts"] = written([OpenEXR.Part({"name": name} | lines, dict(planes)) for name in ("first", "second")])
    contents["exr, layers"] = written(lines, planes | {f"key.{name}": plane for name, plane in halves.items()})
    deep = np.empty((8, 16), object)
    for at in np.ndindex(deep.shape):
        deep[at] = np.arange(1 + at[1] % 3, dtype=np.float32)
    contents["exr, deep"] = written({"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}, {"Z": deep})
    contents["exr, subsampled"] = _subsampled(contents["exr, NO"])
    return contents


def _subsampled(content: bytes) -> bytes:
    """An uncompressed picture of three halves a pixel, with every other pixel and row of red and blue, which the library does not write."""
    rows, columns = ROWS, 2 * ROWS
    header = content[: -rows * (8 + 8 + 6 * columns)]
    for name in (b"B", b"R"):
        header = header.replace(name + struct.pack("<BiiII", 0, 1, 0, 1, 1), name + struct.pack("<BiiII", 0, 1, 0, 2, 2))
    sizes = [4 * columns if row % 2 == 0 else 2 * columns for row in range(rows)]
    ends = len(header) + 8 * rows + np.cumsum([0, *(8 + size for size in sizes[:-1])])
    lines = [
        struct.pack("<ii", row, size) + bytes(range(0, 60, 4)) * (size // 15) + bytes(size % 15) for row, size in enumerate(sizes)
    ]
    return header + ends.astype("<u8").tobytes() + b"".join(lines)
