"""Material coefficients that vary over the volume: piecewise linear in the scalar, as colours and extinction are, or in the length of its
gradient, so that a surface is as glossy as it is sharp (course notes on GPU-based volume ray-casting, Eurographics 2009, section 9.2)."""

from typing import Any, ClassVar, TypeVar

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

    needs_gradient: ClassVar[bool] = False
    positions: Float[Array, "n"] = parameter(INCREASING, doc="in the data's own units")
    values: Float[Array, "n"] = parameter(ordered=True, doc="one for each position")

    def __init__(self, positions: ArrayLike, values: ArrayLike):
        assign(self, positions=positions, values=values)

    def evaluate(self, s: Scalar) -> Scalar:
        return jnp.interp(s, self.positions, self.values)

    def at_sample(self, s: Scalar, magnitude: Scalar) -> Scalar:
        return self.evaluate(s)


class ByGradient(AbstractByScalar):
    """A coefficient of a material by the length of the gradient of the scalar, as of a shift-variant BRDF: piecewise linear in it, constant
    beyond the ends, so that no gradient, however strong, takes it out of its range.

    **Arguments:** `positions`: `(n,)`, strictly increasing lengths, in data units per world length; `values`: `(n,)`. Both differentiable,
    and so is the length, in voxels and in their places. **Raises** `ValueError` for other shapes, positions that do not increase, values
    that are not finite.
    """

    needs_gradient: ClassVar[bool] = True
    positions: Float[Array, "n"] = parameter(INCREASING, doc="lengths of the gradient", unit="data units per mm")
    values: Float[Array, "n"] = parameter(ordered=True, doc="one for each position")

    def __init__(self, positions: ArrayLike, values: ArrayLike):
        assign(self, positions=positions, values=values)

    def evaluate(self, magnitude: Scalar) -> Scalar:
        return jnp.interp(magnitude, self.positions, self.values)

    def at_sample(self, s: Scalar, magnitude: Scalar) -> Scalar:
        return self.evaluate(magnitude)


def at_sample(module: Tree, s: Scalar, magnitude: Scalar) -> Tree:
    """`module` with every coefficient in it replaced by what it is at a sample: the scalar `s`, with a gradient of length `magnitude`."""
    return jax.tree.map(lambda x: x.at_sample(s, magnitude) if _varies(x) else x, module, is_leaf=_varies)


def at_most(module: Tree) -> Tree:
    """`module` with every coefficient in it replaced by the largest of its values."""
    return jax.tree.map(lambda x: jnp.max(x.values) if _varies(x) else x, module, is_leaf=_varies)


def is_by_gradient(module: Any) -> bool:
    """Whether a coefficient in `module` asks for the gradient."""
    return any(_varies(x) and x.needs_gradient for x in jax.tree.leaves(module, is_leaf=_varies))


def is_varying(module: Any) -> bool:
    """Whether there is a coefficient in `module` that varies over the volume."""
    return any(map(_varies, jax.tree.leaves(module, is_leaf=_varies)))


def _varies(x: Any) -> bool:
    return isinstance(x, AbstractByScalar)
