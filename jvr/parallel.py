"""Compiled programs side by side: the CPU's second way to use all cores.

The operations of a march are too small to be shared between cores, so that a compiled program keeps little more than one of them
busy. Programs that do not wait for each other are therefore run from threads; the interpreter's lock is free while they run.
"""

import concurrent.futures
import os
from collections.abc import Callable, Sequence
from typing import TypeVar

import jax

Item = TypeVar("Item")
Result = TypeVar("Result")


def workers() -> int:
    """How many programs may run at a time: one for each core on CPUs, one on accelerators, which share their work themselves."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """`function` of every item, in order, as many at a time as there are `workers`; each result is waited for.

    Not traceable. JAX's settings that belong to a thread do not reach the others, but for double precision.
    """
    double = jax.numpy.zeros(()).dtype == jax.numpy.float64

    def one(item: Item) -> Result:
        with jax.enable_x64(double):
            return jax.block_until_ready(function(item))

    if min(workers(), len(items)) < 2:
        return [one(item) for item in items]
    with concurrent.futures.ThreadPoolExecutor(workers()) as pool:
        return list(pool.map(one, items))
