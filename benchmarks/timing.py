"""Timing several callables against each other on a noisy machine."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax


def seconds(functions: dict[str, Callable[[], Any]], repeats: int = 7) -> dict[str, list[float]]:
    """Wall seconds of each function, taken in turns so that a slow minute of the machine hits all of them alike."""
    for function in functions.values():
        jax.block_until_ready(function())
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            began = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(time.perf_counter() - began)
    return times


def ratio(times: dict[str, list[float]], name: str, reference: str) -> float:
    """The median over rounds of one time over the other."""
    return statistics.median(a / b for a, b in zip(times[name], times[reference], strict=True))


def median(times: dict[str, list[float]], name: str) -> float:
    return statistics.median(times[name])
