"""Which samples a picture is made of: the choices that `Settings(sampling=...)` takes."""

import abc
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Bool, Int

from jvr.march.oracle import AbstractOracle, LocalError
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.ranges import NOT_NEGATIVE, Interval

if TYPE_CHECKING:
    # What renders knows the settings, which know this.
    from jvr.rendering.image import Rendering

TILES = (2, 4, 8, 16, 32, 64)


class AbstractSampling(AbstractPart):
    """A choice of samples. Static, without arrays."""

    # Whether samples that could be seen are left out.
    leaves_out: ClassVar[bool] = True

    @property
    @abc.abstractmethod
    def explanation(self) -> str:
        """What it does, for `jvr.plan`."""

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry("adaptive sampling", self.leaves_out, self.explanation),)

    @abc.abstractmethod
    def render(self, scene: Any, camera: Any, settings: Any) -> "Rendering":
        """The picture. **Raises** `ValueError` for scenes and settings that this choice does not support."""


class Uniform(AbstractSampling):
    """Uniform sampling: every pixel's ray, and every sample of a ray that can be seen. The default."""

    leaves_out: ClassVar[bool] = False

    @property
    def explanation(self) -> str:
        return "every ray, evenly spaced samples"

    def render(self, scene: Any, camera: Any, settings: Any) -> "Rendering":
        from jvr.rendering.image import render_uniform

        return render_uniform(scene, camera, settings)


class Slices(AbstractSampling):
    """Adaptive sampling on slices across the view, far apart where an oracle allows it, along the view and across it; between them the
    scalar is interpolated, by B-splines across the view and by pre-integration along it (`jvr.rendering.adaptive`).

    **Arguments:** `oracle`: says how far apart samples may be, within its tolerance: `jvr.LocalError()` (default),
    `jvr.OpacityChange()`, `jvr.BrickRange()`, or `jvr.Finest()`, which allows nothing. `levels`: samples are at most `2^levels` slices
    and pixels apart, 0 ... 5; 0 leaves none out. **Raises** `ValueError` for levels out of range.
    """

    oracle: AbstractOracle = parameter(doc="jvr.LocalError(), jvr.OpacityChange(), jvr.BrickRange() or jvr.Finest()")
    levels: int = choice(Interval(0.0, 5.0), doc="samples are up to 2^levels slices and pixels apart")

    def __init__(self, oracle: AbstractOracle = LocalError(), *, levels: int = 3):
        assign(self, oracle=oracle, levels=levels)

    @property
    def explanation(self) -> str:
        return f"slices, samples up to {2**self.levels} slices and pixels apart where {type(self.oracle).__name__} allows it"

    def render(self, scene: Any, camera: Any, settings: Any) -> "Rendering":
        from jvr.rendering.adaptive import render_slices

        return render_slices(scene, camera, settings, self)


class Refinement(AbstractSampling):
    """Progressive refinement, rays far apart where the picture is smooth: first every `tile`-th and `tile / 2`-th pixel, in rows and in
    columns, then those between where interpolation was wrong by more than `tolerance` (`jvr.rendering.refinement`).

    **Arguments:** `tolerance`: in radiance and opacity, 0 (every ray) or more. It bounds what interpolation was wrong by on the grid
    before, so the picture's root mean square error stays well below it; single pixels at an edge may be farther off. `tile`: a
    power of two, 2 ... 64; features smaller than half of it are missed where none of its rays meets them. **Raises** `ValueError` for
    values out of range.
    """

    tolerance: float = choice(NOT_NEGATIVE, doc="radiance and opacity, 0 for every ray", hint="0.005 is a good start")
    tile: int = choice(Interval(2.0, 64.0), doc="pixels from one ray of the coarsest grid to the next", hint="8 is a good start")

    def __init__(self, tolerance: float | int = 0.005, *, tile: int = 8):
        assign(self, tolerance=tolerance, tile=tile)
        if tile not in TILES:
            raise ValueError(f"tile must be a power of two from 2 to 64 pixels, not {tile!r}; 8 is a good start")

    @property
    def explanation(self) -> str:
        return f"every {self.tile // 2}th ray, those between where interpolation is wrong by more than {self.tolerance:g}"

    def render(self, scene: Any, camera: Any, settings: Any) -> "Rendering":
        from jvr.rendering.refinement import render_refined

        return render_refined(scene, camera, settings, self)


class SliceStats(eqx.Module):
    """What `Slices` sampled.

    - `samples`: samples of the volume taken on each level of the pyramid, the finest first, `(levels + 1,)`.
    - `full`: slices between entry and end of each pixel, all pixels together: the samples if none is left out. The finest level
      may take one more a pixel, behind its exit.
    """

    samples: Int[Array, "levels"]
    full: Int[Array, ""]


class RefinementStats(eqx.Module):
    """What `Refinement` traced: `traced`, the pixels, and `rays`, their number and that of the rays around the picture that its border
    is interpolated from."""

    traced: Bool[Array, "height width"]
    rays: Int[Array, ""]
