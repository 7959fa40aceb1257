"""How a translucent volume scatters, from six noisy views under a light that moves: asymmetry, lobes and albedo with standard errors.

`python experiments/phase_recovery.py [--json FILE] [--figure FILE] [--quick]`; everything is in `configs/phase_recovery.toml`.

`jvr.fit` explains all pictures by one scene. Here every view has a scene of its own, the same but for the direction of its light, so the
residuals of all views are stacked as a function of what the scenes share, and Optimistix's Levenberg-Marquardt makes them small:
`jvr.Settings(adjoint=jvr.Forward())` is what it needs to differentiate `jvr.render`. Standard errors come from the Jacobian at the end, by
the same rule as those of `jvr.fit`. Beside it `jvr.fit` itself, with the light at rest, finds the direction of the light as well. Two
questions have no answer, and are reported so: albedo and irradiance, of which pictures determine the product alone, and asymmetry and
albedo under a light at the eye, which shows one scattering angle.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from experiments.accuracy_vs_time import machine
from jvr.fitting.identifiability import identifiability
from jvr.fitting.unknowns import ExposedModel, Unknowns, choose_unknowns
from jvr.io.config import Config, build_fit, build_scene, read_config

CONFIG = Path(__file__).parents[1] / "configs" / "phase_recovery.toml"
# Standard deviation of the noise, as a share of the brightest pixel.
NOISE = 0.01
# The light turns by so many degrees about z from one view to the next, the camera by 60.
TURN = 100.0
LOBES = (
    'scattering.phase={kind="double-henyey-greenstein", g1=0.7, g2=-0.4, weight=0.75}',
    'fit.initial.scattering={albedo=0.5, phase={kind="double-henyey-greenstein", g1=0.3, g2=-0.1, weight=0.5}}',
    'fit.unknowns=["scattering.phase.g1", "scattering.phase.g2", "scattering.phase.weight", "scattering.albedo"]',
)
DIRECTION = (
    "fit.initial.lights=[{kind='directional', direction=[0.3, 0.9, -0.1], irradiance=[12.0, 11.0, 10.0]}]",
    'fit.unknowns=["scattering.phase.g", "scattering.albedo", "lights.0.direction"]',
)
BOTH = (
    "fit.initial.lights=[{kind='directional', direction=[0.8, 0.6, -0.4], irradiance=[9.0, 9.0, 9.0]}]",
    "fit.initial.scattering={albedo=0.7, phase={kind='henyey-greenstein', g=0.55}}",
    'fit.unknowns=["scattering.albedo", "lights.0.irradiance"]',
)
# A light at the eye, which shows one scattering angle; shadows ask for another light.
HEAD = ('lights=[{kind="head", irradiance=12.0}, {kind="directional", direction=[0, 0, -1], irradiance=0.0}]',)


class View(NamedTuple):
    """A camera, how far the light has turned, and the picture. All views together have a leading axis."""

    camera: Any
    turn: Float[Array, "..."]
    image: Float[Array, "..."]


class Residuals(eqx.Module):
    """Rendered minus target of every view, as Optimistix calls it: a function of what the views share, in unconstrained space."""

    start: ExposedModel
    unknowns: Unknowns
    views: View
    settings: jvr.Settings

    def of_values(self, values: Float[Array, "unknowns"]) -> Float[Array, "residuals"]:
        scene = self.unknowns.insert(self.start, self.unknowns.split(values, self.start)).scene
        of_view = lambda view: jvr.render(turned(scene, view.turn), view.camera, self.settings).rgb - view.image
        # One program for all views.
        return jnp.ravel(jax.lax.map(of_view, self.views))

    def __call__(self, unconstrained: Float[Array, "unknowns"], args: None) -> tuple[Float[Array, "residuals"], None]:
        return self.of_values(self.unknowns.values_from_unconstrained(unconstrained, self.start)), None


class Found(NamedTuple):
    """What a run ends with: names, values from start to end (at each step where there is a way to see them), standard errors, number of
    steps, seconds, and how many combinations of unknowns the pictures determine."""

    names: list[str]
    path: np.ndarray
    errors: np.ndarray
    steps: int
    seconds: float
    rank: int


def turned(scene: jvr.Scene, degrees: Any) -> jvr.Scene:
    """The scene with its first light turned about z."""
    angle, light = jnp.deg2rad(degrees), cast(Any, scene.lights[0])
    x, y, z = light.direction
    direction = jnp.stack([jnp.cos(angle) * x - jnp.sin(angle) * y, jnp.sin(angle) * x + jnp.cos(angle) * y, z])
    return eqx.tree_at(lambda s: s.lights[0].direction, scene, direction)


def noisy(images: Sequence[Any], seed: int) -> list[np.ndarray]:
    """The pictures with independent normal noise in every pixel and channel."""
    rng, level = np.random.default_rng(seed), NOISE * max(float(np.max(image)) for image in images)
    return [np.asarray(image + level * rng.standard_normal(np.shape(image)), np.float32) for image in images]


def under_moving_light(config: Config, steps: int = 30) -> tuple[Found, View]:
    """The fit with a light for each view, by Optimistix."""
    job, truth = build_fit(config), build_scene(config)
    settings = eqx.tree_at(lambda s: s.adjoint, job.keywords["settings"], jvr.Forward())
    turns = [TURN * i for i in range(len(job.cameras))]
    render = jax.jit(jvr.render)
    images = noisy([render(turned(truth, t), c, settings).rgb for t, c in zip(turns, job.cameras, strict=True)], seed=1)
    stacked = [View(c, jnp.asarray(t), jnp.asarray(i)) for c, t, i in zip(job.cameras, turns, images, strict=True)]
    views = jax.tree.map(lambda *leaves: jnp.stack(leaves), *stacked)

    start = ExposedModel(job.scene, None)
    chosen = choose_unknowns(start, lambda m: job.keywords["unknowns"](m.scene))
    residuals = Residuals(start, chosen, views, settings)
    began = time.perf_counter()
    path = minimised(residuals, chosen.unconstrained_from_model(start), steps)
    values = [np.asarray(chosen.values_from_unconstrained(unconstrained, start)) for unconstrained in path]
    jacobian = np.asarray(_jacobian(residuals, jnp.asarray(values[-1])), np.float64)
    r = np.asarray(residuals_at(residuals, jnp.asarray(values[-1])), np.float64)
    known = identifiability(jacobian.T @ jacobian, float(r @ r), r.size)
    seconds = time.perf_counter() - began
    return Found(_labels(chosen, start), np.stack(values), known.standard_errors, len(path) - 1, seconds, known.rank), views


def minimised(residuals: Residuals, unconstrained: Float[Array, "unknowns"], steps: int) -> list[Array]:
    """The accepted points of Levenberg-Marquardt, one for each step."""
    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-5)
    shape, aux = eqx.filter_eval_shape(residuals, unconstrained, None)
    state, path = solver.init(residuals, unconstrained, None, {}, shape, aux, frozenset()), [unconstrained]
    for _ in range(steps):
        unconstrained, state, done = _step(solver, residuals, unconstrained, state)
        path.append(unconstrained)
        if done:
            break
    return path


@eqx.filter_jit
def _step(solver: Any, residuals: Residuals, unconstrained: Array, state: Any) -> tuple[Array, Any, Array]:
    unconstrained, state, _ = solver.step(residuals, unconstrained, None, {}, state, frozenset())
    done, _ = solver.terminate(residuals, unconstrained, None, {}, state, frozenset())
    return unconstrained, state, done


@eqx.filter_jit
def residuals_at(residuals: Residuals, values: Array) -> Array:
    return residuals.of_values(values)


@eqx.filter_jit
def _jacobian(residuals: Residuals, values: Array) -> Array:
    return jax.jacfwd(residuals.of_values)(values)


def light_at_rest(config: Config) -> Found:
    """The fit with one light for all views, by `jvr.fit`."""
    job = build_fit(config)
    result = jvr.fit(job.scene, job.cameras, noisy(job.targets, seed=2), **job.keywords)
    chosen = choose_unknowns(ExposedModel(job.scene, None), lambda m: job.keywords["unknowns"](m.scene))
    values = [np.concatenate([np.ravel(a) for a in job.keywords["unknowns"](s)]) for s in (job.scene, result.scene)]
    errors = np.concatenate([np.ravel(e) for e in result.errors_by_name.values()])
    names, stats = _labels(chosen, ExposedModel(job.scene, None)), result.stats
    return Found(names, np.stack(values), errors, len(result.history), stats.seconds, stats.rank)


def _labels(chosen: Unknowns, model: ExposedModel) -> list[str]:
    """A name for each number."""
    found = []
    for name, array in zip(chosen.names, chosen.values(model), strict=True):
        short = name.removeprefix("scattering.")
        found += [short] if array.ndim == 0 else [f"{short}[{i}]" for i in range(array.size)]
    return found


def true_values(config: Config) -> np.ndarray:
    """What the unknowns are where the pictures come from; directions with length 1, as fits return them."""
    select, scene = build_fit(config).keywords["unknowns"], build_scene(config)
    light = cast(Any, scene.lights[0])
    if isinstance(light, jvr.DirectionalLight):
        scene = eqx.tree_at(lambda s: s.lights[0].direction, scene, light.direction / jnp.linalg.norm(light.direction))
    return np.concatenate([np.ravel(a) for a in select(scene)])


def rows(run: str, found: Found, truth: np.ndarray) -> list[dict[str, Any]]:
    """One line for each number; what is not determined has the standard error `None`."""
    lines = []
    for name, true, first, last, error in zip(found.names, truth, found.path[0], found.path[-1], found.errors, strict=True):
        known = bool(np.isfinite(error))
        away = float(abs(last - true) / error) if known else None
        lines.append({"run": run, "unknown": name, "truth": float(true), "start": float(first), "found": float(last),
                      "standard_error": float(error) if known else None, "errors_from_truth": away})  # fmt: skip
    return lines


def show(lines: list[dict[str, Any]], found: Found) -> None:
    print(f"\n{lines[0]['run']}: {found.steps} steps, {found.seconds:.0f} s, {found.rank} of {len(lines)} combinations known")
    print(f"{'':<26}{'truth':>10}{'start':>10}{'found':>10}{'std. error':>12}{'away':>8}")
    for line in lines:
        error, away = line["standard_error"], line["errors_from_truth"]
        tail = f"{error:>12.5f}{away:>8.1f}" if error is not None else f"{'infinite':>12}{'':>8}"
        print(f"{line['unknown']:<26}{line['truth']:>10.4f}{line['start']:>10.4f}{line['found']:>10.4f}{tail}", flush=True)


def figure(one: Found, lobes: Found, truths: Sequence[np.ndarray], views: View, path: str) -> None:
    """The pictures of the first run, how the unknowns of both came to their values, and the lobes that were found."""
    from matplotlib.figure import Figure

    from jvr.pictures import srgb_from_linear

    drawing = Figure(figsize=(11, 5.2), layout="constrained")
    above, below = drawing.subfigures(2, 1, height_ratios=[1, 1.7], squeeze=False).ravel()
    white = float(np.percentile(np.asarray(views.image), 99.8))
    for panel, image, turn in zip(above.subplots(1, len(views.turn)), views.image, views.turn, strict=True):
        panel.imshow(srgb_from_linear(np.clip(np.asarray(image) / white, 0, 1)))
        panel.set_title(f"light turned by {float(turn) % 360:g}°", fontsize=8)
        panel.set_axis_off()
    panels = below.subplots(1, 3)
    for panel, found, truth, title in zip(panels, (one, lobes), truths, ("one lobe", "two lobes"), strict=False):
        for i, name in enumerate(found.names):
            panel.plot(found.path[:, i], "o-", markersize=3, color=f"C{i}", label=name)
            panel.axhline(truth[i], color=f"C{i}", linestyle=":", linewidth=1)
        panel.set(title=f"{title} (dotted: truth)", xlabel="step of Levenberg-Marquardt")
        panel.xaxis.get_major_locator().set_params(integer=True)
        panel.legend(fontsize=8, frameon=False)
    degrees = np.linspace(0, 180, 181)
    for values, style, label in ((lobes.path[0], "C7--", "start"), (lobes.path[-1], "C0-", "found"), (truths[1], "k:", "truth")):
        panels[2].plot(degrees, _lobes(values, degrees), style, label=label)
    panels[2].set(title="phase function of two lobes", xlabel="scattering angle, degrees", yscale="log")
    panels[2].legend(fontsize=8, frameon=False)
    drawing.savefig(path, dpi=130)


def _lobes(values: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    from jvr.model.phase import ScatteringAngle

    phase = jvr.DoubleHenyeyGreenstein(values[0], values[1], values[2])
    return np.asarray(phase.evaluate(ScatteringAngle.of_cosine(jnp.cos(jnp.deg2rad(jnp.asarray(degrees)))))[0])


def main() -> None:
    """Runs all fits, prints a table for each, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of the pictures and the convergence")
    parser.add_argument("--quick", action="store_true", help="tiny pictures, long steps, half of the fits")
    arguments = parser.parse_args()
    small = ("camera.width=12", "camera.height=12", "settings.step=4.0") if arguments.quick else ()
    configs = {name: read_config(CONFIG, [*small, *sets]) for name, sets in
               (("one lobe", ()), ("two lobes", LOBES), ("direction", DIRECTION), ("both", BOTH), ("head", HEAD))}  # fmt: skip
    truths = {name: true_values(config) for name, config in configs.items()}
    one, views = under_moving_light(configs["one lobe"])
    lobes, _ = under_moving_light(configs["two lobes"])
    runs = {
        "one lobe, moving light": ("one lobe", one),
        "two lobes, moving light": ("two lobes", lobes),
        "one lobe, light at the eye (jvr.fit)": ("head", light_at_rest(configs["head"])),
    }
    if not arguments.quick:
        runs |= {
            "albedo and irradiance, moving light": ("both", under_moving_light(configs["both"])[0]),
            "one lobe and direction, light at rest (jvr.fit)": ("direction", light_at_rest(configs["direction"])),
            "albedo and irradiance, light at rest (jvr.fit)": ("both", light_at_rest(configs["both"])),
        }
    table = []
    for title, (name, found) in runs.items():
        table.append(rows(title, found, truths[name]))
        show(table[-1], found)
    if arguments.json:
        seconds = {title: found.seconds for title, (_, found) in runs.items()}
        result = {"machine": machine(), "noise": NOISE, "seconds": seconds, "table": [line for lines in table for line in lines]}
        Path(arguments.json).write_text(json.dumps(result, indent=2) + "\n")
    if arguments.figure:
        figure(one, lobes, (truths["one lobe"], truths["two lobes"]), views, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
