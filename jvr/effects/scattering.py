"""Single scattering: light that the medium scatters once on its way to the eye (course notes on GPU-based volume ray-casting,
Eurographics 2009, chapters 7.1 to 7.4)."""

from collections.abc import Iterator
from typing import Any

from jvr.effects.shading import surface_weight
from jvr.model.effects import AbstractScattering
from jvr.model.parameters import GREY_OR_RGB, AbstractByScalar, assign, parameter
from jvr.model.parts import is_zero
from jvr.model.phase import AbstractPhase, Isotropic, ScatteringAngle
from jvr.model.ranges import POSITIVE, UNIT_INTERVAL
from jvr.types import ArrayLike, Channels, Scalar, Triple


class SingleScattering(AbstractScattering):
    """Scattered emission `j = sigma_t albedo p(cos theta) E T_light`, added to the medium's own.

    **Arguments:**

    - `phase`: a phase function, such as `jvr.HenyeyGreenstein(g)`; a `jvr.ByValue` as its `g` makes it depend on the scalar, a
      `jvr.ByGradient` on the length of its gradient.
    - `albedo`: fraction of extinguished light that is scattered, 0 ... 1; a number, `(3,)`, `jvr.ByValue` or `jvr.ByGradient`.
    - `threshold`: with one, light is scattered where the gradient is weak and reflected (`Scene(shading=...)`) where it is strong (notes,
      section 7.4.4): with a gradient of length `m` the fraction `threshold^2 / (m^2 + threshold^2)` scatters, and what remains
      reflects. `None`: everything scatters, surface or not.

    With lights of unknown intensity, only the product of albedo and intensity can be seen in a picture. Differentiable in all numbers.
    """

    phase: AbstractPhase = parameter(doc="a phase function such as jvr.HenyeyGreenstein(0.5)")
    albedo: Any = parameter(UNIT_INTERVAL, shapes=GREY_OR_RGB, by_scalar=True, doc="share of the extinguished light")
    threshold: Scalar | None = parameter(POSITIVE, doc="length of a gradient", unit="data units per mm")

    def __init__(
        self,
        phase: AbstractPhase = Isotropic(),
        albedo: ArrayLike | AbstractByScalar = 1.0,
        *,
        threshold: ArrayLike | None = None,
    ):
        assign(self, phase=phase, albedo=albedo, threshold=threshold)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        if is_zero(self.albedo):
            yield "scattering.albedo is zero everywhere: nothing is scattered"

    @property
    def needs_gradient(self) -> bool:
        return self.threshold is not None

    def medium_weight(self, magnitude: Scalar) -> Scalar:
        assert self.threshold is not None
        return 1 - surface_weight(magnitude, self.threshold)

    def scatter(self, w_o: Triple, w_i: Triple) -> Channels:
        phase = self.phase.evaluate(ScatteringAngle.between(w_o, w_i))
        return _times(phase, self._albedo())

    def scatter_ambient(self) -> Channels:
        # The integral of a phase function over the sphere is 1.
        return self._albedo()

    def _albedo(self) -> Channels:
        return (self.albedo,) if self.albedo.ndim == 0 else (self.albedo[0], self.albedo[1], self.albedo[2])


def _times(a: Channels, b: Channels) -> Channels:
    """Products of one or three channels each."""
    n = max(len(a), len(b))
    return tuple(x * y for x, y in zip(a * (n // len(a)), b * (n // len(b)), strict=True))
