"""The first picture of volumes that nobody has said anything about, as `jvr render FILE` draws it, beside a plain window on the whole box.

`python experiments/first_pictures.py [-o FILE] [--json FILE] [--quick]`; `--figure` is another name of `-o`. Public volumes are looked for
in `$JVR_DATA`; eight more are made here, each with something that spoils pictures: padding, a hot voxel, NaN, labels, thin slabs, tiny
units. JSON holds what was guessed of each, and how much of the picture shows something.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.accuracy_vs_time import machine
from experiments.protocols import DATA
from jvr.cli.first import Wishes, configured
from jvr.io.config import build_cameras, build_scene, config_from
from jvr.pictures import srgb_from_linear

PUBLIC: dict[str, tuple[str, dict[str, Any]]] = {
    "CT of a torso": ("ct_torso/example_ct.nii.gz", {}),
    "CT of a head, no unit": ("ct_head_quarter/ct_head_quarter.mhd", {}),
    "CT of a phantom": ("ct_head_pitch/CT_pitch.nii.gz", {}),
    "MR of a brain": ("mr_flair/FLAIR.nrrd", {}),
    "MR angiography": ("carotid/carotid.vtk", {}),
    "micrograph": ("embryo/embryo_256x256x256_uint8.raw", {"shape": [256, 256, 256], "dtype": "uint8"}),
    "labels": ("frogtissue/frogtissue.mhd", {}),
    "orbital": ("hydrogen/hydrogen.vti", {}),
    "protein": ("ironprot/ironProt.vtk", {}),
    "protein, TIFF": ("neghip/neghip_stack.tif", {}),
}
N = 64


def made() -> dict[str, np.ndarray]:
    """Volumes with something odd about them, by what that is."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, N)] * 3, indexing="ij")
    r = np.sqrt(x**2 + y**2 + z**2)
    noise = np.random.default_rng(0).normal(size=(N, N, N))
    body = np.where(x**2 + y**2 < 0.6, 40.0, -1000.0) + np.where((x - 0.2) ** 2 + y**2 < 0.05, 700.0, 0.0) + 12 * noise
    padded = np.where(x**2 + y**2 < 0.95, body, -2000).astype(np.int16)
    vessels = np.where((x - 0.3 * np.sin(3 * z)) ** 2 + (y - 0.3 * np.cos(3 * z)) ** 2 < 0.012, 350.0, 45.0)
    gyroid = np.sin(8 * x) * np.cos(8 * y) + np.sin(8 * y) * np.cos(8 * z) + np.sin(8 * z) * np.cos(8 * x)
    hot = np.exp(-4 * r**2) * (1 + 0.02 * noise)
    hot[3, 3, 3] = 1e6
    holed = np.where((x > 0) & (y < 0), np.nan, 0.5 + 0.5 * gyroid / 1.5)
    regions = np.zeros((N, N, N), np.uint8)
    for k, center in enumerate([(-0.4, 0, 0), (0.4, 0, 0.3), (0, 0.4, -0.4), (0, -0.3, 0.4)], start=1):
        regions[sum((a - b) ** 2 for a, b in zip((x, y, z), center, strict=True)) < 0.1] = k
    return {
        "CT, padding -2000": padded,
        "CT angiography": np.where(r < 0.95, vessels + 8 * noise, -1000).astype(np.int16),
        "micro-CT of foam": np.clip(20000 + 15000 * (gyroid > 0.3) + 900 * noise, 0, 65535).astype(np.uint16),
        "one hot voxel": hot.astype(np.float32),
        "NaN in a quarter": holed.astype(np.float32),
        "four labels": regions,
        "one slice": (128 + 100 * gyroid[:, :, :1] / 1.5).astype(np.uint8),
        "tiny units": (1e-12 * np.exp(-6 * (r - 0.6) ** 2)).astype(np.float64),
    }


def drawn(path: Path, keywords: dict[str, Any], size: int) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """The plain picture, the first picture, and what was guessed for that."""
    sets = [f"camera.width={size}", f"camera.height={size}"]
    config, volume, notes = configured(path, sets, keywords, Wishes())
    assert volume is not None
    scene = build_scene(config, volume)
    (camera,) = build_cameras(config, volume, scene.transfer)
    picture = jvr.render(scene, camera)
    tables = {"volume": {"path": str(path), **keywords}, "transfer": {"kind": "window"}, "background": [0.0, 0.0, 0.0]}
    plain = config_from(tables, str(path), path.parent, sets)
    (whole,) = build_cameras(plain, volume)
    before = jvr.render(build_scene(plain, volume), whole)
    seen = float(np.mean(np.asarray(picture.alpha) > 0.05))
    return np.asarray(before.rgb), np.asarray(picture.rgb), {"notes": notes, "share of pixels that show something": seen}


def sheet(rows: dict[str, tuple[np.ndarray, np.ndarray, dict[str, Any]]], path: Path) -> None:
    """All pictures, two for each volume, one above the other."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = 6
    lines = -(-len(rows) // columns)
    figure, axes = plt.subplots(2 * lines, columns, figsize=(1.75 * columns, 3.75 * lines), squeeze=False, layout="constrained")
    for axis in axes.ravel():
        axis.set_axis_off()
    for i, (name, (before, after, _)) in enumerate(rows.items()):
        for k, picture in enumerate((before, after)):
            axis = axes[2 * (i // columns) + k, i % columns]
            axis.imshow(srgb_from_linear(np.clip(picture, 0, 1)))
            if k == 0:
                axis.set_title(name, fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--figure", type=Path, default=Path("first_pictures.png"), help="the sheet (default %(default)s)")
    parser.add_argument("--json", type=Path, help="what was guessed")
    parser.add_argument("--quick", action="store_true", help="two volumes, small")
    options = parser.parse_args(arguments)
    size = 48 if options.quick else 256
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        files = {name: (DATA / file, keywords) for name, (file, keywords) in PUBLIC.items() if (DATA / file).exists()}
        for name, values in made().items():
            path = Path(folder) / f"{name}.npy"
            np.save(path, values)
            files[name] = (path, {"spacing": [1.0, 1.0, 1.0]})
        for name, (path, keywords) in list(files.items())[-2 if options.quick else 0 :]:
            rows[name] = drawn(path, keywords, size)
            print(f"{name}: {'; '.join(rows[name][2]['notes'])}", flush=True)
            jax.clear_caches()
    sheet(rows, options.figure)
    if options.json is not None:
        report = {"machine": machine(), "size": size, "volumes": {name: row[2] for name, row in rows.items()}}
        options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
