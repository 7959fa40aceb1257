"""Phase functions of particles about as large as the wavelength or larger: Draine's, a fit to Mie theory, tables."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.model.checks import require
from jvr.model.parameters import GREY_OR_RGB, AbstractByScalar, assign, parameter
from jvr.model.phase import (
    AbstractPhase,
    Numbers,
    ScatteringAngle,
    asymmetry,
    choose,
    components,
    from_axis,
    henyey_greenstein,
    magnitude,
    sample_henyey_greenstein,
)
from jvr.model.ranges import INCREASING, NOT_NEGATIVE, Interval
from jvr.numerics import divide_or_zero, rounded_into
from jvr.types import ArrayLike, Channels, Scalar

# Of droplets, in micrometres: what their fit was made for.
DIAMETER = Interval(5.0, 50.0)


class Draine(AbstractPhase):
    """Draine's phase function, `p = HG(g) (1 + alpha cos^2 theta) / (1 + alpha (1 + 2 g^2) / 3)` (Draine 2003, ApJ 598, 1017).

    `alpha = 0` is Henyey-Greenstein; `g = 0`, `alpha = 1` is Rayleigh; `alpha = 1` is Cornette and Shanks 1992. The mean cosine is
    not `g`.
    **Arguments:** `g` between -1 and 1 without either, `alpha >= 0`; each `()` or `(3,)`, differentiable.
    **Raises** `ValueError` otherwise.
    """

    g: Any = asymmetry()
    alpha: Numbers = parameter(NOT_NEGATIVE, shapes=GREY_OR_RGB, doc="0 for Henyey-Greenstein")

    def __init__(self, g: ArrayLike | AbstractByScalar, alpha: ArrayLike):
        assign(self, g=g, alpha=alpha)

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        return tuple(_draine(g, alpha, angle) for g, alpha in components(self.g, self.alpha))

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        return tuple(_draw_draine(g, alpha, u) for g, alpha in components(self.g, self.alpha))

    @property
    def mean_cosine(self) -> Channels:
        return tuple(_draine_mean(g, alpha) for g, alpha in components(self.g, self.alpha))


class JendersieEon(AbstractPhase):
    """Fog and clouds: a fit to Mie theory for water droplets, `(1 - w) HG(g_HG) + w Draine(g_D, alpha)` (Jendersie and d'Eon
    2023, An Approximate Mie Scattering Function for Fog and Cloud Rendering, SIGGRAPH Talks).

    **Arguments:** `diameter` of the droplets in micrometres, `()` or `(3,)`, in [5, 50]; differentiable.
    **Raises** `ValueError` otherwise.
    """

    diameter: Numbers = parameter(DIAMETER, shapes=GREY_OR_RGB, doc="of the droplets", unit="micrometres")

    def __init__(self, diameter: ArrayLike):
        assign(self, diameter=diameter)

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        lobes = (_droplet_lobes(d) for (d,) in components(self.diameter))
        return tuple((1.0 - w) * henyey_greenstein(g_hg, angle) + w * _draine(g_d, alpha, angle) for g_hg, g_d, alpha, w in lobes)

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        lobes = (_droplet_lobes(d) for (d,) in components(self.diameter))
        return tuple(
            choose(
                u,
                (1.0 - w, lambda v, g=g_hg: sample_henyey_greenstein(g, v)),
                (w, lambda v, g=g_d, alpha=alpha: _draw_draine(g, alpha, v)),
            )
            for g_hg, g_d, alpha, w in lobes
        )

    @property
    def mean_cosine(self) -> Channels:
        lobes = (_droplet_lobes(d) for (d,) in components(self.diameter))
        return tuple((1.0 - w) * g_hg + w * _draine_mean(g_d, alpha) for g_hg, g_d, alpha, w in lobes)


class TabulatedPhase(AbstractPhase):
    """A tabulated phase function: values at some angles, linear in `cos theta` between them and scaled to integrate to 1.

    **Arguments:** `angles`: `(n,)` in radians, strictly increasing from 0 (forward) to pi; `values`: `(n,)` or `(n, 3)`, not negative,
    in any unit. Differentiable in the values. **Raises** `ValueError` otherwise, and where all values are zero.
    """

    angles: Float[Array, "n"] = parameter(INCREASING, least=2, doc="from 0 (forward) to pi (backward)", unit="radians")
    values: Numbers = parameter(NOT_NEGATIVE, shapes=(("n",), ("n", 3)), doc="in any unit")

    def __init__(self, angles: ArrayLike, values: ArrayLike):
        assign(self, angles=angles, values=values)
        require(
            self.angles,
            lambda a: (abs(a[0]) < 1e-6) & (abs(a[-1] - math.pi) < 1e-5),
            "angles must run from 0 to pi: convert degrees with numpy.deg2rad, repeat the nearest value where an end is missing",
        )
        require(jnp.max(self.values, axis=0), lambda v: v > 0, "values must not all be zero")

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        one_minus, one_plus, widths = self._nodes()
        # Looked up by the angle, not its cosine, of which neighbouring entries may share all digits. Only the index comes from it.
        half = jnp.arctan2(*(jnp.sqrt(jax.lax.stop_gradient(gap)) for gap in (angle.one_minus, angle.one_plus)))
        i = jnp.searchsorted(jax.lax.stop_gradient(self.angles), 2.0 * half, side="right", method="scan_unrolled") - 1
        i = jnp.clip(i, 0, self.angles.shape[0] - 2)
        offset = jnp.where(angle.cos >= 0, angle.one_minus - one_minus[i], one_plus[i] - angle.one_plus)
        fraction = offset / widths[i]
        # Clamped for the rounding of the look-up alone: the derivative at an entry stays that of an interval.
        fraction = rounded_into(fraction, 0.0, 1.0)
        return tuple(
            (values[i] + fraction * (values[i + 1] - values[i])) / (2.0 * math.pi * jnp.sum(masses))
            for values, masses in self._columns(widths)
        )

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        one_minus, one_plus, widths = self._nodes()
        return tuple(_draw_linear(values, masses, one_minus, one_plus, widths, u) for values, masses in self._columns(widths))

    @property
    def mean_cosine(self) -> Channels:
        _, _, widths = self._nodes()
        c = jnp.cos(self.angles)
        return tuple(
            jnp.sum(widths * (values[:-1] * (2 * c[:-1] + c[1:]) + values[1:] * (c[:-1] + 2 * c[1:]))) / (6.0 * jnp.sum(masses))
            for values, masses in self._columns(widths)
        )

    def _nodes(self) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, "m"]]:
        """`1 - cos` and `1 + cos` of the angles, and by how much `cos` falls from each to the next, none of them by a difference."""
        # The angles themselves are halved, never their sums: near pi those would round away the digits of `1 + cos`.
        sine, cosine = jnp.sin(0.5 * self.angles), jnp.cos(0.5 * self.angles)
        middle = sine[1:] * cosine[:-1] + cosine[1:] * sine[:-1]
        return 2.0 * sine * sine, 2.0 * cosine * cosine, 2.0 * middle * jnp.sin(0.5 * jnp.diff(self.angles))

    def _columns(self, widths: Float[Array, "m"]) -> list[tuple[Float[Array, "n"], Float[Array, "m"]]]:
        """For each component its values and the integral over each interval of the cosine."""
        columns = self.values.reshape(self.angles.shape[0], -1).T
        return [(values, 0.5 * widths * (values[1:] + values[:-1])) for values in columns]


def _draine(g: Numbers, alpha: Numbers, angle: ScatteringAngle) -> Numbers:
    norm = 1.0 + alpha * (1.0 + 2.0 * g * g) / 3.0
    return henyey_greenstein(g, angle) * (1.0 + alpha * angle.cos * angle.cos) / norm


def _draine_mean(g: Numbers, alpha: Numbers) -> Numbers:
    return g * (15.0 + 3.0 * alpha * (3.0 + 2.0 * g * g)) / (15.0 + 5.0 * alpha * (1.0 + 2.0 * g * g))


def _draw_draine(g: Scalar, alpha: Scalar, u: Numbers) -> ScatteringAngle:
    """Inverts the distribution function by bisection.

    The unknown is Henyey-Greenstein's own fraction of light `h`: in it the function is smooth, its slope between `1 / norm` and
    `(1 + alpha) / norm` for every `g`, where `cos theta` would need ever more digits for a narrow lobe. The published closed
    form, the root of a quartic, divides by `g^3` and `alpha`.
    """
    a, near = magnitude(g)
    wanted = jnp.where(g < 0, u, 1.0 - u)
    norm = 1.0 + alpha * (1.0 + 2.0 * a * a) / 3.0

    def gap(h: Numbers) -> tuple[Numbers, Numbers]:
        v = 2.0 * near * h / (near + 2.0 * a * (1.0 - h))
        return v, v * (near + 0.5 * a * v)

    def fraction(h: Numbers) -> Numbers:
        # Integration by parts: the integral of cos^2 dh is cos^2 h plus that of 2 h cos d(1 - cos), a polynomial in v.
        v, away = gap(h)
        rest = (1.0 + a) * v * v * (0.5 - near * v / 3.0 - 0.125 * a * v * v)
        return (h * (1.0 + alpha * (1.0 - away) ** 2) + alpha * rest) / norm

    def halve(_: Int[Array, ""], bracket: tuple[Numbers, Numbers]) -> tuple[Numbers, Numbers]:
        low, high = bracket
        middle = 0.5 * (low + high)
        above = fraction(middle) > wanted
        return jnp.where(above, low, middle), jnp.where(above, middle, high)

    digits = jnp.finfo(u.dtype).nmant + 2
    low, high = jax.lax.fori_loop(0, digits, halve, (jnp.zeros_like(u), jnp.ones_like(u)))
    return from_axis(g, gap(0.5 * (low + high))[1])


def _droplet_lobes(d: Scalar) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """`g_HG`, `g_D`, `alpha` and the weight of Draine's lobe for droplets of diameter `d` in micrometres."""
    g_hg = jnp.exp(-0.0990567 / (d - 1.67154))
    g_d = jnp.exp(-2.20679 / (d + 3.91029) - 0.428934)
    alpha = jnp.exp(3.62489 - 8.29288 / (d + 5.52825))
    return g_hg, g_d, alpha, jnp.exp(-0.599085 / (d - 0.641583) - 0.665888)


def _draw_linear(
    values: Float[Array, "n"],
    masses: Float[Array, "m"],
    one_minus: Float[Array, "n"],
    one_plus: Float[Array, "n"],
    widths: Float[Array, "m"],
    u: Numbers,
) -> ScatteringAngle:
    """Inverts the distribution function of a density that is linear in each interval of the cosine."""
    below = jnp.concatenate([jnp.zeros(1, masses.dtype), jnp.cumsum(masses)])
    wanted = (1.0 - u) * below[-1]
    # From the left: an interval without light is passed over.
    i = jnp.clip(jnp.searchsorted(below, wanted, side="left") - 1, 0, masses.shape[0] - 1)
    fraction = jnp.clip(divide_or_zero(wanted - below[i], masses[i]), 0.0, 1.0)
    low, high = values[i], values[i + 1]
    # The root of low x + (high - low) x^2 / 2 = fraction (low + high) / 2 in the form that does not cancel.
    root = jnp.sqrt(jnp.maximum(low * low + fraction * (high * high - low * low), 0.0))
    x = jnp.clip(divide_or_zero(fraction * (low + high), low + root), 0.0, 1.0)
    return ScatteringAngle.of_gaps(one_minus[i] + x * widths[i], one_plus[i + 1] + (1.0 - x) * widths[i])
