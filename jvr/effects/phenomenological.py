"""A surface that reflects and lets through, by five numbers (course notes on GPU-based volume ray-casting, Eurographics 2009, section 7.5).

With the normal `n` turned to the eye, `r = 2 (n . w_o) n - w_o` mirrored and `t` where the line of sight goes on behind the surface:

    f_r = k_d max(n . w_i, 0) + k_s max(r . w_i, 0)^s         on the side of the eye,
    f_t = k_t max(t . w_i, 0)^q                               behind,

cosines included. `t = -w_o`, or by Snell's law `eta (n . w_o) n - eta w_o - c n` with `c^2 = 1 - eta^2 (1 - (n . w_o)^2)`, where `eta` is
the index of the medium of the eye over that behind. Where `c^2` is negative all is reflected: the lobe of `k_t` is about `r`.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.shading import surface_weight
from jvr.model.dielectric import mirrored, refracted
from jvr.model.effects import AbstractShading
from jvr.model.lobes import sample_about, upright
from jvr.model.parameters import AbstractByScalar, assign, choice, parameter
from jvr.model.parts import is_zero
from jvr.model.ranges import NOT_NEGATIVE, POSITIVE, UNIT_INTERVAL
from jvr.numerics import divide_or_zero, dot, power_of_cosine
from jvr.types import ArrayLike, Scalar, Triple

Numbers = Float[Array, "..."]


class PhenomenologicalBSDF(AbstractShading):
    """Diffuse, specular and transmissive lobes: `f_r` and `f_t` of this file's first lines.

    Light of irradiance 1 that falls on the surface from the front returns `k_d` of its colour; what is let through is coloured as well,
    the specular lobe has the colour of the light.

    **Arguments:**

    - `k_d`, `k_s`, `k_t`: shares of the three lobes, 0 ... 1, numbers, `jvr.ByValue` or `jvr.ByGradient`. With a sum of at most 1 no
      more leaves than arrives.
    - `s`, `q`: exponents of the specular and of the transmissive lobe, not negative; as the shares.
    - `index`: refractive index of what has the larger values over that of what has the smaller ones, positive, or `None`: straight on.
    - `normalised`: lobes are scaled to reflect, or let through, their share of all light from everywhere, `k_s (s + 1) / 2` and
      `k_t (q + 1) / 2`; else they are the notes' to the letter.
    - `threshold`: as of `jvr.Lambert`.

    Ambient light is returned by `k_d + k_s + k_t`, in the colour of the surface. What of a lobe lies on the wrong side of it is lost.
    Differentiable in all numbers; detached: which way the normal is turned and where all is reflected.

    `value`, `sample` and `pdf` are of the frame of the surface, `n = (0, 0, 1)`, with `w_o` above it: per solid angle of `w_i`, cosine
    included, without the colour; normalised.
    """

    k_d: Any = parameter(UNIT_INTERVAL, by_scalar=True, doc="share of the diffuse lobe")
    k_s: Any = parameter(UNIT_INTERVAL, by_scalar=True, doc="share of the specular lobe")
    k_t: Any = parameter(UNIT_INTERVAL, by_scalar=True, doc="share of the transmissive lobe")
    s: Any = parameter(NOT_NEGATIVE, by_scalar=True, doc="exponent of the specular lobe", hint="30 is a soft one")
    q: Any = parameter(NOT_NEGATIVE, by_scalar=True, doc="exponent of the transmissive lobe", hint="30 is a soft one")
    index: Scalar | None = parameter(POSITIVE, doc="refractive index behind the surface, relative to the outside")
    threshold: Scalar = parameter(NOT_NEGATIVE, doc="length of a gradient", unit="data units per mm")
    normalised: bool = choice(doc="whether each lobe integrates to its share")

    def __init__(
        self,
        k_d: ArrayLike | AbstractByScalar = 0.5,
        k_s: ArrayLike | AbstractByScalar = 0.2,
        k_t: ArrayLike | AbstractByScalar = 0.3,
        s: ArrayLike | AbstractByScalar = 30.0,
        q: ArrayLike | AbstractByScalar = 10.0,
        index: ArrayLike | None = None,
        *,
        normalised: bool = True,
        threshold: ArrayLike = 0.0,
    ):
        assign(self, k_d=k_d, k_s=k_s, k_t=k_t, s=s, q=q, index=index, normalised=normalised, threshold=threshold)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        if is_zero(self.k_d) and is_zero(self.k_s) and is_zero(self.k_t):
            yield "shading.k_d, k_s and k_t are zero: nothing is reflected or let through"

    def ambient_reflectance(self) -> Scalar:
        return self.k_d + self.k_s + self.k_t

    def surface_weight(self, magnitude: Scalar) -> Scalar:
        return surface_weight(magnitude, self.threshold)

    def reflect(self, weight: Scalar, normal: Triple, w_o: Triple, w_i: Triple) -> tuple[Scalar, Scalar]:
        behind = dot(normal, w_o) < 0
        sides = _sides(tuple(jnp.where(behind, -c, c) for c in normal), w_o, self.index, behind)
        facing = dot(sides.normal, w_i)
        specular, let_through = self._lobes(sides, w_i, normalised=self.normalised)
        # What is not a surface reflects as if it faced the light.
        tinted = self.k_d * (1 + weight * (jnp.maximum(facing, 0.0) - 1)) + weight * let_through
        return tinted, weight * specular

    def value(self, w_o: Triple, w_i: Triple) -> Numbers:
        """`f_r + f_t`, per solid angle."""
        sides = _sides(upright(w_o), w_o, self.index, False)
        specular, let_through = self._lobes(sides, w_i, normalised=True)
        return (self.k_d * jnp.maximum(w_i[2], 0.0) + specular + let_through) / math.pi

    def pdf(self, w_o: Triple, w_i: Triple) -> Numbers:
        """Density of `sample`, per solid angle; it integrates to 1 less what of the lobes lies on the wrong side."""
        return divide_or_zero(self.value(w_o, w_i), jnp.broadcast_to(self.ambient_reflectance(), w_i[2].shape))

    def sample(self, w_o: Triple, u: Triple) -> tuple[Triple, Bool[Array, "..."]]:
        """A direction for three numbers in [0, 1), and whether it is on the side of its lobe; the weight `value / pdf` is `k_d + k_s + k_t`
        where it is, and 0 where it is not. Detached: which lobe is taken."""
        sides = _sides(upright(w_o), w_o, self.index, False)
        chosen = u[0] * self.ambient_reflectance()
        diffuse, through = chosen < self.k_d, chosen >= self.k_d + self.k_s
        passes = through & ~sides.total
        axis = tuple(
            jnp.where(diffuse, n, jnp.where(passes, t, r))
            for n, r, t in zip(sides.normal, sides.mirrored, sides.onward, strict=True)
        )
        exponent = jnp.where(diffuse, 1.0, jnp.where(through, self.q, self.s))
        w_i = sample_about(axis, exponent, u[1], u[2])
        return w_i, jnp.where(passes, w_i[2] < 0, w_i[2] > 0)

    def _lobes(self, sides: "_Sides", w_i: Triple, *, normalised: bool) -> tuple[Numbers, Numbers]:
        """The specular lobe and the transmissive one, times pi where they are `normalised`; the latter is reflected where all is."""
        of_s, of_q = ((e + 1) / 2 if normalised else 1.0 for e in (self.s, self.q))
        front = dot(sides.normal, w_i) > 0
        total = jnp.where(front & sides.total, power_of_cosine(sides.mirrored, w_i, self.q), 0.0)
        passed = jnp.where(~front & ~sides.total, power_of_cosine(sides.onward, w_i, self.q), 0.0)
        specular = jnp.where(front, power_of_cosine(sides.mirrored, w_i, self.s), 0.0)
        return self.k_s * of_s * specular, self.k_t * of_q * (passed + total)


class _Sides(NamedTuple):
    """A surface as the eye sees it: the normal turned to it, the mirrored direction, where the line of sight goes on, and whether it does
    not."""

    normal: Triple
    mirrored: Triple
    onward: Triple
    total: Bool[Array, "..."]


def _sides(normal: Triple, w_o: Triple, index: Scalar | None, inside: Bool[Array, "..."] | bool) -> _Sides:
    """`normal` is turned to the eye; `inside`: whether that is in the medium of the larger values."""
    mirror = mirrored(normal, w_o)
    if index is None:
        return _Sides(normal, mirror, tuple(-o for o in w_o), jnp.zeros_like(mirror[0], bool))
    behind = refracted(normal, w_o, jnp.where(inside, index, 1 / index))
    return _Sides(normal, mirror, behind.direction, behind.total)
