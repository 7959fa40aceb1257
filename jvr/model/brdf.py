"""Reflectance as material functions: which fraction of the light from one direction a surface sends into another.

The material function is `M(w_o, w_i) = f(w_o, w_i) max(n . w_i, 0)`, the BRDF times the cosine, per solid angle of `w_i`: its
integral over the sphere is the fraction reflected to `w_o` of light that is the same from everywhere. All are isotropic and in the
surface's own frame: `n = (0, 0, 1)`, and `w_o`, `w_i` are unit directions that point away from the point, to the eye and to the light.

A material function has two parts: `tinted` is multiplied with the colour of the transfer function, `plain` is unmodulated: it
keeps the colour of the light, as highlights of everything but metals do.
"""

import abc
import math
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.model.by_value import is_varying
from jvr.model.lobes import about_half_way, about_mirrored
from jvr.model.material import AbstractBRDF, SymmetryAxis
from jvr.model.parameters import GREY_OR_RGB, assign, parameter
from jvr.model.phase import AbstractPhase, ScatteringAngle, components
from jvr.model.ranges import NOT_NEGATIVE, UNIT_INTERVAL
from jvr.types import ArrayLike, Channels, Scalar, Triple


def share(doc: str = "share of the light") -> Any:
    """The declaration of a fraction that is reflected, grey or linear RGB."""
    return parameter(UNIT_INTERVAL, shapes=GREY_OR_RGB, doc=doc)


class LambertBRDF(AbstractBRDF):
    """Diffuse (Lambert): `M = reflectance / pi max(n . w_i, 0)`, tinted.

    **Arguments:** `reflectance`: fraction reflected, in [0, 1], a number or `(3,)`; differentiable. **Raises** `ValueError` otherwise.
    """

    symmetry_axis: ClassVar[SymmetryAxis] = "normal"
    reflectance: Float[Array, "..."] = share()

    def __init__(self, reflectance: ArrayLike = 1.0):
        assign(self, reflectance=reflectance)

    def evaluate(self, w_o: Triple, w_i: Triple) -> tuple[Channels, Channels]:
        return lambert(self.reflectance, w_i), ()


class AbstractGlossyBRDF(AbstractBRDF):
    """A diffuse part, tinted, and a specular lobe in the light's own colour: `diffuse / pi max(n . w_i, 0)` and
    `specular lobe(w_o, w_i) max(n . w_i, 0)`, zero where either direction is below the surface.

    **Arguments:** `diffuse`, `specular`: in [0, 1], each a number or `(3,)`; where their sum is at most 1 no more is reflected than
    arrives. `exponent`: `e`, a number, not negative. All differentiable. **Raises** `ValueError` otherwise.
    """

    symmetry_axis: ClassVar[SymmetryAxis] = "both"
    diffuse: Float[Array, "..."] = share()
    specular: Float[Array, "..."] = share()
    exponent: Scalar = parameter(NOT_NEGATIVE, doc="exponent of the highlight", hint="30 is a soft one")

    def __init__(self, diffuse: ArrayLike, specular: ArrayLike, exponent: ArrayLike):
        assign(self, diffuse=diffuse, specular=specular, exponent=exponent)

    @abc.abstractmethod
    def lobe(self, w_o: Triple, w_i: Triple) -> Float[Array, "..."]:
        """The specular lobe, per solid angle, where both directions are above the surface."""

    def evaluate(self, w_o: Triple, w_i: Triple) -> tuple[Channels, Channels]:
        received = jnp.where(above(w_o, w_i), self.lobe(w_o, w_i) * w_i[2], 0.0)
        return lambert(self.diffuse, w_i), tuple(s * received for (s,) in components(self.specular))


class PhongBRDF(AbstractGlossyBRDF):
    """Diffuse and a specular lobe about the mirrored light, `(e + 2) / (2 pi) max(r . w_o, 0)^e` (Lafortune and Willems 1994, Using the
    modified Phong reflectance model for physically based rendering).

    Reciprocal. The lobe reflects the fraction `specular` to an eye that looks straight down, less to others: what of the lobe lies below
    the surface is lost. Arguments as `AbstractGlossyBRDF`.
    """

    # Type checkers do not see an inherited constructor of a dataclass.
    def __init__(self, diffuse: ArrayLike = 0.7, specular: ArrayLike = 0.3, exponent: ArrayLike = 30.0):
        super().__init__(diffuse, specular, exponent)

    def lobe(self, w_o: Triple, w_i: Triple) -> Float[Array, "..."]:
        return (self.exponent + 2.0) / (2.0 * math.pi) * about_mirrored(_normal(), w_o, w_i, self.exponent)


class BlinnPhongBRDF(AbstractGlossyBRDF):
    """Diffuse and a specular lobe `(e + 2) (e + 4) / (8 pi (2^(-e/2) + e)) max(n . h, 0)^e`, `h` half-way between the directions to eye and
    light.

    The factor makes the fraction reflected straight up exactly `specular` (Giesen 2009, Phong and Blinn-Phong normalization factors); the
    common `(e + 8) / (8 pi)` reflects up to 8 % more than arrives. Exponent 0 is Lambert's. Arguments as `AbstractGlossyBRDF`.
    """

    def __init__(self, diffuse: ArrayLike = 0.7, specular: ArrayLike = 0.3, exponent: ArrayLike = 30.0):
        super().__init__(diffuse, specular, exponent)

    def lobe(self, w_o: Triple, w_i: Triple) -> Float[Array, "..."]:
        e = self.exponent
        factor = (e + 2.0) * ((e + 4.0) / (8.0 * math.pi * (jnp.exp2(-0.5 * e) + e)))
        return factor * about_half_way(_normal(), w_o, w_i, e)


class PhaseBRDF(AbstractBRDF):
    """A phase function as a material, a medium without surface: tinted `albedo p(cos theta)`, `cos theta = -w_o . w_i`, and no cosine of
    `w_i`.

    **Arguments:** `phase`: any phase function, such as `jvr.HenyeyGreenstein(0.6)`; `albedo`: in [0, 1], a number or `(3,)`.
    All differentiable. **Raises** `ValueError` otherwise.
    """

    symmetry_axis: ClassVar[SymmetryAxis] = "eye"
    phase: AbstractPhase = parameter(doc="a phase function such as jvr.HenyeyGreenstein(0.5)")
    albedo: Float[Array, "..."] = share()

    def __init__(self, phase: AbstractPhase, albedo: ArrayLike = 1.0):
        if is_varying(phase):
            raise ValueError(
                "a material has one phase function: take jvr.MaterialByValue(positions, materials) for one by the scalar"
            )
        assign(self, phase=phase, albedo=albedo)

    def evaluate(self, w_o: Triple, w_i: Triple) -> tuple[Channels, Channels]:
        # Of one shape: a phase function's derivative rules do not broadcast.
        w_o, w_i = of_one_shape(w_o, w_i)
        values = self.phase.evaluate(ScatteringAngle.between(w_o, w_i))
        albedo = [a for (a,) in components(self.albedo)]
        n = max(len(values), len(albedo))
        return tuple(albedo[c % len(albedo)] * values[c % len(values)] for c in range(n)), ()


def _normal() -> Triple:
    """In a surface's own frame."""
    return jnp.zeros(()), jnp.zeros(()), jnp.ones(())


def lambert(reflectance: Float[Array, "..."], w_i: Triple) -> Channels:
    """Lambert's `reflectance / pi max(n . w_i, 0)` for each component of the reflectance."""
    facing = jnp.maximum(w_i[2], 0.0) / math.pi
    return tuple(r * facing for (r,) in components(reflectance))


def above(w_o: Triple, w_i: Triple) -> Bool[Array, "..."]:
    """Whether both directions are above the surface, so that light can be reflected from one into the other."""
    return (w_o[2] > 0) & (w_i[2] > 0)


def of_one_shape(w_o: Triple, w_i: Triple) -> tuple[Triple, Triple]:
    """Both directions with all components broadcast to one shape."""
    every = jnp.broadcast_arrays(*w_o, *w_i)
    return tuple(every[:3]), tuple(every[3:])


def where_or_normal(lit: Bool[Array, "..."], w: Triple) -> Triple:
    """`w` where `lit`, else the normal: there every derivative of what is then left out is finite."""
    return jnp.where(lit, w[0], 0.0), jnp.where(lit, w[1], 0.0), jnp.where(lit, w[2], 1.0)
