"""What spherical harmonics cost in error and time: radiance transfer over each of its knobs, against a sum over directions.

`python experiments/sh_accuracy.py [--json FILE] [--figure FILE] [--quick]`

The reference knows no harmonics: the environment is cut into a thousand directions, each is a directional light with shadow rays of
one-voxel steps, and the pictures are added up. Matte bones of a formula, and of a CT with a photographed sky where `$JVR_DATA` has them.

Errors are root mean squares over all pixels, relative to that of the reference. Colour differences at lower order are measured against
the same picture without that.
"""

import argparse
import dataclasses
import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks.peers import ours, scenes
from benchmarks.timing import median, seconds
from experiments.accuracy_vs_time import machine
from jvr.effects.radiance_transfer_grid import projected_of
from jvr.model.harmonics.projection import map_directions

DEFAULT: dict[str, Any] = {"order": 3, "rays": 64, "resolution": 1 / 3}
KNOBS: dict[str, tuple[Any, ...]] = {
    "order": (0, 1, 2, 3, 4, 6, 8),
    "rays": (8, 16, 32, 64, 128, 256),
    "resolution": (1 / 8, 1 / 4, 1 / 3, 1 / 2, 1.0),
}


def sky(height: int) -> np.ndarray:
    """A map from a formula: a blue sky, a dark ground and a warm sun of 15 degrees."""
    d, _ = map_directions(height, 2 * height)
    blue = np.clip(0.5 + 0.5 * d[..., 1:2], 0, 1) * [0.4, 0.6, 1.0]
    sun = (d @ (np.array([0.5, 0.7, 0.5]) / math.sqrt(0.99)) > math.cos(math.radians(15)))[..., None] * [12.0, 10.0, 7.0]
    return np.where(d[..., 1:2] > 0, blue, 0.1) + sun


def coarse(pixels: np.ndarray, height: int) -> np.ndarray:
    """A map at a lower resolution, by the means of blocks; at most the map's own resolution."""
    factor = max(pixels.shape[0] // height, 1)
    rows, columns = pixels.shape[0] // factor, pixels.shape[1] // factor
    return pixels[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, 3).mean((1, 3))


def photographed(name: str) -> np.ndarray | None:
    """A light probe of the data folder, or `None` without it."""
    from jvr.io.environment import read_environment

    path = Path(os.environ.get("JVR_DATA", "")) / "env" / name
    return np.asarray(read_environment(path)) if path.exists() else None


def reference(scene: jvr.Scene, camera: jvr.PerspectiveCamera, pixels: np.ndarray) -> np.ndarray:
    """The picture under every pixel of a map as a light of its own. `jvr.Lambert` returns the irradiance itself where it faces it; a
    matte surface returns it over pi."""
    directions, solid_angle = map_directions(*pixels.shape[:2])
    irradiance = pixels * solid_angle[:, None, None] / math.pi
    total = np.zeros((camera.height, camera.width, 3))
    for k, (d, e) in enumerate(zip(directions.reshape(-1, 3), irradiance.reshape(-1, 3), strict=True)):
        one = dataclasses.replace(
            scene,
            lights=(jvr.DirectionalLight(-d, e),),
            shading=jvr.Lambert(0.0, 1.0),
            shadows=jvr.ShadowRays(1.0, termination=0.01),
        )
        total += np.asarray(jvr.render(one, camera).rgb, np.float64)
        if k % 32 == 0 and sys.stderr.isatty():
            print(f"  reference: {k / directions[..., 0].size:.0%}", end="\r", file=sys.stderr)
    return total


def relative(picture: np.ndarray, exact: np.ndarray) -> float:
    return float(np.sqrt(np.mean((picture - exact) ** 2) / np.mean(exact**2)))


def measured(name: str, scene: jvr.Scene, camera: jvr.PerspectiveCamera, pixels: np.ndarray, quick: bool) -> dict[str, Any]:
    """One row for each setting: its error by the shortcut and by the exact product, and what it takes."""
    exact = reference(scene, camera, pixels)
    lit = lambda order, transfer: dataclasses.replace(
        scene,
        environment=jvr.EnvironmentLight.from_image(pixels, order),
        material=jvr.LambertBRDF(),
        radiance_transfer=transfer,
    )
    picture = lambda s: np.asarray(jvr.render(s, camera).rgb, np.float64)
    unshadowed = relative(picture(lit(DEFAULT["order"], None)), exact)
    rows = []
    for knob, values in KNOBS.items():
        for value in values[1::2] if quick else values:
            given = DEFAULT | {knob: value}
            rows.append(
                {"knob": knob, "value": value} | _row(lambda t, given=given: lit(given["order"], t), given, camera, exact)
            )
            show(rows[-1])
    return {
        "scene": name,
        "voxels": scene.volume.shape,
        "directions": pixels[..., 0].size,
        "unshadowed": unshadowed,
        "rows": rows,
        "windows": _windows(lit, camera, exact, pixels),
        "chromaticity": _chromaticity(lit, camera, quick),
    }


def _row(
    lit: Callable[[Any], jvr.Scene], given: dict[str, Any], camera: jvr.PerspectiveCamera, exact: np.ndarray
) -> dict[str, Any]:
    made, row = {}, {}
    project = lambda: made.update(scene=jvr.precompute(lit(jvr.RadianceTransfer(**given))))
    row["projection_seconds"] = min(seconds({"": lambda: project() or 0}, repeats=1)[""])
    projected = projected_of(made["scene"])
    row["bytes"] = projected.nbytes
    for kind in ("shortcut", "exact"):
        chosen = jvr.RadianceTransfer(**given, exact=kind == "exact").with_projected(projected)
        frame = dataclasses.replace(made["scene"], radiance_transfer=chosen)
        row[f"{kind}_error"] = relative(np.asarray(jvr.render(frame, camera).rgb, np.float64), exact)
        row[f"{kind}_seconds"] = median(seconds({"": lambda s=frame: jvr.render(s, camera).rgb}, repeats=3), "")
    return row


def _windows(lit: Any, camera: jvr.PerspectiveCamera, exact: np.ndarray, pixels: np.ndarray) -> list[dict[str, Any]]:
    """Windowing and clamping of a light that rings: without any, a share of the pixels may be negative."""
    rows = []
    frozen = jvr.precompute(lit(DEFAULT["order"], jvr.RadianceTransfer(**DEFAULT, exact=True)))
    for window in (None, 8.0, 4.0):
        for clamped in (False, True):
            light = jvr.EnvironmentLight.from_image(pixels, DEFAULT["order"], window=window, clamped=clamped)
            picture = np.asarray(jvr.render(dataclasses.replace(frozen, environment=light), camera).rgb, np.float64)
            found = {"error": relative(picture, exact), "negative": float(np.mean(picture < 0)), "least": float(picture.min())}
            rows.append({"window": window, "clamped": clamped} | found)
    return rows


def _chromaticity(lit: Any, camera: jvr.PerspectiveCamera, quick: bool) -> list[dict[str, Any]]:
    """Colour differences of a bleeding transfer at lower orders, against all of them at the order of the luminance."""
    rows, whole = [], None
    for order in (3, 2, 1, 0)[:: 2 if quick else 1]:
        transfer = jvr.RadianceTransfer(**DEFAULT, exact=True, bleeding=jvr.TransferBleeding(), chromaticity=order)
        frozen = jvr.precompute(lit(DEFAULT["order"], transfer))
        picture = np.asarray(jvr.render(frozen, camera).rgb, np.float64)
        whole = picture if whole is None else whole
        rows.append({"order": order, "bytes": projected_of(frozen).nbytes, "error": relative(picture, whole)})
    return rows


def show(row: dict[str, Any]) -> None:
    print(
        f"  {row['knob']} {row['value']:g}: shortcut {row['shortcut_error']:.1%} in {1e3 * row['shortcut_seconds']:.0f} ms, "
        f"exact {row['exact_error']:.1%} in {1e3 * row['exact_seconds']:.0f} ms; "
        f"projected in {row['projection_seconds']:.2f} s, {row['bytes'] / 1e6:.1f} MB",
        flush=True,
    )


def figure(results: list[dict[str, Any]], path: str) -> None:
    """Error over each knob, for both products."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(3.4 * len(KNOBS), 3.1 * len(results)), layout="constrained")
    grid = drawing.subplots(len(results), len(KNOBS), squeeze=False, sharey="row")
    for axes_row, result in zip(grid, results, strict=True):
        for axes, knob in zip(axes_row, KNOBS, strict=True):
            rows = [r for r in result["rows"] if r["knob"] == knob]
            for kind, colour in (("shortcut", "C1"), ("exact", "C0")):
                axes.plot([r["value"] for r in rows], [r[f"{kind}_error"] for r in rows], "o-", color=colour, label=kind)
            axes.axhline(result["unshadowed"], color="0.6", ls=":", label="no transfer")
            axes.axvline(DEFAULT[knob], color="0.85", zorder=0)
            axes.set(xlabel="nodes for each voxel" if knob == "resolution" else knob, ylim=(0, None))
        axes_row[0].set_ylabel(f"{result['scene']}\nrelative RMSE")
    grid[0][0].legend(frameon=False)
    drawing.savefig(path, dpi=130)


def main() -> None:
    """Measures, prints a line for each setting, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of the errors over each knob")
    parser.add_argument("--quick", action="store_true", help="small pictures, few settings and directions")
    arguments = parser.parse_args()
    n, size, height = (24, 24, 6) if arguments.quick else (64, 64, 24)
    wanted = {("bone", "phantom"): sky(240)}
    probe = photographed("potsdamer_platz_1k.hdr")
    if probe is not None and not arguments.quick:
        wanted[("bone", "CT of a torso")] = probe
    results = []
    for described in (scene for scene in scenes.four(n, size) if (scene.name, scene.data) in wanted):
        scene, camera = ours.to_jvr(described)
        name = f"{described.name} ({described.data})"
        print(name, flush=True)
        results.append(measured(name, scene, camera, coarse(wanted[described.name, described.data], height), arguments.quick))
        jax.clear_caches()
        if arguments.json:
            Path(arguments.json).write_text(json.dumps({"machine": machine(), "scenes": results}, indent=2) + "\n")
        if arguments.figure:
            figure(results, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
