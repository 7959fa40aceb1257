"""Surfaces that are smoother in one direction than in others: brushed metal, hair, muscle, wood (course notes on GPU-based volume
ray-casting, Eurographics 2009, section 9.2: the shape of the specular lobe depends on the local orientation).

The slopes of microfacets have a covariance that is a tensor in space, as of fibres along the unit vector `d`,

    M = alpha_along^2 d d^T + alpha_across^2 (1 - d d^T),    alpha = roughness^2,

and on a surface with normal `n` they have what M is in its plane. Along the projection of `d` on it, the tangent, that is
`alpha_t^2 = alpha_along^2 |n x d|^2 + alpha_across^2 (n . d)^2`, and across it `alpha_across^2`. Where fibres end on a surface both are
equal and the lobe is round: value and derivatives stay finite where there is no tangent.

The lobe is that of GGX for two roughnesses (Heitz 2014, Understanding the masking-shadowing function, equations 85, 86, 99): with the
half-way direction `h`, its components `h_t`, `h_b` along and across the tangent, and `root(v)^2 = v^T M_n v + (n . v)^2`,

    D = 1 / (pi alpha_t alpha_across (h_t^2 / alpha_t^2 + h_b^2 / alpha_across^2 + (n . h)^2)^2),
    f (n . w_i) = D V,    V = (n . w_i) / (2 ((n . w_i) root(w_o) + (n . w_o) root(w_i))).
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.shading import Lambert, reflected
from jvr.model.brdf import where_or_normal
from jvr.model.lobes import sample_about, upright
from jvr.model.microfacet import ROUGHNESS, smith
from jvr.model.parameters import AbstractByScalar, assign, parameter
from jvr.model.ranges import DIRECTION
from jvr.numerics import cross, direction_and_length, divide_or_zero, dot
from jvr.types import ArrayLike, Scalar, Triple, Vector

Numbers = Float[Array, "..."]


class AnisotropicGGX(Lambert):
    """Anisotropic surfaces: Lambert's, and `specular E pi D V` in the colour of the light, see this file's first lines.

    **Arguments:**

    - `direction`: `(3,)`, of the fibres, scratches or hairs in the world, of any length but zero; its sign says nothing.
    - `ambient`, `diffuse`, `threshold`, `two_sided`: as of `jvr.Lambert`.
    - `specular`: not negative; with a sum of `diffuse` and `specular` of at most 1 no more leaves than arrives. Light between the
      microfacets is not followed: that much of the lobe is lost.
    - `roughness_along`, `roughness_across`: along `direction` and across it, in [0.001, 1], as of `jvr.MicrofacetBRDF`, whose lobe it is
      where they are equal. Smoother along than across, the highlight is a streak across the fibres.

    Coefficients are numbers, `jvr.ByValue` or `jvr.ByGradient`. Differentiable in all numbers; detached: which way a normal is turned.

    `value`, `sample` and `pdf` are those of a surface that faces along z, `n = (0, 0, 1)`, with `w_o` above it and `direction` in the same
    axes: per solid angle of `w_i`, cosine included, without the colour. Without the cosine it is reciprocal.
    """

    direction: Vector = parameter(DIRECTION, doc="x, y, z, the way that fibres go")
    specular: Any = reflected("share of the light in the highlight")
    roughness_along: Any = parameter(
        ROUGHNESS, by_scalar=True, doc="along the direction; 0.001 is as good as a mirror, 1 is diffuse"
    )
    roughness_across: Any = parameter(ROUGHNESS, by_scalar=True, doc="across the direction")

    def __init__(
        self,
        direction: ArrayLike,
        ambient: ArrayLike | AbstractByScalar = 0.1,
        diffuse: ArrayLike | AbstractByScalar = 0.7,
        specular: ArrayLike | AbstractByScalar = 0.3,
        roughness_along: ArrayLike | AbstractByScalar = 0.2,
        roughness_across: ArrayLike | AbstractByScalar = 0.6,
        *,
        threshold: ArrayLike = 0.0,
        two_sided: bool = True,
    ):
        super().__init__(ambient, diffuse, threshold=threshold, two_sided=two_sided)
        assign(self, direction=direction, specular=specular, roughness_along=roughness_along, roughness_across=roughness_across)

    def specular_lobe(self, normal: Triple, w_o: Triple, w_i: Triple) -> Numbers:
        lit = (dot(normal, w_o) > 0) & (dot(normal, w_i) > 0)
        # Where there is no lobe every derivative of what is left out is finite.
        normal, w_o, w_i = (where_or_normal(lit, w) for w in (normal, w_o, w_i))
        facets = self._facets(normal)
        visible = smith(dot(normal, w_o), facets.root(w_o), dot(normal, w_i), facets.root(w_i))
        return self.specular * jnp.where(lit, math.pi * facets.density(_half_way(w_o, w_i)) * visible, 0.0)

    def value(self, w_o: Triple, w_i: Triple) -> Numbers:
        """The BRDF times the cosine, per solid angle."""
        return (self.diffuse * jnp.maximum(w_i[2], 0.0) + self.specular_lobe(upright(w_o), w_o, w_i)) / math.pi

    def pdf(self, w_o: Triple, w_i: Triple) -> Numbers:
        """Density of `sample`, per solid angle; it integrates to 1 less what of the lobe lies below the surface."""
        above = w_i[2] > 0
        w_o, w_i = (where_or_normal(above, w) for w in (w_o, w_i))
        facets = self._facets(upright(w_o))
        # Microfacets that are seen from w_o, mirrored in: with Smith's masking the cosine of h cancels.
        lobe = facets.density(_half_way(w_o, w_i)) / (2 * (w_o[2] + facets.root(w_o)))
        density = divide_or_zero(
            self.diffuse * w_i[2] / math.pi + self.specular * lobe, jnp.broadcast_to(self.diffuse + self.specular, w_i[2].shape)
        )
        return jnp.where(above, density, 0.0)

    def sample(self, w_o: Triple, u: Triple) -> tuple[Triple, Bool[Array, "..."]]:
        """A direction for three numbers in [0, 1), and whether it is above the surface; the weight `value / pdf` is at most
        `diffuse + specular` where it is, and 0 where it is not. Detached: which lobe is taken.

        Microfacets are drawn among those that are visible from `w_o` (Dupuy and Benyoub 2023, Sampling visible GGX normals with spherical
        caps).
        """
        normal = upright(w_o)
        facets = self._facets(normal)
        (x, y, z), _ = direction_and_length(facets.stretched(w_o))
        # A point of the cap above -z; the radius of its ring in a form that does not cancel.
        ring = jnp.sqrt(u[1]) * jnp.sqrt((1 + z) * ((1 - u[1]) * (1 + z) + (1 - z)))
        azimuth = 2 * math.pi * u[2]
        cap = x + ring * jnp.cos(azimuth), y + ring * jnp.sin(azimuth), (1 - u[1]) * (1 + z)
        h, _ = direction_and_length(facets.stretched(cap))
        twice = 2 * dot(w_o, h)
        diffuse = u[0] * (self.diffuse + self.specular) < self.diffuse
        around = sample_about(normal, jnp.ones_like(z), u[1], u[2])
        w_i = tuple(jnp.where(diffuse, a, twice * b - c) for a, b, c in zip(around, h, w_o, strict=True))
        return w_i, w_i[2] > 0

    def _facets(self, normal: Triple) -> "_Facets":
        d, _ = direction_and_length((self.direction[0], self.direction[1], self.direction[2]))
        steep = dot(normal, d)
        tangent = tuple(a - steep * n for a, n in zip(d, normal, strict=True))
        along, across = (jnp.square(jnp.square(roughness)) for roughness in (self.roughness_along, self.roughness_across))
        rougher = along > across
        # No absolute value, whose derivative is lost where both are the same; nor products of which then the derivative has to cancel.
        excess = jnp.where(rougher, along - across, across - along)
        in_plane = jnp.where(rougher, across + excess * dot(tangent, tangent), along + excess * jnp.square(steep))
        return _Facets(normal, tangent, across, in_plane, rougher, excess)


class _Facets(NamedTuple):
    """Microfacets on a surface: its normal, the direction's projection on it, `alpha^2` across the direction and along the projection,
    whether they are rougher along than across, and by how much of `alpha^2` these differ.

    Forms of M are sums of positive terms, of which none is divided by the length of the projection: with `p` the projection and
    `q = n x p`, `(v . p)^2 + (v . q)^2 = |p|^2 |n x v|^2` and `alpha_t^2 - alpha_across^2 = (alpha_along^2 - alpha_across^2) |p|^2`.
    """

    normal: Triple
    tangent: Triple
    across: Scalar
    in_plane: Numbers
    rougher: Bool[Array, ""]
    excess: Scalar

    def density(self, h: Triple) -> Numbers:
        """`D`, per area and solid angle."""
        flat, sine, p, q = self._parts(h)
        # No product of squares under a quotient or a root: that of two mirrors leaves float32 in derivatives.
        ratio = self.excess / self.in_plane / self.across
        slopes = sine / jnp.where(self.rougher, self.in_plane, self.across) + ratio * jnp.square(jnp.where(self.rougher, q, p))
        peak = 1 / (jnp.sqrt(jnp.sqrt(self.in_plane) * jnp.sqrt(self.across)) * (slopes + jnp.square(flat)))
        return peak * peak / math.pi

    def root(self, v: Triple) -> Numbers:
        """`root(v)` of masking and shadowing."""
        flat, sine, p, q = self._parts(v)
        least = jnp.where(self.rougher, self.across, self.in_plane)
        return jnp.sqrt(least * sine + self.excess * jnp.square(jnp.where(self.rougher, p, q)) + jnp.square(flat))

    def stretched(self, v: Triple) -> Triple:
        """The root of M times what of `v` lies in the surface, and the rest of `v`: the map from a hemisphere's normals to these."""
        flat, across = dot(self.normal, v), jnp.sqrt(self.across)
        more = jnp.where(self.rougher, self.excess, -self.excess) / (jnp.sqrt(self.in_plane) + across) * dot(self.tangent, v)
        parts = zip(v, self.normal, self.tangent, strict=True)
        return tuple(across * (c - flat * n) + more * t + flat * n for c, n, t in parts)

    def _parts(self, v: Triple) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """The cosine to the normal, the square of the sine, `v . p` and `v . q`."""
        flat = dot(self.normal, v)
        plane = tuple(c - flat * n for c, n in zip(v, self.normal, strict=True))
        return flat, dot(plane, plane), dot(plane, self.tangent), dot(plane, cross(self.normal, self.tangent))


def _half_way(w_o: Triple, w_i: Triple) -> Triple:
    return direction_and_length(tuple(o + i for o, i in zip(w_o, w_i, strict=True)))[0]
