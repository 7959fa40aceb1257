"""Pixel filters: how much each of several rays counts for a pixel, by its distance from the pixel's middle.

A pixel is `sum w(x) w(y) L / sum w(x) w(y)` over the rays whose distances `x` and `y`, in pixels, are within the filter's radius, those of
its neighbours among them: the midpoint rule for the convolution of the picture with the filter (Mitchell and Netravali, "Reconstruction
filters in computer graphics", 1988; Pharr, Jakob and Humphreys, "Physically Based Rendering", 8.8). `Settings(pixel_filter=...)`.
"""

import abc
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jvr.model.parameters import assign, choice
from jvr.model.parts import AbstractPart, PlanEntry, spelling
from jvr.model.ranges import Interval

# A pixel's own rays are within it, and no picture wants more of its neighbours than this.
RADIUS = Interval(0.5, 8.0)
# A narrower one has no weight but for the ray that is nearest.
SIGMA = Interval(0.05, 8.0)


def filter_radius() -> Any:
    """The declaration of a radius."""
    return choice(
        RADIUS, doc="distance from a pixel's middle, along rows and along columns, at which a ray counts no more", unit="pixels"
    )


class AbstractPixelFilter(AbstractPart):
    """A pixel filter, the same along rows and columns. Static, without arrays."""

    radius: eqx.AbstractVar[float]

    @abc.abstractmethod
    def weight(self, x: Float[np.ndarray, "rays"]) -> Float[np.ndarray, "rays"]:
        """What rays count that are `x` pixels away from the middle, `|x| <= radius`, in proportion to each other."""

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry(name, True, spelling(self)),) if settings.pixel_samples > 1 else ()


class BoxFilter(AbstractPixelFilter):
    """All rays within the radius count alike: `w = 1`. With half a pixel, the default, a pixel is the mean over its own area, and shares
    no ray with others. **Raises** `ValueError` for a radius out of range."""

    radius: float = filter_radius()

    def __init__(self, radius: float | int = 0.5):
        assign(self, radius=radius)

    def weight(self, x: Float[np.ndarray, "rays"]) -> Float[np.ndarray, "rays"]:
        # A ray on the edge is half inside, on either side.
        return np.where(np.abs(x) < self.radius, 1.0, 0.5)


class TentFilter(AbstractPixelFilter):
    """`w = 1 - |x| / radius`: with a pixel, the default, the linear interpolation of pixels in reverse, so that what moves across the
    picture keeps its brightness. **Raises** `ValueError` for a radius out of range."""

    radius: float = filter_radius()

    def __init__(self, radius: float | int = 1.0):
        assign(self, radius=radius)

    def weight(self, x: Float[np.ndarray, "rays"]) -> Float[np.ndarray, "rays"]:
        return 1 - np.abs(x) / self.radius


class GaussianFilter(AbstractPixelFilter):
    """`w = exp(-x^2 / (2 sigma^2)) - exp(-radius^2 / (2 sigma^2))`: smooth, and without rings next to edges. **Raises** `ValueError` for
    numbers out of range."""

    radius: float = filter_radius()
    sigma: float = choice(SIGMA, doc="standard deviation", unit="pixels")

    def __init__(self, radius: float | int = 1.5, *, sigma: float | int = 0.5):
        assign(self, radius=radius, sigma=sigma)

    def weight(self, x: Float[np.ndarray, "rays"]) -> Float[np.ndarray, "rays"]:
        # As a product: for a wide filter both exponentials are nearly 1.
        return np.exp(-(x**2) / (2 * self.sigma**2)) * -np.expm1((x**2 - self.radius**2) / (2 * self.sigma**2))


class MitchellFilter(AbstractPixelFilter):
    """The cubic of Mitchell and Netravali with `B = C = 1/3`, sharper than those without negative weights. With `u = 2 |x| / radius`,

        w = (7 u^3 - 12 u^2 + 16/3) / 6                     for u < 1,
        w = (-7/3 u^3 + 12 u^2 - 20 u + 32/3) / 6           for u < 2.

    Next to an edge radiance goes beyond that of both sides, by 2 % of the step, also below 0; opacity is cut to 0 ... 1, and the mean
    of depths leaves negative weights out. **Raises** `ValueError` for a radius out of range.
    """

    radius: float = filter_radius()

    def __init__(self, radius: float | int = 2.0):
        assign(self, radius=radius)

    def weight(self, x: Float[np.ndarray, "rays"]) -> Float[np.ndarray, "rays"]:
        u = 2 * np.abs(x) / self.radius
        inner, outer = 7 * u**3 - 12 * u**2 + 16 / 3, -7 / 3 * u**3 + 12 * u**2 - 20 * u + 32 / 3
        return np.where(u < 1, inner, outer) / 6
