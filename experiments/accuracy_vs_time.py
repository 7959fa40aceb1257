"""What accuracy costs in time: error against seconds of pictures and gradients under many settings, for several scenes.

`python experiments/accuracy_vs_time.py [--json FILE] [--figure FILE] [--quick]`; real volumes are looked for in `$JVR_DATA`, embedded
ones are always measured. The figure shows one work-precision diagram a scene; settings that nothing beats in both are joined.
"""

import argparse
import dataclasses
import datetime
import json
import platform
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks.peers import ours, scenes

ENTRIES = lambda scene: (scene.transfer.rgb, scene.transfer.sigma_t)


def sweep(quick: bool) -> dict[str, list[jvr.Settings]]:
    """Settings by the knob that they turn, the others at their defaults."""
    steps = (0.5, 1.0, 2.0) if quick else (0.25, 0.5, 1.0, 2.0, 4.0)
    terminations = (1e-2,) if quick else (1e-3, 1e-2, 1e-1)
    tolerances = (1e-2,) if quick else (1e-3, 1e-2)
    return {
        "step": [jvr.Settings(step) for step in steps],
        "termination": [jvr.Settings(0.5, termination=t) for t in terminations],
        "no skipping": [jvr.Settings(0.5, skipping=False)],
        "pre-integration": [jvr.Settings(step, quadrature=jvr.PreIntegrated()) for step in steps[-3:]],
        "refinement": [jvr.Settings(0.5, sampling=jvr.Refinement(t)) for t in tolerances],
        "slices": [jvr.Settings(1.0, sampling=jvr.Slices(jvr.LocalError(t))) for t in tolerances[-1:]],
    }


def measured(name: str, scene: jvr.Scene, camera: jvr.PerspectiveCamera, knobs: dict[str, list[jvr.Settings]], gradient: bool):
    """One row for each setting."""
    flat = [(knob, s) for knob, group in knobs.items() for s in group]
    found = jvr.measure(scene, camera, [s for _, s in flat], unknowns=ENTRIES if gradient else None, repeats=3)
    rows = []
    for (knob, settings), m in zip(flat, found, strict=True):
        numbers = {k: v for k, v in dataclasses.asdict(m).items() if k != "settings"}
        rows.append({"scene": name, "knob": knob, "step": settings.step, "termination": settings.termination, **numbers})
    return rows


def with_voxels_of(scene: jvr.Scene, dtype: Any) -> jvr.Scene:
    """The same scene with its voxels rounded to the levels of an unsigned integer type."""
    values = np.asarray(scene.volume.values, np.float64)
    low, high = values.min(), values.max()
    slope = (high - low) / np.iinfo(dtype).max
    stored = np.round((values - low) / slope).astype(dtype)
    volume = jvr.Volume(stored, scene.volume.world_from_grid, slope=slope, intercept=low).bricked()
    return dataclasses.replace(scene, volume=volume)


def main() -> None:
    """Measures, prints a line for each setting, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of the work-precision diagrams")
    parser.add_argument("--quick", action="store_true", help="small pictures and volumes, few settings")
    arguments = parser.parse_args()
    n, size = (32, 48) if arguments.quick else (64, 128)
    pictures, gradients = [], []
    for described in [*scenes.four(n, size), scenes.fog(n, size)]:
        scene, camera = ours.to_jvr(described)
        name = f"{described.name} ({described.data})"
        print(f"\n{name}: {'x'.join(map(str, scene.volume.shape))} {scene.volume.values.dtype}")
        rows = measured(name, scene, camera, sweep(arguments.quick), gradient=False)
        if scene.volume.values.dtype != np.uint8:
            rows += rounded(name, scene, camera, "8 bits", with_voxels_of(scene, np.uint8))
        if scene.volume.values.dtype == np.float32:
            rows += rounded(name, scene, camera, "16 bits", with_voxels_of(scene, np.uint16))
        packed = dataclasses.replace(scene, volume=scene.volume.packed().bricked())
        rows += rounded(name, scene, camera, "8 bits, packed", packed)
        show(rows)
        pictures += rows
        knobs = {knob: some for knob, some in sweep(arguments.quick).items() if knob in ("step", "termination")}
        gradients += measured(name, scene, camera, knobs, gradient=True)
        # The programs of all scenes together exceed what a process may map into memory.
        jax.clear_caches()
        # After each scene, so that a run that is stopped leaves what it has.
        result = {"machine": machine(), "pictures": pictures, "gradients": gradients}
        if arguments.json:
            Path(arguments.json).write_text(json.dumps(result, indent=2) + "\n")
        if arguments.figure:
            figure(pictures, gradients, arguments.figure)


def rounded(name: str, scene: jvr.Scene, camera: jvr.PerspectiveCamera, knob: str, stored: jvr.Scene) -> list[dict[str, Any]]:
    """The picture of a volume stored in fewer bits, against the reference of the one it was rounded from."""
    settings = jvr.Settings(0.5)
    (row,) = measured(name, stored, camera, {knob: [settings]}, gradient=False)
    difference = np.asarray(jvr.render(stored, camera, settings).rgb) - np.asarray(jvr.render(scene, camera, settings).rgb)
    # Its own reference does not know what rounding took away: both errors together.
    row["rmse"] = float(np.hypot(row["rmse"], np.sqrt(np.mean(difference**2))))
    row["largest"] += float(np.abs(difference).max())
    return [row]


def show(rows: list[dict[str, Any]]) -> None:
    print(f"{'knob':<16}{'step':>7}{'termination':>13}{'ms':>9}{'samples':>10}{'RMSE':>10}{'largest':>10}{'SSIM':>9}")
    for r in rows:
        print(
            f"{r['knob']:<16}{r['step']:>7g}{r['termination']:>13g}{1e3 * r['seconds']:>9.1f}{r['samples']:>10}"
            f"{r['rmse']:>10.1e}{r['largest']:>10.1e}{r['ssim']:>9.5f}"
        )


def pareto(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points (seconds, error) that no other beats in both, by rising time."""
    best, front = np.inf, []
    for seconds, error in sorted(points):
        if error < best:
            front.append((seconds, error))
            best = error
    return front


def figure(pictures: list[dict[str, Any]], gradients: list[dict[str, Any]], path: str) -> None:
    """One panel a scene: RMSE of the picture against its time, and relative error of the gradient against its time."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    knobs = list(dict.fromkeys(row["knob"] for row in pictures))
    names = list(dict.fromkeys(row["scene"] for row in pictures))
    columns = 3
    drawing = Figure(figsize=(4.6 * columns, 3.6 * -(-len(names) // columns)), layout="constrained")
    panels = drawing.subplots(-(-len(names) // columns), columns, squeeze=False).ravel()
    for panel, name in zip(panels, names, strict=False):
        rows = [row for row in pictures if row["scene"] == name]
        for knob in knobs:
            some = [row for row in rows if row["knob"] == knob]
            panel.plot([1e3 * r["seconds"] for r in some], [r["rmse"] for r in some], "o", markersize=4, color=f"C{knobs.index(knob)}",
                       label=knob)  # fmt: skip
        front = np.array(pareto([(row["seconds"], row["rmse"]) for row in rows]))
        panel.plot(1e3 * front[:, 0], front[:, 1], "-", color="0.4", linewidth=1, zorder=0, label="Pareto front")
        of_gradient = [row for row in gradients if row["scene"] == name]
        panel.plot([1e3 * r["seconds"] for r in of_gradient], [r["gradient_error"] for r in of_gradient], "kx", markersize=4,
                   label="gradient (relative)")  # fmt: skip
        panel.set(title=name, xscale="log", yscale="log", xlabel="milliseconds", ylabel="error")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter(NullFormatter())
    drawing.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False)
    for panel in panels[len(names) :]:
        panel.set_axis_off()
    drawing.savefig(path, dpi=130)


def machine() -> dict[str, Any]:
    """What it was measured on."""
    versions = {"jvr": jvr.__version__, "jax": jax.__version__, "python": platform.python_version()}
    return {"date": datetime.date.today().isoformat(), "device": str(jax.devices()[0].device_kind), **versions}


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
