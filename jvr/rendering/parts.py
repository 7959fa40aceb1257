"""The order in which the pixels of a picture are marched, and pictures of arrays at hand: in parts, side by side, smaller ones where
memory runs out.

Pixels come in square blocks: rays that are neighbours in the picture in both directions read the same voxels.
"""

import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jvr.parallel import in_threads, workers

# Pixels along an edge of a block.
SIDE = 4
# Rays that are worth a program of their own.
LEAST = 4096


def block_shape(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of a block: a picture that is narrower has narrower ones."""
    return min(SIDE, height), min(SIDE, width)


def blocks_of(height: int, width: int) -> tuple[int, int]:
    """How many blocks there are from top to bottom, and from left to right."""
    rows, columns = block_shape(height, width)
    return -(-height // rows), -(-width // columns)


def all_blocks(height: int, width: int) -> Int[Array, "blocks"]:
    """Indices of the blocks of a picture, row by row."""
    return jnp.arange(math.prod(blocks_of(height, width)), dtype=jnp.int32)


def pixels_of(blocks: Int[Array, "blocks"], height: int, width: int) -> Int[Array, "rays"]:
    """Indices of the pixels in blocks of a picture, block after block; what lies beyond the border is the border's pixel again."""
    rows, columns = block_shape(height, width)
    _, across = blocks_of(height, width)
    row = (blocks // across * rows)[:, None, None] + jnp.arange(rows, dtype=jnp.int32)[:, None]
    column = (blocks % across * columns)[:, None, None] + jnp.arange(columns, dtype=jnp.int32)
    return (jnp.minimum(row, height - 1) * width + jnp.minimum(column, width - 1)).reshape(-1)


def picture_of(rays: Any, height: int, width: int) -> Any:
    """Arrays with an entry for each ray of all blocks, as arrays `(height, width, ...)`; more blocks than there are may follow."""
    rows, columns = block_shape(height, width)
    down, across = blocks_of(height, width)

    def one(x: Array) -> Array:
        own = x.shape[1:]
        blocks = x[: down * across * rows * columns].reshape(down, across, rows, columns, *own)
        return jnp.swapaxes(blocks, 1, 2).reshape(down * rows, across * columns, *own)[:height, :width]

    return jax.tree.map(one, rays)


def rays_of(picture: Any, height: int, width: int) -> Any:
    """What `picture_of` undoes; beyond the border there is zero."""
    rows, columns = block_shape(height, width)
    down, across = blocks_of(height, width)

    def one(x: Array) -> Array:
        own = x.shape[2:]
        padded = jnp.pad(x, [(0, down * rows - height), (0, across * columns - width), *[(0, 0)] * len(own)])
        blocks = padded.reshape(down, rows, across, columns, *own)
        return jnp.swapaxes(blocks, 1, 2).reshape(down * across * rows * columns, *own)

    return jax.tree.map(one, picture)


def dealt_blocks(height: int, width: int, most: int) -> list[np.ndarray]:
    """The blocks of a picture in parts of at most `most`, dealt out in turn, so that all parts have about as much to do.

    Part `p` of `n` has the blocks `p, p + n, ...`. All have the same number: where they do not come out even the last block is repeated.
    """
    count = math.prod(blocks_of(height, width))
    parts = -(-count // most)
    blocks = np.arange(parts)[:, None] + parts * np.arange(-(-count // parts))
    return list(np.minimum(blocks, count - 1).astype(np.int32))


@functools.partial(jax.jit, static_argnums=(0, 1))
def joined(height: int, width: int, pieces: Sequence[Any]) -> Any:
    """The picture that pieces with an entry for each ray make, one for each part of `dealt_blocks`."""
    size = math.prod(block_shape(height, width))

    def one(*arrays: Array) -> Array:
        blocks = jnp.stack([x.reshape(-1, size, *x.shape[1:]) for x in arrays], axis=1)
        return blocks.reshape(-1, *arrays[0].shape[1:])

    return picture_of(jax.tree.map(one, *pieces), height, width)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def dealt(height: int, width: int, parts: int, picture: Any) -> list[Any]:
    """What `joined` undoes; blocks that repeat another are zero."""
    size = math.prod(block_shape(height, width))

    def one(x: Array) -> Array:
        blocks = x.reshape(-1, size, *x.shape[1:])
        blocks = jnp.pad(blocks, [(0, -blocks.shape[0] % parts), *[(0, 0)] * (blocks.ndim - 1)])
        return jnp.swapaxes(blocks.reshape(-1, parts, *blocks.shape[1:]), 0, 1).reshape(parts, -1, *x.shape[1:])

    leaves, kind = jax.tree.flatten(rays_of(picture, height, width))
    return [jax.tree.unflatten(kind, piece) for piece in zip(*map(one, leaves), strict=True)]


def in_parts(function: Callable[[Int[Array, "blocks"]], Any], height: int, width: int, tile: int) -> list[Any]:
    """`function` of all blocks of a picture, in parts of at most `tile` rays: a result for each part, which `joined` puts together.

    Where a part does not fit into memory, parts are halved, with one warning.
    """
    count, size = math.prod(blocks_of(height, width)), math.prod(block_shape(height, width))
    most = min(max(tile // size, 1), max(LEAST // size, -(-count // workers())))
    warned = False
    while True:
        try:
            return in_threads(lambda part: function(jnp.asarray(part)), dealt_blocks(height, width, most))
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or most == 1:
                raise
            if not warned:
                advice = "going on with half as many; Settings(tile=...) starts with fewer"
                warnings.warn(f"out of memory with {most * size} rays at a time: {advice}", RuntimeWarning, stacklevel=3)
            most, warned = -(-most // 2), True
