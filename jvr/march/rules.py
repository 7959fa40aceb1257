"""What JAX tells a `custom_vjp` or `custom_jvp` rule with symbolic zeros, in terms of values; loops whose derivatives have a mode."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jvr.march.medium import showing_all

Tree = TypeVar("Tree")

# What a derivative of a gradient is taken by.
FORWARDS = (
    "second derivatives are taken forwards: use jax.jvp(jax.grad(loss), (x,), (v,)) in place of a gradient of jax.grad(loss)"
)


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
    perturbed = jax.tree.map(lambda x: x.perturbed and _is_inexact(x.value), arguments, is_leaf=_is_primal)
    return eqx.partition(values(arguments), perturbed)


def perturbed(primals: Any, tangents: Any) -> Any:
    """The tangents that a rule is given, without those that are known to be zero."""
    moves = jax.tree.map(lambda t, x: not is_zero(t) and _is_inexact(x), tangents, primals, is_leaf=is_zero)
    return eqx.filter(tangents, moves)


def is_there(tree: Any) -> Any:
    """Which leaves of a tree are not `None`."""
    return jax.tree.map(lambda leaf: leaf is not None, tree, is_leaf=lambda leaf: leaf is None)


def skipping(function: Callable[..., Tree], remedy: str) -> Callable[..., Tree]:
    """`function(options, *arguments)`, which skips empty bricks of the media among its arguments, and not where it is differentiated:
    what is empty adds nothing to a value and may well have a derivative. Those are of forward mode; reverse mode is refused, with the
    `remedy`."""

    @functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
    def call(options: Any, *arguments: Any) -> Tree:
        return function(options, *arguments)

    def rule(options: Any, primals: Any, tangents: Any) -> tuple[Tree, Tree]:
        tangents = perturbed(primals, tangents)
        moving, still = eqx.partition(primals, is_there(tangents))
        along = lambda moving: function(options, *showing_all(eqx.combine(moving, still)))
        primal, tangent = jax.jvp(along, (moving,), (tangents,))
        return primal, forwards_only(tangent, remedy)

    call.defjvp(rule, symbolic_zeros=True)
    return call


def forwards_only(tree: Tree, remedy: str) -> Tree:
    """The same arrays; reverse mode through them raises `ValueError(remedy)`, where JAX's own words would be about loops."""
    return jax.tree.map(lambda x: _forwards_only.bind(x, remedy=remedy) if _is_inexact(x) else x, tree)


def _is_inexact(x: Any) -> bool:
    return jnp.issubdtype(jax.dtypes.result_type(x), jnp.inexact)


def _is_primal(x: Any) -> bool:
    return isinstance(x, jax.custom_derivatives.CustomVJPPrimal)


def _refuse(cotangent: Any, x: Any, *, remedy: str) -> Any:
    raise ValueError(remedy)


_forwards_only = Primitive("forwards_only")
_forwards_only.def_impl(lambda x, *, remedy: x)
_forwards_only.def_abstract_eval(lambda x, *, remedy: x)
ad.deflinear2(_forwards_only, _refuse)
batching.defvectorized(_forwards_only)
mlir.register_lowering(_forwards_only, lambda context, x, *, remedy: [x])
