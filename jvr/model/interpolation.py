"""How a volume is reconstructed between its voxels."""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
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

    @abc.abstractmethod
    def stencil(self, shape: tuple[int, int, int], p: Triple) -> tuple[Run, ...]:
        """The voxels that make the value at grid position `p`; their weights sum to one. The first is the first of its cell."""


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
