"""Lobes: how what a glossy surface reflects falls off about a direction. Shading and materials scale them each by their own convention.

`n` is the normal, `w_o` and `w_i` point away from the surface, to the eye and to the light; all unit vectors.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.numerics import direction_and_length, dot, perpendicular, power_of_cosine
from jvr.types import Triple

Numbers = Float[Array, "..."]


def about_mirrored(n: Triple, w_o: Triple, w_i: Triple, exponent: Numbers) -> Numbers:
    """`max(r . w_o, 0)^exponent`, `r` the mirrored light (Phong 1975)."""
    twice = 2 * dot(n, w_i)
    mirrored = tuple(twice * a - b for a, b in zip(n, w_i, strict=True))
    return power_of_cosine(mirrored, w_o, exponent)


def about_half_way(n: Triple, w_o: Triple, w_i: Triple, exponent: Numbers) -> Numbers:
    """`max(n . h, 0)^exponent`, `h` half-way between the directions to eye and light (Blinn 1977); 0 where these are opposite."""
    half, length = direction_and_length(tuple(o + i for o, i in zip(w_o, w_i, strict=True)))
    return jnp.where(length > 0, power_of_cosine(n, half, exponent), 0.0)


def sample_about(axis: Triple, exponent: Numbers, u: Numbers, v: Numbers) -> Triple:
    """A direction with the density `(e + 1) / (2 pi) cos^e` about an axis (notes, equation 8.22), for two numbers in [0, 1)."""
    cosine = jnp.power(1 - u, 1 / (exponent + 1))
    sine = jnp.sqrt(jnp.maximum((1 - cosine) * (1 + cosine), 0.0))
    across, up = perpendicular(axis)
    x, y = sine * jnp.cos(2 * math.pi * v), sine * jnp.sin(2 * math.pi * v)
    return tuple(cosine * a + x * b + y * c for a, b, c in zip(axis, across, up, strict=True))


def upright(like: Triple) -> Triple:
    """The normal of a surface in its own frame, of the shape of another direction."""
    zero = jnp.zeros_like(like[2])
    return zero, zero, zero + 1
