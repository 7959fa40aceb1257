"""Lobes: how what a glossy surface reflects falls off about a direction. Shading and materials scale them each by their own convention.

`n` is the normal, `w_o` and `w_i` point away from the surface, to the eye and to the light; all unit vectors.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.numerics import direction_and_length, dot, power_of_cosine
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
