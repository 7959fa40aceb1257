"""Smallest and largest voxel of each brick of a volume."""

from typing import Any

import equinox as eqx
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


def _along(values: Array, axis: int, size: int, extreme: Any) -> Array:
    """Extremes of each run of `size + 1` voxels along an axis, runs sharing their ends."""
    n = values.shape[axis]
    count = max(1, -(-(n - 1) // size))
    padding = [(0, 0)] * 3
    padding[axis] = (0, count * size + 1 - n)
    values = jnp.moveaxis(jnp.pad(values, padding, mode="edge"), axis, 0)
    runs = values[:-1].reshape(count, size, *values.shape[1:])
    return jnp.moveaxis(extreme(extreme.reduce(runs, axis=1), values[size::size]), 0, axis)
