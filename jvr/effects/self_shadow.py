"""Self-shadowing: what the medium just in front of a sample takes of the light.

Light of radiance transfer is known at nodes that lie further apart than a surface is thick, and so it is that above the surface. What
such nodes miss is known at the sample: the scalar goes linearly along the normal, so that the optical depth `tau` from the sample up to
where light comes from is an integral of the transfer function, and light at an angle of cosine `mu` to the normal keeps `exp(-tau / mu)`
of itself. Under a diffuse surface band `l` of the light keeps

    f_l = integral_0^1 mu P_l(mu) exp(-tau / mu) dmu / integral_0^1 mu P_l(mu) dmu:  2 E_3,  3 E_4,  4 (3 E_5 - E_3)

of `tau`, with the exponential integrals `E_n`. Averaged over what an eye sees, this is the law of Lommel and Seeliger.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jvr.march.medium import DENSEST
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTransfer, Classified
from jvr.numerics import dot, mean_depth, smaller
from jvr.types import Channels, Scalar, Triple

# Quadrature nodes along the normal that the extinction is looked at, and their weights, as fractions of the way: closest to each other
# near the sample, since what an opaque medium keeps is decided there.
_STEPS = (np.arange(4) + 0.5) / 4
NODES, WEIGHTS = _STEPS**2.5, _STEPS**1.5 / np.sum(_STEPS**1.5)


class ShadedSegment(NamedTuple):
    """A segment whose light is asked for: the properties and the gradient at its middle, and its length."""

    classified: Classified
    gradient: Triple
    dt: Scalar


class SelfShadow(eqx.Module):
    """Self-shadowing of a scene's surfaces.

    `width`: how far in front of a sample the medium counts as near where there is nothing but a surface, as far as rays of nodes begin
    above it; `of_opacity`: gradients are those of the extinction; `bleeds`: the medium that is near shows its colour instead of a shadow,
    with an `albedo` (`jvr.effects.environment_lighting.EnvironmentLighting`) what that reflects of light from everywhere.
    """

    transfer: AbstractTransfer
    width: Scalar
    of_opacity: bool = eqx.field(static=True)
    bleeds: bool = eqx.field(static=True)
    albedo: Any = None

    def remaining(self, s: Scalar, magnitude: Scalar, normal: Triple, w_o: Triple, here: ShadedSegment, strength: Scalar) -> Any:
        """What band `l` keeps, `[l][channel]` for `l` up to 2, with one or three channels; `strength`: how much of a surface there is."""
        # Rays of nodes begin as much lower as there is less of a surface: what is above them is in what they carry.
        tau = self._depth(s, magnitude, normal, w_o, here, strength * self.width)
        e3, e4, e5 = (_exponential_integral(n, tau) for n in (3, 4, 5))
        shadows = [1 - f for f in (2 * e3, 3 * e4, 4 * (3 * e5 - e3))]
        if self.bleeds:
            colour = here.classified.rgb
            if self.albedo is not None:
                # The medium above is seen from below, along its normal.
                tinted, unmodulated = self.albedo.reflect(s, magnitude, normal, normal, ())
                colour = tuple(c * a + b for c, a, b in zip(colour, tinted, unmodulated, strict=True))
            return [tuple(1 - shadow * (1 - c) for c in colour) for shadow in shadows]
        return [(1 - shadow,) for shadow in shadows]

    def _depth(self, s: Scalar, magnitude: Scalar, normal: Triple, w_o: Triple, here: ShadedSegment, width: Scalar) -> Scalar:
        """Optical depth of the medium up to `width` in front of the place where the light of a segment is looked at."""
        sigma = _mean(here.classified.sigma_t)
        # As far in front of the middle as the light that arrives is looked up: `jvr.march.segments.light_at`.
        ahead = here.dt * (0.5 - mean_depth(jnp.minimum(sigma * here.dt, DENSEST)))
        begin, slope = ahead * dot(here.gradient, w_o), dot(here.gradient, normal)
        if self.of_opacity:
            return _ramp(jnp.maximum(sigma + begin, 0.0), slope, width)
        tau = jnp.zeros_like(s)
        for node, weight in zip(NODES.tolist(), WEIGHTS.tolist(), strict=True):
            found = self.transfer.evaluate(s + begin + slope * (width * node), magnitude)
            tau += width * weight * _mean(found.sigma_t)
        return tau


def self_shadow_of(scene: Scene, albedo: Any) -> SelfShadow | None:
    """The self-shadowing of surfaces, where light of nodes arrives at them; with the transfer function that the nodes know.
    `albedo`: where rays of the nodes pick up the material's colour, that under light of one from everywhere."""
    if scene.radiance_transfer is None or scene.material is None or not scene.material.needs_gradient:
        return None
    width = scene.radiance_transfer.lift(scene.volume)
    transfer = scene.radiance_transfer.transfer_function(scene)
    return SelfShadow(transfer, width, scene.normals.of_opacity, scene.radiance_transfer.bleeding is not None, albedo)


def _ramp(sigma: Scalar, slope: Scalar, width: Scalar) -> Scalar:
    """The integral of `max(sigma + slope u, 0)` over `u` from 0 to `width`."""
    falls = slope < 0
    end = jnp.where(falls, jnp.minimum(sigma / jnp.where(falls, -slope, 1.0), width), width)
    return end * (sigma + 0.5 * end * slope)


def _exponential_integral(n: int, x: Scalar) -> Scalar:
    """`E_n(x)`, `n` from 3 to 5, within 0.4 %: `1 / (exp(x) E_n(x)) - x` goes from `n - 1` at 0, where its slope is `1 / (n - 2)`, to
    `n - n / x` in the limit; a rational function has all of these exactly, and the constant that makes the rest the least."""
    # Beyond, nothing is left, and squares would overflow.
    x = smaller(x, 80.0)
    a = {3: 1.261, 4: 2.251, 5: 3.246}[n]
    return jnp.exp(-x) / (n - 1 + x + x * (x + a) / (x * (x + a + n) + a * (n - 2)))


def _mean(channels: Channels) -> Scalar:
    return sum(channels[1:], channels[0]) / len(channels)
