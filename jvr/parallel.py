"""Compiled programs side by side: the CPU's second way to use all cores.

The operations of a march are too small to be shared between cores, so that a compiled program keeps little more than one of them
busy. Programs that do not wait for each other are therefore run from threads; the interpreter's lock is free while they run.
"""

import concurrent.futures
import functools
import os
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax.core import Tracer

Item = TypeVar("Item")
Result = TypeVar("Result")

# What becomes of an operation on it tells whether operations are traced now.
_ZERO = np.float32(0)
_this_thread = threading.local()


def is_traced(tree: Any) -> bool:
    """Whether any array of `tree` is being traced, or whatever is computed now."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(tree)) or isinstance(jax.lax.neg(_ZERO), Tracer)


def program(function: Callable[..., Result], static_argnums: int | tuple[int, ...] = ()) -> Callable[..., Result]:
    """`jax.jit` of a function that is a program of its own where its arguments are at hand, and a part of another one elsewhere.

    On processors it then works with vectors as wide as they have, where the compiler's own choice is half of that.
    """
    inside, own = jax.jit(function, static_argnums=static_argnums), None

    @functools.wraps(function)
    def call(*arguments: Any) -> Result:
        nonlocal own
        if jax.default_backend() != "cpu" or is_traced(arguments):
            return inside(*arguments)
        own = own or jax.jit(function, static_argnums=static_argnums, compiler_options=_widest())
        return own(*arguments)

    return call


@functools.cache
def _widest() -> dict[str, Any]:
    """The compiler's option, where it knows it."""
    options = {"xla_cpu_prefer_vector_width": 512}
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return options


def workers() -> int:
    """How many programs may run at a time: one for each core on CPUs, one on accelerators, which share their work themselves."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """`function` of every item, in order, as many at a time as there are `workers`; each result is waited for.

    Within one of these threads, one after the other. Not traceable. JAX's settings that belong to a thread do not reach the others, but
    for double precision.
    """
    double = jax.dtypes.canonicalize_dtype(np.float64) == np.float64

    def one(item: Item) -> Result:
        with jax.enable_x64(double):
            return jax.block_until_ready(function(item))

    if min(workers(), len(items)) < 2 or getattr(_this_thread, "is_worker", False):
        return [one(item) for item in items]
    threads = _threads(workers())
    futures = [threads.submit(one, item) for item in items]
    try:
        concurrent.futures.wait(futures, return_when=concurrent.futures.FIRST_EXCEPTION)
    finally:
        # After an error nothing goes on that would take memory from what the caller does about it.
        for future in futures:
            future.cancel()
        concurrent.futures.wait(futures)
    return [future.result() for future in futures]


@functools.cache
def _threads(number: int) -> concurrent.futures.ThreadPoolExecutor:
    """Threads that stay: starting some takes longer than a small picture's part."""
    mark = lambda: setattr(_this_thread, "is_worker", True)
    return concurrent.futures.ThreadPoolExecutor(number, thread_name_prefix="jvr", initializer=mark)
