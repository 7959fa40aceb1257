"""Measured reflectance of isotropic materials, as in the MERL data base (Matusik et al. 2003, A data-driven reflectance model).

A table over the half-way direction `h` and the difference to it (Rusinkiewicz 1998, A new change of variables for efficient BRDF
representation): `theta_h` between normal and `h`, `theta_d` between `h` and `w_i`, `phi_d` the turn of `w_i` about `h`. A turn by half a
circle exchanges `w_i` and `w_o` and leaves reflectance the same, so `phi_d` runs from 0 to pi alone.
"""

import itertools
import math
import os
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.model.brdf import above, of_one_shape, where_or_normal
from jvr.model.material import AbstractBRDF, SymmetryAxis
from jvr.model.parameters import assign, parameter
from jvr.model.ranges import NOT_NEGATIVE
from jvr.numerics import direction_and_length, dot
from jvr.types import ArrayLike, Channels, Triple

Numbers = Float[Array, "..."]


class MerlBRDF(AbstractBRDF):
    """Measured reflectance, unmodulated: `M = table max(n . w_i, 0)`, three components.

    Entries are the middles of cells, even in `sqrt(theta_h)`, `theta_d` and `phi_d`; linear between them and constant in the outer halves
    of the first and last. Differentiable in the table and in the directions.

    **Arguments:** `table`: `(theta_h, theta_d, phi_d, 3)`, `(90, 90, 180, 3)` in the data base; BRDF in 1 / solid angle, finite and not
    negative. **Raises** `ValueError` otherwise.
    """

    symmetry_axis: ClassVar[SymmetryAxis] = "both"
    table: Float[Array, "theta_h theta_d phi_d 3"] = parameter(NOT_NEGATIVE, doc="measured BRDF", unit="1 / sr")

    def __init__(self, table: ArrayLike):
        assign(self, table=table)

    @classmethod
    def read(cls, path: str | os.PathLike) -> "MerlBRDF":
        """The material in a file of the MERL binary format. **Raises** `FileNotFoundError`, `jvr.io.merl.MerlError` (a `ValueError`)."""
        from jvr.io.merl import read_merl

        return cls(read_merl(path))

    def evaluate(self, w_o: Triple, w_i: Triple) -> tuple[Channels, Channels]:
        w_o, w_i = of_one_shape(w_o, w_i)
        lit = above(w_o, w_i)
        theta_h, theta_d, phi_d = half_and_difference(*(where_or_normal(lit, w) for w in (w_o, w_i)))
        n_h, n_d, n_p, _ = self.table.shape
        # The root has no derivative at 0; within half a cell of it the table is constant.
        bounded = jnp.maximum(theta_h / (0.5 * math.pi), (0.25 / n_h) ** 2)
        axes = (
            _bounded_cells(n_h * jnp.sqrt(bounded), n_h),
            _bounded_cells(n_d * theta_d / (0.5 * math.pi), n_d),
            _periodic_cells(n_p * phi_d / math.pi, n_p),
        )
        values = jnp.zeros((*lit.shape, 3), self.table.dtype)
        for corner in itertools.product(*axes):
            (i, wi), (j, wj), (k, wk) = corner
            values = values + (wi * wj * wk)[..., None] * self.table[i, j, k]
        facing = jnp.where(lit, w_i[2], 0.0)
        return (), tuple(facing * values[..., c] for c in range(3))


def half_and_difference(w_o: Triple, w_i: Triple) -> Triple:
    """`theta_h`, `theta_d` in [0, pi / 2] and `phi_d` in [0, pi] of two directions above the surface.

    Angles come from sines and cosines, none of them from an arc cosine, which has no digits near 0. Where a turn is not defined,
    it is 0 with derivative 0.
    """
    sums, differences = (tuple(i + s * o for o, i in zip(w_o, w_i, strict=True)) for s in (1.0, -1.0))
    half, long = direction_and_length(sums)
    _, short = direction_and_length(differences)
    (x, y), sine = _turn(half[0], half[1])
    # The frame about h: `along` lies in the plane of normal and h.
    along, across = (half[2] * x, half[2] * y, -sine), (-y, x, jnp.zeros_like(x))
    (x, y), _ = _turn(dot(differences, along), dot(differences, across))
    side = jnp.where(y < 0, -1.0, 1.0)
    return jnp.arctan2(sine, half[2]), jnp.arctan2(short, long), jnp.arctan2(side * y, side * x)


def _turn(x: Numbers, y: Numbers) -> tuple[tuple[Numbers, Numbers], Numbers]:
    """Cosine and sine of the angle of `(x, y)`, and its length; 1 and 0 where it has none."""
    (cosine, sine, _), length = direction_and_length((x, y, jnp.zeros_like(x)))
    return (jnp.where(length > 0, cosine, 1.0), sine), length


def _bounded_cells(u: Numbers, n: int) -> list[tuple[Int[Array, "..."], Numbers]]:
    """The two entries nearest to `u`, in cells, and their weights."""
    u = jnp.clip(u - 0.5, 0.0, n - 1.0)
    low = jnp.clip(jnp.floor(u), 0, max(n - 2, 0)).astype(int)
    return [(low, 1.0 - (u - low)), (jnp.minimum(low + 1, n - 1), u - low)]


def _periodic_cells(u: Numbers, n: int) -> list[tuple[Int[Array, "..."], Numbers]]:
    low = jnp.floor(u - 0.5).astype(int)
    fraction = u - 0.5 - low
    return [(low % n, 1.0 - fraction), ((low + 1) % n, fraction)]
