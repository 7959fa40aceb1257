"""The transfer function of a shaded CT that shadows itself, fitted with its shadows and without: how wrong is the simpler model?

`python experiments/shadowed_fit.py [--json FILE] [--figure FILE] [--quick]`; `configs/real/shadowed_fit.toml`, a head looked for in
`$JVR_DATA`, or `configs/shadowed_fit.toml`, the embedded volume in its place. Both fits start from the same 16 grey entries and see the
same pictures. Scores: the entries against the true ones, a view that took no part, and that view under a light that shone from nowhere
in the fit. There the fit without shadows is rendered as it was fitted and, to see what its transfer function alone is worth, with shadows.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.accuracy_vs_time import machine
from experiments.protocols import DATA, HEAD
from jvr.io.config import FitJob, build_fit, build_scene, read_config

CONFIGS = Path(__file__).parents[1] / "configs"
# An entry's colour counts where its true extinction is at least this share of the largest: a clear entry has no colour to see.
SEEN = 0.01


def relit(scene: jvr.Scene) -> jvr.Scene:
    """The same scene with its light coming from the other side."""
    light = cast(Any, scene.lights[0])
    return eqx.tree_at(lambda s: s.lights[0].direction, scene, jnp.array([-1.0, 1.0, 1.0]) * light.direction)


def psnr(target: np.ndarray, rendered: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean(np.square(target - rendered))))


def table_errors(found: Any, truth: Any) -> dict[str, float]:
    """Root mean square errors of the entries: of extinction relative to that of the true ones, of colours where they can be seen."""
    sigma, true = np.asarray(found.sigma_t), np.asarray(truth.sigma_t)
    seen = true >= SEEN * true.max()
    of_colour = np.asarray(found.rgb)[seen] - np.asarray(truth.rgb)[seen]
    return {
        "extinction": float(np.sqrt(np.sum(np.square(sigma - true)) / np.sum(np.square(true)))),
        "largest_extinction": float(np.max(np.abs(sigma - true)) / true.max()),
        "colour": float(np.sqrt(np.mean(np.square(of_colour)))),
    }


def compare(job: FitJob, truth: jvr.Scene, size: int) -> tuple[list[dict[str, Any]], dict[str, list[np.ndarray]], dict[str, Any]]:
    """A row for each way to render what was fitted, the pictures (seen, held out, relit; `size` pixels wide) and the transfer
    functions behind them."""
    settings = job.keywords["settings"]
    assert job.held_out is not None
    seen, front = (dataclasses.replace(camera, width=size, height=size) for camera in (job.cameras[0], *job.held_out[0]))
    render = jax.jit(jvr.render)
    picture = lambda scene, camera: np.asarray(render(scene, camera, settings).rgb)
    views = lambda scene: [picture(scene, seen), picture(scene, front), picture(relit(scene), front)]
    fitted = {}
    for name, start in (("with shadows", job.scene), ("without shadows", dataclasses.replace(job.scene, shadows=None))):
        fitted[name] = jvr.fit(start, job.cameras, job.targets, **job.keywords)
        print(f"{name}: {len(fitted[name].history)} steps, {fitted[name].stats.seconds:.0f} s", file=sys.stderr, flush=True)
    scenes = {name: result.scene for name, result in fitted.items()}
    scenes["fitted without, rendered with"] = dataclasses.replace(scenes["without shadows"], shadows=truth.shadows)
    pictures = {"truth": views(truth), **{name: views(scene) for name, scene in scenes.items()}}
    rows = []
    for name, scene in scenes.items():
        scores = [psnr(a, b) for a, b in zip(pictures["truth"], pictures[name], strict=True)]
        of_fit = fitted.get(name, fitted["without shadows"])
        rows.append(
            {
                "model": name,
                **table_errors(scene.transfer, truth.transfer),
                **dict(zip(("fitted_psnr", "held_out_psnr", "relit_psnr"), scores, strict=True)),
                "steps": len(of_fit.history),
                "seconds": of_fit.stats.seconds,
                "outcome": of_fit.outcome.value,
            }
        )
    transfers = {"truth": truth.transfer, **{name: scenes[name].transfer for name in fitted}}
    return rows, pictures, transfers


def show(rows: list[dict[str, Any]]) -> None:
    titles = ("extinction", "largest", "colour", "fitted dB", "held-out dB", "relit dB")
    print(f"{'':<32}" + "".join(f"{title:>13}" for title in titles))
    for r in rows:
        errors = "".join(f"{r[key]:>13.4f}" for key in ("extinction", "largest_extinction", "colour"))
        scores = "".join(f"{r[key]:>13.1f}" for key in ("fitted_psnr", "held_out_psnr", "relit_psnr"))
        print(f"{r['model']:<32}{errors}{scores}")


def figure(pictures: dict[str, list[np.ndarray]], transfers: dict[str, Any], path: str) -> None:
    """A row of pictures for each model, and the extinctions and colours that were found."""
    from matplotlib.figure import Figure

    from jvr.pictures import srgb_from_linear

    drawing = Figure(figsize=(11, 7), layout="constrained")
    left, right = drawing.subfigures(1, 2, width_ratios=[1.25, 1], squeeze=False).ravel()
    panels = left.subplots(len(pictures), 3)
    for row, (name, some) in zip(panels, pictures.items(), strict=True):
        for panel, image, title in zip(row, some, ("fitted view", "held-out view", "relit"), strict=True):
            panel.imshow(srgb_from_linear(np.clip(image, 0, 1)))
            panel.set(xticks=[], yticks=[])
            panel.set_title(title if name == "truth" else "", fontsize=9)
        row[0].set_ylabel(name.replace(", ", ",\n"), fontsize=8)
    above, *below = right.subplots(4, 1, sharex=True, height_ratios=[2, 1, 1, 1])
    styles = {"truth": "k-", "with shadows": "C0o--", "without shadows": "C1s:"}
    for name, transfer in transfers.items():
        low, high = np.asarray(transfer.domain)
        s = np.linspace(low, high, len(transfer.sigma_t))
        above.plot(s, transfer.sigma_t, styles[name], markersize=4, label=name)
        seen = np.asarray(transfers["truth"].sigma_t) >= SEEN * float(np.max(transfers["truth"].sigma_t))
        for panel, channel, label in zip(below, np.asarray(transfer.rgb).T, ("red", "green", "blue"), strict=True):
            panel.plot(s[seen], channel[seen], styles[name], markersize=4)
            panel.set(ylabel=label, ylim=(-0.05, 1.05))
    above.set(ylabel="extinction, 1 / mm", title="16 entries; colours where there is extinction")
    above.legend(fontsize=8, frameon=False)
    below[-1].set_xlabel("value")
    drawing.savefig(path, dpi=120)


def main() -> None:
    """Runs both fits, prints their scores, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of the pictures and the transfer functions")
    parser.add_argument("--quick", action="store_true", help="the embedded volume, tiny pictures, few entries and steps")
    arguments = parser.parse_args()
    on_head = (DATA / HEAD).exists() and not arguments.quick
    if not on_head and not arguments.quick:
        print(f"{HEAD} is not in $JVR_DATA: the embedded volume stands in for it", file=sys.stderr)
    small = (
        "truth.entries=4",
        "fit.start.entries=4",
        "camera.width=12",
        "camera.height=12",
        "settings.step=4.0",
        "fit.max_steps=3",
    )
    name = "real/shadowed_fit.toml" if on_head else "shadowed_fit.toml"
    config = read_config(CONFIGS / name, small if arguments.quick else ())
    rows, pictures, transfers = compare(build_fit(config), build_scene(config), 12 if arguments.quick else 160)
    show(rows)
    if arguments.json:
        result = {"machine": machine(), "config": f"configs/{name}", "table": rows}
        Path(arguments.json).write_text(json.dumps(result, indent=2) + "\n")
    if arguments.figure:
        figure(pictures, transfers, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
