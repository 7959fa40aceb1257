"""How a scene is rendered: everything that changes time and accuracy, and nothing that changes the scene."""

from typing import Any

from jvr.march.differentiation import AbstractAdjoint, Replay
from jvr.march.quadrature import AbstractQuadrature, Midpoint, PreIntegrated
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import AbstractPart, Knob, PlanEntry
from jvr.model.ranges import AT_LEAST_ONE, POSITIVE, TRANSMITTANCE
from jvr.rendering.integrator import AbstractIntegrator
from jvr.rendering.marching import Uniform
from jvr.rendering.pixel_filters import AbstractPixelFilter, BoxFilter

# Values of its knobs, the coarsest first.
STEPS = (4.0, 2.0, 1.0, 0.5, 0.25)
TERMINATIONS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
NEGLIGIBLE = (1e-2, 0.0)
# Segments of a reference for each of the finest setting's.
FINER = 4


class Settings(AbstractPart):
    """Static choices of a rendering; hashable, without arrays, so `jax.jit(jvr.render)` works as it is.

    **Arguments:**

    - `step`: length of a segment in units of the smallest voxel spacing; the error falls with its square in smooth scenes.
    - `termination`: a ray ends once its transmittance is at most this, in every channel. What is behind could have added at most
      `termination` times the brightest radiance. 0 follows every ray to its end.
    - `quadrature`: how a segment is integrated: `jvr.Midpoint()` (default) or `jvr.PreIntegrated()`.
    - `skipping`: whether rays skip bricks of the volume that the transfer function leaves empty. The picture is the same to
      rounding; what gradients skip is what has none.
    - `negligible`: optical depth of what a ray may leave out on top of that, in pictures, gradients and fits: bricks whose extinction is so
      small that a whole ray through the volume would gather less. A pixel changes by at most this times the brightest radiance, and
      so does `sigma_t` times the derivative in `sigma_t`; every evaluation looks anew. An extinction of zero then has the derivative
      zero where a brick has nothing else. 0 leaves out nothing that has a derivative.
    - `adjoint`: how derivatives are computed: `jvr.Replay()` (both modes, default), `jvr.Forward()` or `jvr.Rows()`.
    - `sampling`: which samples are taken: `jvr.Uniform()` (default: all), `jvr.Refinement()` or `jvr.Slices()`.
    - `pixel_samples`: `n`, for `n x n` rays a pixel, on a regular grid, of which the pixel is the mean: edges without steps, at `n^2` times
      the time. Fits and geometry by pixels (`jvr.DepthImage`) want 1, a ray through the middle.
    - `pixel_filter`: the weights of that mean: `jvr.BoxFilter()` (default, the pixel's own rays alike), or, with rays of neighbours,
      `jvr.TentFilter()`, `jvr.GaussianFilter()` or `jvr.MitchellFilter()`. With one ray a pixel there is nothing to weigh.
    - `tile`: rays marched at a time. Memory is about 120 bytes a ray; smaller tiles need less and take longer.

    **Raises** `ValueError` for values out of range.
    """

    step: float = choice(POSITIVE, doc="length of a step", unit="voxels of the smallest spacing", hint="0.5 is a good start")
    termination: float = choice(TRANSMITTANCE, doc="transmittance at which a ray ends", hint="0 never ends one early")
    quadrature: AbstractQuadrature = parameter(doc="jvr.Midpoint() or jvr.PreIntegrated()")
    skipping: bool = choice(doc="whether empty bricks are skipped")
    negligible: float = choice(TRANSMITTANCE, doc="optical depth that a ray may leave out", hint="1e-3 changes no 8-bit picture")
    adjoint: AbstractAdjoint = parameter(doc="jvr.Replay(), jvr.Forward() or jvr.Rows()")
    sampling: AbstractIntegrator = parameter(doc="jvr.Uniform(), jvr.Refinement() or jvr.Slices()")
    tile: int = choice(AT_LEAST_ONE, doc="rays at a time")
    pixel_samples: int = choice(AT_LEAST_ONE, doc="rays a pixel along rows and along columns", most=64)
    pixel_filter: AbstractPixelFilter = parameter(
        doc="jvr.BoxFilter(), jvr.TentFilter(), jvr.GaussianFilter() or jvr.MitchellFilter()"
    )

    def __init__(
        self,
        step: float | int = 0.5,
        *,
        termination: float | int = 1e-4,
        quadrature: AbstractQuadrature = Midpoint(),
        skipping: bool = True,
        negligible: float | int = 0.0,
        adjoint: AbstractAdjoint = Replay(),
        sampling: AbstractIntegrator = Uniform(),
        tile: int = 262_144,
        pixel_samples: int = 1,
        pixel_filter: AbstractPixelFilter = BoxFilter(),
    ):
        assign(self, step=step, termination=termination, quadrature=quadrature, skipping=skipping)
        assign(self, negligible=negligible, adjoint=adjoint, sampling=sampling, tile=tile, pixel_samples=pixel_samples)
        assign(self, pixel_filter=pixel_filter)
        if negligible and not skipping:
            raise ValueError("negligible bricks can only be left out with skipping=True")
        if negligible and not isinstance(quadrature, Midpoint):
            raise ValueError("what is negligible is left out by midpoints: set quadrature=jvr.Midpoint()")
        if pixel_samples == 1 and pixel_filter != BoxFilter():
            raise ValueError("a pixel filter weighs several rays a pixel: set pixel_samples=2 or more, or leave pixel_filter out")

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        absorbs, ends = scene.optical.absorbs, self.termination > 0
        limit = f"rays end at transmittance {self.termination:g}" if ends else "rays run to their end"
        n = self.pixel_samples
        several = () if n == 1 else (PlanEntry("supersampling", True, f"{n} x {n} rays a pixel"),)
        return (
            *several,
            PlanEntry("empty-space skipping", self.skipping, self._skipped(scene)),
            PlanEntry("early termination", ends and absorbs, limit if absorbs else "nothing absorbs"),
        )

    def _skipped(self, scene: Any) -> str:
        if not self.skipping:
            return "every sample is taken"
        bound = f", and those of optical depth below {self.negligible:g} a ray" if self.negligible else ""
        bricks = scene.volume.bricks
        if bricks is None:
            return f"empty bricks{bound}; they are bounded anew for each picture: jvr.Volume.bricked() does it once"
        return f"empty bricks of {bricks.size}^3 voxels{bound}; bounded anew inside of a jit that takes the voxels as an argument"

    def knobs(self, scene: Any) -> tuple[Knob, ...]:
        quadratures = tuple(rule for rule in (Midpoint(), PreIntegrated()) if rule.integrates(scene.transfer))
        termination = (Knob("termination", TERMINATIONS, 0.0, bounds_error=True),) if scene.optical.absorbs else ()
        return (
            Knob("step", STEPS, STEPS[-1] / FINER),
            Knob("quadrature", quadratures, Midpoint()),
            *termination,
            Knob("negligible", NEGLIGIBLE, 0.0),
        )
