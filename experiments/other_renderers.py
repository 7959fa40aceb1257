"""Pictures that other renderers made: how near jvr comes with their transfer function, and how well it finds that function.

`JVR_DATA=... python experiments/other_renderers.py [--json FILE] [--figure FILE] [--quick] [--only CASE ...]`, or `--files FOLDER`

VTK's fixed-point ray caster and its GPU mapper (on the software rasteriser where there is no graphics card), without and with shading whose
coefficients are unknown to the fit (but the diffuse one, which colours and it have as their product alone), and Mitsuba for a medium that
absorbs alone. Seven views are fitted and one is kept aside. For each: the PSNR of jvr's picture of the known function, that of the fit (of
the view that was kept aside), the RMSE of the opacity of a voxel and the share of values within two standard errors, both over what the
pictures determine, and the time of the fit. What is not installed is left out; without scans a phantom stands for them. `--files`
writes what a user of VTK has at hand, eight screenshots, their cameras and a rough preset: those of configs/vtk.toml.
"""

import argparse
import dataclasses
import functools
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks.peers import ours, scenes, shapes

ENTRIES = 32
VIEWS = 8
STEP = 0.5
# VTK's mappers end a ray at this transmittance.
TERMINATION = 1 / 255
# VTK's coefficients of reflection, and the exponent of its highlights.
AMBIENT, DIFFUSE, SPECULAR, EXPONENT = 0.3, 0.6, 0.3, 10.0
# Where a fit starts with those that it does not know: ambient, specular, exponent.
GUESS = 0.5, 0.1, 5.0
# Of Mitsuba, a pixel.
SAMPLES = 256
DOMAIN = (-1000.0, 1500.0)
# Scalar, red, green, blue, extinction per millimetre.
POINTS = (
    (-500, 0.85, 0.55, 0.40, 0.0),
    (-100, 0.90, 0.65, 0.45, 0.006),
    (40, 0.80, 0.35, 0.25, 0.003),
    (200, 0.90, 0.60, 0.45, 0.02),
    (700, 1.0, 0.95, 0.85, 0.2),
)


@dataclasses.dataclass(frozen=True)
class Case:
    """Pictures of another renderer, and what made them, as jvr has it."""

    truth: jvr.Scene
    cameras: tuple[jvr.PerspectiveCamera, ...]
    images: list[np.ndarray]
    settings: jvr.Settings
    unknowns: Callable[[jvr.Scene], Any]
    start: jvr.Scene


def cases(size: int, quick: bool) -> dict[str, Callable[[], Case]]:
    """The cases by name, those whose renderer is installed."""
    found: dict[str, Callable[[], Case]] = {}
    if importlib.util.find_spec("vtk"):
        for subject in subjects(quick):
            for mapper, kind in (("GPU", "GpuRenderer"), ("fixed-point", "Renderer")):
                for shaded in (False, True):
                    title = f"VTK {mapper}, {subject.data}{', shaded' if shaded else ''}"
                    found[title] = functools.partial(vtk_case, subject, kind, shaded, size)
    if importlib.util.find_spec("mitsuba"):
        found["Mitsuba, absorption"] = functools.partial(mitsuba_case, size, 16 if quick else 48)
    return found


def subjects(quick: bool) -> list[scenes.Scene]:
    """Scans, or a phantom where they are absent."""
    files = {"CT of a torso": "ct_torso/example_ct.nii.gz", "CT of a head": "ct_head_quarter/ct_head_quarter.mhd"}
    folder, found = Path(os.environ.get("JVR_DATA", "data")), []
    for name, file in files.items():
        if not quick and (folder / file).exists():
            volume = jvr.read_volume(folder / file)
            found.append(subject(name, np.asarray(volume.values, np.int16), np.asarray(volume.spacing, float)))
    voxels, spacing = shapes.phantom(20 if quick else 64)
    return found or [subject("phantom", voxels, np.full(3, spacing))]


def subject(name: str, voxels: np.ndarray, spacing: np.ndarray) -> scenes.Scene:
    """A volume around the origin with translucent skin and bone; the scan's own orientation plays no part."""
    hull = (np.asarray(voxels.shape) - 1) * spacing
    at, *columns = np.asarray(POINTS).T
    table = np.stack([np.interp(np.linspace(*DOMAIN, ENTRIES), at, column) for column in columns], axis=1)
    place = tuple(map(float, spacing)), tuple(map(float, -hull / 2))
    return scenes.Scene("skin", name, voxels, *place, table[:, :3], table[:, 3], DOMAIN, view((0, -1, 0), hull, 1))


def view(direction: Any, hull: np.ndarray, size: int) -> scenes.View:
    """From a direction, the whole volume in the picture."""
    up = (0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (0.0, 1.0, 0.0)
    eye = 1.1 * float(np.linalg.norm(hull)) * np.asarray(direction)
    return scenes.View(tuple(map(float, eye)), (0.0, 0.0, 0.0), up, 50.0, size, size)


def views(scene: scenes.Scene, size: int) -> list[scenes.Scene]:
    """The scene seen from the directions of a Fibonacci sphere."""
    i = np.arange(VIEWS) + 0.5
    z, angle = 1 - 2 * i / VIEWS, np.pi * (1 + 5**0.5) * i
    directions = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    return [dataclasses.replace(scene, view=view(direction, scene.hull, size)) for direction in directions]


def vtk_case(scene: scenes.Scene, kind: str, shaded: bool, size: int) -> Case:
    """Pictures of one of VTK's mappers, in 8 bits."""
    from benchmarks.peers import vtk_mappers

    images, seen = [], views(scene, size)
    for one in seen:
        renderer = getattr(vtk_mappers, kind)(one)
        renderer.prepare(STEP)
        if shaded:
            renderer.look.ShadeOn()
            renderer.look.SetAmbient(AMBIENT)
            renderer.look.SetDiffuse(DIFFUSE)
            renderer.look.SetSpecular(SPECULAR)
            renderer.look.SetSpecularPower(EXPONENT)
        renderer.draw()
        images.append(np.asarray(renderer.picture(), np.float32))
    truth, settings = ours.scene_of(scene), jvr.Settings(STEP, termination=TERMINATION)
    table = lambda s: (s.transfer.rgb, s.transfer.sigma_t)
    if not shaded:
        return Case(truth, _cameras(seen), images, settings, table, eqx.tree_at(table, truth, _flat(scene)))
    light = {"lights": (jvr.HeadLight(1.0), jvr.AmbientLight(1.0))}
    # The GPU mapper mirrors, the ray caster has half vectors; both take central differences.
    look = jvr.Phong if kind == "GpuRenderer" else jvr.BlinnPhong
    shading = look(AMBIENT, DIFFUSE, SPECULAR, EXPONENT)
    truth = dataclasses.replace(truth, shading=shading, normals=jvr.CentralDifferences(), **light)
    both = lambda s: (*table(s), s.shading.ambient, s.shading.specular, s.shading.shininess)
    return Case(
        truth, _cameras(seen), images, settings, both, eqx.tree_at(both, truth, (*_flat(scene), *map(jnp.asarray, GUESS)))
    )


def mitsuba_case(size: int, n: int) -> Case:
    """A medium that absorbs before a white sky; Mitsuba's extinction is linear in the scalar, and so is the table."""
    from benchmarks.peers import paths

    scene = scenes.fog(n, size)
    x = np.linspace(0, 1, ENTRIES)
    scene = dataclasses.replace(
        scene, rgb=np.zeros((ENTRIES, 3)), sigma_t=np.interp(x, np.linspace(0, 1, len(scene.sigma_t)), scene.sigma_t)
    )
    images, seen = [], views(scene, size)
    for one in seen:
        renderer = paths.Renderer(one)
        renderer.prepare(SAMPLES)
        renderer.draw()
        images.append(np.asarray(renderer.picture(), np.float32))
    truth, extinction = ours.scene_of(scene), lambda s: s.transfer.sigma_t
    start = eqx.tree_at(extinction, truth, _flat(scene)[1])
    return Case(truth, _cameras(seen), images, jvr.Settings(STEP, termination=0.0), extinction, start)


def _cameras(seen: list[scenes.Scene]) -> tuple[jvr.PerspectiveCamera, ...]:
    return tuple(ours.camera_of(one.view) for one in seen)


def _flat(scene: scenes.Scene) -> tuple[jax.Array, jax.Array]:
    """Grey, 2 % of the light stopped by a voxel."""
    return jnp.full((ENTRIES, 3), 0.5), jnp.full(ENTRIES, 0.02 / min(scene.spacing))


def run(case: Case) -> dict[str, Any]:
    """What the known function and a fit give."""
    *cameras, aside = case.cameras
    *images, kept_aside = case.images
    render = jax.jit(lambda scene, camera: jvr.render(scene, camera, case.settings).rgb)
    psnr = lambda scene: peak_signal_noise_ratio(kept_aside, np.asarray(render(scene, aside)), data_range=1.0)
    began = time.perf_counter()
    result = jvr.fit(case.start, cameras, images, unknowns=case.unknowns, settings=case.settings, progress=False)
    seconds = time.perf_counter() - began
    found, true, errors, determined = (
        np.concatenate([np.ravel(x).astype(float) for x in jax.tree.leaves(tree)])
        for tree in (case.unknowns(result.scene), case.unknowns(case.truth), result.standard_errors, result.determined)
    )
    voxel, known = float(jnp.min(case.truth.volume.spacing)), determined > 0
    names = dict(zip(result.unknowns, jax.tree.leaves(result.determined), strict=True))
    of_extinction = np.asarray(names["transfer.sigma_t"])
    opacity = lambda scene: -np.expm1(-voxel * np.asarray(scene.transfer.sigma_t, float))[of_extinction]
    return {
        "known_psnr": float(psnr(case.truth)),
        "held_out_psnr": float(psnr(result.scene)),
        "opacity_rmse": float(np.sqrt(np.mean(np.square(opacity(result.scene) - opacity(case.truth))))),
        "within_two_errors": float(np.mean(np.abs(found - true)[known] <= 2 * errors[known])),
        "determined": int(known.sum()),
        "unknowns": int(known.size),
        "smoothed": sum(count for _, count in result.stats.smoothed),
        "structured": result.stats.structured,
        "steps": len(result.history),
        "outcome": result.outcome.name,
        "seconds": seconds,
        "pictures": [
            np.clip(x, 0, 1).tolist()
            for x in (kept_aside, np.asarray(render(case.truth, aside)), np.asarray(render(result.scene, aside)))
        ],
    }


def figure(report: dict[str, Any], path: str) -> None:
    """The view that was kept aside, by the other renderer, by jvr with its function, and by jvr with the function found."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(8.5, 2.4 * len(report)), layout="constrained")
    panels = np.atleast_2d(drawing.subplots(len(report), 4))
    for row, (name, found) in zip(panels, report.items(), strict=True):
        theirs, known, fitted = map(np.asarray, found["pictures"])
        titles = (
            "theirs",
            f"function known, {found['known_psnr']:.1f} dB",
            f"found, {found['held_out_psnr']:.1f} dB",
            "20 x difference",
        )
        for axes, picture, title in zip(row, (theirs, known, fitted, 0.5 + 20 * (fitted - theirs)), titles, strict=True):
            axes.imshow(np.clip(picture, 0, 1))
            axes.set_title(title, fontsize=8)
            axes.set(xticks=[], yticks=[])
        row[0].set_ylabel(name, fontsize=7)
    drawing.savefig(path, dpi=110)


def write_files(folder: Path, size: int = 64) -> None:
    """Pictures of the demonstration's volume by VTK's GPU mapper in 8 bits, as `view_0.png` ..., `cameras.json`, and `start.vp.json`, a
    preset that knows where the volume has something and no more."""
    from benchmarks.peers import vtk_mappers
    from jvr.io import interop
    from jvr.io.config import read_config
    from jvr.io.config.transfers import build_transfer, resampled
    from jvr.io.demo import demo_volume

    volume, config = demo_volume(), read_config(Path(__file__).parents[1] / "configs" / "demo.toml")
    assert config.tables.truth is not None
    truth = resampled(build_transfer(config.tables.truth, volume, config.name, "truth"), 65)
    voxels, spacing = np.asarray(volume.values), np.asarray(volume.spacing, float)
    place = tuple(map(float, spacing)), tuple(np.asarray(volume.world_from_grid, float)[:3, 3].tolist())
    table = np.asarray(truth.rgb), np.asarray(truth.sigma_t)
    hull = (np.asarray(voxels.shape) - 1) * spacing
    scene = scenes.Scene("demo", "formula", voxels, *place, *table, (float(truth.domain[0]), 1.0), view((0, -1, 0), hull, size))
    cameras = []
    folder.mkdir(parents=True, exist_ok=True)
    for i, one in enumerate(views(scene, size)):
        renderer = vtk_mappers.GpuRenderer(one)
        renderer.prepare(STEP)
        renderer.draw()
        Image.fromarray(np.rint(255 * renderer.picture()).astype(np.uint8)).save(folder / f"view_{i}.png")
        said = {"position": one.view.eye, "focal_point": one.view.target, "view_up": one.view.up, "view_angle": one.view.fov_y}
        cameras.append(said | {"width": size, "height": size})
    (folder / "cameras.json").write_text(json.dumps(cameras, indent=1) + "\n")
    rough = jvr.LinearTransfer([0.05, 0.15, 1.0], np.full((3, 3), 0.5), [0.0, 0.02, 0.02])
    interop.write_slicer(folder / "start.vp.json", interop.Preset(rough))


def main() -> None:
    """Runs the cases, prints a line for each, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE")
    parser.add_argument("--only", nargs="+", metavar="CASE", help="those whose name contains one of these words")
    parser.add_argument("--quick", action="store_true", help="a phantom, small pictures")
    parser.add_argument("--files", type=Path, metavar="FOLDER", help="write what a user of VTK has at hand, and run nothing")
    a = parser.parse_args()
    if a.files:
        write_files(a.files)
        return
    report = {}
    print(f"{'case':<40}{'known':>8}{'held out':>10}{'opacity':>9}{'in 2 se':>9}{'determined':>12}{'steps':>7}{'time':>8}")
    for name, make in cases(24 if a.quick else 128, a.quick).items():
        if a.only and not any(word in name for word in a.only):
            continue
        report[name] = found = run(make())
        print(
            f"{name:<40}{found['known_psnr']:>8.1f}{found['held_out_psnr']:>10.1f}{found['opacity_rmse']:>9.4f}"
            f"{found['within_two_errors']:>9.0%}{found['determined']:>8} of {found['unknowns']}"
            f"{found['steps']:>5}{found['seconds']:>7.0f} s",
            flush=True,
        )
        if a.json:
            numbers = {name: {key: value for key, value in row.items() if key != "pictures"} for name, row in report.items()}
            Path(a.json).write_text(json.dumps(numbers, indent=1) + "\n")
    if a.figure:
        figure(report, a.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
