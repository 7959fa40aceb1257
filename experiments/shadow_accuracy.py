"""What shadows cost in time and error: every method over its knob, against exact shadow rays.

`python experiments/shadow_accuracy.py [--json FILE] [--figure FILE] [--quick]`; a translucent body from a formula, and the bones of a CT
where `$JVR_DATA` has it. Shadow maps are for opaque occluders and measured on bones alone.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks.light import lit
from benchmarks.peers import ours, scenes
from benchmarks.timing import median, seconds
from experiments.accuracy_vs_time import machine

# What "exact" stands for: a sample every quarter of a voxel, every shadow ray to its end.
EXACT = jvr.ShadowRays(0.25, termination=0.0)
OPAQUE = "bone"


def methods(quick: bool, opaque: bool) -> dict[str, list[tuple[str, Any]]]:
    """For each method its knob, from coarse to fine: how it is called, and the shadows."""
    found = {
        "rays: step": [(f"{step:g}", jvr.ShadowRays(step)) for step in (8, 4, 2, 1)],
        "volume: resolution": [(f"1/{n:g}", jvr.ShadowVolume(1 / n)) for n in (12, 6, 3, 1.5)],
        "piecewise: piece, resolution": [
            (f"{h}, 1/{n}", jvr.PiecewiseShadows(h, 1 / n)) for h, n in ((2, 8), (4, 4), (8, 4), (8, 2))
        ],
        "opacity map: texels, layers": [
            (f"{n}, {k}", jvr.OpacityShadowMap(n, k)) for n, k in ((32, 8), (64, 16), (128, 32), (256, 64))
        ],
        "deep map: texels, pieces, error": [
            (f"{n}, {k}, {error:g}", jvr.DeepShadowMap(n, k, error=error))
            for n, k, error in ((32, 4, 0.04), (64, 8, 0.02), (128, 12, 0.01), (256, 24, 0.005))
        ],
    }
    if opaque:
        found["map: texels"] = [(f"{n}", jvr.ShadowMap(n)) for n in (64, 128, 256, 512)]
    return {name: group[1:3] for name, group in found.items()} if quick else found


def measured(name: str, scene: jvr.Scene, camera: jvr.PerspectiveCamera, quick: bool, opaque: bool) -> dict[str, Any]:
    """One row for each setting: seconds of a picture, and root mean square and largest difference from exact rays, both over the largest
    value of the picture; beside them the time without shadows."""
    shaded = lit(scene, camera)
    flat = [(method, knob, shadows) for method, group in methods(quick, opaque).items() for knob, shadows in group]
    drawn = lambda shadows: jvr.render(dataclasses.replace(shaded, shadows=shadows), camera)
    exact = np.asarray(drawn(EXACT).rgb)
    pictures = {"none": None, **{method + knob: shadows for method, knob, shadows in flat}}
    times = seconds({key: lambda s=shadows: drawn(s).rgb for key, shadows in pictures.items()}, repeats=3)
    rows = []
    for method, knob, shadows in flat:
        rendering = drawn(shadows)
        error = (np.asarray(rendering.rgb) - exact) / exact.max()
        taken = median(times, method + knob)
        row = {"method": method, "knob": knob, "seconds": taken, "added": taken / median(times, "none") - 1}
        row |= {"rmse": float(np.sqrt(np.mean(error**2))), "largest": float(np.abs(error).max())}
        stats = rendering.stats.shadows
        rows.append(row if stats is None else {**row, "rays_out_of_pieces": float(stats.overflow)})
    without = (np.asarray(drawn(None).rgb) - exact) / exact.max()
    unshadowed = {"seconds": median(times, "none"), "rmse": float(np.sqrt(np.mean(without**2)))}
    return {"scene": name, "voxels": scene.volume.shape, "unshadowed": unshadowed, "methods": rows}


def main() -> None:
    """Measures, prints a line for each setting, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of the work-precision diagrams")
    parser.add_argument("--quick", action="store_true", help="small pictures and volumes, few settings")
    arguments = parser.parse_args()
    n, size = (32, 48) if arguments.quick else (64, 128)
    wanted = [("skin", "phantom"), (OPAQUE, "CT of a torso")]
    results = []
    for described in (scene for scene in scenes.four(n, size) if (scene.name, scene.data) in wanted):
        scene, camera = ours.to_jvr(described)
        result = measured(f"{described.name} ({described.data})", scene, camera, arguments.quick, described.name == OPAQUE)
        show(result)
        results.append(result)
        # The programs of all scenes together exceed what a process may map into memory.
        jax.clear_caches()
        if arguments.json:
            Path(arguments.json).write_text(json.dumps({"machine": machine(), "scenes": results}, indent=2) + "\n")
        if arguments.figure:
            figure(results, arguments.figure)


def show(result: dict[str, Any]) -> None:
    plain = result["unshadowed"]
    print(f"\n{result['scene']}: without shadows {1e3 * plain['seconds']:.1f} ms, RMSE {plain['rmse']:.1e}")
    print(f"{'method':<34}{'knob':<16}{'ms':>9}{'added':>9}{'RMSE':>10}{'largest':>10}")
    for r in result["methods"]:
        print(
            f"{r['method']:<34}{r['knob']:<16}{1e3 * r['seconds']:>9.1f}{r['added']:>8.0%} {r['rmse']:>10.1e}{r['largest']:>10.1e}",
            flush=True,
        )


def figure(results: list[dict[str, Any]], path: str) -> None:
    """One panel a scene: error against time, one line a method, from coarse to fine."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    drawing = Figure(figsize=(5.6 * len(results), 4.6), layout="constrained")
    panels = drawing.subplots(1, len(results), squeeze=False)[0]
    for panel, result in zip(panels, results, strict=True):
        for k, method in enumerate(dict.fromkeys(row["method"] for row in result["methods"])):
            rows = [row for row in result["methods"] if row["method"] == method]
            panel.plot(
                [1e3 * r["seconds"] for r in rows], [r["rmse"] for r in rows], "o-", markersize=4, color=f"C{k}", label=method
            )
            for row in rows:
                at = (1e3 * row["seconds"], row["rmse"])
                panel.annotate(row["knob"], at, (4, 3), textcoords="offset points", fontsize=6, color=f"C{k}")
        plain = result["unshadowed"]
        panel.plot(1e3 * plain["seconds"], plain["rmse"], "kx", label="no shadows")
        panel.axvline(1e3 * plain["seconds"], color="0.6", linewidth=0.8, linestyle=":")
        panel.axhline(0.01, color="0.6", linewidth=0.8, linestyle=":")
        panel.set(title=result["scene"], xscale="log", yscale="log", xlabel="milliseconds", ylabel="RMSE over the largest value")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter(NullFormatter())
    most = max(panels, key=lambda panel: len(panel.get_legend_handles_labels()[0]))
    drawing.legend(*most.get_legend_handles_labels(), loc="outside lower center", ncols=1 + len(results), frameon=False)
    drawing.savefig(path, dpi=130)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
