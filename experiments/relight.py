"""The light of a CT head from a few noisy views, as 16 RGB coefficients, and the head under another light with what was kept.

`python experiments/relight.py [--json FILE] [--figure FILE] [--quick]`; the head (`ct_head_quarter`) and the maps (`env`)
`potsdamer_platz_1k.hdr` and `studio_small_03_1k.hdr` are looked for in `$JVR_DATA`; without them the embedded volume stands under two
skies made of discs.

The truth is rendered with light and transfer at order 8, 256 rays a node and the exact product of material, light and transfer, with 1 %
noise. The fit knows neither: it sees light and transfer at order 3, 64 rays. Transfer and material are computed once and kept; only the
light is unknown. Three models are fitted: the exact product, the two double products of Lindemann and Ropinski, and no transfer at all
(nothing casts shadows). Each is then looked at from a view that took no part, under the light that it found and under the other one,
projected at order 3; beside them the exact product under the true light at order 3, which is what the order alone costs.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.accuracy_vs_time import machine
from experiments.protocols import DATA, HEAD
from jvr.io.config import build_scene, read_config
from jvr.io.environment import read_environment
from jvr.model.harmonics.projection import map_directions
from jvr.pictures import srgb_from_linear

CONFIGS = Path(__file__).parents[1] / "configs"
LIGHTS = ("potsdamer_platz_1k", "studio_small_03_1k")
# Standard deviation of the noise, as a share of the brightest pixel.
NOISE = 0.01
# Directions from the middle of the volume to the eyes, in the axes of the picture (to the right, upwards, towards the front); the
# last takes no part in the fit.
EYES = ((0.0, 0.1, 1.0), (0.9, 0.3, 0.6), (-0.9, -0.1, 0.6), (0.3, 0.3, -1.0), (0.2, 1.0, 0.4), (-0.5, 0.35, 0.9))


class Study(NamedTuple):
    """A subject without light, its world (columns: to the right, upwards and to the front, which is where a map's centre is), both maps
    and their names, and how finely it is all taken: orders of truth and fit, rays, pixels."""

    scene: jvr.Scene
    axes: np.ndarray
    maps: tuple[np.ndarray, np.ndarray]
    names: tuple[str, str]
    volume: str
    orders: tuple[int, int]
    rays: tuple[int, int]
    size: int
    resolution: float
    settings: jvr.Settings

    def light(self, which: int, order: int) -> jvr.EnvironmentLight:
        """One of the two lights around the subject."""
        return jvr.EnvironmentLight.from_image(self.maps[which], order).rotated(self.axes)

    def lit(self, which: int, order: int, rays: int, *, exact: bool) -> jvr.Scene:
        """The subject under one of the lights, everything about material and transfer computed."""
        material = jvr.MicrofacetBRDF(base=0.9, roughness=0.45)
        light, transfer = self.light(which, order), jvr.RadianceTransfer(order, rays, self.resolution, exact=exact)
        return jvr.precompute(dataclasses.replace(self.scene, environment=light, material=material, radiance_transfer=transfer))

    def cameras(self, size: int | None = None) -> list[Any]:
        center, radius = np.asarray(self.scene.volume.center), float(self.scene.volume.radius)
        place = lambda eye: center + 3.4 * radius * (self.axes @ np.array(eye)) / np.linalg.norm(eye)
        look = lambda eye: jvr.PerspectiveCamera.look_at(
            place(eye), center, self.axes[:, 1], 28.0, size or self.size, size or self.size
        )
        return [look(eye) for eye in EYES]


def study(*, quick: bool) -> Study:
    """The head under both maps where they are there, else (and for a quick look) the embedded volume under two skies."""
    files = [DATA / "env" / f"{name}.hdr" for name in LIGHTS]
    if not quick and (DATA / HEAD).exists() and all(file.exists() for file in files):
        scene, maps, names = build_scene(read_config(CONFIGS / "real" / "ct_head_lit.toml")), map(read_environment, files), LIGHTS
        # In this file z grows downwards and the face looks along -y.
        axes, volume = np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]]).T, "ct_head_quarter"
    else:
        if not quick:
            print(f"{HEAD} or the maps are not in $JVR_DATA: the embedded volume stands in for it", file=sys.stderr)
        scene, maps, names = build_scene(read_config(CONFIGS / "lit.toml")), (sky(0), sky(1)), ("clouds", "lamps")
        axes, volume = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]).T, "demo"
    bare = jvr.Scene(scene.volume, scene.transfer, clipping=scene.clipping)
    fine = {"orders": (3, 1), "rays": (32, 16), "size": 12, "resolution": 0.15, "settings": jvr.Settings(4.0)}
    if not quick:
        fine = {"orders": (8, 3), "rays": (256, 64), "size": 64, "resolution": 1 / 3, "settings": jvr.Settings(1.0)}
    first, second = maps
    return Study(bare, axes, (first, second), names, volume, **fine)


def sky(which: int) -> np.ndarray:
    """A map of a bright disc, high up on one side or the other, over a weaker gradient."""
    d, _ = map_directions(32, 64)
    towards = np.array([[0.5, 0.7, 0.5], [-0.8, 0.3, 0.5]])[which]
    inside = np.asarray(d).reshape(32, 64, 3) @ (towards / np.linalg.norm(towards)) > (0.8, 0.95)[which]
    gradient = 0.4 + 0.3 * np.asarray(d).reshape(32, 64, 3)[..., 1:2]
    colours = np.array([[3.0, 2.7, 2.2], [12.0, 14.0, 18.0]])[which]
    return gradient * np.array([0.7, 0.9, 1.2]) + inside[..., None] * colours


def noisy(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The pictures with independent normal noise in every pixel and channel."""
    rng, level = np.random.default_rng(1), NOISE * max(float(np.max(image)) for image in images)
    return [np.asarray(image + level * rng.standard_normal(image.shape), np.float32) for image in images]


def scores(truth: np.ndarray, image: np.ndarray) -> dict[str, float]:
    """PSNR relative to the brightest pixel of the truth, and the root mean square error relative to the truth's root mean square."""
    error = float(np.mean(np.square(image - truth)))
    return {
        "psnr": float(10 * np.log10(np.max(truth) ** 2 / error)),
        "relative_rmse": float(np.sqrt(error / np.mean(np.square(truth)))),
    }


class Result(NamedTuple):
    """Rows of the table, pictures by name and then by light, and the coefficients that the exact product found."""

    rows: list[dict[str, Any]]
    views: list[np.ndarray]
    pictures: dict[str, list[np.ndarray]]
    found: jvr.EnvironmentLight


def compare(of: Study) -> Result:
    """Fits each model and looks at it from the view that took no part, under both lights."""
    say = lambda text: print(text, file=sys.stderr, flush=True)
    (true_order, order), (true_rays, rays) = of.orders, of.rays
    *cameras, held_out = of.cameras()
    render = jax.jit(jvr.render)
    picture = lambda scene, camera: np.asarray(render(scene, camera, of.settings).rgb)
    truth = of.lit(0, true_order, true_rays, exact=True)
    other = dataclasses.replace(truth, environment=of.light(1, true_order))
    images = noisy([picture(truth, camera) for camera in cameras])
    pictures = {"truth": [picture(scene, held_out) for scene in (truth, other)]}
    say(f"rendered {len(images)} views of {of.volume} under {of.names[0]} at order {true_order}")
    exact = of.lit(0, order, rays, exact=True)
    wanted = of.light(0, order).coefficients
    models = {
        "exact product": exact,
        "two double products": of.lit(0, order, rays, exact=False),
        "no transfer": dataclasses.replace(exact, radiance_transfer=None),
    }
    rows, found = [], {}
    for name, model in models.items():
        start = dataclasses.replace(model, environment=jvr.EnvironmentLight(_constant(order), clamped=False))
        coefficients: Any = lambda s: s.environment.coefficients
        result = jvr.fit(start, cameras, images, unknowns=coefficients, settings=of.settings, max_steps=8)
        say(f"{name}: {len(result.history)} steps, {result.stats.seconds:.0f} s")
        found[name] = jvr.EnvironmentLight(coefficients(result.scene))
        errors = np.asarray(result.standard_errors)
        rows.append(
            {
                "model": name,
                "steps": len(result.history),
                "seconds": result.stats.seconds,
                "outcome": result.outcome.value,
                "residual_over_noise": float(
                    np.sqrt(result.stats.residual_variance) / (NOISE * max(float(np.max(i)) for i in images))
                ),
                "determined": result.stats.rank,
                "coefficients": _distance(coefficients(result.scene), wanted),
                "standard_error": float(np.sqrt(np.sum(np.square(errors)) / np.sum(np.square(wanted)))),
            }
        )
    shown = {name: (model, found[name]) for name, model in models.items()}
    shown[f"true light at order {order}"] = (exact, of.light(0, order))
    rows.append({"model": f"true light at order {order}"})
    for row, (name, (model, light)) in zip(rows, shown.items(), strict=True):
        scenes = [dataclasses.replace(model, environment=e) for e in (light, of.light(1, order))]
        pictures[name] = [picture(scene, held_out) for scene in scenes]
        row["held_out"], row["relit"] = map(scores, pictures["truth"], pictures[name])
    return Result(rows, images, pictures, found["exact product"])


def _constant(order: int) -> np.ndarray:
    """A light of one from everywhere."""
    return np.asarray(jvr.EnvironmentLight.constant(1.0, order).coefficients)


def _distance(found: Any, truth: Any) -> float:
    """Root mean square of the difference, relative to that of the truth; by Parseval, that of radiance over the sphere."""
    return float(np.sqrt(np.sum(np.square(found - truth)) / np.sum(np.square(truth))))


def show(rows: list[dict[str, Any]]) -> None:
    print(
        f"{'':<26}{'light':>8}{'+-':>8}{'steps':>7}{'s':>7}{'held-out dB':>13}{'rel. RMSE':>11}{'relit dB':>10}{'rel. RMSE':>11}"
    )
    for r in rows:
        fitted = (
            f"{r['coefficients']:>8.3f}{r['standard_error']:>8.3f}{r['steps']:>7}{r['seconds']:>7.0f}"
            if "steps" in r
            else " " * 30
        )
        held_out, relit = r["held_out"], r["relit"]
        print(
            f"{r['model']:<26}{fitted}{held_out['psnr']:>13.1f}{held_out['relative_rmse']:>11.3f}"
            f"{relit['psnr']:>10.1f}{relit['relative_rmse']:>11.3f}"
        )


def toned(radiance: np.ndarray, like: np.ndarray) -> np.ndarray:
    """For display: `L / (L + K)`, then sRGB, `K` the radiance that nine tenths of what is lit in `like` stay below."""
    bright, radiance = np.max(like, axis=-1), np.maximum(radiance, 0)
    # Noise is not light.
    return srgb_from_linear(radiance / (radiance + np.percentile(bright[bright > 5 * NOISE * bright.max()], 90)))


def figure(of: Study, result: Result, path: str) -> None:
    """The views, the maps, and the view that took no part under both lights, with their scores."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(11, 10.5), layout="constrained")
    of_views, of_maps, of_pictures = drawing.subfigures(3, 1, height_ratios=[1.05, 0.95, 2.0], squeeze=False).ravel()
    of_views.suptitle(
        "The views that were fitted, 1 % noise; everywhere L / (L + K), then sRGB, K as the true picture or map has it",
        fontsize=10,
    )
    for panel, view in zip(of_views.subplots(1, len(result.views)), result.views, strict=True):
        panel.imshow(toned(view, result.views[0]))
    known = of.maps[0]
    directions, _ = map_directions(64, 128)
    unrolled = lambda light: np.asarray(light.radiance(directions.reshape(-1, 3) @ of.axes.T)).reshape(64, 128, 3)
    truth, row = unrolled(of.light(0, of.orders[1])), result.rows[0]
    maps = {
        f"{of.names[0]}": known,
        f"its projection at order {of.orders[1]}": truth,
        f"recovered, {row['coefficients']:.0%} away": unrolled(result.found),
    }
    for panel, (name, image) in zip(of_maps.subplots(1, 3), maps.items(), strict=True):
        panel.imshow(toned(image, truth), aspect="auto", extent=(0, 2, 1, 0))
        panel.set_title(name, fontsize=10)
    panels = of_pictures.subplots(2, len(result.pictures))
    for which, (row, key) in enumerate(zip(panels, ("held_out", "relit"), strict=True)):
        for panel, (name, images) in zip(row, result.pictures.items(), strict=True):
            if which == 1 and "true light" in name:
                panel.set_axis_off()  # it is the picture of the exact product
                continue
            panel.imshow(toned(images[which], result.pictures["truth"][which]))
            score = next((r[key] for r in result.rows if r["model"] == name), None)
            text = f"{score['psnr']:.1f} dB, {score['relative_rmse']:.1%}" if score else f"under {of.names[which]}"
            light = "recovered light, " if which == 0 and score and "true" not in name else ""
            panel.set_title(f"{name}\n{light if score else ''}{text}", fontsize=8)
    for panel in drawing.axes:
        panel.set(xticks=[], yticks=[])
    panels[0, 0].set_ylabel("a view that took no part", fontsize=9)
    panels[1, 0].set_ylabel("the same, relit", fontsize=9)
    drawing.savefig(path, dpi=110)


def main() -> None:
    """Runs the fits, prints their scores, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of views, lights and relit pictures")
    parser.add_argument("--quick", action="store_true", help="the embedded volume, tiny pictures, low orders")
    arguments = parser.parse_args()
    of = study(quick=arguments.quick)
    result = compare(of)
    show(result.rows)
    if arguments.json:
        setup = {"volume": of.volume, "lights": of.names, "orders": of.orders, "rays": of.rays, "size": of.size, "noise": NOISE}
        Path(arguments.json).write_text(json.dumps({"machine": machine(), "setup": setup, "table": result.rows}, indent=2) + "\n")
    if arguments.figure:
        figure(of, result, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
