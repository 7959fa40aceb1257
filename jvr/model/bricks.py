"""Min-max bricks: the smallest and the largest voxel of each brick of a volume."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Shaped

from jvr.types import Voxels


class Bricks(eqx.Module):
    """Bounds of what interpolation can return anywhere in a brick.

    Brick `b` of an axis holds grid positions `b * size ... (b + 1) * size`, so neighbouring bricks share a layer of voxels and every
    point between voxels lies in a brick with all the voxels that its value is made of.

    - `lower`, `upper`: `(bricks along x, y, z)`, stored voxels before slope and intercept.
    - `size`: voxels along an edge, static.
    """

    lower: Shaped[Array, "bx by bz"]
    upper: Shaped[Array, "bx by bz"]
    size: int = eqx.field(static=True)


def bricks_of(values: Voxels, size: int = 4) -> Bricks:
    """The bricks of an array of voxels; one pass over memory. NaN voxels make NaN bounds."""
    lower, upper = values, values
    for axis in range(3):
        lower = _along(lower, axis, size, jnp.minimum)
        upper = _along(upper, axis, size, jnp.maximum)
    return Bricks(lower, upper, size)


def bricks_along(n: int, size: int) -> int:
    """How many bricks an axis of `n` voxels has."""
    return max(1, -(-(n - 1) // size))


def _along(values: Array, axis: int, size: int, extreme: Any) -> Array:
    """Extremes of each run of `size + 1` voxels along an axis, runs sharing their ends; the last one may be shorter."""
    n = values.shape[axis]
    count = bricks_along(n, size)
    last = jax.lax.slice_in_dim(values, n - 1, n, axis=axis)

    def voxel(i: int) -> Array:
        """The `i`-th voxel of each run. The array is not padded, which would copy it: what is missing is what the last run ends with."""
        some = jax.lax.slice_in_dim(values, min(i, n), n, stride=size, axis=axis)
        some = jax.lax.slice_in_dim(some, 0, min(count, some.shape[axis]), axis=axis)
        return jnp.concatenate([some, *[last] * (count - some.shape[axis])], axis=axis)

    # A run that is longer than the axis holds nothing else.
    return functools.reduce(extreme, [voxel(i) for i in range(min(size, n - 1) + 1)])


def widened(bricks: Bricks) -> Bricks:
    """Bounds of each brick and of all that touch it: of values that are made of voxels up to a brick's size beyond."""
    lower, upper = bricks.lower, bricks.upper
    for axis in range(3):
        lower, upper = _with_neighbours(lower, axis, jnp.minimum), _with_neighbours(upper, axis, jnp.maximum)
    return Bricks(lower, upper, bricks.size)


def _with_neighbours(bounds: Array, axis: int, extreme: Any) -> Array:
    """Extremes of each element and of both that are next to it along an axis."""
    padded, n = jnp.pad(bounds, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge"), bounds.shape[axis]
    before, after = (jax.lax.slice_in_dim(padded, at, at + n, axis=axis) for at in (0, 2))
    return extreme(bounds, extreme(before, after))
