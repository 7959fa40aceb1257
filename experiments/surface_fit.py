"""Isovalue, poses and reflectance of an isosurface, found from six noisy views, and what its silhouettes are worth.

`JVR_DATA=... python experiments/surface_fit.py [--json FILE] [--figure FILE] [--quick]`; the bones of a CT of a head (or the embedded
volume where there is no scan) under two lights. Unknown are the isovalue, where each of six cameras was, and three numbers of Blinn
and Phong's reflectance; the fit starts some voxels, degrees and millimetres away. Pictures are jvr's own, and those of a renderer that
shares nothing with it (`experiments/numpy_surfaces.py`), with one ray a pixel and with nine, of which a pixel at a silhouette shows a
part of each side.

The derivative of a picture is that of what each ray meets; which ray meets it has none. Two measurements say what that costs:

- derivatives of pictures in isovalue and position, beside differences of pictures of 64 rays a pixel in which the surface moves by half a
  voxel, at silhouettes (pixels beside a jump in depth) and away from them;
- the same fits with all pixels, and with silhouettes of weight zero.
"""

import argparse
import dataclasses
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments import protocols
from experiments.numpy_surfaces import Surface
from experiments.numpy_surfaces import picture as by_numpy
from experiments.pose_recovery import apart as poses_apart
from jvr.io.demo import demo_volume

NOISE, VIEWS = 0.01, 6
RGB = np.array([0.95, 0.85, 0.70])
LIGHTS = np.array([[0.6, 0.8, -0.7], [-0.9, 0.2, -0.3]])
# Ambient, diffuse, specular, exponent; the first is known.
REFLECTANCE, START = (0.1, 0.55, 0.25, 20.0), (0.1, 0.45, 0.35, 12.0)
# How far off poses begin, in degrees and voxels, and the isovalue, in voxels.
TURN, SHIFT, OFF = 1.0, 0.7, 0.4
# Rays a pixel along rows and columns of the pictures whose differences are taken, and how far the surface moves to each side, in voxels.
FINE, MOVED = 8, 0.25
# Depths of neighbouring pixels that differ by more, in sides of a pixel where the surface is, are different things: a surface that is seen
# at 76 degrees changes as much.
JUMP = 4.0
FOV = 26.0


class Study(NamedTuple):
    """A scene and its cameras as they are, how much the scalar changes in a voxel where the surface is, and which pixels of each view are
    silhouettes."""

    name: str
    scene: Any
    cameras: tuple[jvr.PerspectiveCamera, ...]
    slope: float
    silhouettes: list[np.ndarray]


def study(quick: bool) -> Study:
    """Bones of a head where it is, else the embedded volume."""
    head = None if quick else protocols.head_volume()
    volume, name, level, size = (demo_volume(), "embedded volume", 0.45, 48) if head is None else (head, "CT of a head", 0.5, 64)
    if quick:
        volume = jvr.Volume(np.asarray(volume.values)[::3, ::3, ::3], np.diag([3.0, 3.0, 3.6, 1.0]))
        size = 28
    values = np.asarray(volume.values, float)
    near = np.abs(values - level) < 0.1
    slope = float(np.median(np.linalg.norm(np.gradient(values), axis=0)[near]))
    scene = jvr.Scene(
        volume,
        surfaces=jvr.Isosurfaces([level], [RGB], step=0.5),
        lights=(*(jvr.DirectionalLight(way) for way in LIGHTS), jvr.AmbientLight(1.0)),
        shading=jvr.BlinnPhong(*REFLECTANCE),
        normals=jvr.CentralDifferences(),
    )
    away, views = 3.0 * float(volume.radius), 2 if quick else VIEWS
    cameras = jvr.fibonacci_sphere(np.asarray(volume.center), away, 2 * views + 1, FOV, size, size)[1::2]
    study = Study(name, scene, cameras, slope, [])
    jump = JUMP * away * 2 * np.tan(np.radians(FOV) / 2) / size
    return study._replace(silhouettes=[_jumps(by_numpy(surface_of(study), camera)[1], jump) for camera in cameras])


def surface_of(study: Study) -> Surface:
    """The surface of a study without jvr."""
    volume, (level,) = study.scene.volume, np.asarray(study.scene.surfaces.values, float)
    values, place = np.asarray(volume.values, float), np.asarray(volume.world_from_grid, float)
    return Surface(values, place, float(level), RGB, *REFLECTANCE, LIGHTS)


def _jumps(depth: np.ndarray, most: float) -> np.ndarray:
    """Pixels that are no farther than a pixel from a jump in depth."""
    depth = np.where(np.isfinite(depth), depth, 1e6)
    return binary_dilation(maximum_filter(depth, 3) - minimum_filter(depth, 3) > most)


def pictures(study: Study) -> dict[str, list[np.ndarray]]:
    """Pictures of each kind."""
    draw = jax.jit(jvr.render)
    return {
        "jvr": [np.asarray(draw(study.scene, camera).rgb) for camera in study.cameras],
        "NumPy": [by_numpy(surface_of(study), camera)[0] for camera in study.cameras],
        "NumPy, 9 rays a pixel": [by_numpy(surface_of(study), camera, 3)[0] for camera in study.cameras],
    }


def disturbed(study: Study) -> tuple[jvr.Scene, list[jvr.PerspectiveCamera]]:
    """Where fits start."""
    rng, center = np.random.default_rng(2), np.asarray(study.scene.volume.center, float)
    voxel, cameras = float(np.min(np.asarray(study.scene.volume.spacing))), []
    for camera in study.cameras:
        turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        rotation, pose = Rotation.from_rotvec(TURN * turn, degrees=True).as_matrix(), np.array(camera.world_from_camera, float)
        pose[:3, 3] = center + rotation @ (pose[:3, 3] - center) + SHIFT * voxel * shift
        pose[:3, :3] = rotation @ pose[:3, :3]
        cameras.append(jvr.PerspectiveCamera(pose, camera.fov_y, camera.width, camera.height))
    surfaces = dataclasses.replace(study.scene.surfaces, values=study.scene.surfaces.values + OFF * study.slope)
    return dataclasses.replace(study.scene, surfaces=surfaces, shading=jvr.BlinnPhong(*START)), cameras


def unknowns(scene: Any, cameras: Any) -> Any:
    shading: Any = scene.shading
    poses = [camera.world_from_camera for camera in cameras]
    return scene.surfaces.values, (shading.diffuse, shading.specular, shading.shininess), poses


def fitted(study: Study, images: list[np.ndarray], weights: list[np.ndarray] | None) -> dict[str, Any]:
    """How far a fit ends from the truth, and how sure it is; lengths and isovalue in voxels."""
    scene, cameras = disturbed(study)
    began = time.perf_counter()
    found = jvr.fit(scene, cameras, images, unknowns=unknowns, weights=weights, max_steps=30, progress=False)
    seconds = time.perf_counter() - began
    center, voxel = np.asarray(study.scene.volume.center, float), float(np.min(np.asarray(study.scene.volume.spacing)))
    ends = np.array([poses_apart(a, b, center) for a, b in zip(found.cameras, study.cameras, strict=True)])
    level_error, reflectance_errors, poses = found.standard_errors
    sure = np.array(poses)
    surfaces: Any = found.scene.surfaces
    level = float(surfaces.values[0] - study.scene.surfaces.values[0])
    return {
        "isovalue": level / study.slope,
        "isovalue_error": float(level_error[0]) / study.slope,
        "degrees": float(np.sqrt(np.mean(ends[:, 0] ** 2))),
        "degrees_error": float(np.sqrt(np.mean(np.sum(sure[:, :3] ** 2, axis=1)))),
        "voxels": float(np.sqrt(np.mean(ends[:, 1] ** 2))) / voxel,
        "voxels_error": float(np.sqrt(np.mean(np.sum(sure[:, 3:] ** 2, axis=1)))) / voxel,
        "reflectance": [float(x) for x in unknowns(found.scene, ())[1]],
        "reflectance_errors": [float(x) for x in reflectance_errors],
        "outcome": found.outcome.name,
        "steps": len(found.history),
        "seconds": seconds,
        "structured": bool(found.stats.structured),
    }


def derivatives(study: Study) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Of a picture of the first view, in the isovalue and in a shift across the view, beside differences: how large differences are at
    silhouettes and inside, and what of them derivatives miss; and both as images."""
    camera, settings = study.cameras[0], jvr.Settings(pixel_samples=FINE)
    voxel, pose = float(np.min(np.asarray(study.scene.volume.spacing))), np.asarray(camera.world_from_camera, float)
    across = np.zeros((4, 4))
    across[:3, 3] = pose[:3, 0] * voxel

    def seen(by: jax.Array) -> jax.Array:
        """The picture with the surface moved along its normal, and the camera, by so many voxels."""
        scene = eqx.tree_at(lambda s: s.surfaces.values, study.scene, study.scene.surfaces.values + by[0] * study.slope)
        there = jvr.PerspectiveCamera(pose + by[1] * jnp.asarray(across), camera.fov_y, camera.width, camera.height)
        return jvr.render(scene, there, settings).rgb

    # One program for pictures and derivatives.
    both = jax.jit(lambda by, along: jax.jvp(seen, (by,), (along,)))
    rows, images = {}, {}
    for i, name in enumerate(("isovalue", "position")):
        along, edge = jnp.eye(2)[i], study.silhouettes[0]
        derivative = np.asarray(both(jnp.zeros(2), along)[1], float)
        ahead, back = (np.asarray(both(by * along, along)[0], float) for by in (MOVED, -MOVED))
        difference = (ahead - back) / (2 * MOVED)
        norm = lambda x: float(np.sqrt(np.sum(np.square(x))))
        rows[name] = {
            "difference_at_silhouettes": norm(difference[edge]) / norm(difference),
            **{
                f"missing_{where}": norm((difference - derivative)[mask]) / norm(difference[mask])
                for where, mask in (("at_silhouettes", edge), ("inside", ~edge))
            },
        }
        images[f"{name}: difference"], images[f"{name}: derivative"] = difference, derivative
    return rows, images


def main() -> None:
    """Measures, prints two tables, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of pictures, silhouettes, derivatives and differences")
    parser.add_argument("--quick", action="store_true", help="two small views of the embedded volume")
    arguments = parser.parse_args()
    # Noise.
    warnings.filterwarnings("ignore", ".*negative values")
    of = study(arguments.quick)
    share = float(np.mean(of.silhouettes))
    clean, rng = pictures(of), np.random.default_rng(1)
    apart = np.stack([np.abs(a - b).max(axis=-1) for a, b in zip(clean["jvr"], clean["NumPy"], strict=True)])
    inside = ~np.stack(of.silhouettes)
    shown = {name: [image + rng.normal(0, NOISE, image.shape) for image in images] for name, images in clean.items()}
    report: dict[str, Any] = {"data": of.name, "views": len(of.cameras), "silhouettes": share, "start": list(START), "fits": []}
    report["renderers"] = {
        "largest_inside": float(apart[inside].max()),
        "rms_inside": float(np.sqrt(np.mean(apart[inside] ** 2))),
    }
    print(f"{of.name}, {len(of.cameras)} views of {of.cameras[0].width}^2, {share:.0%} of their pixels at silhouettes")
    print("the two renderers differ away from them by {largest_inside:.1e} at most".format(**report["renderers"]))
    slopes, images = derivatives(of)
    report["derivatives"] = slopes
    for name, row in slopes.items():
        print(f"{name}: " + ", ".join(f"{key.replace('_', ' ')} {value:.3f}" for key, value in row.items()))
    weights = [np.where(mask, 0.0, 1.0) for mask in of.silhouettes]
    print(f"{'pictures':<24}{'silhouettes':>12}{'isovalue':>20}{'degrees':>18}{'voxels':>18}{'steps':>7}{'seconds':>9}")
    for name, targets in shown.items():
        for kept in (True, False):
            row = {"pictures": name, "silhouettes": kept, **fitted(of, targets, None if kept else weights)}
            report["fits"].append(row)
            numbers = "".join(f"{row[key]:>10.4f} +-{row[f'{key}_error']:<7.4f}" for key in ("isovalue", "degrees", "voxels"))
            print(f"{name:<24}{'kept' if kept else 'left out':>12}{numbers}{row['steps']:>5}{row['seconds']:>9.1f}", flush=True)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(report, indent=1) + "\n")
    if arguments.figure:
        figure(of, shown, images, arguments.figure)


def figure(of: Study, shown: dict[str, list[np.ndarray]], images: dict[str, np.ndarray], path: str) -> None:
    """The first view by both renderers, what the start shows beside it, its silhouettes; derivatives and differences."""
    from matplotlib.figure import Figure

    scene, cameras = disturbed(of)
    start = np.asarray(jvr.render(scene, cameras[0]).rgb)
    first = {name: targets[0] for name, targets in shown.items()}
    top = {
        "jvr": first["jvr"],
        "NumPy, 9 rays a pixel": first["NumPy, 9 rays a pixel"],
        "the start less jvr's": 0.5 + start - first["jvr"],
        "silhouettes": np.repeat(1.0 * of.silhouettes[0][..., None], 3, axis=2),
    }
    drawing = Figure(figsize=(11, 5.9), layout="constrained")
    grid = drawing.subplots(2, 4)
    for axes, (title, image) in zip(grid[0], top.items(), strict=True):
        axes.imshow(jvr.srgb_from_linear(np.clip(image, 0, 1)), interpolation="nearest")
        axes.set(title=title, xticks=[], yticks=[])
    for axes, (title, image) in zip(grid[1], images.items(), strict=True):
        grey = image.mean(axis=-1)
        largest = float(np.percentile(np.abs(images[title.split(":")[0] + ": difference"].mean(axis=-1)), 98))
        axes.imshow(grey, cmap="coolwarm", vmin=-largest, vmax=largest, interpolation="nearest")
        axes.set(title=title, xticks=[], yticks=[])
    drawing.savefig(path, dpi=130)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
