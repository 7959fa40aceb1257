"""What ambient occlusion and in-scattering cost in time and error: each method over its knobs, against brute force.

`python experiments/occlusion_accuracy.py [--json FILE] [--figure FILE] [--quick] [--only surface]`; the embedded volume, opaque, with all
knobs; translucent, and a CT of a head where `$JVR_DATA` has it, with few. Errors are of the factor that light is multiplied with, whose
largest value is 1: root mean squares over points in all that is visible, and over those that a picture shows. Brute force is
`experiments/numpy_occlusion.py`, in double precision: thousands of directions from each point, four samples a voxel. In-scattering is that
of one directional light; its truth follows shadow rays to their ends, from fewer points in fewer directions. Occlusion of surfaces is that
of an isosurface where the ramp begins.
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
from scipy.stats import spearmanr

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments import numpy_occlusion
from experiments.accuracy_vs_time import machine
from experiments.protocols import head_volume
from jvr.io.demo import demo_volume
from jvr.march.secondary import points
from jvr.rendering.medium import absorbing, occupancy, visibility

RADIUS, OFFSET, REACH = 16.0, 1.0, 30.0  # in voxels
LIGHT = np.array([0.6, 0.8, -0.5])


class Subject(NamedTuple):
    """A scene without occlusion, the same without jvr, and points in it: grid positions `(n, 3)`, the first `seen` of them where a picture
    shows it. `rays`: of brute force from each."""

    name: str
    scene: Any
    medium: numpy_occlusion.Medium
    camera: jvr.PerspectiveCamera
    points: np.ndarray
    seen: int
    rays: int


def subjects(quick: bool) -> list[Subject]:
    """Every subject; smaller where that is to be `quick`."""
    count, rays, size = (40, 500, 40) if quick else (300, 4096, 128)
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
    return [_subject(name, *scene, count, rays, size) for name, scene in scenes.items()]


def _subject(name: str, volume: jvr.Volume, transfer: Any, count: int, rays: int, size: int) -> Subject:
    center, away = np.asarray(volume.center), 3.5 * float(volume.radius)
    eye = center + away * np.array([0.5, -0.8, 0.33])
    camera = jvr.PerspectiveCamera.look_at(eye, center, [0, 0, 1], 34.0, size, size)
    scene = jvr.Scene(volume, transfer, lights=(jvr.AmbientLight(),), shading=jvr.Lambert())
    numbers = (volume.values, volume.world_from_grid, transfer.positions, transfer.sigma_t)
    medium = numpy_occlusion.Medium(*(np.asarray(x, np.float64) for x in numbers))
    rng = np.random.default_rng(0)
    picture = jax.jit(jvr.render)(dataclasses.replace(scene, lights=(), shading=None), camera)
    pixels = np.flatnonzero(np.asarray(picture.alpha).ravel() > 0.5)
    seen = _places(camera, picture.depth, rng.choice(pixels, min(count, pixels.size), replace=False), medium)
    # Anywhere in what absorbs.
    anywhere = rng.uniform(0, np.array(volume.shape) - 1, (200 * count, 3))
    matter = anywhere[medium.extinction(anywhere) > 0][:count]
    return Subject(name, scene, medium, camera, np.concatenate([seen, matter]), len(seen), rays)


def _places(camera: jvr.PerspectiveCamera, depth: Any, pixels: np.ndarray, medium: numpy_occlusion.Medium) -> np.ndarray:
    """Grid positions `(pixels, 3)` of what some pixels show."""
    origin, direction = (np.stack(v, axis=1).astype(np.float64) for v in camera.rays(jnp.asarray(pixels)))
    world = origin + np.asarray(depth, np.float64).ravel()[pixels, None] * direction
    inverse = np.linalg.inv(medium.world_from_grid)
    return world @ inverse[:3, :3].T + inverse[:3, 3]


def varied(make: Callable[..., Any], knobs: dict[str, tuple[Any, ...]], quick: bool) -> list[tuple[str, Any]]:
    """Knob and method: the defaults, and every knob from coarse to fine beside the defaults of the others; but one of these if `quick`."""
    found = [("default", make())]
    return found + [(f"{k} {v:.3g}", make(**{k: v})) for k, values in knobs.items() for v in values][: 1 if quick else None]


def methods(quick: bool) -> dict[str, list[tuple[str, Any]]]:
    """What takes ambient light in the medium."""
    local = {"rays": (8, 64, 256), "samples": (4, 32), "resolution": (0.5, 0.25)}
    rows = {"bins": (8, 16), "shells": (1, 4, 16), "clusters": (2**10,), "rays": (8, 128), "resolution": (0.5,)}
    return {"local": varied(jvr.LocalOcclusion, local, quick), "histogram": varied(jvr.HistogramOcclusion, rows, quick)}


def ambient(subject: Subject, quick: bool) -> list[dict[str, Any]]:
    """A row for each method of the medium and knob."""
    scene, rows = subject.scene, []
    plain = _least(lambda: jvr.render(scene, subject.camera).rgb)
    truth = numpy_occlusion.in_ball(subject.medium, subject.points, subject.rays, (OFFSET, RADIUS))
    for method, knobs in methods(quick).items():
        for knob, occlusion in knobs:
            row, kept = costs(subject, plain, dataclasses.replace(scene, occlusion=occlusion))
            found = np.asarray(_factors(kept, _points(subject.points)), np.float64)
            rows.append({"method": method, "knob": knob, **row, **errors(found, truth, subject.seen)})
            if method == "histogram":
                rows[-1]["transfer_seconds"] = _least(lambda kept=kept: jax.block_until_ready(_visibility(kept)))
            show(rows[-1])
            jax.clear_caches()
    return rows


def scattered(subject: Subject, quick: bool) -> list[dict[str, Any]]:
    """A row for each knob of in-scattering, under one directional light."""
    few = np.r_[0 : subject.seen : 5, subject.seen : len(subject.points) : 5]
    where, seen = subject.points[few], int(np.count_nonzero(few < subject.seen))
    truth = numpy_occlusion.in_ball(subject.medium, where, subject.rays // 16, (OFFSET, RADIUS), LIGHT)
    scene, rows = dataclasses.replace(subject.scene, lights=(jvr.DirectionalLight(LIGHT),)), []
    plain = _least(lambda: jvr.render(scene, subject.camera).rgb)
    knobs = varied(jvr.InScattering, {"rays": (8, 64, 256), "samples": (4, 32), "resolution": (0.5, 0.25)}, quick)
    knobs += [] if quick else [("ShadowRays", jvr.InScattering(direct=jvr.ShadowRays()))]
    for knob, shadows in knobs:
        row, kept = costs(subject, plain, dataclasses.replace(scene, shadows=shadows))
        found = np.asarray(_lights(kept, _points(where)), np.float64)
        rows.append({"method": "in-scattering", "knob": knob, **row, **errors(found, truth, seen)})
        show(rows[-1])
        jax.clear_caches()
    return rows


def surfaces(subject: Subject, quick: bool) -> list[dict[str, Any]]:
    """A row for each knob of the occlusion of an isosurface, at the points that a picture shows."""
    level = float(subject.medium.positions[np.flatnonzero(subject.medium.sigma_t)[0] - 1])
    surface = jvr.Isosurfaces([level], np.ones((1, 3)))
    scene = dataclasses.replace(subject.scene, transfer=jvr.ClearTransfer(), surfaces=surface)
    free, rng = jvr.render(scene, subject.camera), np.random.default_rng(2)
    plain = _least(lambda: jvr.render(scene, subject.camera).rgb)
    pixels = rng.choice(np.flatnonzero(np.asarray(free.alpha).ravel() > 0.5), subject.seen, replace=False)
    where = _places(subject.camera, free.depth, pixels, subject.medium)
    eye = np.asarray(subject.camera.world_from_camera, np.float64)[:3, 3]
    truth = numpy_occlusion.above_surface(subject.medium, level, where, eye, subject.rays // 2, REACH)
    fields = {"rays": (8, 32, 128), "tilt": (0.1,)}
    knobs = varied(jvr.SurfaceOcclusion, fields, quick)
    knobs += [] if quick else [(f"steps {n}", jvr.SurfaceOcclusion(steps=n, factor=REACH / n)) for n in (5, 10, 60)]
    knobs += [] if quick else [("all fine", jvr.SurfaceOcclusion(256, steps=60, factor=REACH / 60))]
    rows = []
    for knob, occlusion in knobs:
        row, kept = costs(subject, plain, dataclasses.replace(scene, occlusion=occlusion))
        share = np.asarray(jvr.render(kept, subject.camera).rgb) / np.maximum(np.asarray(free.rgb), 1e-9)
        rows.append({"method": "surface", "knob": knob, **row, **errors(share[..., 0].ravel()[pixels], truth, len(truth))})
        show(rows[-1])
        jax.clear_caches()
    return rows


PARTS = {"ambient": ambient, "in-scattering": scattered, "surface": surfaces}


def costs(subject: Subject, plain: float, scene: Any) -> tuple[dict[str, float], Any]:
    """Seconds of what is computed beforehand, and of a picture over `plain`, those of one without; and the scene that keeps it."""
    kept = jvr.precompute(scene)
    seconds = _least(lambda: jax.tree.leaves(jvr.precompute(scene)), repeats=2)
    return {"projection_seconds": seconds, "picture": _least(lambda: jvr.render(kept, subject.camera).rgb) / plain}, kept


def errors(found: np.ndarray, truth: np.ndarray, seen: int) -> dict[str, float]:
    """Of factors at the `seen` points that a picture shows, and at the others."""
    parts = {"seen": slice(0, seen), "matter": slice(seen, None)}
    row: dict[str, float] = {}
    for name, part in parts.items():
        if truth[part].size:
            error = found[part] - truth[part]
            row |= {f"rmse_{name}": float(np.sqrt(np.mean(error**2))), f"largest_{name}": float(np.abs(error).max())}
            row[f"rank_correlation_{name}"] = float(np.asarray(spearmanr(found[part], truth[part])[0]))
            row[f"without_{name}"] = float(np.sqrt(np.mean((1 - truth[part]) ** 2)))
    return row


def _points(where: np.ndarray) -> Any:
    return points(tuple(jnp.asarray(c, jnp.float32) for c in where.T), (jnp.ones(len(where)),) * 3)


@jax.jit
def _visibility(scene: jvr.Scene) -> Any:
    assert scene.occlusion is not None
    return scene.occlusion.visibility(scene, lambda graded: absorbing(scene, None, graded))


@jax.jit
def _factors(scene: jvr.Scene, at: Any) -> Any:
    return _visibility(scene).transmittances(at, jnp.ones(at.p[0].shape, bool), reverse=False).ambient[0]


@jax.jit
def _lights(scene: jvr.Scene, at: Any) -> Any:
    found = visibility(scene, occupancy(scene, jvr.Settings()))
    assert found is not None
    return found.transmittances(at, jnp.ones(at.p[0].shape, bool), reverse=False).lights[0][0]


def _least(work: Callable[[], Any], repeats: int = 5) -> float:
    """The least seconds that something takes, after a first time."""
    jax.block_until_ready(work())
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - began)
    return min(times)


def heading(subject: Subject) -> None:
    print(f"\n{subject.name}")
    print(f"{'method':<15}{'knob':<18}{'seen':>8}{'matter':>8}{'largest':>9}{'without':>9}{'s':>8}{'picture':>9}", flush=True)


def show(r: dict[str, Any]) -> None:
    """Errors at points that are seen, in all matter, the largest; that of no occlusion at all; times."""
    numbers = f"{r['rmse_seen']:>8.4f}{r.get('rmse_matter', np.nan):>8.4f}{r['largest_seen']:>9.3f}{r['without_seen']:>9.3f}"
    print(f"{r['method']:<15}{r['knob']:<18}{numbers}{r['projection_seconds']:>8.2f}{r['picture']:>8.2f}x", flush=True)


def figure(results: list[dict[str, Any]], path: str) -> None:
    """One panel a subject: error against the time of the projection, a mark for each method of the medium and knob."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(5.0 * len(results), 4.4), layout="constrained")
    panels = drawing.subplots(1, len(results), squeeze=False)[0]
    for panel, result in zip(panels, results, strict=True):
        for k, method in enumerate(dict.fromkeys(row["method"] for row in result["rows"] if row["method"] != "surface")):
            rows = [row for row in result["rows"] if row["method"] == method]
            at = [row["projection_seconds"] for row in rows], [row["rmse_seen"] for row in rows]
            panel.plot(*at, "o", markersize=4, color=f"C{k}", label=method)
            for row, x, y in zip(rows, *at, strict=True):
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
    parser.add_argument("--only", choices=PARTS, help="this part alone; others stay as they are in the JSON")
    arguments = parser.parse_args()
    old_file = Path(arguments.json) if arguments.only and arguments.json else None
    before = json.loads(old_file.read_text())["subjects"] if old_file and old_file.exists() else []
    results = []
    for k, subject in enumerate(subjects(arguments.quick)):
        heading(subject)
        parts = [PARTS[arguments.only]] if arguments.only else PARTS.values()
        rows = [row for part in parts for row in part(subject, arguments.quick or k > 0)]
        new = {row["method"] for row in rows}
        kept = [row for old in before if old["subject"] == subject.name for row in old["rows"] if row["method"] not in new]
        results.append({"subject": subject.name, "voxels": subject.scene.volume.shape, "rows": kept + rows})
        if arguments.json:
            Path(arguments.json).write_text(json.dumps({"machine": machine(), "subjects": results}, indent=2) + "\n")
        if arguments.figure:
            figure(results, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
