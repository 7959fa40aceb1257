"""What ambient occlusion costs in time and error: each method over its knobs, against brute force.

`python experiments/occlusion_accuracy.py [--json FILE] [--figure FILE] [--quick]`; the embedded volume, opaque and translucent, and a
CT of a head where `$JVR_DATA` has it. Errors are of the factor that ambient light is multiplied with, whose largest value is 1: root mean
squares over points in all that is visible, and over those that a picture shows. Brute force is NumPy's in double precision: thousands of
random directions from each point, four samples a voxel.
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.stats import spearmanr

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.accuracy_vs_time import machine
from experiments.protocols import head_volume
from jvr.io.demo import demo_volume
from jvr.march.secondary import points
from jvr.rendering.medium import absorbing

RADIUS, OFFSET = 16.0, 1.0  # in voxels
AMBIENT = (jvr.AmbientLight(),)


class Subject(NamedTuple):
    """A scene without occlusion, points in it (grid positions `(n, 3)`, the first `seen` of them where a picture shows it), and their true
    factors."""

    name: str
    scene: Any
    camera: jvr.PerspectiveCamera
    points: np.ndarray
    seen: int
    truth: np.ndarray


def subjects(quick: bool) -> list[Subject]:
    """Every subject with its truth; smaller where that is to be `quick`."""
    count, rays = (40, 500) if quick else (300, 4096)
    volume = demo_volume()
    if quick:
        volume = jvr.Volume(np.asarray(volume.values)[::3, ::3, ::3], np.diag([3.0, 3.0, 3.6, 1.0]))
    ramp = lambda *sigma_t: jvr.LinearTransfer([0.1, 0.3, 0.45, 0.6, 1.0], [[1, 1, 1]] * 5, sigma_t)
    scenes = {"opaque": (volume, ramp(0.0, 0.0, 0.0, 2.0, 2.0))}
    if not quick:
        scenes["translucent"] = (volume, ramp(0.0, 0.02, 0.05, 0.1, 0.2))
    head = None if quick else head_volume()
    if head is not None:
        scenes["CT of a head"] = (head, jvr.LinearTransfer([0.45, 0.55, 1.0], [[1, 1, 1]] * 3, [0.0, 0.5, 0.5]))
    return [_subject(name, *scene, count, rays) for name, scene in scenes.items()]


def _subject(name: str, volume: jvr.Volume, transfer: Any, count: int, rays: int) -> Subject:
    center, away = np.asarray(volume.center), 3.5 * float(volume.radius)
    eye = center + away * np.array([0.5, -0.8, 0.33])
    camera = jvr.PerspectiveCamera.look_at(eye, center, [0, 0, 1], 34.0, 128, 128)
    scene = jvr.Scene(volume, transfer, lights=AMBIENT, shading=jvr.Lambert())
    rng = np.random.default_rng(0)
    picture = jax.jit(jvr.render)(dataclasses.replace(scene, lights=(), shading=None), camera)
    pixels = np.flatnonzero(np.asarray(picture.alpha).ravel() > 0.5)
    pixels = rng.choice(pixels, min(count, pixels.size), replace=False)
    origin, direction = (np.stack(v, axis=1).astype(np.float64) for v in camera.rays(jnp.asarray(pixels)))
    world = origin + np.asarray(picture.depth, np.float64).ravel()[pixels, None] * direction
    inverse = np.linalg.inv(np.asarray(volume.world_from_grid, np.float64))
    seen = world @ inverse[:3, :3].T + inverse[:3, 3]
    # Anywhere in what absorbs.
    anywhere = rng.uniform(0, np.array(volume.shape) - 1, (200 * count, 3))
    values = map_coordinates(np.asarray(volume.values, np.float64), anywhere.T, order=1)
    matter = anywhere[np.interp(values, transfer.positions, transfer.sigma_t) > 0][:count]
    where = np.concatenate([seen, matter])
    return Subject(name, scene, camera, where, len(seen), brute_force(scene, where, rays))


def brute_force(scene: Any, where: np.ndarray, rays: int) -> np.ndarray:
    """Factors at grid positions, without jvr."""
    volume, transfer = scene.volume, scene.transfer
    values, matrix = np.asarray(volume.values, np.float64), np.asarray(volume.world_from_grid, np.float64)
    spacing = float(np.min(np.linalg.norm(matrix[:3, :3], axis=0)))
    directions = np.random.default_rng(1).normal(size=(rays, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    along = directions @ np.linalg.inv(matrix[:3, :3]).T
    steps = round(4 * (RADIUS - OFFSET))
    dt = spacing * (RADIUS - OFFSET) / steps
    distances = spacing * OFFSET + dt * (np.arange(steps) + 0.5)
    found = []
    for start in where:
        at = start + along[:, None] * distances[:, None]
        inside = np.all((at >= 0) & (at <= np.array(values.shape) - 1), axis=-1)
        s = map_coordinates(values, at.reshape(-1, 3).T, order=1, mode="nearest").reshape(inside.shape)
        dtau = np.where(inside, np.interp(s, transfer.positions, transfer.sigma_t), 0.0) * dt
        before = np.cumsum(dtau, axis=1) - dtau
        mean = np.where(dtau > 0, -np.expm1(-dtau) / np.where(dtau > 0, dtau, 1.0), 1.0)
        found.append(np.mean(np.exp(-before) * mean))
    return np.array(found)


def methods(quick: bool) -> list[tuple[str, str, Any]]:
    """Method, knob and occlusion, from coarse to fine; every knob beside the defaults of the others."""
    found = [("local", "default", jvr.LocalOcclusion()), ("histogram", "default", jvr.HistogramOcclusion())]
    sets: dict[str, Any] = {"rays": (8, 16, 64, 256), "samples": (4, 8, 32), "resolution": (0.25, 1 / 3, 1.0)}
    found += [("local", f"{k} {v:.2g}", jvr.LocalOcclusion(**{k: v})) for k, values in sets.items() for v in values]
    sets = {"bins": (8, 16, 64), "rays": (8, 128), "resolution": (0.25,)}
    found += [("histogram", f"{k} {v:.2g}", jvr.HistogramOcclusion(**{k: v})) for k, values in sets.items() for v in values]
    return found[:3] if quick else found


def measured(subject: Subject, quick: bool) -> dict[str, Any]:
    """A row for each method and knob."""
    at = points(tuple(jnp.asarray(c, jnp.float32) for c in subject.points.T), (jnp.ones(len(subject.points)),) * 3)
    drawn = lambda scene: jvr.render(scene, subject.camera).rgb
    plain, rows = _least(lambda: drawn(subject.scene)), []
    for method, knob, occlusion in methods(quick):
        scene = dataclasses.replace(subject.scene, occlusion=occlusion)
        kept = jvr.precompute(scene)
        projection = _least(lambda scene=scene: jax.tree.leaves(jvr.precompute(scene)), repeats=2)
        found = np.asarray(_factors(kept, at), np.float64)
        row = {"method": method, "knob": knob, "projection_seconds": projection}
        row["picture"] = _least(lambda kept=kept: drawn(kept)) / plain
        for name, part in (("seen", slice(0, subject.seen)), ("matter", slice(subject.seen, None))):
            error = found[part] - subject.truth[part]
            row |= {f"rmse_{name}": float(np.sqrt(np.mean(error**2))), f"largest_{name}": float(np.abs(error).max())}
            row[f"rank_correlation_{name}"] = float(np.asarray(spearmanr(found[part], subject.truth[part])[0]))
        if method == "histogram":
            row["transfer_seconds"] = _least(lambda kept=kept: jax.block_until_ready(_visibility(kept)))
        rows.append(row)
        jax.clear_caches()
    none = {name: float(np.sqrt(np.mean((1 - subject.truth[part]) ** 2))) for name, part in _parts(subject).items()}
    return {"subject": subject.name, "voxels": subject.scene.volume.shape, "without": none, "rows": rows}


def _parts(subject: Subject) -> dict[str, slice]:
    return {"seen": slice(0, subject.seen), "matter": slice(subject.seen, None)}


@jax.jit
def _visibility(scene: jvr.Scene) -> Any:
    assert scene.occlusion is not None
    return scene.occlusion.visibility(scene, lambda graded: absorbing(scene, None, graded))


@jax.jit
def _factors(scene: jvr.Scene, at: Any) -> Any:
    return _visibility(scene).transmittances(at, jnp.ones(at.p[0].shape, bool), reverse=False).ambient[0]


def _least(work: Callable[[], Any], repeats: int = 5) -> float:
    """The least seconds that something takes, after a first time."""
    jax.block_until_ready(work())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - began)
    return min(times)


def show(result: dict[str, Any]) -> None:
    none = result["without"]
    print(f"\n{result['subject']}: without occlusion RMSE {none['seen']:.3f} of what is seen, {none['matter']:.3f} of all matter")
    print(f"{'method':<12}{'knob':<18}{'seen':>8}{'matter':>8}{'largest':>9}{'s':>8}{'picture':>9}")
    for r in result["rows"]:
        numbers = f"{r['rmse_seen']:>8.4f}{r['rmse_matter']:>8.4f}{r['largest_seen']:>9.3f}"
        print(f"{r['method']:<12}{r['knob']:<18}{numbers}{r['projection_seconds']:>8.2f}{r['picture']:>8.2f}x", flush=True)


def figure(results: list[dict[str, Any]], path: str) -> None:
    """One panel a subject: error against the time of the projection, a mark for each method and knob."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(5.0 * len(results), 4.4), layout="constrained")
    panels = drawing.subplots(1, len(results), squeeze=False)[0]
    for panel, result in zip(panels, results, strict=True):
        for k, method in enumerate(("local", "histogram")):
            rows = [row for row in result["rows"] if row["method"] == method]
            seconds, errors = ([r[key] for r in rows] for key in ("projection_seconds", "rmse_seen"))
            panel.plot(seconds, errors, "o", markersize=4, color=f"C{k}", label=method)
            for row, x, y in zip(rows, seconds, errors, strict=True):
                panel.annotate(row["knob"], (x, y), (4, 3), textcoords="offset points", fontsize=6, color=f"C{k}")
        panel.axhline(0.03, color="0.6", linewidth=0.8, linestyle=":")
        panel.set(
            title=result["subject"], xscale="log", yscale="log", xlabel="seconds of the projection", ylabel="RMSE of the factor"
        )
    panels[0].legend(frameon=False)
    drawing.savefig(path, dpi=130)


def main() -> None:
    """Measures, prints a line for each method and knob, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of error against time")
    parser.add_argument("--quick", action="store_true", help="small volumes, few methods")
    arguments = parser.parse_args()
    results = []
    for subject in subjects(arguments.quick):
        results.append(measured(subject, arguments.quick))
        show(results[-1])
        if arguments.json:
            Path(arguments.json).write_text(json.dumps({"machine": machine(), "subjects": results}, indent=2) + "\n")
        if arguments.figure:
            figure(results, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
