"""Every effect of light on one sheet, and on another isosurfaces, what is around and in a volume, and occlusion: on a CT of a head
(`ct_head_quarter`, looked for in `$JVR_DATA`) and on the embedded volume.

`python experiments/contact_sheet.py [--of surfaces] [-o FILE] [--json FILE] [--quick]`; `--figure` is another name of `-o`. Both
scenes come from configurations (`configs/real/ct_head_lit.toml`, `configs/lit.toml`), and each picture changes the one thing that its title
names; JSON holds its mean and largest radiance and, for shadows, the error against shadow rays.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias, cast

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.accuracy_vs_time import machine
from experiments.contact_subjects import Subject, subjects
from experiments.contact_surfaces import around, occlusion, surfaces
from jvr.pictures import srgb_from_linear

COLUMNS = 6
# By subject and title.
Pictures: TypeAlias = dict[str, dict[str, np.ndarray]]
# Scenes by title.
Group: TypeAlias = Callable[[Subject], dict[str, jvr.Scene]]

METHODS = {
    "shadow rays": jvr.ShadowRays(),
    "shadow volume": jvr.ShadowVolume(),
    "shadow map": jvr.ShadowMap(),
    "opacity shadow map": jvr.OpacityShadowMap(),
    "deep shadow map": jvr.DeepShadowMap(),
}
# What share of a picture a detail shows.
DETAIL = 0.3


def shaded(of: Subject) -> dict[str, jvr.Scene]:
    """Shading, and transfer functions that look at the gradient; nothing casts shadows."""
    change = lambda **parts: dataclasses.replace(of.scene, **parts)
    surface = {"threshold": cast(Any, of.scene.shading).threshold}
    by_gradient = jvr.GradientOpacity(of.scene.transfer, 0.25 * of.surface, of.surface)
    return {
        "unlit": change(shading=None, lights=()),
        "Lambert": change(shading=jvr.Lambert(0.15, 0.85, **surface)),
        "Phong": change(shading=jvr.Phong(0.15, 0.85, 0.4, 10.0, **surface)),
        "Blinn-Phong": of.scene,
        "gradient-opacity": change(transfer=by_gradient),
        "2-D transfer function": change(transfer=two_dimensional(of)),
    }


def two_dimensional(of: Subject) -> jvr.GradientTransfer:
    """The same materials where the gradient is weak, fainter, and boundaries in one colour where it is strong."""
    table = of.table
    share = np.linspace(0, 1, 5)
    colours = (1 - share[None, :, None]) * np.asarray(table.rgb)[:, None] + share[None, :, None] * np.array([0.15, 0.55, 0.75])
    sigma_t = np.asarray(table.sigma_t)[:, None] * (0.1 + 0.9 * share)
    return jvr.GradientTransfer(colours, sigma_t, table.domain, (0.0, of.surface))


def normals(of: Subject) -> dict[str, jvr.Scene]:
    """A detail by each estimate of the gradient."""
    kinds = {
        "analytic gradient": jvr.AnalyticGradient(),
        "forward differences": jvr.ForwardDifferences(),
        "central differences": jvr.CentralDifferences(),
        "Sobel": jvr.SobelDifferences(),
        "precomputed": jvr.PrecomputedGradient(),
        "precomputed, of opacity": jvr.PrecomputedGradient(of_opacity=True),
    }
    return {f"normals: {name}": dataclasses.replace(of.scene, normals=kind) for name, kind in kinds.items()}


def shadowed(of: Subject) -> dict[str, jvr.Scene]:
    """Each method for shadows, and none."""
    return {name: dataclasses.replace(of.scene, shadows=method) for name, method in {"no shadows": None, **METHODS}.items()}


def lit(of: Subject) -> dict[str, jvr.Scene]:
    """Other lights, with a shadow volume where they cast shadows."""
    center, radius = np.asarray(of.scene.volume.center), float(of.scene.volume.radius)
    place, near = of.beside(-1.5, 1.5, 2.0), of.beside(-0.5, 0.6, 0.7)
    # Irradiance 1.5 at the middle of the volume.
    power = lambda place: 1.5 * float(np.sum(np.square(place - center)))
    fill = jvr.AmbientLight(0.5)
    # Every point of a luminous ball adds to what is compiled.
    points: Any = {"key": jax.random.key(0), "samples": 8}
    lights = {
        "soft shadow: sphere light": (*jvr.sphere_light(place, 0.5 * radius, power(place), **points), fill),
        "disc light": (*jvr.disc_light(place, center - place, 0.5 * radius, power(place), **points), fill),
        "point light, near": (jvr.PointLight(near, 0.6 * power(near)), fill),
        "spot light": (jvr.SpotLight(place, center - place, power(place), inner=3.0, outer=8.0), fill),
        "head light": (jvr.HeadLight(0.8), fill),
        "ambient light": (jvr.AmbientLight(4.0),),
    }
    scenes = {}
    for name, some in lights.items():
        casts = any(not isinstance(light, jvr.HeadLight | jvr.AmbientLight) for light in some)
        shadows = jvr.ShadowVolume(1.0) if casts else None
        scenes[name] = dataclasses.replace(of.scene, lights=some, shadows=shadows)
    return scenes


def scattering(of: Subject) -> dict[str, jvr.Scene]:
    """The volume as a cloud that scatters light from behind on the left, and the switch between surfaces and medium."""
    table = of.table
    thin, black = of.cloud * np.asarray(table.sigma_t), np.zeros_like(np.asarray(table.rgb))
    cloud = jvr.LutTransfer(black, thin, table.domain)
    coloured = jvr.LutTransfer(black, thin[:, None] * np.array([0.5, 1.0, 2.0]), table.domain)
    travels = np.asarray(of.scene.volume.center) - of.beside(-1.0, 0.5, -0.6)
    lights = (jvr.DirectionalLight(travels, 14.0),)
    media = {
        "scattering: isotropic": (cloud, jvr.Isotropic()),
        "Henyey-Greenstein, g = 0.5": (cloud, jvr.HenyeyGreenstein(0.5)),
        "Henyey-Greenstein, g = -0.5": (cloud, jvr.HenyeyGreenstein(-0.5)),
        "Rayleigh": (cloud, jvr.Rayleigh()),
        "coloured extinction": (coloured, jvr.Isotropic()),
    }
    change = lambda **parts: dataclasses.replace(of.scene, shadows=jvr.ShadowVolume(1.0), **parts)
    scenes = {
        name: change(transfer=transfer, lights=lights, shading=None, scattering=jvr.SingleScattering(phase, 0.95))
        for name, (transfer, phase) in media.items()
    }
    switch = jvr.SingleScattering(jvr.Isotropic(), 1.0, threshold=0.3 * of.surface)
    scenes["surfaces and medium"] = change(scattering=switch)
    return scenes


SHEETS = {"light": (shaded, normals, shadowed, lit, scattering), "surfaces": (surfaces, around, occlusion)}


def detail_of(of: Subject) -> jvr.PerspectiveCamera:
    """A narrow view of a part of the subject."""
    pose = np.asarray(of.camera.world_from_camera)
    fov_y = DETAIL * float(of.camera.fov_y)
    return jvr.PerspectiveCamera.look_at(pose[:3, 3], of.detail, pose[:3, 1], fov_y, of.camera.width, of.camera.height)


def pictures(subjects: list[Subject], groups: tuple[Group, ...], every: int = 1) -> Pictures:
    """The linear radiance of all pictures of groups, or of `every` so many."""
    titles: list[tuple[str, list[tuple[Subject, jvr.Scene, Any]]]] = []
    for group in groups:
        of_group = {of.name: group(of) for of in subjects}
        camera = detail_of if group is normals else lambda of: of.camera
        for title in of_group[subjects[0].name]:
            titles.append((title, [(of, of_group[of.name][title], camera(of)) for of in subjects]))

    def one_title(of_title: tuple[str, list[tuple[Subject, jvr.Scene, Any]]]) -> list[np.ndarray]:
        # All subjects use the program that the first one compiles, which takes most of the time.
        title, scenes = of_title
        found = [np.asarray(jvr.render(scene, camera, of.settings).rgb) for of, scene, camera in scenes]
        for (of, _, _), rgb in zip(scenes, found, strict=True):
            print(f"{of.name:<18}{title:<28}mean {rgb.mean():.3f}   largest {rgb.max():.2f}", flush=True)
        return found

    found = [one_title(title) for title in titles[::every]]
    names = [title for title, _ in titles[::every]]
    return {of.name: dict(zip(names, [some[i] for some in found], strict=True)) for i, of in enumerate(subjects)}


def rows(found: Pictures) -> list[dict[str, Any]]:
    """A line for each picture; those with shadows say how far they are from that of shadow rays."""
    lines = []
    for name, some in found.items():
        for title, rgb in some.items():
            error = None
            if "shadow rays" in some and (title in METHODS or title == "no shadows"):
                error = float(np.sqrt(np.mean(np.square(rgb - some["shadow rays"]))))
            line = {"subject": name, "picture": title, "mean": float(rgb.mean()), "largest": float(rgb.max())}
            lines.append({**line, "rmse_of_shadow_rays": error})
    return lines


def sheet(found: Pictures, path: str) -> None:
    """All pictures in rows, a heading for each subject."""
    from matplotlib.figure import Figure

    rows = {name: -(-len(some) // COLUMNS) for name, some in found.items()}
    drawing = Figure(figsize=(1.9 * COLUMNS, sum(2.1 * n + 0.3 for n in rows.values())), layout="constrained", facecolor="white")
    heights = [2.1 * n + 0.3 for n in rows.values()]
    parts = drawing.subfigures(len(found), 1, height_ratios=heights, squeeze=False).ravel()
    for part, (name, some) in zip(parts, found.items(), strict=True):
        part.suptitle(name, fontsize=11)
        panels = part.subplots(rows[name], COLUMNS, squeeze=False).ravel()
        for panel in panels:
            panel.set_axis_off()
        for panel, (title, rgb) in zip(panels, some.items(), strict=False):
            panel.imshow(srgb_from_linear(np.clip(rgb, 0, 1)))
            panel.set_title(title, fontsize=8, pad=3)
    drawing.savefig(path, dpi=84, pil_kwargs={"optimize": True})


def main() -> None:
    """Renders all pictures, prints a line for each, and writes the sheet and JSON on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--figure", metavar="FILE", help="PNG of the sheet")
    parser.add_argument("--of", choices=SHEETS, default="light", help="which sheet")
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--quick", action="store_true", help="tiny pictures, one column")
    arguments = parser.parse_args()
    size = 24 if arguments.quick else 160
    found = pictures(subjects(size), SHEETS[arguments.of], every=COLUMNS if arguments.quick else 1)
    if arguments.json:
        Path(arguments.json).write_text(
            json.dumps({"machine": machine(), "size": size, "pictures": rows(found)}, indent=2) + "\n"
        )
    if arguments.figure:
        sheet(found, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
