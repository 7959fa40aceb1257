"""Functions with a delicate limit, and their derivatives."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.types import Triple


def two_sum(
    high: Float[Array, "..."], low: Float[Array, "..."], term: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Adds `term` to the unevaluated sum `high + low` (Knuth 1969, TAOCP 2, 4.2.2, theorem B).

    Only additions occur, so a compiler that contracts products into fused multiply-adds cannot spoil it.
    The rounding error has derivative zero; stopping it keeps that exact and forward mode cheap.
    """
    total = high + term
    shadow = total - high
    error = (high - (total - shadow)) + (term - shadow)
    return total, low + jax.lax.stop_gradient(error)


def divide_or_zero(numerator: Float[Array, "*n"], denominator: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """`numerator / denominator`, and 0 with derivative 0 where the denominator is 0."""
    is_zero = denominator == 0
    return jnp.where(is_zero, 0.0, numerator / jnp.where(is_zero, 1.0, denominator))


def normalise(vector: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Unit vector; the zero vector stays zero, with derivative zero. Scaled first, so that squares neither overflow nor underflow."""
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(vector), axis=-1, keepdims=True))
    is_zero = scale == 0
    scaled = jnp.where(is_zero, 1.0, vector / jnp.where(is_zero, 1.0, scale))
    return jnp.where(is_zero, 0.0, scaled / jnp.linalg.norm(scaled, axis=-1, keepdims=True))


def ray_box(origin: Triple, direction: Triple, lower: Triple, upper: Triple) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Distances at which a ray enters and leaves an axis-aligned box (slab method, Kay and Kajiya 1986).

    The ray misses where `t_far <= t_near`. A ray parallel to a slab is inside it always or never: there the quotient
    is not formed, so neither value nor derivative is NaN. Differentiable in everything; the choice of the face is not.
    """
    t_near, t_far = jnp.asarray(-jnp.inf), jnp.asarray(jnp.inf)
    for o, d, low, high in zip(origin, direction, lower, upper, strict=True):
        parallel = d == 0
        inverse = 1.0 / jnp.where(parallel, 1.0, d)
        first, second = (low - o) * inverse, (high - o) * inverse
        inside = (o >= low) & (o <= high)
        enter = jnp.where(parallel, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(first, second))
        leave = jnp.where(parallel, jnp.where(inside, jnp.inf, -jnp.inf), jnp.maximum(first, second))
        t_near, t_far = jnp.maximum(t_near, enter), jnp.minimum(t_far, leave)
    return t_near, t_far
