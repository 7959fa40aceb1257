"""The measurements: what is rendered, to what error, and what is timed against what."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

import jvr
from benchmarks.peers import scenes
from benchmarks.peers.compare import NEAR_BEST, error_at, in_turns, longest_step, near_best, running, z_test
from benchmarks.peers.scenes import Scene
from benchmarks.peers.worker import Worker
from benchmarks.timing import median, ratio

USUAL_STEP = 0.5
# Where the packed one reaches the error, too, the faster of the two counts.
OURS = ("jvr", "jvr_packed")
# Of Mitsuba's picture of single scattering, whose error is then the target.
USUAL_SAMPLES = 64
# What jvr may choose from there: steps in voxels, and shadows.
LIT_STEPS = (16.0, 8.0, 4.0, 2.0, 1.0)
SHADOWS = (jvr.ShadowVolume(1 / 16), jvr.ShadowVolume(1 / 8), jvr.ShadowRays(8))
# A view in which the medium fills the picture: at its rim, a pixel's mean takes more rays than a reference can spare.
NARROW = 16.0


@dataclasses.dataclass(frozen=True)
class Sizes:
    """How much is measured: voxels a side, pictures a side, rounds."""

    voxels: int
    picture: int
    small_picture: int
    growth: tuple[int, ...]
    gradient_growth: tuple[int, ...]
    fit_picture: int
    absorption_error: float
    agreement: tuple[int, int, int]
    """Pictures a side, samples per pixel of each, and how many."""
    repeats: int


FULL = Sizes(128, 256, 128, (64, 128, 256, 512), (64, 128, 256), 128, 0.01, (48, 1024, 32), 7)
QUICK = Sizes(48, 64, 48, (32, 64), (32, 64), 48, 0.05, (16, 64, 16), 2)


def forward(scene: Scene, present: list[str], repeats: int) -> dict[str, Any]:
    """Pictures at the error of VTK's ray caster, taken at the longest step within 5 % of its best; without VTK, at that of `jvr`
    with half-voxel steps. Every other renderer takes its longest step that reaches this error."""
    reference = _reference(scene, "picture")
    names = [name for name in ("vtk", "vtk_gpu", "compiled", *OURS) if name in present]
    with running(names, scene) as (workers, failed):
        leader = "vtk" if "vtk" in workers else "jvr"
        usual = lambda worker: (USUAL_STEP, error_at(worker, USUAL_STEP, reference))
        chosen = {leader: near_best(workers["vtk"], reference) if leader == "vtk" else usual(workers["jvr"])}
        target = chosen[leader][1]
        for name in workers.keys() - {leader}:
            chosen[name] = longest_step(workers[name], reference, target)
        for name, worker in workers.items():
            worker.call("prepare", chosen[name][0])
        times = _times(workers, "draw", repeats)
        good = [name for name in OURS if name in workers and chosen[name][1] <= target] or ["jvr"]
        return {
            **_about(scene),
            "target_rmse": target,
            "renderers": _rows(workers, chosen, times, "draw", target) | _failures(failed),
            "jvr_over": {name: min(ratio(times, ours, name) for ours in good) for name in workers if name not in OURS},
        }


def gradient(scene: Scene, present: list[str], repeats: int) -> dict[str, Any]:
    """The picture and the gradient of a loss over it in the transfer function, at the error of PyTorch with half-voxel steps, for
    `jvr` at its longest step within 5 % of it. Reverse mode needs the whole picture in memory in one of the two."""
    reference, slope = _reference(scene, "picture"), _reference(scene, "gradient")
    with running([name for name in ("torch", "jvr") if name in present], scene) as (workers, failed):
        target = error_at(workers.get("torch", workers["jvr"]), USUAL_STEP, reference)
        chosen = {"torch": (USUAL_STEP, target)} if "torch" in workers else {}
        chosen["jvr"] = longest_step(workers["jvr"], reference, NEAR_BEST * target)
        for name, worker in workers.items():
            worker.call("prepare", chosen[name][0])
        times = _times(workers, "differentiate", repeats)
        rows = _rows(workers, chosen, times, "differentiate", NEAR_BEST * target)
        for name, worker in workers.items():
            rows[name]["gradient_errors"] = worker.call("gradient_error", slope)
        return {
            **_about(scene),
            "target_rmse": target,
            "renderers": rows | _failures(failed),
            "over_jvr": {name: ratio(times, name, "jvr") for name in workers if name != "jvr"},
        }


def absorption(scene: Scene, target: float, present: list[str], repeats: int) -> dict[str, Any]:
    """A medium that only absorbs, at a stated error: Mitsuba with as many samples as that takes, judged by the mean over pixels
    that it estimates; `jvr` at its longest step."""
    if "mitsuba" not in present:
        return {"failed": "Mitsuba is not installed"}
    centres, areas = _reference(scene, "picture"), _reference(scene, "picture", 4)
    with running(["mitsuba", "jvr"], scene) as (workers, failed):
        if failed:
            return {"failed": str(failed)}
        # The variance of the mean falls with the number of samples; one pilot says how many are needed.
        pilot = 16
        needed = max(1, round(pilot * (error_at(workers["mitsuba"], pilot, areas) / target) ** 2))
        chosen = {
            "mitsuba": (needed, error_at(workers["mitsuba"], needed, areas)),
            "jvr": longest_step(workers["jvr"], centres, target),
        }
        workers["jvr"].call("prepare", chosen["jvr"][0])
        times = _times(workers, "draw", repeats)
        rows = _rows(workers, chosen, times, "draw", NEAR_BEST * target)
        rows["mitsuba"]["samples_per_pixel"] = rows["mitsuba"].pop("step")
        return {
            **_about(scene),
            "target_rmse": target,
            "renderers": rows,
            "over_jvr": {"mitsuba": ratio(times, "mitsuba", "jvr")},
        }


def scattering(scene: Scene, sizes: Sizes, present: list[str]) -> dict[str, Any]:
    """Light that is scattered once: whether Mitsuba and the reference agree within noise, and the time of both at the error of
    Mitsuba's usual number of samples, `jvr` with the steps and shadows that are fastest there."""
    if "mitsuba" not in present:
        return {"failed": "Mitsuba is not installed"}
    centres, areas = _reference(scene, "picture"), _reference(scene, "picture", 2)
    with running(["mitsuba", "jvr"], scene) as (workers, failed):
        if failed:
            return {"failed": str(failed)}
        target = error_at(workers["mitsuba"], USUAL_SAMPLES, areas)
        step, error, shadows = _fastest_lit(workers["jvr"], centres, target)
        chosen = {"mitsuba": (USUAL_SAMPLES, target), "jvr": (step, error)}
        workers["jvr"].call("prepare", step, shadows)
        times = _times(workers, "draw", sizes.repeats)
        rows = _rows(workers, chosen, times, "draw", target)
        rows["mitsuba"]["samples_per_pixel"] = rows["mitsuba"].pop("step")
        rows["jvr"]["shadows"] = repr(shadows)
        return {
            **_about(scene),
            "target_rmse": target,
            "renderers": rows,
            "over_jvr": {"mitsuba": ratio(times, "mitsuba", "jvr")},
            "agreement": _agreement(scene, *sizes.agreement),
        }


def fit(size: int, present: list[str], repeats: int) -> dict[str, Any]:
    """A Levenberg-Marquardt fit to 60 dB beside one gradient over the same views in PyTorch, the same step for both."""
    with Worker("fit").load(size) as ours, contextlib.ExitStack() as stack:
        functions: dict[str, Callable[[], float]] = {"jvr": lambda: _to_goal(ours)}
        theirs = None
        if "torch" in present:
            theirs = stack.enter_context(Worker("torch_views")).load(*ours.call("views"))
            functions["torch"] = functools.partial(theirs.seconds, "gradient_step")
        times = in_turns(functions, repeats)
        row = {**ours.call("outcome"), "seconds": median(times, "jvr"), "peak_bytes": ours.peak("run")}
        if theirs is not None:
            row["torch_gradient_seconds"] = median(times, "torch")
            row["torch_peak_bytes"] = theirs.peak("gradient_step")
            row["fit_over_torch_gradient"] = ratio(times, "jvr", "torch")
        return row


def empty_space(sizes: Sizes) -> dict[str, float]:
    """What empty space costs `jvr`: the same object in a box of 8 times the volume, and 8 times the voxels with 5 % not empty."""
    object_ = scenes.four(sizes.voxels, sizes.picture)[0]
    narrow = object_.sized(sizes.small_picture, sizes.small_picture)
    few, many = sizes.growth[-2:]
    return {
        "picture_in_8_times_the_box": _pair("draw", object_, scenes.boxed(object_), sizes.repeats),
        "gradient_in_8_times_the_box": _pair("differentiate", narrow, scenes.boxed(narrow), sizes.repeats),
        "fit_in_8_times_the_box": _pair_of_fits(sizes.fit_picture, min(sizes.repeats, 3)),
        f"sparse_{many}_over_{few}": _pair(
            "draw", scenes.growing(few, sizes.picture), scenes.growing(many, sizes.picture), sizes.repeats
        ),
    }


def opengl(present: list[str]) -> str | None:
    """What VTK's GPU mapper draws with here."""
    if "vtk_gpu" not in present:
        return None
    with Worker("vtk_gpu").load(scenes.simulation(8, 8)) as worker:
        worker.call("prepare", USUAL_STEP)
        worker.call("draw")
        return worker.call("device")


def _fastest_lit(worker: Worker, reference: np.ndarray, target: float) -> tuple[float, float, Any]:
    """Step, error and shadows of the fastest picture with at most this error; where none is, of the one with the smallest. For each kind
    of shadows the longest step that reaches it is tried."""
    errors, seconds = {}, {}
    for shadows in SHADOWS:
        for step in LIT_STEPS:
            errors[step, shadows] = error_at(worker, step, reference, shadows)
            if errors[step, shadows] <= target:
                seconds[step, shadows] = min(worker.seconds("draw") for _ in range(5))
                break
    step, shadows = min(seconds, key=lambda one: seconds[one]) if seconds else min(errors, key=lambda one: errors[one])
    return step, errors[step, shadows], shadows


def _agreement(scene: Scene, size: int, samples: int, pictures: int) -> dict[str, float]:
    """A Z-test of Mitsuba's pictures against the reference."""
    close = dataclasses.replace(scene, view=dataclasses.replace(scene.view, width=size, height=size, fov_y=NARROW))
    reference = _reference(close, "picture", 3)
    with Worker("mitsuba").load(close) as worker:
        worker.call("prepare", samples)
        drawn = []
        for _ in range(pictures):
            worker.call("draw")
            drawn.append(worker.call("picture"))
    return {"samples_per_pixel": samples, "pictures": pictures, **z_test(drawn, reference)}


def _to_goal(worker: Worker) -> float:
    worker.call("run")
    return worker.call("seconds_to_goal")


def _pair_of_fits(size: int, repeats: int) -> float:
    with Worker("fit").load(size) as small, Worker("fit").load(size, True) as large:
        times = in_turns({"small": lambda: _to_goal(small), "large": lambda: _to_goal(large)}, repeats)
    return ratio(times, "large", "small")


def _pair(method: str, first: Scene, second: Scene, repeats: int) -> float:
    """The time of the second scene over that of the first, half-voxel steps."""
    with Worker("jvr").load(first) as a, Worker("jvr").load(second) as b:
        for worker in (a, b):
            worker.call("prepare", USUAL_STEP)
        times = in_turns({"a": lambda: a.seconds(method), "b": lambda: b.seconds(method)}, repeats)
    return ratio(times, "b", "a")


def _reference(scene: Scene, method: str, *arguments: Any) -> Any:
    with Worker("reference").load(scene) as worker:
        return worker.call(method, *arguments)


def _times(workers: dict[str, Worker], method: str, repeats: int) -> dict[str, list[float]]:
    return in_turns({name: functools.partial(worker.seconds, method) for name, worker in workers.items()}, repeats)


def _rows(
    workers: dict[str, Worker], chosen: dict[str, tuple[float, float]], times: Any, method: str, target: float
) -> dict[str, Any]:
    """What each renderer took."""
    return {
        name: {
            "step": chosen[name][0],
            "rmse": chosen[name][1],
            "reached": chosen[name][1] <= target,
            "seconds": median(times, name),
            "peak_bytes": worker.peak(method),
        }
        for name, worker in workers.items()
    }


def _failures(failed: dict[str, str]) -> dict[str, Any]:
    return {name: {"failed": reason} for name, reason in failed.items()}


def _about(scene: Scene) -> dict[str, Any]:
    return {
        "scene": scene.name,
        "data": scene.data,
        "voxels": scene.voxels.shape,
        "type": str(scene.voxels.dtype),
        "picture": (scene.view.width, scene.view.height),
    }
