"""Where a camera was: poses found again from one picture each, from up to 10 degrees and 20 mm away.

`JVR_DATA=... python experiments/pose_recovery.py [--json FILE] [--figure FILE] [--quick]`

Two kinds of pictures of a CT of a head (or of a phantom where there is no scan): through a transfer function, and an X-ray projection,
which only absorbs, as of DiffDRR (Gopalakrishnan and Golland 2022). All six numbers of a pose are unknown to a fit of one picture; 100
starts each are turned about the volume's centre by up to 10 degrees and moved by up to 20 mm, both in uniform directions and of uniform
length. The targets are drawn with four samples where the fit takes one, and have noise. A fit counts as a success where it ends within
a degree and a millimetre, by the rotation and the way of the volume's centre between the found and the true pose.
"""

import argparse
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks.peers import shapes
from benchmarks.poses import pose_step
from experiments import protocols
from jvr.model.camera import AbstractCamera

STARTS = 100
# Degrees, millimetres.
MOST_TURN, MOST_SHIFT = 10.0, 20.0
SUCCESS = (1.0, 1.0)
NOISE = 0.01
LEVELS = 1
SETTINGS = jvr.Settings(0.5)
FINE = jvr.Settings(0.125)
DISTANCE, HALF_ANGLE = 450.0, 0.3
# Scalar, red, green, blue, extinction per millimetre: translucent skin over bone.
POINTS = (
    (0.0, 0.0, 0.0, 0.0, 0.0),
    (0.30, 0.85, 0.55, 0.40, 0.0),
    (0.38, 0.90, 0.65, 0.45, 0.006),
    (0.44, 0.80, 0.35, 0.25, 0.01),
    (0.50, 0.90, 0.60, 0.45, 0.03),
    (0.75, 1.0, 0.95, 0.85, 0.2),
)


class Study(NamedTuple):
    """A scene, the cameras that its pictures are from, and these."""

    scene: jvr.Scene
    cameras: tuple[jvr.PerspectiveCamera, ...]
    images: list[np.ndarray]


def head() -> tuple[str, jvr.Volume]:
    """The CT of a head, or a phantom, with values 0 ... 1."""
    found = protocols.head_volume()
    if found is not None:
        return "CT of a head", found
    voxels, _ = shapes.phantom(48)
    place = np.diag([4.0, 4.0, 4.0, 1.0])
    return "phantom", jvr.Volume(np.clip(voxels / 1500, 0, 1).astype(np.float32), place)


def scenes(volume: jvr.Volume) -> dict[str, jvr.Scene]:
    """The two kinds of pictures."""
    ray = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [0.0, 0.04])
    cold = jvr.Scene(volume, ray, background=(1.0, 1.0, 1.0), optical=jvr.AbsorptionOnly())
    at, *rgb, sigma_t = np.asarray(POINTS).T
    lit = jvr.Scene(volume, jvr.LinearTransfer(at, np.stack(rgb, axis=1), sigma_t))
    return {"transfer function": lit, "X-ray": cold}


def study(scene: jvr.Scene, size: int, views: int, rng: np.random.Generator) -> Study:
    """Noisy pictures from all around, finer than any fit."""
    fov_y = float(np.degrees(2 * np.arctan(HALF_ANGLE)))
    # An odd rig, so that no axis of the volume is one of a picture.
    cameras = jvr.fibonacci_sphere(np.asarray(scene.volume.center), DISTANCE, 2 * views + 1, fov_y, size, size)[1::2]
    draw = jax.jit(jvr.render)
    clean = [np.asarray(draw(scene, camera, FINE).rgb) for camera in cameras]
    return Study(scene, cameras, [image + rng.normal(0, NOISE, image.shape).astype(np.float32) for image in clean])


def disturbed(camera: jvr.PerspectiveCamera, center: np.ndarray, rng: np.random.Generator) -> jvr.PerspectiveCamera:
    """A camera that is turned about the centre and moved."""
    turn, shift = (length * rng.uniform() * _direction(rng) for length in (MOST_TURN, MOST_SHIFT))
    rotation, pose = Rotation.from_rotvec(turn, degrees=True).as_matrix(), _pose(camera)
    pose[:3, 3] = center + rotation @ (pose[:3, 3] - center) + shift
    pose[:3, :3] = rotation @ pose[:3, :3]
    return jvr.PerspectiveCamera(pose, camera.fov_y, camera.width, camera.height)


def apart(one: AbstractCamera, other: AbstractCamera, center: np.ndarray) -> tuple[float, float]:
    """Degrees and millimetres between two poses: the rotation, and the way of the volume's centre as the camera sees it."""
    a, b = _pose(one), _pose(other)
    turn = Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).magnitude()
    places = [pose[:3, :3].T @ (center - pose[:3, 3]) for pose in (a, b)]
    return float(np.degrees(turn)), float(np.linalg.norm(places[0] - places[1]))


def _pose(camera: AbstractCamera) -> np.ndarray:
    matrix = np.asarray(camera.world_from_camera, np.float64)
    return matrix + np.asarray(camera.remainder.beside(camera.world_from_camera), np.float64)


def _direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def recovered(of: Study, start: jvr.PerspectiveCamera, view: int, levels: int) -> jvr.FitResult:
    """The fit of one pose to one picture."""
    return jvr.fit(
        of.scene,
        [start],
        [of.images[view]],
        settings=SETTINGS,
        unknowns=lambda scene, cameras: cameras[0].world_from_camera,
        coarse_levels=levels,
        progress=False,
    )


def run(name: str, of: Study, starts: int, levels: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """One row for each start."""
    center, rows = np.asarray(of.scene.volume.center, np.float64), []
    for i in range(starts):
        view = i % len(of.cameras)
        truth, start = of.cameras[view], disturbed(of.cameras[view], center, rng)
        began = time.perf_counter()
        result = recovered(of, start, view, levels)
        seconds = time.perf_counter() - began
        (found,), (errors,) = result.cameras, result.errors_by_name.values()
        before, after = apart(start, truth, center), apart(found, truth, center)
        rows.append({"view": view, "start": before, "end": after, "seconds": seconds, "steps": len(result.history)})
        rows[-1]["standard_errors"] = np.asarray(errors).tolist()
        if (i + 1) % 10 == 0:
            print(f"{name}, {levels} levels: {i + 1} of {starts} starts", file=sys.stderr, flush=True)
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    """What a table shows of the rows: medians are over the successes."""
    ends = np.array([row["end"] for row in rows])
    good = np.all(ends <= SUCCESS, axis=1)
    middle = np.median(ends[good], axis=0) if good.any() else np.full(2, np.nan)
    return {
        "success": float(np.mean(good)),
        "median_degrees": float(middle[0]),
        "median_mm": float(middle[1]),
        "median_seconds": float(np.median([row["seconds"] for row in rows])),
        "median_steps": float(np.median([row["steps"] for row in rows])),
    }


def main() -> None:
    """Runs both kinds with and without a coarse start, prints a table, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of pictures before and after, and of all ends over their starts")
    parser.add_argument("--quick", action="store_true", help="smaller pictures and few starts")
    arguments = parser.parse_args()
    size, starts = (24, 2) if arguments.quick else (48, STARTS)
    # Noise.
    warnings.filterwarnings("ignore", ".*negative values")
    data, volume = head()
    report: dict[str, Any] = {"data": data, "size": size, "starts": starts, "noise": NOISE, "success": SUCCESS, "kinds": {}}
    print(f"{data}, {size}^2 pictures, {starts} starts")
    print(f"{'pictures':<20}{'levels':>7}{'success':>9}{'degrees':>9}{'mm':>8}{'seconds':>9}{'steps':>7}")
    studies = {}
    for name, scene in scenes(volume).items():
        of = studies[name] = study(scene, size, 4, np.random.default_rng(1))
        kind: dict[str, Any] = {"cost": pose_step(of.scene, of.cameras, of.images, SETTINGS), "runs": {}}
        for levels in (0, LEVELS):
            # The same starts with and without the coarse levels.
            rows = run(name, of, starts, levels, np.random.default_rng(2))
            kind["runs"][str(levels)] = {**summary(rows), "rows": rows}
            shown = "{success:>9.0%}{median_degrees:>9.3f}{median_mm:>8.3f}{median_seconds:>9.1f}{median_steps:>7.0f}"
            print(f"{name:<20}{levels:>7}{shown.format(**kind['runs'][str(levels)])}")
        print(f"{name}: a step of all poses takes {kind['cost']['step_over_pictures']:.2f} pictures of the same views")
        report["kinds"][name] = kind
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(report, indent=1) + "\n")
    if arguments.figure:
        figure(report, studies, arguments.figure)


def figure(report: dict[str, Any], studies: dict[str, Study], path: str) -> None:
    """For each kind a target, what the start showed and what the fit shows, and where all fits began and ended."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(11, 5.6), layout="constrained")
    grid = drawing.subplots(len(studies), 4, width_ratios=(1, 1, 1, 1.6))
    draw = jax.jit(jvr.render)
    for line, (name, of) in zip(grid, studies.items(), strict=True):
        rng, center = np.random.default_rng(2), np.asarray(of.scene.volume.center, np.float64)
        start = disturbed(of.cameras[0], center, rng)
        found = recovered(of, start, 0, LEVELS).cameras[0]
        shown = {"target": of.images[0]}
        for title, camera in (("start - target", start), ("found - target", found)):
            shown[title] = 0.5 + np.asarray(draw(of.scene, camera, SETTINGS).rgb) - of.images[0]
        for axes, (title, image) in zip(line, shown.items(), strict=False):
            axes.imshow(jvr.srgb_from_linear(np.clip(image, 0, 1)), interpolation="nearest")
            axes.set(title=f"{name}: {title}" if title == "target" else title, xticks=[], yticks=[])
        axes = line[-1]
        for levels, marker in (("0", "x"), (str(LEVELS), "o")):
            rows = report["kinds"][name]["runs"][levels]["rows"]
            before, after = (np.array([row[key] for row in rows]) for key in ("start", "end"))
            label = "sharp pictures alone" if levels == "0" else f"{levels} coarse level first"
            axes.scatter(before[:, 0], after[:, 0], marker=marker, s=18, label=label, linewidths=0.9)
        axes.axhline(SUCCESS[0], color="0.6", linewidth=0.8)
        axes.set(xlabel="degrees at the start", ylabel="degrees at the end", yscale="log")
        axes.legend(frameon=False, fontsize="small")
    drawing.savefig(path, dpi=130)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
