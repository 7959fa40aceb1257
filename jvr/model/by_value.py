"""Material coefficients by scalar: piecewise linear in it, as colours and extinction are."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.parameters import AbstractByScalar, assign, parameter
from jvr.model.ranges import INCREASING
from jvr.types import ArrayLike, Scalar

Tree = TypeVar("Tree")


class ByValue(AbstractByScalar):
    """A coefficient of a material through the transfer function: piecewise linear in the scalar, constant beyond the ends.

    **Arguments:** `positions`: `(n,)`, strictly increasing, in the data's units; `values`: `(n,)`. Both differentiable.
    **Raises** `ValueError` for other shapes, positions that do not increase, values that are not finite.
    """

    positions: Float[Array, "n"] = parameter(INCREASING, doc="in the data's own units")
    values: Float[Array, "n"] = parameter(ordered=True, doc="one for each position")

    def __init__(self, positions: ArrayLike, values: ArrayLike):
        assign(self, positions=positions, values=values)

    def evaluate(self, s: Scalar) -> Scalar:
        return jnp.interp(s, self.positions, self.values)


def at_value(module: Tree, s: Scalar) -> Tree:
    """`module` with every `ByValue` in it replaced by its value at the scalar `s`."""
    is_by_value = lambda x: isinstance(x, ByValue)
    return jax.tree.map(lambda x: x.evaluate(s) if is_by_value(x) else x, module, is_leaf=is_by_value)
