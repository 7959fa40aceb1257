"""Pictures at equal error, and times in turns."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.peers.settings import STEPS
from benchmarks.peers.worker import Worker

# How near to its best a renderer must come before a longer step is preferred.
NEAR_BEST = 1.05


@contextlib.contextmanager
def running(names: list[str], *arguments: Any) -> Iterator[tuple[dict[str, Worker], dict[str, str]]]:
    """Workers that have loaded a scene, and the reasons of those that could not."""
    with contextlib.ExitStack() as stack:
        workers, failed = {}, {}
        for name in names:
            try:
                workers[name] = stack.enter_context(Worker(name)).load(*arguments)
            except RuntimeError as error:
                failed[name] = str(error)
        yield workers, failed


def error_at(worker: Worker, step: float, reference: np.ndarray, *choices: Any) -> float:
    """Draws with a step and what else there is to choose, and compares."""
    worker.call("prepare", step, *choices)
    worker.call("draw")
    return worker.call("error", reference)


def near_best(worker: Worker, reference: np.ndarray) -> tuple[float, float]:
    """The longest step whose error is within 5 % of the smallest that the renderer reaches, and that error."""
    errors = {step: error_at(worker, step, reference) for step in STEPS}
    limit = NEAR_BEST * min(errors.values())
    return next((step, error) for step, error in errors.items() if error <= limit)


def longest_step(worker: Worker, reference: np.ndarray, target: float) -> tuple[float, float]:
    """The longest step whose error is at most `target`, and that error; where none is, that of the smallest error met.

    By bisection, since a step may cost a compilation: the error is taken to grow with the step.
    """
    errors: dict[float, float] = {}
    low, high = 0, len(STEPS)
    while low < high:
        middle = (low + high) // 2
        step = STEPS[middle]
        errors[step] = error_at(worker, step, reference)
        low, high = (low, middle) if errors[step] <= target else (middle + 1, high)
    good = [step for step, error in errors.items() if error <= target]
    chosen = max(good) if good else min(errors, key=lambda step: errors[step])
    return chosen, errors[chosen]


def z_test(pictures: Sequence[np.ndarray], reference: np.ndarray) -> dict[str, float]:
    """Whether independent noisy pictures have the reference as their mean, pixel by pixel of the first channel.

    `z` is the difference of a pixel's mean over its standard error, both from the pictures, so that it follows Student's distribution.
    `mean_z` and `mean_square_z` come with what is expected and the standard error of that, `share_beyond_3` with what is expected;
    `brightness` is the mean of all pixels over that of the reference.
    """
    first, n = np.stack(pictures).astype(float)[..., 0], len(pictures)
    z = (first.mean(axis=0) - reference[..., 0]) / (first.std(axis=0, ddof=1) / np.sqrt(n))
    student = stats.t(n - 1)
    square, fourth = (float(student.moment(k)) for k in (2, 4))
    totals = first.mean(axis=(1, 2)) / reference[..., 0].mean()
    return {
        "pixels": z.size,
        "mean_z": float(z.mean()),
        "mean_z_expected": 0.0,
        "mean_z_deviation": float(np.sqrt(square / z.size)),
        "mean_square_z": float(np.mean(z**2)),
        "mean_square_z_expected": square,
        "mean_square_z_deviation": float(np.sqrt((fourth - square**2) / z.size)),
        "share_beyond_3": float(np.mean(np.abs(z) > 3)),
        "share_beyond_3_expected": float(2 * student.sf(3)),
        "brightness": float(totals.mean()),
        "brightness_deviation": float(totals.std(ddof=1) / np.sqrt(n)),
    }


def in_turns(functions: dict[str, Callable[[], float]], repeats: int) -> dict[str, list[float]]:
    """Seconds of each function, which measures itself; in turns, so that a slow minute of the machine hits all of them alike. The
    first round is dropped."""
    times = {name: [] for name in functions}
    for _ in range(repeats + 1):
        for name, function in functions.items():
            times[name].append(function())
    return {name: measured[1:] for name, measured in times.items()}
