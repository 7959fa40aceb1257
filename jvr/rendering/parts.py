"""A picture of arrays that are at hand: in parts, side by side, smaller ones where memory runs out."""

import functools
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Int

from jvr.parallel import in_threads, workers

# Rays that are worth a program of their own.
LEAST = 4096


def is_traced(tree: Any) -> bool:
    """Whether any array of `tree` is being traced, or whatever is computed now."""
    return any(isinstance(x, Tracer) for x in (jnp.zeros(()), *jax.tree.leaves(tree)))


def in_parts(function: Callable[[Int[Array, "rays"]], Any], height: int, width: int, tile: int) -> Any:
    """`function` of all pixels of a picture, in interleaved rows, so that all parts have about as much to do.

    `function` takes the indices of pixels and returns arrays with a row for each. A part has at most `tile` rays, or one row of the
    picture; where one does not fit into memory, parts are halved, with one warning.
    """
    rays = min(tile, max(LEAST, -(-height * width // workers())))
    rows = min(max(rays // width, 1), height)
    warned = False
    while True:
        try:
            return _in_parts(function, height, width, -(-height // rows))
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or rows == 1:
                raise
            if not warned:
                advice = "going on with half as many; Settings(tile=...) starts with fewer"
                warnings.warn(f"out of memory with {rows * width} rays at a time: {advice}", RuntimeWarning, stacklevel=3)
            rows, warned = -(-rows // 2), True


def _in_parts(function: Callable[[Int[Array, "rays"]], Any], height: int, width: int, parts: int) -> Any:
    rows = -(-height // parts)
    # What is beyond the last row repeats it, and is dropped.
    row = np.minimum(np.arange(parts)[:, None] + parts * np.arange(rows), height - 1)
    pixels = (row[:, :, None] * width + np.arange(width)).reshape(parts, -1).astype(np.int32)
    return _whole(height, width, in_threads(lambda part: function(jnp.asarray(part)), list(pixels)))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _whole(height: int, width: int, pieces: list[Any]) -> Any:
    """The rows of all parts in the order of the picture."""

    def one(*arrays: Array) -> Array:
        row = arrays[0].shape[1:]
        stacked = jnp.stack(arrays).reshape(len(arrays), -1, width, *row)
        return jnp.swapaxes(stacked, 0, 1).reshape(-1, *row)[: height * width]

    return jax.tree.map(one, *pieces)
