"""Samples taken against samples avoided, as tables 2 and 3 of "Adaptive Sampling in Three Dimensions for Volume Rendering on GPUs" (Kraus,
Strengert, Klein and Ertl) count them, with the error of the picture and the time beside those of plain marching.

`python experiments/adaptive_sampling.py [--json FILE] [--figure FILE] [--quick]`; sparse vessels (`carotid`) and a dense abdomen
(`ct_torso`) are looked for in `$JVR_DATA`, embedded scenes stand in where they are absent. "plain ms" is the time of the fastest plain
march with that error or less: where it is the smaller one, leaving samples out did not pay.
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
from benchmarks.peers import ours, scenes
from experiments.accuracy_vs_time import machine, pareto

PLAIN = "plain"
# The paper's aneurysm and abdomen, and what stands in for them: the names of `benchmarks.peers.scenes`.
WANTED = {"vessels": "carotid", "skin": "ct_torso"}


def described(n: int, size: int) -> list[scenes.Scene]:
    """The sparse and the dense scene: scans where `$JVR_DATA` has them."""
    found = [scene for scene in scenes.four(n, size) if scene.name in WANTED]
    by_name = {scene.name: scene for scene in found}
    for name, scan in WANTED.items():
        if sum(scene.name == name for scene in found) == 1:
            print(f"{scan} is not in $JVR_DATA: an embedded scene stands in for it", file=sys.stderr)
    # Scans come after the embedded scenes of the same name.
    return list(by_name.values())


def ways(quick: bool) -> list[tuple[str, jvr.Settings]]:
    """Plain marching, and everything that leaves samples out."""
    tolerances = (0.01,) if quick else (0.03, 0.01, 0.003)
    slices = lambda oracle, step: jvr.Settings(step, sampling=jvr.Slices(oracle))
    steps = (0.5, 1.0, 2.0) if quick else (0.25, 0.5, 1.0, 2.0, 4.0)
    found = [(PLAIN, jvr.Settings(step)) for step in steps]
    found += [(f"{PLAIN}, pre-integrated", jvr.Settings(step, quadrature=jvr.PreIntegrated())) for step in steps[-3:]]
    found.append(("slices, min.", slices(jvr.Finest(), 0.5)))
    for pixels in (2,) if quick else (2, 4):
        found.append((f"slices, PixelSize {pixels}", slices(jvr.PixelSize(jvr.Finest(), pixels=pixels), 0.5)))
    for tolerance in tolerances:
        for oracle in (jvr.OpacityChange(tolerance), jvr.BrickRange(tolerance), jvr.LocalError(tolerance)):
            found.append((f"slices, {type(oracle).__name__} {tolerance:g}", slices(oracle, 0.5)))
        found.append((f"refinement {tolerance / 2:g}", jvr.Settings(0.5, sampling=jvr.Refinement(tolerance / 2))))
    return found


def measured(scene: jvr.Scene, camera: jvr.PerspectiveCamera, choices: list[tuple[str, jvr.Settings]], reference: float):
    """One row for each choice, with the time of plain marching at its error or less, `None` where none is that accurate."""
    found = jvr.measure(scene, camera, [s for _, s in choices], reference_step=reference, repeats=3)
    plain = [(m.seconds, m.rmse) for (name, _), m in zip(choices, found, strict=True) if name.startswith(PLAIN)]
    least = next((m.samples for (name, _), m in zip(choices, found, strict=True) if name == "slices, min."), None)
    rows = []
    for (name, settings), m in zip(choices, found, strict=True):
        times = [seconds for seconds, rmse in plain if rmse <= m.rmse]
        numbers = {k: v for k, v in dataclasses.asdict(m).items() if k not in ("settings", "gradient_error")}
        share = m.samples / least if name.startswith("slices") and least else None
        rows.append({"way": name, "step": settings.step, **numbers, "share": share, "plain": min(times, default=None)})
    return rows


def show(name: str, rows: list[dict[str, Any]]) -> None:
    print(f"\n{name}")
    print(f"{'':<30}{'step':>6}{'samples':>12}{'of min.':>9}{'RMSE':>10}{'largest':>9}{'SSIM':>9}{'ms':>9}{'plain ms':>10}")
    for r in rows:
        share = f"{r['share']:>9.0%}" if r["share"] is not None else f"{'':>9}"
        plain = f"{1e3 * r['plain']:>10.1f}" if r["plain"] is not None else f"{'none':>10}"
        print(
            f"{r['way']:<30}{r['step']:>6g}{r['samples']:>12,}{share}{r['rmse']:>10.1e}{r['largest']:>9.3f}{r['ssim']:>9.5f}"
            f"{1e3 * r['seconds']:>9.1f}{plain}"
        )


def figure(tables: dict[str, list[dict[str, Any]]], pictures: dict[str, list[tuple[str, np.ndarray]]], path: str) -> None:
    """Error against samples and against time, and pictures with and without what is left out."""
    from matplotlib.figure import Figure

    width = 2 + max(map(len, pictures.values()))
    drawing = Figure(figsize=(3.4 * width, 3.6 * len(tables)), layout="constrained")
    panels = drawing.subplots(len(tables), width, squeeze=False)
    for row, (name, rows) in zip(panels, tables.items(), strict=True):
        kinds = list(dict.fromkeys(r["way"].rstrip("0123456789.").strip() for r in rows))
        for panel, key, scale, label in ((row[0], "samples", 1, "samples"), (row[1], "seconds", 1e3, "milliseconds")):
            for kind in kinds:
                some = [r for r in rows if r["way"].rstrip("0123456789.").strip() == kind]
                panel.plot([scale * r[key] for r in some], [r["rmse"] for r in some], "o-", markersize=4, label=kind)
            front = np.array(pareto([(r[key], r["rmse"]) for r in rows]))
            panel.plot(scale * front[:, 0], front[:, 1], "-", color="0.8", linewidth=6, zorder=0)
            panel.set(title=name, xscale="log", yscale="log", xlabel=label, ylabel="RMSE")
        for panel, (title, rgb) in zip(row[2:], pictures[name], strict=True):
            panel.imshow(np.clip(rgb, 0, 1) ** (1 / 2.2))
            panel.set_title(title, fontsize=9)
            panel.set_axis_off()
    panels[-1, 0].legend(fontsize=7)
    drawing.savefig(path, dpi=110)


def shown_pictures(scene: jvr.Scene, camera: jvr.PerspectiveCamera) -> list[tuple[str, np.ndarray]]:
    choices = {
        "plain, step 0.5": jvr.Settings(),
        "slices, LocalError 0.01": jvr.Settings(0.5, sampling=jvr.Slices()),
        "refinement 0.005": jvr.Settings(sampling=jvr.Refinement()),
    }
    render = jax.jit(jvr.render)
    return [(title, np.asarray(render(scene, camera, settings).rgb)) for title, settings in choices.items()]


def main() -> None:
    """Measures, prints a table for each scene, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of error against samples and time, with pictures")
    parser.add_argument("--quick", action="store_true", help="small pictures and volumes, few settings")
    arguments = parser.parse_args()
    n, size, reference = (32, 48, 0.25) if arguments.quick else (96, 256, 1 / 16)
    tables, pictures = {}, {}
    for one in described(n, size):
        scene, camera = ours.to_jvr(one)
        name = f"{one.name} ({one.data})"
        tables[name] = measured(scene, camera, ways(arguments.quick), reference)
        show(name, tables[name])
        if arguments.figure:
            pictures[name] = shown_pictures(scene, camera)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps({"machine": machine(), "size": size, "scenes": tables}, indent=2) + "\n")
    if arguments.figure:
        figure(tables, pictures, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
