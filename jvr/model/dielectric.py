"""Where two media of different refractive index meet: Snell's law and Fresnel's equations for light without polarisation."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.numerics import dot
from jvr.types import Scalar, Triple

Numbers = Float[Array, "..."]


class Refraction(NamedTuple):
    """Where a line of sight goes on behind an interface: its direction, the cosine between it and the normal there, and whether all is
    reflected; then the direction is straight on, the cosine 1."""

    direction: Triple
    cosine: Numbers
    total: Bool[Array, "..."]


def mirrored(normal: Triple, w_o: Triple) -> Triple:
    """`2 (n . w_o) n - w_o` of unit vectors."""
    cosine = dot(normal, w_o)
    return tuple(2 * cosine * n - o for n, o in zip(normal, w_o, strict=True))


def refracted(normal: Triple, w_o: Triple, eta: Numbers) -> Refraction:
    """`eta (n . w_o) n - eta w_o - c n` with `c^2 = 1 - eta^2 (1 - (n . w_o)^2)`, of unit vectors; `normal` turned to the eye.

    `eta`: the index of the medium of the eye over that behind. All is reflected where `c^2` is not positive. Differentiable; detached:
    whether it is. The slope of `c` in the angle grows without bound towards that of total reflection.
    """
    cosine = dot(normal, w_o)
    # In this form it is the square of the cosine where indices are equal, with all digits at grazing angles.
    square = (1 - eta) * (1 + eta) + jnp.square(eta * cosine)
    total = square <= 0
    # The root has no derivative at the angle of total reflection; where there is none, none is taken.
    onward = jnp.sqrt(jnp.where(total, 1.0, square))
    bent = (eta * (cosine * n - o) - onward * n for n, o in zip(normal, w_o, strict=True))
    return Refraction(tuple(jnp.where(total, -o, b) for o, b in zip(w_o, bent, strict=True)), onward, total)


def fresnel(cosine: Numbers, behind: Refraction, eta: Scalar | Numbers) -> Numbers:
    """The reflected fraction, `(r_s^2 + r_p^2) / 2` with `r_s = (eta c_o - c) / (eta c_o + c)` and `r_p = (c_o - eta c) / (c_o + eta c)`;
    1 where all is reflected. `cosine`: `c_o`, between the normal and the eye, not negative."""
    of_s = (eta * cosine - behind.cosine) / (eta * cosine + behind.cosine)
    of_p = (cosine - eta * behind.cosine) / (cosine + eta * behind.cosine)
    return jnp.where(behind.total, 1.0, 0.5 * (jnp.square(of_s) + jnp.square(of_p)))
