"""Rough surfaces as a statistic of microfacets: a diffuse base under a clear coat, or bare metal.

With `alpha = roughness^2`, the half-way direction `h` and Fresnel's factor `F` in Schlick's form, `F = F0 (1 - s) + s`,
`s = (1 - w_o . h)^5`, the microfacets reflect `M = D V F max(n . w_i, 0)`: `D` is the GGX distribution (Walter et al. 2007, Microfacet
models for refraction through rough surfaces, equation 33), and `V`, which is masking and shadowing over `4 (n . w_o) (n . w_i)`, Smith's
with correlated heights (Heitz 2014, Understanding the masking-shadowing function, equation 99).
"""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.brdf import above, of_one_shape, share, where_or_normal
from jvr.model.material import AbstractBRDF, SymmetryAxis
from jvr.model.parameters import assign, parameter
from jvr.model.phase import components
from jvr.model.ranges import UNIT_INTERVAL, Interval
from jvr.numerics import direction_and_length, divide_or_zero
from jvr.types import ArrayLike, Channels, Scalar, Triple

Numbers = Float[Array, "..."]
# Angles of the table of reflectances, and microfacets down and around for each: errors of at most 0.001 at any roughness.
_ANGLES, _DOWN, _AROUND = 64, 48, 16

# Below, the peak of D and its derivatives leave float32.
ROUGHNESS = Interval(0.001, 1.0)


class MicrofacetBRDF(AbstractBRDF):
    """A microfacet material (GGX, Smith, Schlick) of metallic workflow, see this file's first lines.

    - Not metallic: unmodulated microfacets with `F0 = reflectance_at_normal` over a tinted diffuse base, which receives and lets out what
      the microfacets do not reflect: `base / pi (1 - E(w_o)) (1 - E(w_i)) / (1 - mean of E) max(n . w_i, 0)`, where `E` is the fraction
      that they reflect (Kelemen and Szirmay-Kalos 2001, A microfacet based coupled specular-matte BRDF model). With `base = 1` it
      reflects everything, at every roughness and angle.
    - Metallic: microfacets whose `F0` is the tint, so `F` is split into a tinted part `1 - s` and an unmodulated part `s`. Light between
      the microfacets is not followed: of light straight down on white metal 3 % are lost at roughness 0.4, a half at 0.85.

    **Arguments:** `base`, `reflectance_at_normal`: in [0, 1], a number or `(3,)`; `metallic`: from 0 to 1, a fraction of each;
    `roughness`: in [0.001, 1]. All differentiable. **Raises** `ValueError` otherwise.
    """

    symmetry_axis: ClassVar[SymmetryAxis] = "both"
    base: Numbers = share()
    metallic: Scalar = parameter(UNIT_INTERVAL, doc="from 0 for none to 1 for all")
    roughness: Scalar = parameter(ROUGHNESS, doc="0.001 is as good as a mirror, 1 is diffuse")
    reflectance_at_normal: Numbers = share("share of the light straight down")

    def __init__(
        self,
        base: ArrayLike = 1.0,
        metallic: ArrayLike = 0.0,
        roughness: ArrayLike = 0.5,
        reflectance_at_normal: ArrayLike = 0.04,
    ):
        assign(self, base=base, metallic=metallic, roughness=roughness, reflectance_at_normal=reflectance_at_normal)

    def evaluate(self, w_o: Triple, w_i: Triple) -> tuple[Channels, Channels]:
        w_o, w_i = of_one_shape(w_o, w_i)
        lit = above(w_o, w_i)
        w_o, w_i = (where_or_normal(lit, w) for w in (w_o, w_i))
        alpha = jnp.square(self.roughness)
        half, length = direction_and_length(tuple(o + i for o, i in zip(w_o, w_i, strict=True)))
        # |w_o + w_i| / 2 is the cosine between each of them and h.
        grazing = _schlick(0.5 * length)
        specular = jnp.where(lit, ggx(half, alpha) * visibility(w_o[2], w_i[2], alpha), 0.0)
        metal = self.metallic * specular * (1.0 - grazing)
        tinted, unmodulated = [], []
        table = reflectances(alpha)
        for base, f0 in components(self.base, self.reflectance_at_normal):
            coated = jnp.where(lit, base * _under_coat(f0, table, w_o[2], w_i[2]) * w_i[2], 0.0)
            tinted.append((1.0 - self.metallic) * coated + metal)
        for (f0,) in components(self.reflectance_at_normal):
            unmodulated.append(specular * ((1.0 - self.metallic) * f0 * (1.0 - grazing) + grazing))
        return tuple(tinted), tuple(unmodulated)


def ggx(h: Triple, alpha: Scalar) -> Numbers:
    """Area of microfacets that face `h`, per area and solid angle: `alpha^2 / (pi ((n . h)^2 alpha^2 + |n x h|^2)^2)`, above the surface.

    The usual `(n . h)^2 (alpha^2 - 1) + 1` has no digits left where `alpha` is small and `h` near the normal.
    """
    sine = h[0] * h[0] + h[1] * h[1]
    peak = alpha / (jnp.square(alpha * h[2]) + sine)
    return peak * peak / math.pi


def visibility(cos_o: Numbers, cos_i: Numbers, alpha: Scalar) -> Numbers:
    """Masking and shadowing over `4 cos_o cos_i`, times `cos_i`: `cos_i / (2 (cos_i root(cos_o) + cos_o root(cos_i)))` with
    `root(c)^2 = alpha^2 + (1 - alpha^2) c^2`; both cosines positive."""
    return smith(cos_o, _root(cos_o, alpha), cos_i, _root(cos_i, alpha))


def smith(cos_o: Numbers, root_o: Numbers, cos_i: Numbers, root_i: Numbers) -> Numbers:
    """The same of given roots."""
    return divide_or_zero(0.5 * cos_i, cos_i * root_o + cos_o * root_i)


def reflectances(alpha: Scalar) -> tuple[Float[Array, "m"], Float[Array, "m"], Float[Array, "m"]]:
    """A table of cosines of `w_i` from 0 to 1, and the fractions `A`, `B` reflected: `E = A F0 + B`, `A` the integral of `D V (1 - s)`
    over the sphere and `B` that of `D V s`.

    Over the microfacets that are visible from the direction, drawn evenly (Dupuy and Benyoub 2023, Sampling visible GGX normals with
    spherical caps): the integrand is then bounded by 1 at any roughness. Differentiable in `alpha`.
    """
    # Denser at grazing angles, where the fractions change fastest.
    cosine = jnp.square(jnp.linspace(0.0, 1.0, _ANGLES))
    # Denser at the end of the cap whose microfacets are steep, where smooth surfaces stop reflecting upwards.
    nodes, weights = np.polynomial.legendre.leggauss(_DOWN)
    down, weights = (0.5 * (nodes + 1)) ** 2, 0.5 * weights * (nodes + 1) / _AROUND
    down, weights = (jnp.asarray(a, cosine.dtype)[:, None] for a in (down, weights))
    # Half a turn: the other is its mirror image.
    azimuth = jnp.pi * (jnp.arange(_AROUND) + 0.5) / _AROUND

    def fractions(cos_o: Scalar) -> tuple[Scalar, Scalar]:
        sin_o = jnp.sqrt(1.0 - cos_o * cos_o)
        (x, _, z), _ = direction_and_length((alpha * sin_o, jnp.zeros_like(cos_o), cos_o))
        # A point of the cap above -z, of height (1 + z) down - z, plus the direction; the radius in a form that does not cancel.
        height = (1.0 + z) * down
        ring = jnp.sqrt((1.0 - down) * (1.0 + z) * (height + x * x / (1.0 + z)))
        h, _ = direction_and_length(
            (alpha * (ring * jnp.cos(azimuth) + x), alpha * ring * jnp.sin(azimuth), jnp.broadcast_to(height, (_DOWN, _AROUND)))
        )
        seen = sin_o * h[0] + cos_o * h[2]
        cos_i = jnp.maximum(2.0 * seen * h[2] - cos_o, 0.0)
        # Masking and shadowing over masking alone, by what is left of `visibility` without the cosine of `w_o`.
        shadowing = visibility(cos_o, cos_i, alpha) * 2.0 * (cos_o + _root(cos_o, alpha)) * weights
        grazing = _schlick(seen)
        return jnp.sum(shadowing * (1.0 - grazing)), jnp.sum(shadowing * grazing)

    return cosine, *jax.vmap(fractions)(cosine)


def _under_coat(f0: Scalar, table: tuple[Numbers, Numbers, Numbers], cos_o: Numbers, cos_i: Numbers) -> Numbers:
    """The diffuse BRDF of a white base under microfacets."""
    cosine, a, b = table
    # Rounding may leave a little less than nothing.
    passes = jnp.maximum(1.0 - a * f0 - b, 0.0)
    width, low, high = jnp.diff(cosine), cosine[:-1], cosine[1:]
    mean = jnp.sum(width * (passes[:-1] * (2.0 * low + high) + passes[1:] * (low + 2.0 * high))) / 3.0
    product = jnp.interp(cos_o, cosine, passes) * jnp.interp(cos_i, cosine, passes)
    return divide_or_zero(product, jnp.broadcast_to(math.pi * mean, product.shape))


def _root(c: Numbers, alpha: Scalar) -> Numbers:
    return jnp.sqrt(jnp.square(alpha) * (1.0 - c) * (1.0 + c) + c * c)


def _schlick(cosine: Numbers) -> Numbers:
    rest = 1.0 - cosine
    return rest * jnp.square(jnp.square(rest))
