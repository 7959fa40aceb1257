"""The order in which the pixels of a picture are marched.

Pixels come in square blocks: rays that are neighbours in the picture in both directions read the same voxels. Blocks are dealt to devices
in turn, so that all have about as much to do, and a device marches a tile of them at a time.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

Result = TypeVar("Result")

# Pixels along an edge of a block.
SIDE = 4


def block_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of a block: a picture that is narrower has narrower ones."""
    return min(SIDE, height), min(SIDE, width)


def blocks_of(height: int, width: int) -> tuple[int, int]:
    """How many blocks there are from top to bottom, and from left to right."""
    rows, columns = block_shape(height, width)
    return -(-height // rows), -(-width // columns)


def dealt(count: int, shares: int) -> Int[Array, "dealt"]:
    """Indices of `count` things, dealt out in turn: share `p` of `n` has `p, p + n, ...`, and shares follow each other. All have the same
    number: where they do not come out even the last thing is repeated."""
    index = jnp.arange(shares)[:, None] + shares * jnp.arange(-(-count // shares))
    return jnp.minimum(index, count - 1).reshape(-1).astype(jnp.int32)


def joined(results: Result, count: int, shares: int) -> Result:
    """What belongs to things that were `dealt`, arrays with as many rows for each, in the order of the things."""

    def one(x: Array) -> Array:
        each = -(-count // shares)
        of_thing = (x.shape[0] // (shares * each), *x.shape[1:])
        return jnp.swapaxes(x.reshape(shares, each, *of_thing), 0, 1).reshape(-1, *of_thing)[:count].reshape(-1, *x.shape[1:])

    return results if shares == 1 else jax.tree.map(one, results)


def dealt_blocks(height: int, width: int, shares: int = 1) -> Int[Array, "blocks"]:
    """Indices of the blocks of a picture, counted row by row, as they are `dealt`."""
    return dealt(math.prod(blocks_of(height, width)), shares)


def pixels_of(blocks: Int[Array, "blocks"], height: int, width: int) -> Int[Array, "rays"]:
    """Indices of the pixels in blocks of a picture, block after block; what lies beyond the border is the border's pixel again."""
    rows, columns = block_shape(height, width)
    _, across = blocks_of(height, width)
    row = (blocks // across * rows)[:, None, None] + jnp.arange(rows, dtype=jnp.int32)[:, None]
    column = (blocks % across * columns)[:, None, None] + jnp.arange(columns, dtype=jnp.int32)
    return (jnp.minimum(row, height - 1) * width + jnp.minimum(column, width - 1)).reshape(-1)


def picture_of(rays: Any, height: int, width: int, shares: int = 1) -> Any:
    """Arrays with an entry for each ray of `dealt_blocks`, as arrays `(height, width, ...)`."""
    rows, columns = block_shape(height, width)
    down, across = blocks_of(height, width)

    def one(x: Array) -> Array:
        own = x.shape[1:]
        blocks = joined(x, down * across, shares).reshape(down, across, rows, columns, *own)
        return jnp.swapaxes(blocks, 1, 2).reshape(down * rows, across * columns, *own)[:height, :width]

    return jax.tree.map(one, rays)


def in_tiles(function: Callable[[Int[Array, "blocks"]], Result], blocks: Int[Array, "blocks"], most: int) -> Result:
    """`function` of blocks, at most `most` of them (or one) at a time; it returns arrays with a leading axis of rays."""
    together = max(most, 1)
    if blocks.size <= together:
        return function(blocks)
    # The last tile repeats the last block; what it computes for it is dropped.
    padded = jnp.pad(blocks, (0, -blocks.size % together), mode="edge").reshape(-1, together)
    whole = lambda x: x.reshape(-1, *x.shape[2:])[: x.shape[1] // together * blocks.size]
    return jax.tree.map(whole, jax.lax.map(function, padded))


def within_memory(function: Callable[[int], Result], tile: int) -> Result:
    """`function(tile)` of concrete arrays; where that does not fit into memory, with half the tile, with one warning. Of several processes
    none can go on alone with another program than the others: there what does not fit is an error."""
    warned = False
    while True:
        try:
            return jax.block_until_ready(function(tile))
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or tile == 1 or jax.process_count() > 1:
                raise
            if not warned:
                advice = "going on with half as many; Settings(tile=...) starts with fewer"
                warnings.warn(f"out of memory with {tile} rays at a time: {advice}", RuntimeWarning, stacklevel=4)
            tile, warned = -(-tile // 2), True
