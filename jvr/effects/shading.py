"""Shading: what a surface reflects of the light that falls on it (Phong 1975; Blinn 1977; course notes on GPU-based volume ray-casting,
Eurographics 2009, section 3.4).

The normal points from larger to smaller values. Visualization convention: a light of irradiance 1 that a surface faces returns the
colour of the transfer function; the cosine is that of the angle between normal and light.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.effects import AbstractShading
from jvr.model.lobes import about_half_way, about_mirrored
from jvr.model.parameters import AbstractByScalar, assign, choice, parameter
from jvr.model.parts import is_zero
from jvr.model.ranges import AT_LEAST_ONE, NOT_NEGATIVE
from jvr.numerics import divide_or_zero, dot, larger, smaller
from jvr.types import ArrayLike, Scalar, Triple


def reflected(doc: str) -> Any:
    """The declaration of a fraction that a surface reflects."""
    return parameter(NOT_NEGATIVE, by_scalar=True, doc=doc)


class Lambert(AbstractShading):
    """Diffuse (Lambert) surfaces: `ambient L_ambient + diffuse E max(n . w_i, 0)`, times the colour of the medium.

    **Arguments:**

    - `ambient`, `diffuse`: numbers, not negative, or `jvr.ByValue` for a material by scalar, `jvr.ByGradient` for one by the length
      of its gradient.
    - `threshold`: length of the gradient (data units per world length) of half a surface: a point with a gradient of length `m` is one
      by the weight `m^2 / (m^2 + threshold^2)`; the rest of it reflects as if it faced the light, so that homogeneous regions are not
      shaded as surfaces. 0: whatever has a gradient is a surface.
    - `two_sided`: the normal is turned to the eye; else the side of larger values is dark.

    Differentiable in all numbers; detached: which way a normal is turned.
    """

    ambient: Any = reflected("share of ambient light")
    diffuse: Any = reflected("share of the light")
    threshold: Scalar = parameter(NOT_NEGATIVE, doc="length of a gradient", unit="data units per mm")
    two_sided: bool = choice(doc="whether normals are turned to the eye")

    def __init__(
        self,
        ambient: ArrayLike | AbstractByScalar = 1.0,
        diffuse: ArrayLike | AbstractByScalar = 1.0,
        *,
        threshold: ArrayLike = 0.0,
        two_sided: bool = True,
    ):
        assign(self, ambient=ambient, diffuse=diffuse, threshold=threshold, two_sided=two_sided)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        if is_zero(self.diffuse) and is_zero(getattr(self, "specular", 0.0)):
            yield "shading.diffuse and shading.specular are zero: nothing but ambient light is reflected"

    def ambient_reflectance(self) -> Scalar:
        return self.ambient

    def surface_weight(self, magnitude: Scalar) -> Scalar:
        return surface_weight(magnitude, self.threshold)

    def reflect(self, weight: Scalar, normal: Triple, w_o: Triple, w_i: Triple) -> tuple[Scalar, Scalar | None]:
        normal = self._turned(normal, w_o)
        facing = jnp.maximum(dot(normal, w_i), 0.0)
        diffuse = self.diffuse * (1 + weight * (facing - 1))
        specular = self.specular_lobe(normal, w_o, w_i)
        return diffuse, None if specular is None else weight * jnp.where(facing > 0, specular, 0.0)

    def specular_lobe(self, normal: Triple, w_o: Triple, w_i: Triple) -> Scalar | None:
        """What is reflected in the colour of the light."""
        return None

    def _turned(self, normal: Triple, w_o: Triple) -> Triple:
        if not self.two_sided:
            return normal
        sign = jnp.where(dot(normal, w_o) < 0, -1.0, 1.0)
        return tuple(sign * c for c in normal)


class Phong(Lambert):
    """Specular (Phong) surfaces: Lambert's, and `specular E max(r . w_o, 0)^shininess` in the colour of the light, `r` the mirrored light.

    **Arguments:** as `Lambert`, and `specular`, not negative; `shininess`, at least 1. Each a number, `jvr.ByValue` or
    `jvr.ByGradient`.
    """

    specular: Any = reflected("share of the light in the highlight")
    shininess: Any = parameter(AT_LEAST_ONE, by_scalar=True, doc="exponent of the highlight", hint="30 is a soft one")

    def __init__(
        self,
        ambient: ArrayLike | AbstractByScalar = 0.1,
        diffuse: ArrayLike | AbstractByScalar = 0.7,
        specular: ArrayLike | AbstractByScalar = 0.3,
        shininess: ArrayLike | AbstractByScalar = 30.0,
        *,
        threshold: ArrayLike = 0.0,
        two_sided: bool = True,
    ):
        super().__init__(ambient, diffuse, threshold=threshold, two_sided=two_sided)
        assign(self, specular=specular, shininess=shininess)

    def specular_lobe(self, normal: Triple, w_o: Triple, w_i: Triple) -> Scalar | None:
        return self.specular * about_mirrored(normal, w_o, w_i, self.shininess)


class BlinnPhong(Phong):
    """Specular (Blinn-Phong) surfaces: as `Phong` with `specular E max(n . h, 0)^shininess`, `h` half-way between the directions to eye
    and light."""

    # Written out because type checkers take a dataclass's fields for its arguments where it has no constructor of its own.
    def __init__(
        self,
        ambient: ArrayLike | AbstractByScalar = 0.1,
        diffuse: ArrayLike | AbstractByScalar = 0.7,
        specular: ArrayLike | AbstractByScalar = 0.3,
        shininess: ArrayLike | AbstractByScalar = 30.0,
        *,
        threshold: ArrayLike = 0.0,
        two_sided: bool = True,
    ):
        super().__init__(ambient, diffuse, specular, shininess, threshold=threshold, two_sided=two_sided)

    def specular_lobe(self, normal: Triple, w_o: Triple, w_i: Triple) -> Scalar | None:
        return self.specular * about_half_way(normal, w_o, w_i, self.shininess)


def surface_weight(magnitude: Float[Array, "..."], threshold: Scalar) -> Float[Array, "..."]:
    """`m^2 / (m^2 + t^2)`, by the ratio of the smaller to the larger, so that no square overflows; 0 where `m` is 0."""
    # Where both are the same, one has the derivative of the magnitude and the other that of the threshold.
    ratio = jnp.square(divide_or_zero(smaller(threshold, magnitude), larger(magnitude, threshold)))
    weight = jnp.where(magnitude >= threshold, 1 / (1 + ratio), ratio / (1 + ratio))
    # A gradient that vanishes has no normal, whatever the threshold.
    return jnp.where(magnitude > 0, weight, jax.lax.stop_gradient(jnp.zeros_like(magnitude)))
