"""Phase functions: how the light that a point scatters is distributed over directions, as value, sample and pdf.

All are densities per solid angle that integrate to 1 over the sphere, so isotropic scattering is `1 / (4 pi)`. `theta` lies
between the way the light travels and the direction to the eye, `cos theta = -w_o . w_i` with both pointing away from the point:
a positive asymmetry scatters forward, at `cos theta = 1`. A parameter is one number, or three where it differs between the colour
channels; values have as many components.
"""

import abc
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.checks import require
from jvr.model.parameters import GREY_OR_RGB, AbstractByScalar, assign, parameter
from jvr.model.ranges import ASYMMETRY, NOT_NEGATIVE, UNIT_INTERVAL
from jvr.numerics import divide_or_zero, dot, perpendicular
from jvr.types import ArrayLike, Channels, Scalar, Triple

Numbers: TypeAlias = Float[Array, "..."]
_UNIFORM = 0.25 / math.pi


def asymmetry(doc: str = "-1 backward, 0 even, 1 forward") -> Any:
    """The declaration of an asymmetry."""
    return parameter(ASYMMETRY, shapes=GREY_OR_RGB, by_scalar=True, doc=doc)


class ScatteringAngle(NamedTuple):
    """The angle theta between light before and after it is scattered, arrays of one shape.

    `cos theta` in float32 cannot tell angles below 0.02 degrees apart, and a lobe of `g = 0.9999` is narrower. So the gaps
    `1 - cos theta` and `1 + cos theta` are kept with their own digits.
    """

    cos: Numbers
    one_minus: Numbers
    one_plus: Numbers

    @classmethod
    def between(cls, w_o: Triple, w_i: Triple) -> "ScatteringAngle":
        """From the unit directions to the eye and to the light, both pointing away from the point:
        `1 -+ cos theta = |w_o +- w_i|^2 / 2`, which does not cancel."""
        sums = tuple(o + i for o, i in zip(w_o, w_i, strict=True))
        differences = tuple(o - i for o, i in zip(w_o, w_i, strict=True))
        return cls.of_gaps(0.5 * dot(sums, sums), 0.5 * dot(differences, differences))

    @classmethod
    def of_cosine(cls, cos: Numbers) -> "ScatteringAngle":
        """From `cos theta`, with the digits that it has."""
        return cls(cos, 1.0 - cos, 1.0 + cos)

    @classmethod
    def of_gaps(cls, one_minus: Numbers, one_plus: Numbers) -> "ScatteringAngle":
        """From `1 - cos theta` and `1 + cos theta`, whose sum is 2."""
        return cls(0.5 * (one_plus - one_minus), one_minus, one_plus)


class AbstractPhase(eqx.Module):
    """A phase function: the distribution of scattered light over the sphere."""

    @abc.abstractmethod
    def evaluate(self, angle: ScatteringAngle) -> Channels:
        """Value per solid angle, one component or three; elementwise, differentiable in the angle and in every parameter."""

    @abc.abstractmethod
    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        """For each component an angle that is distributed as this component, from `u` uniform in [0, 1); elementwise."""

    @property
    @abc.abstractmethod
    def mean_cosine(self) -> Channels:
        """The mean of `cos theta`, one component or three."""

    def sample(self, u: Numbers) -> ScatteringAngle:
        """An angle for each `u`, uniform in [0, 1); the azimuth about the light is uniform. Its density is `pdf`.

        Detached: differentiate the average of `f evaluate / pdf` in `f` and in `evaluate`, with the pdf held fixed.
        """
        # The choice of a lobe has no derivative: a sample that moved within its lobe alone would give a wrong one.
        fixed, u = jax.lax.stop_gradient((self, u))
        n = len(fixed.mean_cosine)
        return choose(u, *((jnp.full((), 1.0 / n), lambda v, c=c: fixed.draw(v)[c]) for c in range(n)))

    def pdf(self, angle: ScatteringAngle) -> Numbers:
        """Density per solid angle of `sample`: the value, or its mean over the three components."""
        values = self.evaluate(angle)
        return sum(values[1:], values[0]) / len(values)

    def sample_direction(self, travel: Triple, u1: Numbers, u2: Numbers) -> tuple[Triple, ScatteringAngle]:
        """The unit direction into which light is scattered that travels along the unit direction `travel`, and its angle.

        Detached, as `sample`. `u1`, `u2`: independent and uniform in [0, 1), for the angle and for the azimuth.
        """
        angle, azimuth = self.sample(u1), 2.0 * math.pi * jax.lax.stop_gradient(u2)
        travel = jax.lax.stop_gradient(travel)
        sine = jnp.sqrt(angle.one_minus * angle.one_plus)
        local = (sine * jnp.cos(azimuth), sine * jnp.sin(azimuth), angle.cos)
        # The rows of the frame about `travel`: component by component of the direction.
        rows = zip(*perpendicular(travel), travel, strict=True)
        return tuple(dot(local, row) for row in rows), angle


class Isotropic(AbstractPhase):
    """The isotropic phase function: `p = 1 / (4 pi)`."""

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        return (jnp.full_like(angle.cos, _UNIFORM),)

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        return (ScatteringAngle(2.0 * u - 1.0, 2.0 * (1.0 - u), 2.0 * u),)

    @property
    def mean_cosine(self) -> Channels:
        return (jnp.zeros(()),)


class Rayleigh(AbstractPhase):
    """Rayleigh's phase function, of particles much smaller than the wavelength: `p = 3 / (16 pi) (1 + cos^2 theta)`, for unpolarised
    light."""

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        return (0.75 * _UNIFORM * (1.0 + angle.cos * angle.cos),)

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        # The one real root of cos^3 + 3 cos = 8 u - 4.
        return (ScatteringAngle.of_cosine(jnp.clip(2.0 * jnp.sinh(jnp.arcsinh(4.0 * u - 2.0) / 3.0), -1.0, 1.0)),)

    @property
    def mean_cosine(self) -> Channels:
        return (jnp.zeros(()),)


def henyey_greenstein(g: Numbers, angle: ScatteringAngle) -> Numbers:
    """`p = (1 - g^2) / (4 pi (1 + g^2 - 2 g cos theta)^(3/2))` (Henyey and Greenstein 1941), elementwise in both.

    The denominator is formed as `(1 - g)^2 + 2 g (1 - cos theta)`, or as its mirror image where `g < 0`: the textbook form has
    no digit left at `g = 0.9999`. A `g` of magnitude 1 or more counts as the largest number below 1, with derivative 0.
    """
    a, near = magnitude(g)
    inverse = jax.lax.rsqrt(near * near + 2.0 * a * gap_to_axis(g, angle))
    # At most 1 is multiplied first: the cube of `inverse` may overflow before `near` makes up for it.
    return _UNIFORM * (1.0 + a) * (near * inverse) * (inverse * inverse)


def sample_henyey_greenstein(g: Numbers, u: Numbers) -> ScatteringAngle:
    """The inverse of the distribution function of `henyey_greenstein`, elementwise, with no limit to take at `g = 0`."""
    (a, near), v = magnitude(g), lobe_coordinate(g, u)
    return from_axis(g, v * (near + 0.5 * a * v))


class HenyeyGreenstein(AbstractPhase):
    """The Henyey-Greenstein phase function of asymmetry `g`, see `henyey_greenstein`; forward for `g > 0`, isotropic for `g = 0`.

    **Arguments:** `g`: `()`, `(3,)`, `jvr.ByValue` or `jvr.ByGradient`, between -1 and 1 without either; differentiable. **Raises**
    `ValueError` otherwise.
    """

    g: Any = asymmetry("mean cosine: -1 backward, 0 even, 1 forward")

    def __init__(self, g: ArrayLike | AbstractByScalar):
        assign(self, g=g)

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        return tuple(henyey_greenstein(g, angle) for (g,) in components(self.g))

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        return tuple(sample_henyey_greenstein(g, u) for (g,) in components(self.g))

    @property
    def mean_cosine(self) -> Channels:
        return tuple(g for (g,) in components(self.g))


class DoubleHenyeyGreenstein(AbstractPhase):
    """Two Henyey-Greenstein lobes, usually one forward and one backward: `weight HG(g1) + (1 - weight) HG(g2)`.

    **Arguments:** `g1`, `g2` as for `HenyeyGreenstein`; `weight` of the first lobe, in [0, 1]; each `()` or `(3,)`, differentiable.
    **Raises** `ValueError` otherwise.
    """

    g1: Any = asymmetry()
    g2: Any = asymmetry()
    weight: Numbers = parameter(UNIT_INTERVAL, shapes=GREY_OR_RGB, doc="share of the first lobe")

    def __init__(self, g1: ArrayLike | AbstractByScalar, g2: ArrayLike | AbstractByScalar, weight: ArrayLike):
        assign(self, g1=g1, g2=g2, weight=weight)

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        return tuple(
            w * henyey_greenstein(g1, angle) + (1.0 - w) * henyey_greenstein(g2, angle)
            for g1, g2, w in components(self.g1, self.g2, self.weight)
        )

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        return tuple(
            choose(
                u,
                (w, lambda v, g=g1: sample_henyey_greenstein(g, v)),
                (1.0 - w, lambda v, g=g2: sample_henyey_greenstein(g, v)),
            )
            for g1, g2, w in components(self.g1, self.g2, self.weight)
        )

    @property
    def mean_cosine(self) -> Channels:
        return tuple(w * g1 + (1.0 - w) * g2 for g1, g2, w in components(self.g1, self.g2, self.weight))


class Schlick(AbstractPhase):
    """Schlick's phase function, `p = (1 - k^2) / (4 pi (1 - k cos theta)^2)` (Blasi, Le Saec and Schlick 1993), which needs no square root.

    It resembles Henyey-Greenstein for `k = 1.55 g - 0.55 g^3` (Pharr and Humphreys 2004).
    **Arguments:** `k`: `()`, `(3,)`, `jvr.ByValue` or `jvr.ByGradient`, between -1 and 1 without either, forward for `k > 0`;
    differentiable.
    **Raises** `ValueError` otherwise.
    """

    k: Any = asymmetry()

    def __init__(self, k: ArrayLike | AbstractByScalar):
        assign(self, k=k)

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        return tuple(_schlick(k, angle) for (k,) in components(self.k))

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        return tuple(from_axis(k, lobe_coordinate(k, u)) for (k,) in components(self.k))

    @property
    def mean_cosine(self) -> Channels:
        return tuple(_schlick_mean(k) for (k,) in components(self.k))


class Mixture(AbstractPhase):
    """A weighted mean of phase functions, `sum_m w_m p_m / sum_m w_m`: several kinds of particle in one medium.

    **Arguments:** `phases`: at least one; `weights`: `(m,)`, or `(m, 3)` where they differ between the colour channels; not
    negative, their sum is positive; differentiable. **Raises** `ValueError` otherwise.
    """

    phases: tuple[AbstractPhase, ...] = parameter(shapes=(("m",),), doc="phase functions, at least one")
    weights: Numbers = parameter(NOT_NEGATIVE, shapes=(("m",), ("m", 3)), doc="weight of a phase function")

    def __init__(self, phases: Sequence[AbstractPhase], weights: ArrayLike):
        assign(self, phases=phases, weights=weights)
        require(
            jnp.sum(self.weights, axis=0), lambda total: total > 0, "weights must not all be zero: give one a positive weight"
        )

    def evaluate(self, angle: ScatteringAngle) -> Channels:
        return self._mean([phase.evaluate(angle) for phase in self.phases])

    def draw(self, u: Numbers) -> tuple[ScatteringAngle, ...]:
        fractions, counts = self._fractions(), [len(phase.mean_cosine) for phase in self.phases]
        return tuple(
            choose(
                u,
                *(
                    (fractions[c % len(fractions)][m], lambda v, p=phase, i=c % count: p.draw(v)[i])
                    for m, (phase, count) in enumerate(zip(self.phases, counts, strict=True))
                ),
            )
            for c in range(max(len(fractions), *counts))
        )

    @property
    def mean_cosine(self) -> Channels:
        return self._mean([phase.mean_cosine for phase in self.phases])

    def _fractions(self) -> Channels:
        fractions = self.weights / jnp.sum(self.weights, axis=0)
        return tuple(fractions.reshape(len(self.phases), -1).T)

    def _mean(self, parts: list[Channels]) -> Channels:
        fractions = self._fractions()
        return tuple(
            jnp.sum(jnp.stack([fractions[c % len(fractions)][m] * part[c % len(part)] for m, part in enumerate(parts)]), axis=0)
            for c in range(max(len(fractions), *map(len, parts)))
        )


def components(*parameters: Numbers) -> tuple[Channels, ...]:
    """For each component, one or three, its own value of every parameter."""
    n = max(parameter.size for parameter in parameters)
    return tuple(tuple(p if p.ndim == 0 else p[c] for p in parameters) for c in range(n))


def choose(u: Numbers, *lobes: tuple[Scalar, Callable[[Numbers], ScatteringAngle]]) -> ScatteringAngle:
    """Spends `u` on the choice between lobes, each `(fraction, draw)` with fractions that sum to 1, and what is left of it on `draw`."""
    if len(lobes) == 1:
        return lobes[0][1](u)
    chosen, below = ScatteringAngle(*(jnp.zeros_like(u),) * 3), jnp.zeros_like(u)
    for fraction, draw in lobes:
        rest = jnp.clip(divide_or_zero(u - below, jnp.broadcast_to(fraction, u.shape)), 0.0, 1.0)
        here = (u >= below) & (fraction > 0)
        chosen = ScatteringAngle(*(jnp.where(here, new, old) for new, old in zip(draw(rest), chosen, strict=True)))
        below = below + fraction
    return chosen


def magnitude(g: Numbers) -> tuple[Numbers, Numbers]:
    """`a = |g|` and `1 - a`. The derivative at 0 is that from above, not JAX's 0; see `henyey_greenstein` for `a >= 1`."""
    a = jnp.where(g < 0, -g, g)
    a = jnp.where(a < 1, a, 1.0 - jnp.finfo(a.dtype).epsneg)
    return a, 1.0 - a


def gap_to_axis(g: Numbers, angle: ScatteringAngle) -> Numbers:
    """`1 - cos` of the angle to the axis of a lobe, forward or, where `g < 0`, backward."""
    return jnp.where(g < 0, angle.one_plus, angle.one_minus)


def lobe_coordinate(g: Numbers, u: Numbers) -> Numbers:
    """Inverts `fraction = (1 + a) v / (2 (1 - a + a v))`, the fraction of light nearer to the axis than `v` of 0 ... 2.

    `u` runs from backward to forward, so that draws are continuous in `g`.
    """
    a, near = magnitude(g)
    # The fraction of light farther from the axis.
    far = jnp.where(g < 0, 1.0 - u, u)
    return 2.0 * near * (1.0 - far) / (near + 2.0 * a * far)


def from_axis(g: Numbers, gap: Numbers) -> ScatteringAngle:
    """The angle of which `gap_to_axis` is `gap`."""
    other = 2.0 - gap
    return ScatteringAngle.of_gaps(jnp.where(g < 0, other, gap), jnp.where(g < 0, gap, other))


def _schlick(k: Numbers, angle: ScatteringAngle) -> Numbers:
    a, near = magnitude(k)
    inverse = 1.0 / (near + a * gap_to_axis(k, angle))
    return _UNIFORM * (1.0 + a) * (near * inverse) * inverse


def _schlick_mean(k: Numbers) -> Numbers:
    # 1 / k - (1 - k^2) / (2 k^2) log((1 + k) / (1 - k)), which cancels for small k: there its series is summed.
    small = jnp.abs(k) < 0.25
    series = k * jnp.polyval(jnp.array([2.0 / (4 * n * n - 1) for n in range(14, 0, -1)], k.dtype), k * k)
    large = jnp.where(small, 0.5, k)
    return jnp.where(small, series, (1.0 - (1.0 - large) * (1.0 + large) * jnp.arctanh(large) / large) / large)
