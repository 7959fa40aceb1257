"""What a fit returns: the scene and cameras that it found, how it came there, and how sure they are."""

from html import escape
from typing import Any, NamedTuple

import jax
import numpy as np

from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.rendering.settings import Settings
from jvr.types import Outcome

# Radiance of 80 dB below white: kept samples are rounded to about as much.
INVISIBLE = 1e-4
# How names of poses end.
POSE = ".world_from_camera"


class Iteration(NamedTuple):
    """One line of a fit's history: `loss` is the objective, `psnr` in decibels relative to radiance 1 (of the rays in use),
    `seconds` since the start, `rays` the fraction of all rays in use."""

    step: int
    loss: float
    psnr: float
    seconds: float
    rays: float


class FitStats(NamedTuple):
    """What a fit took and how well it is determined.

    - `seconds`; `kept_bytes`: of samples kept along the rays, 0 where they were resampled.
    - `residual_variance`, `rank`, `condition`: of the Gauss-Newton matrix at the end, see `jvr.fitting.identifiability`.
    - `structured`: whether neighbouring residuals have something in common, so that the model cannot explain the images whatever its
      unknowns; standard errors are then those of the sandwich. `design_effect`: by how much, 1 for noise.
    - `smoothed`: how many entries of each unknown array were continued from their neighbours, since the images do not determine them.
    - `worst`: the least-determined direction of the unknowns, as (name, coefficient), largest first.
    - `held_out`: (PSNR, SSIM) of each held-out view, radiance 0 ... 1.
    """

    seconds: float
    kept_bytes: int
    residual_variance: float
    rank: int
    condition: float
    worst: tuple[tuple[str, float], ...]
    held_out: tuple[tuple[float, float], ...]
    structured: bool = False
    design_effect: float = float("nan")
    smoothed: tuple[tuple[str, int], ...] = ()

    @property
    def is_misfit(self) -> bool:
        """Whether residuals are structured and large enough to be seen: a root mean square above `INVISIBLE`."""
        return self.structured and self.residual_variance > INVISIBLE**2


class FitResult(NamedTuple):
    """What `jvr.fit` returns.

    - `scene`: the fitted scene.
    - `history`: one `Iteration` for each step.
    - `standard_errors`: of every fitted value, in the structure of what `unknowns` returned; infinite where the images do not determine
      it, NaN for more unknowns than a Gauss-Newton matrix is made for (those of voxels come from `jvr.voxel_errors`). Of a pose six: a
      rotation about the centre of the volume, in degrees about the x, y and z axes of the world, and a translation of it along these, as
      a world length (mm).
    - `determined`: in the same structure, whether the images determine a value: its standard error is at most a quarter of how large it may
      plausibly be; what is not was continued from its neighbours where the fit smooths. `None` for more unknowns than there are errors for.
    - `unknowns`: the paths of the fitted arrays, such as `transfer.rgb` or `cameras[0].fov_y`, in the order of `standard_errors`.
    - `information`: the inverse of the covariance of all fitted values, one after the other, as plain noise would have it, `(n, n)`; `None`
      where there are too many. `jvr.next_view` reads it.
    - `outcome`: how the iteration ended.
    - `exposure`: the fitted factor between rendered and target radiance, 1 where it was not asked for.
    - `stats`: `FitStats`.
    - `cameras`: the fitted cameras, or those that were given; `settings`: those of the fit.
    """

    scene: Scene
    history: tuple[Iteration, ...]
    standard_errors: Any
    unknowns: tuple[str, ...]
    outcome: Outcome
    exposure: float
    stats: FitStats
    information: np.ndarray | None = None
    cameras: tuple[AbstractCamera, ...] = ()
    settings: Settings = Settings()
    determined: Any = None

    @property
    def errors_by_name(self) -> dict[str, np.ndarray]:
        """The standard errors of each fitted array, by its path in the scene."""
        return dict(zip(self.unknowns, map(np.asarray, jax.tree.leaves(self.standard_errors)), strict=True))

    @property
    def pose_errors(self) -> dict[str, np.ndarray]:
        """Those of poses alone."""
        return {name: errors for name, errors in self.errors_by_name.items() if POSE in name}

    def _repr_html_(self) -> str:
        """What notebooks show: how the fit ended, how sure its values are, and the transfer function."""
        last = f", PSNR {self.history[-1].psnr:.1f} dB" if self.history else ""
        lines = [f"Fit: {self.outcome.value} after {len(self.history)} steps, {self.stats.seconds:.1f} s{last}"]
        lines += [f"held-out view: PSNR {psnr:.1f} dB, SSIM {ssim:.4f}" for psnr, ssim in self.stats.held_out]
        lines += _poses_in_words(self.pose_errors)
        for name, errors in self.errors_by_name.items():
            if name in self.pose_errors:
                continue
            known = errors[np.isfinite(errors)]
            middle = f"standard error {np.median(known):.2g} (median), " if known.size else ""
            lines.append(f"{name}: {middle}{errors.size - known.size} of {errors.size} not determined by the images")
        lines += [f"{name}: {count} values continued from their neighbours" for name, count in self.stats.smoothed]
        lines += ["neighbouring residuals are alike: the model does not explain the images"] if self.stats.is_misfit else []
        return f"<div>{'<br>'.join(map(escape, lines))}{self.scene.transfer._repr_html_()}</div>"


def _poses_in_words(errors: dict[str, np.ndarray]) -> list[str]:
    """One line about all fitted poses."""
    if not errors:
        return []
    all_ = np.stack(list(errors.values()))
    unknown = np.count_nonzero(~np.isfinite(all_).all(axis=1))
    degrees, lengths = np.median(all_[:, :3]), np.median(all_[:, 3:])
    poses = f"{len(all_)} pose{'' if len(all_) == 1 else 's'}"
    return [f"{poses}: standard error {degrees:.2g} degrees, {lengths:.2g} mm (medians), {unknown} not determined by the images"]
