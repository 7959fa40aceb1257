"""Linear functions with a transpose of their own: what makes one rule serve forward and reverse mode.

A `custom_vjp` has no forward mode, and the tangent of a `custom_jvp` is transposed operation by operation, which a loop of unknown length
refuses. Here the tangent is one operation of JAX's with both: evaluated, it is `forward`, transposed, `backward`; under `vmap` either is
batched, and a derivative of it is that of `forward`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jvr.march.rules import FORWARDS, forwards_only

Residuals = TypeVar("Residuals")
Tangent = TypeVar("Tangent")
Result = TypeVar("Result")


def linear(
    forward: Callable[[Residuals, Tangent], Result],
    backward: Callable[[Residuals, Result], Tangent],
    residuals: Residuals,
    tangent: Tangent,
    like: Result,
) -> Result:
    """`forward(residuals, tangent)`, linear in `tangent`, whose transpose is `backward(residuals, cotangent)`.

    **Arguments:** `forward` and `backward` close over no traced array; leaves of a cotangent that are zero are `None`; `like`: arrays as
    `forward` returns them, so that it is not traced where nobody evaluates it.

    Differentiable: in `tangent` in both modes, in `residuals` forwards, any number of times; reverse mode raises `ValueError` there.
    """
    (fixed, fixed_tree), (moved, moved_tree), (results, tree) = map(jax.tree.flatten, (residuals, tangent, like))
    rule = _Linear(
        lambda r, t: tree.flatten_up_to(forward(fixed_tree.unflatten(r), moved_tree.unflatten(t))),
        lambda r, g: moved_tree.flatten_up_to(backward(fixed_tree.unflatten(r), tree.unflatten(g))),
        len(fixed),
        tuple(jax.typeof(x) for x in results),
    )
    return tree.unflatten(_linear.bind(*fixed, *moved, rule=rule))


@dataclasses.dataclass(frozen=True, eq=False)
class _Linear:
    """The same with lists of arrays; how many residuals come before the tangents, and the types of the results."""

    forward: Callable[[list[Any], list[Any]], list[Any]]
    backward: Callable[[list[Any], list[Any]], list[Any]]
    residuals: int
    results: tuple[Any, ...]

    def __call__(self, *arguments: Any) -> list[Any]:
        return self.forward(*self.split(arguments))

    def split(self, arguments: Any) -> tuple[list[Any], list[Any]]:
        return list(arguments[: self.residuals]), list(arguments[self.residuals :])


def _evaluate(*arguments: Any, rule: _Linear) -> list[Any]:
    return rule(*arguments)


def _differentiate(primals: Any, tangents: Any, *, rule: _Linear) -> tuple[list[Any], list[Any]]:
    place = [i for i, t in enumerate(tangents) if type(t) is not ad.Zero]
    if all(i >= rule.residuals for i in place):
        residuals, _ = rule.split(primals)
        along = map(ad.instantiate_zeros, tangents[rule.residuals :])
        return _linear.bind(*primals, rule=rule), _linear.bind(*residuals, *along, rule=rule)

    def moved(*moving: Any) -> list[Any]:
        arguments = list(primals)
        for i, x in zip(place, moving, strict=True):
            arguments[i] = x
        return rule(*arguments)

    results, along = jax.jvp(moved, [primals[i] for i in place], [tangents[i] for i in place])
    return results, forwards_only(along, FORWARDS)


def _transpose(cotangents: Any, *arguments: Any, rule: _Linear) -> list[Any]:
    residuals, tangents = rule.split(arguments)
    given = [None if type(g) is ad.Zero else g for g in cotangents]
    found = rule.backward(residuals, given) if jax.tree.leaves(given) else [None] * len(tangents)
    return [None] * len(residuals) + found


def _batch(arguments: Any, axes: Any, *, rule: _Linear) -> tuple[list[Any], list[int]]:
    of_residuals, of_tangents = rule.split(axes)
    size = next(x.shape[axis] for x, axis in zip(arguments, axes, strict=True) if axis is not None)

    def backward(residuals: list[Any], cotangents: list[Any]) -> list[Any]:
        found = jax.vmap(rule.backward, in_axes=(of_residuals, 0))(residuals, cotangents)
        return [jnp.sum(x, axis=0) if a is None else jnp.moveaxis(x, 0, a) for x, a in zip(found, of_tangents, strict=True)]

    results = tuple(x.update(shape=(size, *x.shape)) for x in rule.results)
    batched = _Linear(jax.vmap(rule.forward, in_axes=(of_residuals, of_tangents)), backward, rule.residuals, results)
    return _linear.bind(*arguments, rule=batched), [0] * len(results)


_linear = Primitive("linear")
_linear.multiple_results = True
_linear.def_impl(_evaluate)
_linear.def_abstract_eval(lambda *_, rule: rule.results)
ad.primitive_jvps[_linear] = _differentiate
ad.primitive_transposes[_linear] = _transpose
batching.primitive_batchers[_linear] = _batch
mlir.register_lowering(_linear, mlir.lower_fun(_evaluate, multiple_results=True))
