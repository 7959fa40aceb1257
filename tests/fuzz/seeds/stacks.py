"""Arrays and stacks of pages: NumPy, TIFF in all its compressions, Zarr and OME-Zarr, folders of slices."""

import io
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from seeds.seed import SHAPE, SLOW, Seed, files_in, volume, voxels


def _npy(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def stacks(folder: Path) -> dict[str, Seed]:
    seeds = {"npy": volume({"a.npy": _npy(voxels())}), "npy, axes": volume({"a.npy": _npy(voxels()[None])}, axes="tzyx")}
    return seeds | _tiffs(folder) | _slices() | _zarrs(folder)


def _tiffs(folder: Path) -> dict[str, Seed]:
    import tifffile
    from PIL import Image

    path, pages = folder / "a.tif", np.ascontiguousarray(voxels().T)
    side = 16 * -(-SHAPE[0] // 16) * -(-SHAPE[2] // 16)
    smooth = np.add.outer(np.arange(side), np.arange(side)).astype("u1")

    def seed(values: np.ndarray = pages, **keywords: Any) -> Seed:
        axes = {"channel": 1} if values.ndim > 3 else {}
        tifffile.imwrite(path, values, **keywords)
        # LZW is decoded in a process of its own.
        share = SLOW if keywords.get("compression") == "lzw" else 1
        return volume({"a.tif": path.read_bytes()}, share=share, **axes)

    seeds = {"tif" if kind is None else f"tif, {kind}": seed(compression=kind, photometric="minisblack")
             for kind in (None, "deflate", "lzw", "packbits", "zstd")}  # fmt: skip
    seeds["tif, JPEG"] = seed(smooth, compression="jpeg", photometric="minisblack")
    seeds["tif, tiles"] = seed(smooth, tile=(16, 16), compression="lzw", predictor=True, photometric="minisblack")
    seeds["tif, big"] = seed(bigtiff=True, byteorder=">", photometric="minisblack", resolution=(20, 8), resolutionunit=3)
    hyperstack = np.stack([pages, pages + 1], axis=1).astype("u2")
    seeds["tif, ImageJ"] = seed(hyperstack, imagej=True, metadata={"axes": "ZCYX", "spacing": 3.0, "unit": "um"})
    sizes = {f"PhysicalSize{axis}": size for axis, size in zip("XYZ", (0.5, 1.25, 3.0), strict=True)}
    path = folder / "a.ome.tif"
    seeds["tif, OME"] = seed(hyperstack, metadata={"axes": "ZCYX", **sizes, "Channel": {"Name": ["DAPI", "GFP"]}})
    bits = Image.fromarray(smooth % 3 > 0)
    for kind in ("group3", "group4"):
        bits.save(path, compression=kind)
        seeds[f"tif, {kind}"] = volume({"a.tif": path.read_bytes()})
    return seeds


def _slices() -> dict[str, Seed]:
    """Folders of pictures that Pillow writes."""
    from PIL import Image

    seeds = {}
    for kind in ("PNG", "TIFF", "BMP", "JPEG"):
        files = {}
        for k in range(SHAPE[2]):
            file = io.BytesIO()
            Image.fromarray(np.ascontiguousarray(voxels("u1")[:, :, k].T)).save(file, kind)
            files[f"slice{k + 9}.{kind.lower()}"] = file.getvalue()
        seeds[f"slices, {kind}"] = volume(files, main="")
    return seeds


def _zarrs(folder: Path) -> dict[str, Seed]:
    import numcodecs
    import zarr

    def seed(group: bool, version: int, keywords: dict[str, Any], attributes: dict[str, Any]) -> Seed:
        path = folder / "a.zarr"
        shutil.rmtree(path, ignore_errors=True)
        shape = {"shape": SHAPE[::-1], "chunks": (2, *SHAPE[1::-1]), "dtype": "i2"}
        if group:
            whole = zarr.open_group(path, mode="w", zarr_format=version)
            array = whole.create_array("0", **shape, **keywords)
            whole.attrs.update(attributes)
        else:
            array = zarr.create_array(path, zarr_format=version, attributes=attributes, **shape, **keywords)
        array[...] = voxels().T
        share = 1 if keywords.get("compressors", "") is None else SLOW
        return volume(files_in(path, "zarr.json" if version == 3 else ".zarray"), main="a.zarr", share=share)

    axes = [{"name": name, "type": "space", "unit": "micrometer"} for name in "zyx"]
    steps = [{"type": "scale", "scale": [3, 1.25, 0.5]}, {"type": "translation", "translation": [30, -20, 10]}]
    image = {"multiscales": [{"axes": axes, "datasets": [{"path": "0", "coordinateTransformations": steps}]}]}
    blosc = numcodecs.Blosc(cname="lz4", shuffle=numcodecs.Blosc.SHUFFLE)
    seeds = {
        "zarr": seed(False, 2, {"compressors": None}, {"_ARRAY_DIMENSIONS": ["z", "y", "x"], "_FillValue": -9.0}),
        "zarr, zlib": seed(False, 2, {"compressors": numcodecs.Zlib()}, {}),
        "zarr, OME 0.4, blosc": seed(True, 2, {"compressors": blosc}, image),
        "zarr, OME 0.5, zstd": seed(True, 3, {}, {"ome": {"version": "0.5"} | image}),
        "zarr, shards": seed(False, 3, {"shards": (4, *SHAPE[1::-1])}, {}),
    }
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in seeds["zarr, OME 0.5, zstd"].files.items():
            archive.writestr(name.removeprefix("a.zarr/"), content)
    return seeds | {"zarr, zip": volume({"a.zarr.zip": packed.getvalue()}, share=SLOW)}
