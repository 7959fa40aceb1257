"""How a volume is reconstructed between its voxels."""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.model.voxels import CELL, VOXEL
from jvr.types import Scalar, Triple


class Run(NamedTuple):
    """Neighbouring voxels along the last axis: the flat index of the first, and the weight of each."""

    start: Int[Array, ""]
    weights: tuple[Float[Array, ""], ...]


class AbstractInterpolation(eqx.Module):
    """How a value between voxels is made of the voxels around it."""

    # Which bit of `Volume.gaps` says that a voxel of a stencil is missing.
    gap: ClassVar[int]
    # How many voxels beyond those of its cell a value is made of, in each direction.
    reach: ClassVar[int] = 0

    @abc.abstractmethod
    def stencil(self, shape: tuple[int, int, int], p: Triple) -> tuple[Run, ...]:
        """The voxels that make the value at grid position `p`; their weights sum to one and are not negative. Without a `reach` the
        first is the first of its cell."""


class Trilinear(AbstractInterpolation):
    """Trilinear interpolation of the eight voxels around a point; continuous, differentiable in position inside each cell."""

    gap: ClassVar[int] = CELL

    def stencil(self, shape: tuple[int, int, int], p: Triple) -> tuple[Run, ...]:
        (i, wx), (j, wy), (k, wz) = (_linear(x, n) for x, n in zip(p, shape, strict=True))
        # Runs of voxels that lie side by side in memory: a derivative writes half as often as it would single voxels.
        return tuple(
            Run(((i + a) * shape[1] + j + b) * shape[2] + k, tuple(wx[a] * wy[b] * w for w in wz))
            for a in range(len(wx))
            for b in range(len(wy))
        )


class Tricubic(AbstractInterpolation):
    """The tricubic B-spline whose coefficients are the voxels: 64 of them make a value. Two derivatives are continuous, so that normals
    have no facets and derivatives no kinks, and values stay between those of the voxels.

    Voxels are smoothed: at a voxel the value is the mean of it and its neighbours with weights 1, 4, 1 along each axis. Of
    `Volume.prefiltered()` the spline goes through the voxels. Beyond the border voxels are mirrored in the outermost ones.
    """

    gap: ClassVar[int] = VOXEL
    reach: ClassVar[int] = 1

    def stencil(self, shape: tuple[int, int, int], p: Triple) -> tuple[Run, ...]:
        (i, wx), (j, wy), (k, wz) = (_cubic(x, n) for x, n in zip(p, shape, strict=True))
        return tuple(
            Run(((i + a) * shape[1] + j + b) * shape[2] + k, tuple(wx[a] * wy[b] * w for w in wz))
            for a in range(len(wx))
            for b in range(len(wy))
        )


class Nearest(AbstractInterpolation):
    """The value of the nearest voxel: for labels. Its derivative with respect to position is zero."""

    gap: ClassVar[int] = VOXEL

    def stencil(self, shape: tuple[int, int, int], p: Triple) -> tuple[Run, ...]:
        i, j, k = (jnp.clip(jnp.round(x), 0, n - 1).astype(jnp.int32) for x, n in zip(p, shape, strict=True))
        return (Run((i * shape[1] + j) * shape[2] + k, (jnp.ones_like(p[0]),)),)


def _linear(x: Scalar, n: int) -> tuple[Int[Array, ""], tuple[Scalar, ...]]:
    """The first of the two voxels around `x` on an axis of `n`, and the weights of both; an axis of one voxel is constant."""
    if n == 1:
        return jnp.zeros_like(x, jnp.int32), (jnp.ones_like(x),)
    low = jnp.clip(jnp.floor(x), 0, n - 2)
    return low.astype(jnp.int32), (1 - (x - low), x - low)


def _cubic(x: Scalar, n: int) -> tuple[Int[Array, ""], tuple[Scalar, ...]]:
    """The first of the voxels that the cubic B-spline at `x` on an axis of `n` is made of, and the weights of these, four if there are as
    many."""
    if n == 1:
        return jnp.zeros_like(x, jnp.int32), (jnp.ones_like(x),)
    low = jnp.clip(jnp.floor(x), 0, n - 2)
    f = x - low
    g = 1 - f
    # Of the voxels one before the cell, at its ends, and one behind it.
    a, b, c, d = g**3 / 6, 2 / 3 - f * f * (1 - f / 2), 2 / 3 - g * g * (1 - g / 2), f**3 / 6
    if n == 2:
        return low.astype(jnp.int32), (b + d, a + c)
    is_first, is_last = low == 0, low == n - 2
    # What lies beyond the border is the mirrored voxel's: the run begins one further, or ends one before.
    inside, first, last = (a, b, c, d), (b, a + c, d, jnp.zeros_like(d)), (jnp.zeros_like(a), a, b + d, c)
    if n == 3:
        return jnp.zeros_like(low, jnp.int32), tuple(jnp.where(is_first, v, w) for v, w in zip(first, last[1:], strict=False))
    weights = (jnp.where(is_first, v, jnp.where(is_last, w, u)) for u, v, w in zip(inside, first, last, strict=True))
    return jnp.clip(low - 1, 0, n - 4).astype(jnp.int32), tuple(weights)


def spline_coefficients(values: Float[Array, "x y z"]) -> Float[Array, "x y z"]:
    """The coefficients of the tricubic B-spline that goes through some values, mirrored at the border (Unser, Aldroubi and Eden 1991).
    Linear in them and differentiable.

    Along each axis they solve `(c_-1 + 4 c_0 + c_1) / 6 = v_0`. The inverse is taken in double precision, before anything is compiled.
    """
    for axis, n in enumerate(values.shape):
        if n > 1:
            matrix = (4 * np.eye(n) + np.eye(n, k=1) + np.eye(n, k=-1)) / 6
            matrix[0, 1] = matrix[-1, -2] = 2 / 6
            inverse = jnp.asarray(np.linalg.inv(matrix), values.dtype)
            values = jnp.moveaxis(jnp.tensordot(inverse, values, axes=(1, axis), precision="highest"), 0, axis)
    return values
