"""Material coefficients by scalar: piecewise linear in it, as colours and extinction are."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.checks import float_array, require
from jvr.model.ranges import INCREASING, within
from jvr.types import ArrayLike, Scalar

Tree = TypeVar("Tree")


class ByValue(eqx.Module):
    """A coefficient of a material through the transfer function: piecewise linear in the scalar, constant beyond the ends.

    **Arguments:** `positions`: `(n,)`, strictly increasing, in the data's units; `values`: `(n,)`. Both differentiable.
    **Raises** `ValueError` for other shapes, positions that do not increase, values that are not finite.
    """

    positions: Float[Array, "n"] = eqx.field(metadata=within(INCREASING))
    values: Float[Array, "n"]

    def __init__(self, positions: ArrayLike, values: ArrayLike):
        self.positions = float_array(positions, "positions", (None,))
        self.values = float_array(values, "values", (self.positions.shape[0],))
        require(self.values, np.isfinite, "values must be finite")
        require(self.positions, INCREASING.holds, "positions must be strictly increasing: sort them")

    def evaluate(self, s: Scalar) -> Scalar:
        return jnp.interp(s, self.positions, self.values)


def at_value(module: Tree, s: Scalar) -> Tree:
    """`module` with every `ByValue` in it replaced by its value at the scalar `s`."""
    is_by_value = lambda x: isinstance(x, ByValue)
    return jax.tree.map(lambda x: x.evaluate(s) if is_by_value(x) else x, module, is_leaf=is_by_value)


def coefficient(value: ArrayLike | ByValue, name: str, condition, message: str) -> Float[Array, ""] | ByValue:
    """A scalar coefficient or one by value, whose values satisfy `condition`. **Raises** `ValueError(message)` where they do not."""
    if isinstance(value, ByValue):
        require(value.values, condition, message)
        return value
    array = float_array(value, name, ())
    require(array, condition, message)
    return array
