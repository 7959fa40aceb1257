"""Checks that constructors share: shapes and types always, values wherever they are known (not while tracing)."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jvr.types import Affine, ArrayLike


def float_array(value: ArrayLike | Any, name: str, *shapes: tuple[int | None, ...]) -> Float[Array, "..."]:
    """`value` as a floating-point array whose shape is one of `shapes` (`None` stands for any length).

    **Raises** `TypeError` where it cannot be an array of real numbers and `ValueError` where the shape does not fit.
    """
    try:
        array = jnp.asarray(value)
        # The type is given so that it is not weak: a number and an array of the same type then compile to one program.
        array = jnp.asarray(array, array.dtype if jnp.issubdtype(array.dtype, jnp.floating) else jnp.result_type(float))
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array of real numbers, not {type(value).__name__}") from error
    fits = any(
        len(shape) == array.ndim and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True)) for shape in shapes
    )
    if not fits:
        wanted = " or ".join(str(tuple("n" if n is None else n for n in shape)) for shape in shapes)
        raise ValueError(f"{name} has shape {array.shape}; it must be {wanted.replace(chr(39), '')}")
    return array


def known(value: Any) -> np.ndarray | None:
    """The values of an array as NumPy, or `None` where a transformation of JAX is tracing it."""
    return None if isinstance(value, Tracer) else np.asarray(value)


def require(value: Any, condition: Any, message: str) -> None:
    """Raises `ValueError(message)` where the values are known and `condition(values)` does not hold everywhere."""
    values = known(value)
    if values is not None and not np.all(condition(values)):
        raise ValueError(message)


def affine(value: Any, name: str) -> Affine:
    """A 4x4 affine transform with an invertible linear part."""
    matrix = float_array(value, name, (4, 4))
    require(matrix, np.isfinite, f"{name} must be finite")
    require(matrix, lambda m: m[3] == np.array([0, 0, 0, 1]), f"the last row of {name} must be 0 0 0 1")
    lengths = lambda m: np.linalg.norm(m[:3, :3], axis=0)
    require(matrix, lambda m: lengths(m) > 0, f"{name} has an axis of zero length: spacing must be positive")
    require(
        matrix,
        lambda m: abs(np.linalg.det(m[:3, :3].astype(float) / lengths(m))) > 1e-6,
        f"{name} is singular: its three axes must not lie in one plane",
    )
    return matrix
