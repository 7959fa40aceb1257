"""Real spherical harmonics: the functions `Y_lm`, their order and their number."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.numerics import normalise
from jvr.types import ArrayLike, Triple


def count(order: int) -> int:
    """Coefficients up to an order: `(order + 1)^2`. **Raises** `ValueError` where it is not an integer from 0 on."""
    if isinstance(order, bool) or not isinstance(order, int) or order < 0:
        raise ValueError(f"order must be a whole number of at least 0, not {order!r}; 3 is a good start")
    return (order + 1) ** 2


def as_floats(value: ArrayLike) -> Float[Array, "..."]:
    """An array of floating-point numbers, of the precision that it has."""
    array = jnp.asarray(value)
    return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(jnp.result_type(float))


def order_of(coefficients: ArrayLike) -> int:
    """The order that a number of coefficients belongs to. **Raises** `ValueError` where it is no square."""
    coefficients = as_floats(coefficients)
    bands = coefficients.shape[0] if coefficients.ndim else 0
    order = math.isqrt(bands) - 1
    if bands < 1 or (order + 1) ** 2 != bands:
        raise ValueError(f"{bands} coefficients belong to no order: it takes (order + 1)^2, such as 9 or 16, on the first axis")
    return order


def band_of(order: int) -> np.ndarray:
    """The `l` of every coefficient, `((order + 1)^2,)`."""
    return np.repeat(np.arange(order + 1), 2 * np.arange(order + 1) + 1)


def evaluate(order: int, directions: ArrayLike) -> Float[Array, "n bands"]:
    """Real orthonormal spherical harmonics of all bands up to `order` at directions, `(n, 3)` -> `(n, (order + 1)^2)`.

    `Y_lm` is at index `l (l + 1) + m`. About the polar axis z and without the Condon-Shortley phase: `Y_1 = sqrt(3 / 4 pi) (y, z, x)`.
    Directions of any length count by where they point; differentiable in them. **Raises** `ValueError` for another shape.
    """
    count(order)
    directions = as_floats(directions)
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ValueError(f"directions must be (n, 3), not {directions.shape}")
    x, y, z = normalise(directions).T
    return jnp.stack(basis(order, (x, y, z)), axis=1)


def basis(order: int, d: Triple | tuple[np.ndarray, ...]) -> list[Any]:
    """`evaluate` for the components of unit directions, of any shape, one array for each harmonic.

    By the recurrence over `l` of the normalised associated Legendre functions, each divided by `sin^m` (Sloan 2013, "Efficient spherical
    harmonic evaluation"): it is stable in this direction and knows no pole. The `sin^m` is in the real and imaginary part of
    `(x + i y)^m`.
    """
    x, y, z = d
    rows: list[Any] = [None] * count(order)
    # Arithmetic alone, so that NumPy's arrays stay NumPy's.
    zero = 0 * z
    cosine, sine = zero + 1, zero
    diagonal = math.sqrt(0.25 / math.pi)
    for m in range(order + 1):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            diagonal *= math.sqrt((2 * m + 1) / (2 * m))
        scale = math.sqrt(2) if m else 1.0
        before, now = zero, zero + diagonal
        for band in range(m, order + 1):
            if band > m:
                a = math.sqrt((4 * band**2 - 1) / (band**2 - m**2))
                b = math.sqrt(((band - 1) ** 2 - m**2) / (4 * (band - 1) ** 2 - 1)) if band > m + 1 else 0.0
                before, now = now, a * (z * now - b * before)
            rows[band * (band + 1) + m] = scale * now * cosine
            if m:
                rows[band * (band + 1) - m] = scale * now * sine
    return rows
