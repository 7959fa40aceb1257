"""Materials under light probes: a CT of a head (`ct_head_quarter`) under photographed light, one material a row, one probe a column.

`python experiments/material_sheet.py [-o FILE] [--quick]`; head and probes are looked for in `$JVR_DATA`. Radiance transfer at half the
resolution of the voxels, the exact product. Each probe is scaled to a mean radiance of one and turned so that its up is that of the head;
the first row shows it as the order of the harmonics leaves it. The last column is shadowed by nothing.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.protocols import DATA, HEAD
from jvr.io.config import build_cameras, build_scene, build_settings, read_config
from jvr.io.environment import read_environment
from jvr.model.harmonics.projection import map_directions
from jvr.pictures import srgb_from_linear

CONFIG = Path(__file__).parents[1] / "configs" / "real" / "ct_head_lit.toml"
PROBES = ("kiara_1_dawn_1k.hdr", "potsdamer_platz_1k.hdr", "studio_small_03_1k.hdr", "StageEnvLatLong.exr")
ORDER = 4
# Takes the probe's right, up and front to the head's: its up is -z of the world.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
MATERIALS: dict[str, Any] = {
    "Lambert": jvr.LambertBRDF(),
    "Blinn-Phong": jvr.BlinnPhongBRDF(0.6, 0.4, 20.0),
    "rough dielectric": jvr.MicrofacetBRDF(roughness=0.5),
    "rough metal": jvr.MicrofacetBRDF(metallic=1.0, roughness=0.5),
    "Henyey-Greenstein, g = 0.5": jvr.PhaseBRDF(jvr.HenyeyGreenstein(0.5)),
}


def upright(light: jvr.EnvironmentLight) -> jvr.EnvironmentLight:
    """The probe with a mean radiance of one and its up, y, turned to the head's, -z of the world; its middle is behind the viewer."""
    light = light.rotated(UPRIGHT)
    mean = jnp.mean(light.coefficients[0]) / np.sqrt(4 * np.pi)
    return jvr.EnvironmentLight(light.coefficients / mean)


def ball(light: jvr.EnvironmentLight, height: int) -> np.ndarray:
    """The light itself as a map, in the orientation that it was photographed in."""
    directions, _ = map_directions(height, 2 * height)
    return np.asarray(light.radiance(directions.reshape(-1, 3) @ UPRIGHT.T)).reshape(height, 2 * height, 3)


def pictures(size: int) -> tuple[dict[str, np.ndarray], dict[tuple[str, str], np.ndarray]]:
    """The probes as maps by name, and pictures by material and probe."""
    config = read_config(CONFIG)
    scene, settings = build_scene(config), build_settings(config)
    (camera,) = build_cameras(config, scene.volume)
    camera = dataclasses.replace(camera, width=size, height=size)
    scene = dataclasses.replace(scene, lights=(), shading=None, shadows=None)
    lights = {name: upright(jvr.EnvironmentLight.from_image(read_environment(DATA / "env" / name), ORDER)) for name in PROBES}
    found = {}
    transfer, projected = jvr.RadianceTransfer(ORDER, 128, 0.5, exact=True), None
    for title, material in MATERIALS.items():
        lit = dataclasses.replace(
            scene,
            environment=next(iter(lights.values())),
            material=jvr.HarmonicMaterial.project(material, ORDER, threshold=20.0),
            radiance_transfer=transfer,
        )
        # What reaches a point does not depend on its material, but on whether that has surfaces.
        if projected is None or projected.stale(lit):
            projected = jvr.precompute(lit).radiance_transfer
        lit = dataclasses.replace(lit, radiance_transfer=projected)
        for name, light in lights.items():
            found[title, name] = np.asarray(jvr.render(dataclasses.replace(lit, environment=light), camera, settings).rgb)
        bare = dataclasses.replace(lit, radiance_transfer=None)
        found[title, "no transfer"] = np.asarray(jvr.render(bare, camera, settings).rgb)
        print(title, flush=True)
    return {name: ball(light, size // 4) for name, light in lights.items()}, found


def sheet(probes: dict[str, np.ndarray], found: dict[tuple[str, str], np.ndarray], path: str) -> None:
    """All pictures on one page; radiance times 0.8 through the sRGB curve."""
    from matplotlib.figure import Figure

    columns = [*probes, "no transfer"]
    drawing = Figure(figsize=(2.6 * len(columns), 2.6 * len(MATERIALS) + 1.6), layout="constrained")
    heights = [0.5, *[1.0] * len(MATERIALS)]
    grid = drawing.subplots(len(heights), len(columns), gridspec_kw={"height_ratios": heights})
    for axes in grid.ravel():
        axes.set_axis_off()
    shown = lambda picture: srgb_from_linear(0.8 * picture)
    for axes, name in zip(grid[0], columns, strict=True):
        title = f"{columns[0].split('.')[0]}, no transfer" if name == "no transfer" else name.split(".")[0]
        axes.set_title(title, fontsize=9)
        if name in probes:
            axes.imshow(shown(0.5 * probes[name]))
    for row, title in zip(grid[1:], MATERIALS, strict=True):
        row[0].text(-0.04, 0.5, title, transform=row[0].transAxes, rotation=90, va="center", ha="right", fontsize=9)
        for axes, name in zip(row, columns, strict=True):
            axes.imshow(shown(found[title, name]))
    drawing.savefig(path, dpi=80)


def main() -> None:
    """Renders the sheet and writes it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--figure", metavar="FILE", default="material_sheet.png", help="PNG of the sheet")
    parser.add_argument("--quick", action="store_true", help="small pictures")
    arguments = parser.parse_args()
    if not (DATA / HEAD).exists() or not (DATA / "env" / PROBES[0]).exists():
        sys.exit(f"{HEAD} and env/{PROBES[0]} are not in $JVR_DATA: set it to the folder of the public data")
    sheet(*pictures(64 if arguments.quick else 256), arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
