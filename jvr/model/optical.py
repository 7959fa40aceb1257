"""Optical models: what one segment of a ray with constant properties adds (Max 1995; course notes on GPU-based volume
ray-casting, Eurographics 2009, section 1.2.1).

With the emission `q` that a transfer function may name beside extinction and colour, `dL/ds = -sigma_t L + sigma_t rgb + q` (equations 1.3
and 1.7 of the notes, in which emission and absorption are independent of each other).
"""

import abc
from typing import Any, ClassVar

from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.transfer import Classified
from jvr.names import Renamed
from jvr.numerics import attenuated, one_minus_exp
from jvr.types import Channels, Scalar


class AbstractOpticalModel(AbstractPart):
    """An optical model: how emission and extinction along a segment of length `dt` become radiance and optical depth."""

    # Whether anything is held back, so that a ray may end early.
    absorbs: ClassVar[bool] = True
    # Whether anything glows.
    emits: ClassVar[bool] = True

    segment = Renamed("evaluate_segment")

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry("optical model", True, type(self).__name__),)

    @abc.abstractmethod
    def evaluate_segment(self, classified: Classified, dt: Scalar) -> tuple[Channels, Channels]:
        """Radiance that leaves the segment (three components, or none where nothing is emitted) and its optical depth (one or
        three components, or none where nothing is absorbed)."""


class EmissionAbsorption(AbstractOpticalModel):
    """Emission and absorption, `j = sigma_t * rgb`: a segment emits `rgb (1 - exp(-dtau))`.

    That is `j dt phi1(dtau)` with `phi1(d) = (1 - exp(-d)) / d`, written without the quotient: for an opaque segment the terms of
    the quotient's derivative cancel and would leave no digit of `exp(-dtau)`. Emission `q` of its own, which does not vanish with the
    extinction, adds `q dt phi1(dtau)`.
    """

    def evaluate_segment(self, classified: Classified, dt: Scalar) -> tuple[Channels, Channels]:
        dtau = tuple(sigma * dt for sigma in classified.sigma_t)
        opacity = tuple(one_minus_exp(d) for d in dtau)
        emitted = tuple(c * a for c, a in zip(classified.rgb, opacity * (3 // len(opacity)), strict=True))
        return with_own(emitted, own_radiance(classified.emission, classified.sigma_t, dt)), dtau


class EmissionOnly(AbstractOpticalModel):
    """A glowing, transparent medium: `j = sigma_t * rgb + q`, `T = 1`."""

    absorbs: ClassVar[bool] = False

    def evaluate_segment(self, classified: Classified, dt: Scalar) -> tuple[Channels, Channels]:
        sigma_t = classified.sigma_t * (3 // len(classified.sigma_t))
        emitted = tuple(c * sigma * dt for c, sigma in zip(classified.rgb, sigma_t, strict=True))
        return with_own(emitted, own_radiance(classified.emission, (), dt)), ()


class AbsorptionOnly(AbstractOpticalModel):
    """A cold medium that only attenuates what is behind it: `j = 0`."""

    emits: ClassVar[bool] = False

    def evaluate_segment(self, classified: Classified, dt: Scalar) -> tuple[Channels, Channels]:
        return (), tuple(sigma * dt for sigma in classified.sigma_t)


def own_radiance(emission: Channels, sigma_t: Channels, dt: Scalar) -> Channels:
    """What leaves a segment of its own emission, `q dt phi1(sigma_t dt)`; `q dt` where there is no extinction."""
    if not sigma_t:
        return tuple(q * dt for q in emission)
    return tuple(attenuated(q, s, dt) for q, s in zip(emission, sigma_t * (len(emission) // len(sigma_t)), strict=True))


def with_own(emitted: Channels, own: Channels) -> Channels:
    """The sum of what is emitted with the extinction and without it, where there is any of the latter."""
    return tuple(e + q for e, q in zip(emitted, own, strict=True)) if own else emitted
