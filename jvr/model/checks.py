"""Checks that constructors share: shapes and types always, values wherever they are known (not while tracing)."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jvr.model.ranges import NOT_NEGATIVE
from jvr.types import Affine, ArrayLike

# Source colours and backgrounds above this are codes that were taken for radiance; lights have their own, far larger scale, up to
# where squares of radiance overflow single precision.
LARGEST_COLOUR = 100.0
LARGEST_RADIANCE = 1e15


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


def colours(value: ArrayLike | Any, name: str, *shapes: tuple[int | None, ...]) -> Float[Array, "..."]:
    """`float_array` of linear RGB of which 1 is white: finite, not negative, and not the codes of a file or a screen.

    **Raises** `ValueError` for integers above 1 and for anything above `LARGEST_COLOUR`, with the remedy.
    """
    array = float_array(value, name, *shapes)
    require(array, NOT_NEGATIVE.holds, f"{name} must be finite and not negative: it is linear RGB, and 1 is white")
    values, given = known(array), None if isinstance(value, Tracer) else np.asarray(value)
    are_codes = given is not None and given.dtype.kind in "iu" and bool(np.any(given > 1))
    if values is not None and (are_codes or np.any(values > LARGEST_COLOUR)):
        raise ValueError(
            f"{name} goes up to {values.max():g}, but 1 is white: convert codes by jvr.linear_from_srgb(codes / 255), "
            f"and give brighter colours as floating-point numbers up to {LARGEST_COLOUR:g}"
        )
    return array


def radiances(value: ArrayLike | Any, name: str, *shapes: tuple[int | None, ...]) -> Float[Array, "..."]:
    """`float_array` of the strength of a light, by default one number or `(3,)`: finite, not negative, at most `LARGEST_RADIANCE`, and not
    8 or 16-bit codes. **Raises** `ValueError` otherwise."""
    array = float_array(value, name, *(shapes or ((), (3,))))
    require(array, NOT_NEGATIVE.holds, f"{name} must be finite and not negative")
    require(array, lambda c: c <= LARGEST_RADIANCE, f"{name} must be at most {LARGEST_RADIANCE:g}: brighter pictures overflow")
    if isinstance(value, np.ndarray) and value.dtype in (np.uint8, np.uint16):
        white = 255 if value.dtype == np.uint8 else 65535
        raise ValueError(f"{name} holds codes ({value.dtype}): convert them by jvr.linear_from_srgb(codes / {white})")
    return array


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
