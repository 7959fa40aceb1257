"""Voxels from pictures: absorption in parallel beams beside filtered backprojection, SART and Adam, and colours under a known transfer
function.

`python experiments/tomography.py [--json FILE] [--figure FILE] [--quick]`; scikit-image is needed for the two it is compared with.

The head of Shepp and Logan is projected in closed form, with noise; the beams go round one axis, so that slices are tomograms of their own.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx

sys.path.insert(0, str(Path(__file__).parents[1]))

import jvr
from benchmarks.__main__ import machine
from experiments.phantoms import Ellipsoids

VOXELS: Any = lambda scene: scene.volume.values
# Standard deviation of a transmitted pixel, of 1 where there is nothing.
NOISE = 0.01
# Extinction per voxel where the phantom is 1.
DENSEST = 0.1
# Strengths, for all numbers of views.
VARIATION = 3e-4
VARIATION_OF_COLOURS, SMOOTHNESS_OF_COLOURS = 1e-4, 1e-5


class Beams(NamedTuple):
    """Parallel beams round z: `theta` in degrees as scikit-image counts them, cameras, noisy pictures, and what the voxels should be."""

    theta: np.ndarray
    cameras: tuple[jvr.OrthographicCamera, ...]
    images: list[np.ndarray]
    start: jvr.Scene
    truth: np.ndarray


def beams(size: int, views: int) -> Beams:
    """The phantom on `size^3` voxels a millimetre apart, seen by as many pixels; the axis goes through voxel `size // 2`, as in
    scikit-image."""
    axis = np.array([size // 2, size // 2, (size - 1) / 2], float)
    phantom, theta = Ellipsoids(axis, 0.94 * (size // 2 - 1)), np.arange(views) * 180 / views
    transfer = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [0.0, DENSEST])
    volume = jvr.Volume(np.full((size,) * 3, 0.1, np.float32))
    start = jvr.Scene(volume, transfer, background=(1.0, 1.0, 1.0), optical=jvr.AbsorptionOnly())
    cameras, images, rng = [], [], np.random.default_rng(0)
    for angle in np.radians(theta):
        towards, right = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
        # Pixel size // 2 looks through the axis.
        middle = axis - right / 2 * (1 - size % 2)
        camera = jvr.OrthographicCamera.look_at(middle + 2 * size * towards, middle, (0, 0, 1), float(size), size, size)
        grey = np.exp(-DENSEST * phantom.integrals(camera))
        # One detector: its three channels are the same.
        noisy = np.maximum(grey + NOISE * rng.standard_normal(grey.shape), 0)
        cameras.append(camera)
        images.append(np.repeat(noisy[..., None], 3, axis=-1).astype(np.float32))
    return Beams(theta, tuple(cameras), images, start, phantom.voxels(np.eye(4), (size,) * 3))


def psnr(found: Any, truth: np.ndarray) -> float:
    """Of all voxels, relative to 1."""
    return float(-10 * np.log10(np.mean(np.square(np.asarray(found, float) - truth))))


# --- Peers -----------------------------------------------------------------------------------------------------------


def sinograms(of: Beams) -> np.ndarray:
    """Line integrals of the phantom, `(slices, detectors, views)`, slices along z."""
    depth = -np.log(np.maximum([image[..., 0] for image in of.images], 1e-3)) / DENSEST
    return np.transpose(depth[:, ::-1], (1, 2, 0)).astype(float)


def backprojected(of: Beams) -> tuple[str, np.ndarray]:
    """Filtered backprojection, by the better of two filters, kept in 0 ... 1."""
    from skimage.transform import iradon

    tried = {}
    for name in ("ramp", "hann"):
        slices = [iradon(s, of.theta, filter_name=name, circle=True) for s in sinograms(of)]
        tried[name] = np.clip(np.stack(slices, axis=-1), 0, 1)
    return max(tried.items(), key=lambda item: psnr(item[1], of.truth))


def algebraic(of: Beams, most: int) -> tuple[str, np.ndarray]:
    """SART, after the best number of rounds, kept in 0 ... 1."""
    from skimage.transform import iradon_sart

    found: list[Any] = [None] * len(sinograms(of))
    tried = {}
    for rounds in range(1, most + 1):
        found = [iradon_sart(s, of.theta, image=f, clip=(0, 1)) for s, f in zip(sinograms(of), found, strict=True)]
        tried[f"{rounds} rounds"] = np.stack(found, axis=-1)
    return max(tried.items(), key=lambda item: psnr(item[1], of.truth))


def adam(
    of: Beams, prior: jvr.TotalVariation, settings: jvr.Settings, seconds: float
) -> tuple[np.ndarray, list[tuple[float, float]]]:
    """Plain Adam over `jax.grad` of the same objective for as long as that, and PSNR of the voxels over seconds."""
    views = jax.tree.map(lambda *leaves: jnp.stack(leaves), *of.cameras)
    targets, optimiser = jnp.asarray(np.array(of.images)), optax.adam(0.02)

    def objective(values: Any) -> Any:
        scene = eqx.tree_at(VOXELS, of.start, values)
        loss = lambda pair: jnp.mean(jnp.square(jvr.render(scene, pair[0], settings).rgb - pair[1]))
        return jnp.mean(jax.lax.map(loss, (views, targets))) + prior.value(scene)

    @jax.jit
    def step(values: Any, state: Any) -> Any:
        change, state = optimiser.update(jax.grad(objective)(values), state)
        return jnp.clip(values + change, 0, 1), state

    values, curve = VOXELS(of.start), []
    state = optimiser.init(values)
    jax.block_until_ready(step(values, state))
    began = time.perf_counter()
    while not curve or curve[-1][0] < seconds:
        values, state = jax.block_until_ready(step(values, state))
        curve.append((time.perf_counter() - began, psnr(values, of.truth)))
    return np.asarray(values), curve


# --- Ours ------------------------------------------------------------------------------------------------------------


# By a smooth map into a little more than 0 ... 1: at the end of such a map a voxel has no slope. They are cut to that at the end.
BOUNDED = {"solver": optx.LBFGS(rtol=1e-9, atol=1e-12), "transforms": (jvr.Sigmoid(-0.02, 1.02),)}


def absorbed(
    of: Beams, levels: int, steps: int, priors: tuple[Any, ...], settings: jvr.Settings, by: dict[str, Any]
) -> jvr.FitResult:
    """A fit of the voxels to the beams."""
    given = {"unknowns": VOXELS, "settings": settings, "priors": priors, "max_steps": steps, "progress": False, **by}
    return jvr.fit_on_grids(of.start, of.cameras, of.images, levels=levels, **given)


def without_compiling(history: tuple[Any, ...], most: int) -> float:
    """Seconds of a fit on grids of `most` steps each: every step counts as the median of its grid, since the first ones compile."""
    steps = np.diff([0.0, *(entry.seconds for entry in history)])
    return float(sum(np.median(part) * part.size for part in np.split(steps, range(most, steps.size, most))))


class Row(NamedTuple):
    """What one method found: PSNR of voxels, and of a picture that took no part where there is one, in `seconds`."""

    method: str
    views: int
    voxels: float
    seconds: float
    steps: int | None = None
    held_out: float | None = None


Found = dict[str, np.ndarray]


def absorption(size: int, numbers: tuple[int, ...], steps: int) -> tuple[list[Row], dict[int, Found], list[tuple[float, float]]]:
    """Every method for every number of views, the middle slices of each, and the curve of Adam at the second number."""
    rows, slices, curve, settings = [], {}, [], jvr.Settings(1.0, termination=0.0)
    prior = jvr.TotalVariation(VARIATION)
    for views in numbers:
        of = beams(size, views)
        shown: Found = {"truth": of.truth}

        def note(
            method: str, found: np.ndarray, seconds: float, steps: int | None = None, of: Beams = of, shown: Found = shown
        ) -> None:
            shown[method] = np.asarray(found)
            rows.append(Row(method, len(of.cameras), psnr(found, of.truth), seconds, steps))
            print(f"{rows[-1].views} views, {method}: {rows[-1].voxels:.2f} dB, {seconds:.1f} s", file=sys.stderr, flush=True)

        for name, run in {"FBP": lambda of=of: backprojected(of), "SART": lambda of=of: algebraic(of, 10)}.items():
            began = time.perf_counter()
            _, found = run()
            note(name, found, time.perf_counter() - began)
        kinds: dict[str, tuple[int, int, tuple[Any, ...], dict[str, Any]]] = {"no prior": (1, 2 * steps, (), BOUNDED)}
        kinds["TV, coarse to fine"] = (3, steps, (prior,), BOUNDED)
        if views == numbers[1]:
            kinds |= {
                "TV": (1, 2 * steps, (prior,), BOUNDED),
                "TV, L-BFGS-B": (1, 2 * steps, (prior,), {"solver": jvr.LBFGSB(tol=0.0)}),
            }
        for name, (levels, most, priors, by) in kinds.items():
            result = absorbed(of, levels, most, priors, settings, by)
            found = np.clip(VOXELS(result.scene), 0, 1)
            # Compiling is left out, as it is of Adam.
            note(name, found, without_compiling(result.history, most), len(result.history))
        if views == numbers[1]:
            ours = next(r.seconds for r in rows if r.method == "TV, coarse to fine" and r.views == views)
            found, curve = adam(of, prior, settings, 3 * ours)
            at = next(i for i, (seconds, _) in enumerate(curve) if seconds >= ours)
            rows.append(Row("Adam, as long", views, curve[at][1], curve[at][0], at + 1))
            note("Adam, three times as long", found, curve[-1][0], len(curve))
        slices[views] = {name: found[..., size // 2] for name, found in shown.items()}
        # The programs of all fits together exceed what a process may map into memory.
        jax.clear_caches()
    return rows, slices, curve


# --- Colours ---------------------------------------------------------------------------------------------------------


def coloured(size: int, views: int, width: int, steps: int) -> tuple[list[Row], Found, Found]:
    """The density behind colour pictures under a known transfer function (the second experiment of Weiss and Westermann 2022), on half as
    many voxels along an edge as the pictures were made of: rows, pictures of the view kept aside, and middle slices."""
    fine, coarse = np.diag([0.5, 0.5, 0.5, 1.0]), np.eye(4)
    phantom = Ellipsoids(np.full(3, (size - 1) / 2), 0.94 * (size - 1) / 2)
    transfer = jvr.LinearTransfer(
        [0.0, 0.1, 0.2, 0.3, 0.6, 1.0],
        [[0, 0, 0], [0.05, 0.1, 0.6], [0.8, 0.25, 0.2], [0.95, 0.85, 0.2], [0.2, 0.7, 0.4], [0.9, 0.9, 0.9]],
        np.array([0.0, 0.4, 1.2, 6.0, 4.0, 8.0]) / size,
    )
    truth = jvr.Scene(jvr.Volume(phantom.voxels(fine, (2 * size - 1,) * 3), fine), transfer)
    wanted = phantom.voxels(coarse, (size,) * 3)
    start = jvr.Scene(jvr.Volume(np.full((size,) * 3, 0.1, np.float32), coarse), transfer)
    center, radius = truth.volume.center, 4.0 * float(truth.volume.radius)
    cameras = jvr.fibonacci_sphere(center, radius, views, 26.0, width, width)
    aside = jvr.fibonacci_sphere(center, radius, 2 * views + 1, 26.0, width, width)[views]
    picture, rng = jax.jit(jvr.render), np.random.default_rng(2)
    exact = lambda camera: np.asarray(picture(truth, camera, jvr.Settings(0.5, termination=0.0)).rgb)
    images = [
        np.maximum(exact(camera) + NOISE / 2 * rng.standard_normal((width, width, 3)), 0).astype(np.float32) for camera in cameras
    ]
    settings, rows = jvr.Settings(0.5, termination=0.0), []
    pictures, slices = {"truth": exact(aside)}, {"truth": wanted[..., size // 2]}
    variation, smooth = jvr.TotalVariation(VARIATION_OF_COLOURS), jvr.Tikhonov(SMOOTHNESS_OF_COLOURS)
    kinds: dict[str, tuple[int, int, tuple[Any, ...]]] = {
        "no prior": (1, 2 * steps, ()),
        "Tikhonov": (1, 2 * steps, (smooth,)),
        "TV": (1, 2 * steps, (variation,)),
        "TV, coarse to fine": (3, steps, (variation,)),
    }
    for name, (levels, most, priors) in kinds.items():
        given = {"unknowns": VOXELS, "settings": settings, "priors": priors, "progress": False, **BOUNDED}
        result = jvr.fit_on_grids(start, cameras, images, levels=levels, max_steps=most, **given)
        pictures[name] = np.asarray(picture(result.scene, aside, settings).rgb)
        found = np.clip(VOXELS(result.scene), 0, 1)
        error = float(np.mean(np.square(pictures[name] - pictures["truth"])))
        seconds = without_compiling(result.history, most)
        rows.append(Row(name, views, psnr(found, wanted), seconds, len(result.history), float(-10 * np.log10(error))))
        print(f"colours, {name}: {rows[-1].voxels:.2f} dB, picture {rows[-1].held_out:.2f} dB", file=sys.stderr, flush=True)
        slices[name] = found[..., size // 2]
        jax.clear_caches()
    return rows, pictures, slices


# --- What is shown ---------------------------------------------------------------------------------------------------


def show(rows: list[Row]) -> None:
    print(f"{'method':<28}{'views':>6}{'voxels dB':>11}{'picture dB':>12}{'steps':>7}{'s':>8}")
    for r in rows:
        picture, steps = ("" if r.held_out is None else f"{r.held_out:.2f}"), ("" if r.steps is None else r.steps)
        print(f"{r.method:<28}{r.views:>6}{r.voxels:>11.2f}{picture:>12}{steps:>7}{r.seconds:>8.1f}")


def figure(
    rows: list[Row],
    slices: dict[int, Found],
    curve: list[tuple[float, float]],
    colours: tuple[list[Row], Found, Found],
    path: str,
) -> None:
    """PSNR over views and over seconds, middle slices, and what the colours gave."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(12, 11.5), layout="constrained")
    of_curves, of_slices, of_colours = drawing.subfigures(3, 1, height_ratios=[1.0, 1.1, 1.35], squeeze=False).ravel()
    over_views, over_time = of_curves.subplots(1, 2)
    numbers = sorted(slices)
    methods = list(dict.fromkeys(r.method for r in rows if not r.method.startswith("Adam")))
    for method in methods:
        over_views.plot(*zip(*((r.views, r.voxels) for r in rows if r.method == method), strict=True), marker="o", label=method)
    over_views.set(xlabel="views", ylabel="PSNR of voxels (dB)", xscale="log", xticks=numbers, xticklabels=numbers)
    over_views.minorticks_off()
    over_views.legend(frameon=False, fontsize=8)
    chosen = numbers[1]
    over_time.plot(*zip(*curve, strict=True), color="black", label="Adam, same objective")
    for i, method in enumerate(methods):
        one = next(r for r in rows if r.method == method and r.views == chosen)
        over_time.plot(one.seconds, one.voxels, "o", color=f"C{i}", label=method)
    over_time.set(xlabel=f"seconds, {chosen} views", ylabel="PSNR of voxels (dB)", xscale="log")
    over_time.legend(frameon=False, fontsize=8)
    shown = [name for name in slices[chosen] if name != "Adam, three times as long"]
    of_slices.suptitle("Middle slices, 0 (black) ... 0.5 (white)", fontsize=10)
    for row, views in zip(of_slices.subplots(2, len(shown), squeeze=False), (numbers[0], chosen), strict=True):
        row[0].set_ylabel(f"{views} views")
        for panel, name in zip(row, shown, strict=True):
            if name not in slices[views]:
                panel.set_axis_off()
                continue
            panel.imshow(slices[views][name].T, cmap="gray", vmin=0, vmax=0.5, origin="lower")
            score = next((f"\n{r.voxels:.1f} dB" for r in rows if (r.method, r.views) == (name, views)), "")
            panel.set_title(name + score, fontsize=8)
    table, pictures, middle = colours
    of_colours.suptitle(f"Colours of {table[0].views} views: one kept aside, and middle slices of the density", fontsize=10)
    above, below = of_colours.subplots(2, len(pictures), squeeze=False)
    for one, other, name in zip(above, below, pictures, strict=True):
        one.imshow(jvr.srgb_from_linear(np.clip(pictures[name], 0, 1)))
        other.imshow(middle[name].T, cmap="gray", vmin=0, vmax=0.5, origin="lower")
        score = next((r for r in table if r.method == name), None)
        one.set_title(name + (f"\n{score.held_out:.1f} dB" if score else ""), fontsize=8)
        other.set_title(f"voxels {score.voxels:.1f} dB" if score else "", fontsize=8)
    for figure in (of_slices, of_colours):
        for panel in figure.axes:
            panel.set(xticks=[], yticks=[])
    drawing.savefig(path, dpi=110)


def main() -> None:
    """Runs both parts, prints their tables, and writes JSON and a figure on request."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--figure", metavar="FILE", help="PNG of PSNR over views and seconds, and of slices and pictures")
    parser.add_argument("--quick", action="store_true", help="few voxels, views and steps")
    arguments = parser.parse_args()
    size, numbers, steps = (16, (4, 8), 5) if arguments.quick else (64, (8, 16, 32, 64), 16)
    rows, slices, curve = absorption(size, numbers, steps)
    colours = coloured(*((9, 3, 12, 3) if arguments.quick else (33, 16, 64, 24)))
    show(rows)
    show(colours[0])
    if arguments.json:
        setup = {
            "voxels": size,
            "noise": NOISE,
            "densest": DENSEST,
            "variation": VARIATION,
            "colours": [VARIATION_OF_COLOURS, SMOOTHNESS_OF_COLOURS],
        }
        tables = {"absorption": [r._asdict() for r in rows], "colours": [r._asdict() for r in colours[0]]}
        Path(arguments.json).write_text(json.dumps({"machine": machine(), "setup": setup, **tables}, indent=2) + "\n")
    if arguments.figure:
        figure(rows, slices, curve, colours, arguments.figure)


if __name__ == "__main__":
    jvr.use_all_cores()
    main()
