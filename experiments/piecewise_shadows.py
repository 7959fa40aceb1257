"""Piecewise shadows over the length of the near piece and the resolution of the shadow volume, against exact shadow rays.

`python experiments/piecewise_shadows.py [--json FILE] [--figure FILE] [--quick]`; table 6.1 (right) and figures 6.8 and 6.10 of the course
notes on GPU-based volume ray-casting (Eurographics 2009), with volumes from formulas: bones under skin, opaque and translucent. A row for
each choice: seconds for a new light (the nodes), seconds of a picture (nodes and all), and the error of the picture as root mean square and
largest difference over its largest value, and in colours as CIE 1976 delta E, with the share of pixels beyond 6, which is seen.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
from skimage.color import deltaE_cie76, rgb2lab

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks.light import lit
from benchmarks.peers import ours, scenes
from benchmarks.timing import median, seconds
from experiments.accuracy_vs_time import machine
from jvr.rendering.medium import occupancy, visibility

# What "exact" stands for: a sample every quarter of a voxel, every shadow ray to its end.
EXACT = jvr.ShadowRays(0.25, termination=0.0)
# Pieces in voxels, and nodes for each voxel: a shadow volume of 32^3 to 256^3 for 512^3 voxels. 0 is the shadow volume by itself.
PIECES, RESOLUTIONS = (0, 4, 8, 16, 32), (1 / 16, 1 / 8, 1 / 4, 1 / 2)
# Milliseconds of the notes for a new light in a volume of 512^3, pieces of 4 to 32 over shadow volumes of 32^3 to 256^3.
NOTES = {4: (261, 267, 439, 1428), 8: (284, 297, 373, 552), 16: (331, 339, 380, 641), 32: (436, 439, 463, 862)}


def subjects(quick: bool) -> dict[str, tuple[jvr.Scene, jvr.PerspectiveCamera]]:
    """Scenes that show their lights, by name."""
    n, size = (24, 24) if quick else (128, 160)
    drawn = [ours.to_jvr(scene) for scene in scenes.from_formulas(n, size)[: 1 if quick else 2]]
    names = ("bone, opaque", "skin, translucent")
    return {name: (lit(scene, camera), camera) for name, (scene, camera) in zip(names, drawn, strict=False)}


@jax.jit
def prepared(scene: jvr.Scene) -> Any:
    """What a new light, or a new transfer function, asks for before the first ray."""
    return visibility(scene, occupancy(scene, jvr.Settings()))


def measured(scene: jvr.Scene, camera: jvr.PerspectiveCamera, quick: bool) -> dict[str, Any]:
    """A row for each piece and resolution, and pictures of some."""
    render = jax.jit(jvr.render)
    drawn = lambda shadows: render(dataclasses.replace(scene, shadows=shadows), camera).rgb
    exact, rows = np.asarray(drawn(EXACT)), []
    pictures = {"shadow rays": exact}
    for piece in PIECES[:2] if quick else PIECES:
        for resolution in RESOLUTIONS[3:] if quick else RESOLUTIONS:
            shadows = jvr.PiecewiseShadows(piece, resolution)
            shaded = dataclasses.replace(scene, shadows=shadows)
            jobs = {"light": lambda s=shaded: prepared(s), "picture": lambda s=shadows: drawn(s)}
            times = seconds(jobs, repeats=1 if quick else 3)
            rgb = np.asarray(drawn(shadows))
            row = {"piece": piece, "resolution": resolution, **{name: median(times, name) for name in jobs}}
            rows.append(row | errors(rgb, exact))
            if piece in (0, 16) or quick:
                pictures[f"pieces of {piece}, 1 / {round(1 / resolution)}"] = rgb
            show(rows[-1])
            jax.clear_caches()
    scattered = jvr.InScattering(8 if quick else 32, samples=4 if quick else 8, bias=0.1)
    pictures["in-scattering"] = np.asarray(drawn(scattered))
    return {"voxels": scene.volume.shape, "without": errors(np.asarray(drawn(None)), exact), "rows": rows, "pictures": pictures}


def errors(rgb: np.ndarray, exact: np.ndarray) -> dict[str, float]:
    """Of a picture, over the largest value of the exact one; and of their colours, with that as white."""
    error = (rgb - exact) / exact.max()
    delta = deltaE_cie76(*(rgb2lab(encoded(picture / exact.max())) for picture in (rgb, exact)))
    seen = exact.max(axis=-1) > 0
    return {
        "rmse": float(np.sqrt(np.mean(error**2))),
        "largest": float(np.abs(error).max()),
        "delta_e": float(np.sqrt(np.mean(delta[seen] ** 2))),
        "beyond_6": float(np.mean(delta[seen] > 6)),
    }


def encoded(linear: np.ndarray) -> np.ndarray:
    """sRGB of linear radiance."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def show(row: dict[str, Any]) -> None:
    print(
        f"piece {row['piece']:>3} resolution {row['resolution']:.3f} light {1e3 * row['light']:>8.0f} ms picture "
        f"{1e3 * row['picture']:>8.0f} ms RMSE {row['rmse']:.2%} delta E {row['delta_e']:.2f} beyond 6 {row['beyond_6']:.1%}",
        flush=True,
    )


def figure(results: dict[str, Any], path: str) -> None:
    """For each subject error against time, one line for each piece, and pictures under it."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    columns = max(len(result["pictures"]) for result in results.values())
    across = -(-columns // 2)
    drawing = Figure(figsize=(2.0 * across + 4.5, 4.2 * len(results)), layout="constrained")
    parts = drawing.subfigures(len(results), 1, squeeze=False)[:, 0]
    for part, (name, result) in zip(parts, results.items(), strict=True):
        left, right = part.subfigures(1, 2, width_ratios=(4.5, 2.0 * across))
        panel = left.subplots()
        for k, piece in enumerate(dict.fromkeys(row["piece"] for row in result["rows"])):
            rows = [row for row in result["rows"] if row["piece"] == piece]
            at = [1e3 * row["picture"] for row in rows], [row["rmse"] for row in rows]
            panel.plot(*at, "o-", markersize=4, color=f"C{k}", label=f"pieces of {piece}" if piece else "no piece")
            for x, y, row in zip(*at, rows, strict=True):
                panel.annotate(f"1/{round(1 / row['resolution'])}", (x, y), (4, 3), textcoords="offset points", fontsize=6)
        panel.set(
            title=name, xscale="log", yscale="log", xlabel="milliseconds of a picture", ylabel="RMSE over the largest value"
        )
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.legend(frameon=False, fontsize=7)
        white = result["pictures"]["shadow rays"].max()
        for axes in (panels := right.subplots(2, across)).flat:
            axes.axis("off")
        for axes, (title, rgb) in zip(panels.flat, result["pictures"].items(), strict=False):
            axes.imshow(encoded(rgb / white))
            axes.set_title(title, fontsize=7)
    drawing.savefig(path, dpi=130)


def main() -> None:
    """Measures, prints a line for each choice, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of error against time, and of pictures")
    parser.add_argument("--quick", action="store_true", help="a small picture and volume, few choices")
    arguments = parser.parse_args()
    results = {}
    for name, (scene, camera) in subjects(arguments.quick).items():
        print(name, flush=True)
        results[name] = measured(scene, camera, arguments.quick)
        if arguments.json:
            numbers = {name: {k: v for k, v in result.items() if k != "pictures"} for name, result in results.items()}
            notes = {str(piece): times for piece, times in NOTES.items()}
            report = {"machine": machine(), "subjects": numbers, "notes_milliseconds": notes}
            Path(arguments.json).write_text(json.dumps(report, indent=2) + "\n")
        if arguments.figure:
            figure(results, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
