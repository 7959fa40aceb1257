"""Times of radiance transfer, as table 1 of Lindemann and Ropinski (2010): `python experiments/sh_timings.py [--json FILE] [--quick]`

For bones of a formula at three sizes, at a third of their resolution and 64 rays a node: how long the transfer takes to project (shadows
only, with the scattering pass, with that and colour bleeding), and how long a picture of 400^2 then takes. Beside them the picture
without light, the same number of plain march samples as projecting takes, what turning the light adds to a picture, and memory.
Compilation is not counted.
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
from benchmarks.timing import median, ratio, seconds
from experiments.accuracy_vs_time import machine
from experiments.sh_accuracy import sky
from jvr.effects.radiance_transfer_grid import RadianceTransferProjection, projected_of
from jvr.rendering.medium import absorbing, occupancy

SIZES = ((128, 128, 128), (256, 256, 128), (256, 256, 256))
COLUMNS: dict[str, dict[str, Any]] = {
    "shadows": {},
    "+ scattering": {"scattering": "skin1"},
    "+ bleeding": {"scattering": "skin1", "bleeding": True},
}


def bones(shape: tuple[int, int, int], size: int) -> tuple[jvr.Scene, jvr.PerspectiveCamera]:
    """The phantom with as many voxels along each axis."""
    described = next(s for s in scenes.four(shape[0], size) if (s.name, s.data) == ("bone", "phantom"))
    scene, camera = ours.to_jvr(described)
    every = [a // b for a, b in zip(scene.volume.shape, shape, strict=True)]
    world = np.array(scene.volume.world_from_grid)
    world[:3, :3] *= every
    values = np.asarray(scene.volume.values)[:: every[0], :: every[1], :: every[2]]
    volume = jvr.Volume(values, world, slope=scene.volume.slope, intercept=scene.volume.intercept)
    return dataclasses.replace(scene, volume=volume.bricked()), camera


def turned(angle: float) -> np.ndarray:
    """A rotation about the vertical axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def transfer_of(scattering: str | None = None, *, bleeding: bool = False) -> jvr.RadianceTransfer:
    return jvr.RadianceTransfer(
        bleeding=jvr.TransferBleeding() if bleeding else None,
        scattering=None if scattering is None else jvr.Dipole.preset(scattering),
    )


def measured(shape: tuple[int, int, int], size: int, repeats: int) -> dict[str, Any]:
    """One row of the table."""
    unlit, camera = bones(shape, size)
    light = jvr.EnvironmentLight.from_image(sky(128))
    lit = dataclasses.replace(unlit, environment=light, material=jvr.LambertBRDF().projected(3))
    row: dict[str, Any] = {"voxels": shape}
    pictures: dict[str, Any] = {"unlit": unlit, "no transfer": lit}
    for name, settings in COLUMNS.items():
        scene = dataclasses.replace(lit, radiance_transfer=transfer_of(**settings))
        jvr.precompute(scene)
        shares: list[float] = []
        times = seconds({"": lambda s=scene, shares=shares: jvr.precompute(s, progress=shares.append) and 0}, repeats=repeats)
        frozen = jvr.precompute(scene)
        row[f"{name}: projection seconds"] = median(times, "")
        row[f"{name}: bytes"] = projected_of(frozen).nbytes
        pictures[name] = frozen
    exact = jvr.RadianceTransfer(exact=True).with_projected(projected_of(pictures["shadows"]))
    pictures["shadows, exact product"] = dataclasses.replace(lit, radiance_transfer=exact)
    # The angle changes each time: coefficients are turned anew, and everything that depends on the light follows.
    angle = iter(np.linspace(0, 3, 1000))
    turning = lambda: (
        jvr.render(dataclasses.replace(pictures["shadows"], environment=light.rotated(turned(next(angle)))), camera).rgb
    )
    draws = {name: lambda s=s: jvr.render(s, camera).rgb for name, s in pictures.items()} | {"turning": turning}
    times = seconds(draws, repeats=2 * repeats + 1)
    for name in pictures:
        row[f"{name}: frame seconds"] = median(times, name)
        row[f"{name}: frame / unlit"] = ratio(times, name, "unlit")
    row["turning the light / frame"] = ratio(times, "turning", "shadows") - 1
    row |= _samples(dataclasses.replace(lit, radiance_transfer=transfer_of()), camera, unlit)
    return row


def _samples(scene: jvr.Scene, camera: jvr.PerspectiveCamera, unlit: jvr.Scene) -> dict[str, Any]:
    """How many samples the projection takes at the most, and how long as many of the march would take."""
    projection = RadianceTransferProjection.of(scene, absorbing(scene, occupancy(scene, jvr.Settings()), graded=False))
    nodes = int(np.sum(projection.active()))
    steps = projection.radiance_transfer.boundaries(scene.volume.shape).size - 1
    rendering = jvr.render(unlit, camera)
    rate = float(rendering.stats.samples) / median(seconds({"": lambda: jvr.render(unlit, camera).rgb}, repeats=3), "")
    samples = nodes * projection.radiance_transfer.rays * steps
    return {"nodes": nodes, "samples at most": samples, "march seconds of as many": samples / rate}


def show(row: dict[str, Any]) -> None:
    print("x".join(map(str, row["voxels"])), f"unlit {1e3 * row['unlit: frame seconds']:.0f} ms", flush=True)
    for name in COLUMNS:
        print(
            f"  {name}: projected in {row[f'{name}: projection seconds']:.2f} s, {row[f'{name}: bytes'] / 1e6:.0f} MB, "
            f"picture {1e3 * row[f'{name}: frame seconds']:.0f} ms, {row[f'{name}: frame / unlit']:.2f} of unlit",
            flush=True,
        )
    for name in ("no transfer", "shadows, exact product"):
        print(f"  {name}: picture {row[f'{name}: frame / unlit']:.2f} of unlit")
    print(
        f"  turning the light adds {row['turning the light / frame']:.1%}; {row['samples at most'] / 1e6:.0f} M samples at most, "
        f"{row['march seconds of as many']:.1f} s of the march",
        flush=True,
    )


def main() -> None:
    """Measures, prints the table, and writes JSON on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--quick", action="store_true", help="a small volume and picture")
    arguments = parser.parse_args()
    rows = []
    for shape in ((32, 32, 16),) if arguments.quick else SIZES:
        rows.append(measured(shape, 64 if arguments.quick else 400, 1 if arguments.quick else 3))
        show(rows[-1])
        jax.clear_caches()
        if arguments.json:
            Path(arguments.json).write_text(json.dumps({"machine": machine(), "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
