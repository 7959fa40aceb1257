"""How a scene is rendered: everything that changes time and accuracy, and nothing that changes the scene."""

import math
from typing import Any

import equinox as eqx

from jvr.march.differentiation import AbstractAdjoint, Replay
from jvr.march.quadrature import AbstractQuadrature, Midpoint, PreIntegrated
from jvr.model.parts import AbstractPart, Knob, PlanEntry
from jvr.rendering.sampling import AbstractSampling, Uniform

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
    - `adjoint`: how derivatives are computed: `jvr.Replay()` (reverse mode, default), `jvr.Forward()` or `jvr.Rows()`.
    - `sampling`: which samples are taken: `jvr.Uniform()` (default: all), `jvr.Refinement()` or `jvr.Slices()`.
    - `tile`: rays marched at a time. Memory is about 120 bytes a ray; smaller tiles need less and take longer.

    **Raises** `ValueError` for values out of range.
    """

    step: float = eqx.field(static=True)
    termination: float = eqx.field(static=True)
    quadrature: AbstractQuadrature
    skipping: bool = eqx.field(static=True)
    negligible: float = eqx.field(static=True)
    adjoint: AbstractAdjoint
    sampling: AbstractSampling
    tile: int = eqx.field(static=True)

    def __init__(
        self,
        step: float | int = 0.5,
        *,
        termination: float | int = 1e-4,
        quadrature: AbstractQuadrature = Midpoint(),
        skipping: bool = True,
        negligible: float | int = 0.0,
        adjoint: AbstractAdjoint = Replay(),
        sampling: AbstractSampling = Uniform(),
        tile: int = 262_144,
    ):
        if isinstance(step, bool) or not isinstance(step, int | float) or not (math.isfinite(step) and step > 0):
            raise ValueError(f"step must be a positive number of voxels, not {step!r}; 0.5 is a good start")
        if not isinstance(termination, int | float) or not 0 <= termination < 1:
            raise ValueError(f"termination must be a transmittance in [0, 1), not {termination!r}; 0 never ends a ray early")
        if not isinstance(quadrature, AbstractQuadrature):
            raise TypeError(f"quadrature must be jvr.Midpoint() or jvr.PreIntegrated(), not {quadrature!r}")
        if not isinstance(skipping, bool):
            raise TypeError(f"skipping must be True or False, not {skipping!r}")
        if isinstance(negligible, bool) or not isinstance(negligible, int | float) or not 0 <= negligible < 1:
            raise ValueError(f"negligible must be an optical depth in [0, 1), not {negligible!r}; 1e-3 changes no 8-bit picture")
        if negligible and not skipping:
            raise ValueError("negligible bricks can only be left out with skipping=True")
        if negligible and not isinstance(quadrature, Midpoint):
            raise ValueError("what is negligible is left out by midpoints: set quadrature=jvr.Midpoint()")
        if isinstance(tile, bool) or not isinstance(tile, int) or tile < 1:
            raise ValueError(f"tile must be a positive number of rays, not {tile!r}")
        if not isinstance(adjoint, AbstractAdjoint):
            raise TypeError(f"adjoint must be jvr.Replay(), jvr.Forward() or jvr.Rows(), not {adjoint!r}")
        if not isinstance(sampling, AbstractSampling):
            raise TypeError(f"sampling must be jvr.Uniform(), jvr.Refinement() or jvr.Slices(), not {sampling!r}")
        self.step = float(step)
        self.termination = float(termination)
        self.quadrature = quadrature
        self.skipping = skipping
        self.negligible = float(negligible)
        self.adjoint = adjoint
        self.sampling = sampling
        self.tile = tile

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        absorbs, ends = scene.optical.absorbs, self.termination > 0
        limit = f"rays end at transmittance {self.termination:g}" if ends else "rays run to their end"
        return (
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
