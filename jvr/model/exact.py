"""Double-float positions: the unevaluated sum of two numbers in single precision.

A position far from the world's origin, or a direction that is followed over a great distance, has more digits than single precision
holds. What a constructor is given in double precision it keeps as an array and its `Remainder`; differences of such positions are taken
before they are rounded, so that what lies near a volume keeps the digits of a volume at the origin.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jvr.numerics import two_sum
from jvr.types import Scalar


class Remainder(eqx.Module):
    """What rounding to single precision has left of an array that was given in double precision, from Python's numbers or NumPy.

    `low` belongs to the numbers `of`, each to its own: of an entry of the array that has been replaced or moved since, nothing is left.
    Detached: the derivative of the array is that of the position.
    """

    of: Float[Array, "*shape"]
    low: Float[Array, "*shape"]

    @classmethod
    def left(cls, value: Any, rounded: Float[Array, "..."], given: "Remainder | None" = None) -> "Remainder":
        """What is left of `value` beside `rounded`; of what JAX holds already, what is `given`, by default nothing."""
        double = _double(value)
        if double is None:
            return cls(rounded, jnp.zeros_like(rounded)) if given is None else given
        with np.errstate(over="ignore", invalid="ignore"):
            low = double - double.astype(rounded.dtype)
        return cls(rounded, jnp.asarray(np.where(np.isfinite(low), low, 0.0), rounded.dtype))

    def beside(self, high: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """What is to be added to an array."""
        return jax.lax.stop_gradient(jnp.where(high == self.of, self.low, 0.0))


class Exact(NamedTuple):
    """A position as the unevaluated sum `high + low`."""

    high: Float[Array, "..."]
    low: Float[Array, "..."]

    def minus(self, other: "Exact") -> "Exact":
        """The difference; the high parts are subtracted without an error."""
        high, low = two_sum(self.high, self.low - other.low, -other.high)
        return Exact(high, low)

    def plus_product(self, a: "Exact", b: Scalar) -> "Exact":
        """`self + a b`, without the rounding of the product: halves of the factors have products that are exact."""
        high, low = self.high, self.low + a.low * b
        for x in _halves(a.high):
            for y in _halves(b):
                high, low = two_sum(high, low, x * y)
        return Exact(high, low)

    def rounded(self) -> Float[Array, "..."]:
        return self.high + self.low


def in_double(value: Any, remainder: Remainder | None = None) -> Any:
    """Known numbers as NumPy's doubles, with what is left of them; what JAX traces as it is."""
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(value)):
        return jnp.asarray(value)
    double = np.asarray(value, np.float64)
    return double if remainder is None else double + np.asarray(remainder.beside(value), np.float64)


def _double(value: Any) -> np.ndarray | None:
    """`value` in double precision where it has that much, else `None`."""
    if any(isinstance(x, jax.Array) for x in jax.tree.leaves(value)):
        return None
    array = np.asarray(value)
    return None if array.dtype in (np.float16, np.float32) else array.astype(np.float64)


def _halves(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Two parts of `x`, each with half of the digits."""
    limits = jnp.finfo(x.dtype)
    top = jax.lax.stop_gradient(jax.lax.reduce_precision(x, int(limits.nexp), int(limits.nmant) // 2))
    return top, x - top
