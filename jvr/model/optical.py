"""Optical models: what one segment of a ray with constant properties adds (Max 1995; course notes on GPU-based volume
ray-casting, Eurographics 2009, section 1.2.1)."""

import abc
from typing import Any, ClassVar

from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.transfer import Classified
from jvr.names import Renamed
from jvr.numerics import one_minus_exp
from jvr.types import Channels, Scalar


class AbstractOpticalModel(AbstractPart):
    """An optical model: how emission and extinction along a segment of length `dt` become radiance and optical depth."""

    # Whether anything is held back, so that a ray may end early.
    absorbs: ClassVar[bool] = True

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
    the quotient's derivative cancel and would leave no digit of `exp(-dtau)`.
    """

    def evaluate_segment(self, classified: Classified, dt: Scalar) -> tuple[Channels, Channels]:
        dtau = tuple(sigma * dt for sigma in classified.sigma_t)
        opacity = tuple(one_minus_exp(d) for d in dtau)
        return tuple(c * a for c, a in zip(classified.rgb, opacity * (3 // len(opacity)), strict=True)), dtau


class EmissionOnly(AbstractOpticalModel):
    """A glowing, transparent medium: `j = sigma_t * rgb`, `T = 1`."""

    absorbs: ClassVar[bool] = False

    def evaluate_segment(self, classified: Classified, dt: Scalar) -> tuple[Channels, Channels]:
        sigma_t = classified.sigma_t * (3 // len(classified.sigma_t))
        return tuple(c * sigma * dt for c, sigma in zip(classified.rgb, sigma_t, strict=True)), ()


class AbsorptionOnly(AbstractOpticalModel):
    """A cold medium that only attenuates what is behind it: `j = 0`."""

    def evaluate_segment(self, classified: Classified, dt: Scalar) -> tuple[Channels, Channels]:
        return (), tuple(sigma * dt for sigma in classified.sigma_t)
