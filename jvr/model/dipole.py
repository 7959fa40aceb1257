"""Subsurface scattering by a dipole: light that enters a translucent material at one place and leaves it at another.

Jensen, Marschner, Levoy and Hanrahan 2001, A practical model for subsurface light transport, section 2.2 and table 1: deep inside, light
that was scattered many times spreads like heat, and a source below the surface with its negative mirror image above it tells how much
comes out at a distance.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.parameters import assign, parameter
from jvr.model.ranges import NOT_NEGATIVE, POSITIVE, Interval
from jvr.types import ArrayLike, Scalar, Triple, Vector

Numbers = Float[Array, "..."]

# Reduced scattering and absorption in 1 / mm, red, green, blue: table 1 of the paper.
MEASURED = {
    "apple": ((2.29, 2.39, 1.97), (0.0030, 0.0034, 0.046)),
    "chicken1": ((0.15, 0.21, 0.38), (0.015, 0.077, 0.19)),
    "chicken2": ((0.19, 0.25, 0.32), (0.018, 0.088, 0.20)),
    "cream": ((7.38, 5.47, 3.15), (0.0002, 0.0028, 0.0163)),
    "ketchup": ((0.18, 0.07, 0.03), (0.061, 0.97, 1.45)),
    "marble": ((2.19, 2.62, 3.00), (0.0021, 0.0041, 0.0071)),
    "potato": ((0.68, 0.70, 0.55), (0.0024, 0.0090, 0.12)),
    "skimmilk": ((0.70, 1.22, 1.90), (0.0014, 0.0025, 0.0142)),
    "skin1": ((0.74, 0.88, 1.01), (0.032, 0.17, 0.48)),
    "skin2": ((1.09, 1.59, 1.79), (0.013, 0.070, 0.145)),
    "spectralon": ((11.6, 20.4, 14.9), (0.0, 0.0, 0.0)),
    "wholemilk": ((2.55, 3.21, 3.77), (0.0011, 0.0024, 0.014)),
}

# Index of refraction: the fit of F_dr is for light from the denser side, and reaches 1 at 4.9.
REFRACTION = Interval(1.0, 3.0)


class Dipole(eqx.Module):
    """Diffuse reflectance `R_d(r)` of a half space by a dipole: the fraction of the light falling on a point that leaves at distance `r`,
    per area.

    `R_d = alpha' / (4 pi) sum_{z = z_r, z_v} z (1 + sigma_tr d) exp(-sigma_tr d) / d^3` with `d = sqrt(r^2 + z^2)`,
    `sigma_t' = sigma_s' + sigma_a`, `alpha' = sigma_s' / sigma_t'`, `sigma_tr = sqrt(3 sigma_a sigma_t')`, `z_r = 1 / sigma_t'`,
    `z_v = z_r (1 + 4 A / 3)`, `A = (1 + F_dr) / (1 - F_dr)`, `F_dr = -1.440 / eta^2 + 0.710 / eta + 0.668 + 0.0636 eta`.

    **Arguments:** `sigma_s_prime`: `(3,)`, reduced scattering, 1 / mm, positive; `sigma_a`: `(3,)`, absorption, 1 / mm, not negative;
    `eta`: relative index of refraction, in [1, 3]. All differentiable. **Raises** `ValueError` otherwise.
    """

    sigma_s_prime: Vector = parameter(POSITIVE, doc="reduced scattering of red, green, blue", unit="1 / mm")
    sigma_a: Vector = parameter(NOT_NEGATIVE, doc="absorption of red, green, blue", unit="1 / mm")
    eta: Scalar = parameter(REFRACTION, doc="index of refraction", hint="skin has 1.3")

    def __init__(self, sigma_s_prime: ArrayLike, sigma_a: ArrayLike, eta: ArrayLike = 1.3):
        assign(self, sigma_s_prime=sigma_s_prime, sigma_a=sigma_a, eta=eta)

    @classmethod
    def preset(cls, name: str) -> "Dipole":
        """One of the twelve materials that the paper measured, see `MEASURED`. **Raises** `ValueError` for another name."""
        if name not in MEASURED:
            raise ValueError(f"no translucent material is called {name!r}; there are {', '.join(MEASURED)}")
        return cls(*MEASURED[name], eta=1.5 if name == "marble" else 1.3)

    def reflectance(self, r: Numbers) -> Triple:
        """`R_d` in 1 / mm^2 for red, green and blue, elementwise in the distance `r` in mm.

        Differentiable in `r` and every coefficient, at `r = 0` and without absorption too.
        """
        return tuple(self._reflectance(r, s, a) for s, a in zip(self.sigma_s_prime, self.sigma_a, strict=True))

    @property
    def total(self) -> Triple:
        """The fraction of all light that leaves again, the integral of `2 pi r R_d`:
        `alpha' / 2 (1 + exp(-4/3 A u)) exp(-u)` with `u = sqrt(3 (1 - alpha'))`.

        Its derivative in the absorption is infinite where there is none: without absorption, light returns from any distance. There it is
        taken as 0.
        """
        return tuple(self._total(s, a) for s, a in zip(self.sigma_s_prime, self.sigma_a, strict=True))

    def _boundary(self) -> Scalar:
        """`A`: how strongly the inside of the surface reflects."""
        inner = -1.440 / (self.eta * self.eta) + 0.710 / self.eta + 0.668 + 0.0636 * self.eta
        return (1.0 + inner) / (1.0 - inner)

    def _reflectance(self, r: Numbers, sigma_s: Scalar, sigma_a: Scalar) -> Numbers:
        sigma_t = sigma_s + sigma_a
        depth = 1.0 / sigma_t
        albedo = sigma_s * depth

        def pole(z: Scalar) -> Numbers:
            square = r * r + z * z
            inverse = jax.lax.rsqrt(square)
            # Factors of at most 1 and about equal size: a power of the distance alone would overflow first.
            return (z * inverse) * inverse * inverse * _screened(3.0 * sigma_a * sigma_t * square)

        return albedo / (4.0 * math.pi) * (pole(depth) + pole(depth * (1.0 + 4.0 / 3.0 * self._boundary())))

    def _total(self, sigma_s: Scalar, sigma_a: Scalar) -> Scalar:
        sigma_t = sigma_s + sigma_a
        loss = 3.0 * sigma_a / sigma_t
        lossless = loss <= 0
        u = jnp.where(lossless, 0.0, jnp.sqrt(jnp.where(lossless, 1.0, loss)))
        return 0.5 * sigma_s / sigma_t * (1.0 + jnp.exp(-4.0 / 3.0 * self._boundary() * u)) * jnp.exp(-u)


@jax.custom_jvp
def _screened(q: Numbers) -> Numbers:
    """`(1 + sqrt(q)) exp(-sqrt(q))`, whose derivative `-exp(-sqrt(q)) / 2` is finite at 0, where that of the root is not."""
    root = jnp.sqrt(q)
    return (1.0 + root) * jnp.exp(-root)


@_screened.defjvp
def _screened_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (q,), (tangent,) = primals, tangents
    return _screened(q), -0.5 * jnp.exp(-jnp.sqrt(q)) * tangent
