"""What JAX tells a `custom_vjp` or `custom_jvp` rule with symbolic zeros, in terms of values."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


def is_zero(x: Any) -> bool:
    """Whether a tangent or cotangent is known to be zero."""
    return isinstance(x, jax.custom_derivatives.SymbolicZero)


def with_zeros(tree: Any) -> Any:
    """Cotangents as arrays."""
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if is_zero(x) else x, tree, is_leaf=is_zero)


def values(arguments: Any) -> Any:
    """The arguments of a forward rule, without what is said about them."""
    return jax.tree.map(lambda x: x.value, arguments, is_leaf=_is_primal)


def wanted_and_fixed(arguments: Any) -> tuple[Any, Any]:
    """The same in two halves, each leaf in one of them: a `None` in the first asks for no derivative. (Numbers of Python's own are told
    apart as arrays are.)"""
    inexact = lambda x: jnp.issubdtype(jnp.result_type(x), jnp.inexact)
    perturbed = jax.tree.map(lambda x: x.perturbed and inexact(x.value), arguments, is_leaf=_is_primal)
    return eqx.partition(values(arguments), perturbed)


def _is_primal(x: Any) -> bool:
    return isinstance(x, jax.custom_derivatives.CustomVJPPrimal)
