"""How well `jvr.tune` chooses: whether the error that was asked for is met on the whole picture, and how long that takes beside the best
choice of an exhaustive sweep over the same knobs.

`python experiments/tuning.py [--json FILE] [--figure FILE] [--quick] [--only TEXT]`: eight scenes that tune was not made on, five errors
each, spread evenly (by ratio) over what the knobs can reach between 1e-3 and 1e-2. Every combination of every knob's values is drawn whole
and compared with the same reference. Times of tune's choice and of the fastest of the sweep that meet the error are taken once more, in
turns. Scans that `$JVR_DATA` has are measured in addition.
"""

import argparse
import itertools
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks.peers import ours, scenes, shapes
from experiments.accuracy_vs_time import machine
from jvr.rendering.foretelling import Turn, reference_of, turned, turns_of
from jvr.rendering.measure import compared, timed_pictures

# All errors within a decade, whose bounds on what is behind the end of a ray are the same: one sweep serves all of them.
LEAST, MOST = 1e-3, 9.9e-3
# Of the fastest of a sweep, as many are timed once more.
RIVALS = 4


def unlit(n: int, size: int) -> dict[str, tuple[jvr.Scene, Any]]:
    """Translucent skin, sparse vessels and a smooth simulation, by formulas, and scans."""
    wanted = [s for s in scenes.four(n, size) if s.name != "bone"]
    return {f"{s.name} ({s.data})": ours.to_jvr(s) for s in wanted}


def lit(n: int, size: int) -> dict[str, tuple[jvr.Scene, Any]]:
    """Surfaces by an expensive gradient, shadows by three methods, light that is scattered, and radiance transfer."""
    volume = jvr.Volume(shapes.gyroid(n)).bricked()
    blobs = _blobs(n)
    sun, side = jvr.DirectionalLight((0.5, 0.8, -0.6), 0.8), jvr.DirectionalLight((-0.9, 0.3, 0.2), 0.3)
    colours = [[0.7, 0.4, 0.2], [0.3, 0.5, 0.7]]
    peaks = jvr.GaussianTransfer([0.2, 0.9], [0.15, 0.25], [0.25, 0.6], colours)
    sheets = jvr.LinearTransfer([-0.4, 0.1, 0.5, 1.2], [*colours, [0.6, 0.6, 0.5], [0.7, 0.7, 0.7]], [0.0, 0.25, 0.1, 0.6])
    soft = jvr.LinearTransfer([0.15, 0.5, 1.0], [*colours, [0.8, 0.8, 0.7]], [0.0, 0.3, 0.9])
    glossy = jvr.BlinnPhong(0.1, 0.6, 0.3, 20.0, threshold=0.02)
    scattering = jvr.SingleScattering(jvr.HenyeyGreenstein(0.5), 0.8)
    sky = jvr.EnvironmentLight.disc((0.4, -0.5, 0.8), 60.0, 0.8, order=3) + jvr.EnvironmentLight.constant(0.15, order=3)
    held = {
        "glossy surfaces, Sobel normals": jvr.Scene(
            volume, peaks, lights=(sun, side), shading=glossy, normals=jvr.SobelDifferences()
        ),
        "surfaces, shadow volume": jvr.Scene(volume, sheets, lights=(sun,), shading=jvr.Lambert(), shadows=jvr.ShadowVolume(0.5)),
        "scattering, shadow rays": jvr.Scene(blobs, soft, lights=(sun,), scattering=scattering, shadows=jvr.ShadowRays(1.0)),
        "scattering, opacity shadow map": jvr.Scene(
            blobs, peaks, lights=(sun,), scattering=scattering, shadows=jvr.OpacityShadowMap(32, 16)
        ),
        "radiance transfer": jvr.Scene(
            blobs, peaks, environment=sky, material=jvr.LambertBRDF(0.8), radiance_transfer=jvr.RadianceTransfer(3, 64, 0.5)
        ),
    }
    return {name: (scene, _camera(scene.volume, size)) for name, scene in held.items()}


def _blobs(n: int) -> jvr.Volume:
    """Three soft balls that shade each other."""
    x = np.stack(np.meshgrid(*(np.linspace(-1, 1, n),) * 3, indexing="ij"))
    centres = np.array([[-0.35, -0.2, -0.3], [0.4, 0.1, 0.0], [-0.1, 0.3, 0.45]])
    fields = [np.exp(-12 * np.sum((x - c[:, None, None, None]) ** 2, axis=0)) for c in centres]
    return jvr.Volume(np.sum(fields, axis=0).astype(np.float32)).bricked()


def _camera(volume: jvr.Volume, size: int) -> jvr.PerspectiveCamera:
    centre, radius = np.asarray(volume.center), float(volume.radius)
    eye = centre + 3.2 * radius * np.array([0.6, -0.7, 0.4])
    return jvr.PerspectiveCamera.look_at(eye, centre, (0, 0, 1), 32.0, size, size)


def sweep(scene: jvr.Scene, camera: Any, turns: tuple[Turn, ...]) -> list[dict[str, Any]]:
    """Error and time of every combination of every knob's values."""
    choices, variants = [], []
    for values in itertools.product(*(turn.knob.values for turn in turns)):
        choice = {turn.name: value for turn, value in zip(turns, values, strict=True)}
        try:
            variants.append(turned((scene, jvr.Settings()), turns, choice))
        except ValueError:
            continue
        choices.append(choice)
    truth = reference_of((scene, jvr.Settings()), camera, turns)
    drawn = timed_pictures(variants, camera, repeats=5)
    return [
        {"choice": c, "variant": v, "rmse": compared(truth, v[1], p).rmse, "seconds": p.least_seconds}
        for c, v, p in zip(choices, variants, drawn, strict=True)
    ]


def judged(scene: jvr.Scene, camera: Any, error: float, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What tune chooses for an error, beside the fastest of the sweep that meet it."""
    began = time.perf_counter()
    found = jvr.tune(scene, camera, error=error)
    took = time.perf_counter() - began
    rivals = sorted((row for row in rows if row["rmse"] <= error), key=lambda row: row["seconds"])[:RIVALS]
    chosen = (found.scene, found.settings)
    again = timed_pictures([chosen, *(row["variant"] for row in rivals)], camera, repeats=9)
    fastest = min(p.least_seconds for p in again)
    return {
        "error": error,
        "met": found.met,
        "rmse": found.measured.rmse,
        "predicted": found.predicted.rmse,
        "seconds": again[0].least_seconds,
        "best": fastest,
        "ratio": again[0].least_seconds / fastest,
        "search": took,
        "turned": {name: _said(value) for name, value in found.turned.items()},
        "best_turned": {name: _said(value) for name, value in rivals[0]["choice"].items()},
    }


def _said(value: Any) -> Any:
    return value if isinstance(value, bool | int | float) else type(value).__name__


def measured(name: str, scene: jvr.Scene, camera: Any, targets: int) -> dict[str, Any]:
    """The sweep of a scene, and what tune makes of each target."""
    turns = turns_of(scene, jvr.Settings(), 0.1 * LEAST)
    rows = sweep(scene, camera, turns)
    reached = [row["rmse"] for row in rows]
    low, high = max(1.1 * min(reached), LEAST), min(max(reached), MOST)
    # Where the finest choice of all is not that fine, the errors asked for begin with it.
    errors = np.geomspace(low, max(high, 1.2 * low), targets)
    print(
        f"\n{name}: {len(rows)} choices of {', '.join(t.name for t in turns)}; errors {min(reached):.1e} ... {max(reached):.1e}"
    )
    found = [judged(scene, camera, float(error), rows) for error in errors]
    for one in found:
        print(
            f"  {one['error']:.1e}: {'met' if one['met'] else 'MISSED'} with {one['rmse']:.1e}, {1e3 * one['seconds']:.1f} ms, "
            f"{one['ratio']:.2f} x the best; {one['turned']}; found in {one['search']:.0f} s",
            flush=True,
        )
    points = [{"rmse": row["rmse"], "seconds": row["seconds"]} for row in rows]
    return {"scene": name, "choices": len(rows), "targets": found, "sweep": points}


def summary(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Over all targets of all scenes."""
    targets = [one for result in results for one in result["targets"]]
    ratios = np.array([one["ratio"] for one in targets if one["met"]])
    return {
        "targets": len(targets),
        "met": sum(one["met"] for one in targets) / len(targets),
        "ratio_mean": math.exp(np.mean(np.log(ratios))),
        "ratio_median": float(np.median(ratios)),
        "ratio_largest": float(ratios.max()),
        "within_1.3": float(np.mean(ratios <= 1.3)),
    }


def figure(results: list[dict[str, Any]], path: str) -> None:
    """One panel a scene: the sweep, what tune chose and what was asked for."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    columns = min(4, len(results))
    drawing = Figure(figsize=(4.0 * columns, 3.4 * -(-len(results) // columns)), layout="constrained")
    panels = drawing.subplots(-(-len(results) // columns), columns, squeeze=False).ravel()
    for panel, result in zip(panels, results, strict=False):
        points = np.array([(1e3 * p["seconds"], p["rmse"]) for p in result["sweep"]])
        panel.plot(points[:, 0], points[:, 1], ".", color="0.7", markersize=4, label="every choice")
        for k, one in enumerate(result["targets"]):
            panel.axhline(one["error"], color=f"C{k}", linewidth=0.6, linestyle=":")
            panel.plot(
                1e3 * one["best"], one["error"], "_", color=f"C{k}", markersize=14, label="best of them" if k == 0 else None
            )
            panel.plot(
                1e3 * one["seconds"], one["rmse"], "o", color=f"C{k}", markersize=6, mfc="none", label="tune" if k == 0 else None
            )
        panel.set(title=result["scene"], xscale="log", yscale="log", xlabel="milliseconds", ylabel="RMSE")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter(NullFormatter())
    for panel in panels[len(results) :]:
        panel.set_axis_off()
    panels[0].legend(fontsize=8)
    drawing.savefig(path, dpi=110)


def main() -> None:
    """Measures, prints a line for each target, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of error against time, with what was chosen")
    parser.add_argument("--quick", action="store_true", help="two scenes, small pictures, one error each")
    parser.add_argument(
        "--only", metavar="TEXT", default="", help="scenes with TEXT in their names; others stay as they are in the JSON"
    )
    arguments = parser.parse_args()
    n, size, targets = (12, 16, 1) if arguments.quick else (24, 64, 5)
    subjects = unlit(n, size) | lit(n, size)
    kept = Path(arguments.json) if arguments.only and arguments.json else None
    held = json.loads(kept.read_text())["scenes"] if kept is not None and kept.exists() else []
    found, results = {result["scene"]: result for result in held}, []
    wanted = [name for name in subjects if arguments.only in name]
    for name in wanted[2:4] if arguments.quick else wanted:
        found[name] = measured(name, *subjects[name], targets)
        results = [found[name] for name in (*subjects, *found.keys() - subjects) if name in found]
        # The programs of all scenes together exceed what a process may map into memory.
        jax.clear_caches()
        # After each scene, so that a run that is stopped leaves what it has.
        report = {"machine": machine(), "summary": summary(results), "scenes": results}
        if arguments.json:
            Path(arguments.json).write_text(json.dumps(report, indent=2) + "\n")
        if arguments.figure:
            figure(results, arguments.figure)
    print(json.dumps(summary(results)))


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
