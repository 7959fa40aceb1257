"""`jvr.fit`: inverse rendering, the arrays of a scene that explain its images."""

import time
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from jvr.fitting import checkpoint as checkpoints
from jvr.fitting.bijectors import Bounded
from jvr.fitting.continuation import continued
from jvr.fitting.evaluator import Evaluator
from jvr.fitting.identifiability import Identifiability, undetermined
from jvr.fitting.kinds import march_unknowns
from jvr.fitting.least_squares import ChunkedLeastSquares, LevenbergMarquardt
from jvr.fitting.losses import DSSIM, AbstractLoss, AbstractPrior, SquaredError
from jvr.fitting.minimisers import OptimistixSolver
from jvr.fitting.objective import check_derivatives
from jvr.fitting.observations import Observations, check_settings, is_mostly_empty, keep_samples, observe
from jvr.fitting.problem import Problem
from jvr.fitting.progress import Iteration, progress_bar
from jvr.fitting.reach import known_background, say_what_is_out_of_reach
from jvr.fitting.solvers import AbstractSolver
from jvr.fitting.targets import Targets, targets_of
from jvr.fitting.unknowns import ExposedModel, Unknowns, choose_unknowns, selected
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable
from jvr.rendering.measure import psnr, similarity
from jvr.rendering.render import render
from jvr.rendering.settings import Settings
from jvr.types import Outcome

# Kept samples are given up where they would take more than this many bytes.
KEEP_LIMIT = 2**30
# The Jacobian of other unknowns than a table's entries takes one march for each.
MOST_FORWARD = 512
# Radiance of 80 dB below white: kept samples are rounded to about as much.
INVISIBLE = 1e-4


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
    - `standard_errors`: of every fitted value, in the structure of `unknowns(scene)`; infinite where the images do not determine it,
      NaN for more unknowns than a Gauss-Newton matrix is made for: those of voxels come from `jvr.voxel_errors`.
    - `unknowns`: the paths of the fitted arrays in the scene, such as `transfer.rgb`, in the order of `standard_errors`.
    - `information`: the inverse of the covariance of all fitted values, one after the other, as plain noise would have it, `(n, n)`; `None`
      where there are too many. `jvr.next_view` reads it.
    - `outcome`: how the iteration ended.
    - `exposure`: the fitted factor between rendered and target radiance, 1 where it was not asked for.
    - `stats`: `FitStats`.
    """

    scene: Scene
    history: tuple[Iteration, ...]
    standard_errors: Any
    unknowns: tuple[str, ...]
    outcome: Outcome
    exposure: float
    stats: FitStats
    information: np.ndarray | None = None

    @property
    def errors_by_name(self) -> dict[str, np.ndarray]:
        """The standard errors of each fitted array, by its path in the scene."""
        return dict(zip(self.unknowns, map(np.asarray, jax.tree.leaves(self.standard_errors)), strict=True))

    def _repr_html_(self) -> str:
        """What notebooks show: how the fit ended, how sure its values are, and the transfer function."""
        last = f", PSNR {self.history[-1].psnr:.1f} dB" if self.history else ""
        lines = [f"Fit: {self.outcome.value} after {len(self.history)} steps, {self.stats.seconds:.1f} s{last}"]
        lines += [f"held-out view: PSNR {psnr:.1f} dB, SSIM {ssim:.4f}" for psnr, ssim in self.stats.held_out]
        for name, errors in self.errors_by_name.items():
            known = errors[np.isfinite(errors)]
            middle = f"standard error {np.median(known):.2g} (median), " if known.size else ""
            lines.append(f"{name}: {middle}{errors.size - known.size} of {errors.size} not determined by the images")
        lines += [f"{name}: {count} values continued from their neighbours" for name, count in self.stats.smoothed]
        lines += ["neighbouring residuals are alike: the model does not explain the images"] if self.stats.is_misfit else []
        return f"<div>{'<br>'.join(map(escape, lines))}{self.scene.transfer._repr_html_()}</div>"


def fit(
    scene: Scene,
    cameras: Sequence[AbstractCamera],
    images: Any,
    *,
    unknowns: Callable[[Scene], Any],
    settings: Settings = Settings(),
    solver: AbstractSolver | optx.AbstractMinimiser | optx.AbstractLeastSquaresSolver | None = None,
    loss: AbstractLoss | DSSIM = SquaredError(),
    priors: Sequence[AbstractPrior] = (),
    transforms: Any = None,
    weights: Sequence[Any] | None = None,
    exposure: bool = False,
    held_out: tuple[Sequence[AbstractCamera], Any] | None = None,
    keep_samples: bool | int = True,
    smooth_undetermined: bool = True,
    max_steps: int = 100,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: bool | Callable[[Iteration], None] | None = None,
) -> FitResult:
    """Finds the values of some arrays of a scene that make it look like the images.

    **Arguments:**

    - `scene`: where the fit starts; what is not unknown stays as it is.
    - `cameras`, `images`: one target image `(height, width, 3)`, linear radiance, for each camera, each of its own size. Pixels that are
      not finite have weight 0. Images `(height, width, 4)`, light over black and alpha, are put over the scene's background.
    - `unknowns`: picks arrays out of the scene by their place, for example `lambda s: (s.transfer.rgb, s.transfer.sigma_t)`.
    - `solver`: `None` is `jvr.LevenbergMarquardt()`; also `jvr.GaussNewton()`, `jvr.Dogleg()`, `jvr.LBFGSB()`, or any minimiser or
      least-squares solver of Optimistix.
    - `loss`: `jvr.SquaredError()`, `jvr.Huber()`, `jvr.AbsoluteError()` or, for solvers that use gradients alone, `jvr.DSSIM()`.
    - `priors`: penalties added to the mean loss; `transforms`: one for each unknown array, see `jvr.fitting.unknowns`.
    - `weights`: one `(height, width)` array for each image, not negative, such as masks.
    - `exposure`: also fit the factor between rendered and target radiance.
    - `held_out`: `(cameras, images)` that are only compared with at the end.
    - `keep_samples`: keep the resampled values along all rays (2 bytes each) while the volume is not unknown, so that no step touches
      the volume again; a number is the most bytes to take (`True`: 1 GiB), beyond which every step resamples.
    - `smooth_undetermined`: continue entries of a table that the images do not determine smoothly from those that they do, in place of what
      the iteration left there (`jvr.fitting.continuation`); it adds at most 0.01 dB of error.
    - `max_steps`: iterations at most. `checkpoint`: a file written after every iteration, from which `resume=True` goes on.
    - `progress`: `None` shows a bar on stderr where that is a terminal; a function is called with each `Iteration`.

    Standard errors are those of weighted least squares at the solution, in the values' own coordinates, priors excluded; with a
    robust loss its final weights count as the weights. Where neighbouring residuals have something in common (another
    renderer's sampling, a camera's blur) they are those of a sandwich estimate, see `jvr.fitting.identifiability`. `settings.adjoint` plays
    no part: each solver has its own.

    What the targets show and no values of the unknowns can is said: another background than the scene's, light that its colours do not
    reach, a camera that sees nothing of the volume.

    **Raises** `ValueError` for images that do not fit the cameras, unknowns that are not arrays of the scene, too many unknowns for
    a least-squares solver, a loss that the solver cannot use, cameras that all miss the volume, or an integrator whose radiance has no
    derivative. A non-finite value ends the fit with that outcome and the last good iterate.
    """
    began = time.perf_counter()
    solver = _as_solver(solver)
    check_settings(settings)
    scene = scene.current()
    model = ExposedModel(scene, jnp.ones(()) if exposure else None)
    chosen = _choose(model, unknowns, transforms, solver)
    model = _without_stale(model, chosen)
    scene, chosen = model.scene, _choose(model, unknowns, transforms, solver)
    behind = known_background(model, chosen)
    targets, weights = given = targets_of(cameras, images, weights, behind)
    held = None if held_out is None else (held_out[0], targets_of(*held_out, None, behind, "held-out image"))
    start = chosen.model_from_unconstrained(model, chosen.unconstrained_from_model(model))
    problem = Problem(model, chosen, settings, loss, tuple(priors), None, is_mostly_empty(start.scene, settings))
    forwards = _check(problem, solver, given)
    say_what_is_out_of_reach(problem, given)

    problem, observations = _keep(problem, observe(scene, cameras, targets, weights, settings), keep_samples)
    check_derivatives(problem, observations, forwards=forwards)
    evaluator = Evaluator(problem, observations, cameras, targets)
    mark = checkpoints.fingerprint(problem, (cameras, targets, weights), solver) if checkpoint else {}
    # The observations hold them.
    del targets, given
    state, history = solver.init(evaluator.functions, chosen.unconstrained_from_model(model)), []
    if checkpoint and resume and Path(checkpoint).exists():
        state, rows = checkpoints.load(Path(checkpoint), state, mark)
        history = [Iteration(**row) for row in rows]
        began -= history[-1].seconds if history else 0.0

    outcome = solver.outcome(state)
    with progress_bar(progress, max_steps) as show:
        while outcome is None and len(history) < max_steps:
            state = solver.step(evaluator.functions, state)
            history.append(_iteration(evaluator, solver, state, len(history) + 1, time.perf_counter() - began))
            if checkpoint:
                checkpoints.save(Path(checkpoint), state, [entry._asdict() for entry in history], mark)
            show(history[-1])
            outcome = solver.outcome(state)

    unconstrained, _ = solver.iterate(state)
    values = chosen.values_from_unconstrained(jnp.asarray(unconstrained), model)
    known, quiet = undetermined(values.size), np.zeros(values.size, bool)
    if march_unknowns(problem) <= MOST_FORWARD:
        known, around = evaluator.solution(values)
        if smooth_undetermined:
            moved, quiet = continued(problem, np.asarray(values, np.float64), known.standard_errors, around, evaluator.objective)
            values = jnp.asarray(moved, values.dtype)
    found = chosen.insert(model, chosen.split(values, model))
    errors = chosen.split(jnp.asarray(known.standard_errors), model)
    selected, structure = jax.tree.flatten(unknowns(scene))
    stats = FitStats(
        seconds=time.perf_counter() - began,
        kept_bytes=0 if problem.samples is None else problem.samples.bytes,
        residual_variance=known.variance,
        rank=known.rank,
        condition=known.condition,
        structured=known.structured,
        design_effect=known.design_effect,
        smoothed=_counted(chosen, model, quiet),
        worst=_least_determined(chosen, model, known),
        held_out=() if held is None else _compare(found, settings, *held),
    )
    return FitResult(
        scene=found.scene,
        history=tuple(history),
        standard_errors=jax.tree.unflatten(structure, errors[: len(selected)]),
        unknowns=chosen.names[: len(selected)],
        information=known.information,
        outcome=outcome or Outcome.STEP_LIMIT,
        exposure=1.0 if found.exposure is None else float(found.exposure),
        stats=stats,
    )


def _as_solver(solver: Any) -> AbstractSolver:
    if solver is None:
        return LevenbergMarquardt()
    if isinstance(solver, AbstractSolver):
        return solver
    if isinstance(solver, optx.AbstractMinimiser | optx.AbstractLeastSquaresSolver):
        return OptimistixSolver(solver)
    raise TypeError(f"solver must be one of jvr's or Optimistix's, not {type(solver).__name__}")


def _choose(model: ExposedModel, unknowns: Callable[[Scene], Any], transforms: Any, solver: AbstractSolver) -> Unknowns:
    """The scene's unknowns and then the exposure."""
    select = lambda m: (selected(unknowns, m.scene), m.exposure)
    if transforms is not None:
        if solver.bounds is None and any(isinstance(t, Bounded) for t in transforms):
            raise ValueError(
                f"{type(solver).__name__} knows no bounds, which jvr.Bounded(low, high) needs: use solver=jvr.LBFGSB(), or "
                "transforms=jvr.Sigmoid(low, high) in its place"
            )
        transforms = (*transforms, *([None] if model.exposure is not None else []))
    return choose_unknowns(model, select, transforms, solver.bounds)


def _without_stale(model: ExposedModel, chosen: Unknowns) -> ExposedModel:
    """The model without what was computed of the unknowns' start and would stay so: what its volume keeps, and a radiance transfer, which
    is taken as it is."""
    transfer = lambda m: m.scene.radiance_transfer
    if model.scene.radiance_transfer is not None and chosen.among(model, lambda m: transfer(m).sources(m.scene)):
        model = eqx.tree_at(transfer, model, model.scene.radiance_transfer.pinned())
    if chosen.among(model, lambda m: m.scene.volume):
        kept = lambda m: (m.scene.volume.bricks, m.scene.volume.gradients)
        model = eqx.tree_at(kept, model, (None, None), is_leaf=lambda x: x is None)
    return model


def _check(problem: Problem, solver: AbstractSolver, given: Targets) -> bool:
    """Refuses combinations that cannot work; whether derivatives are taken in forward mode."""
    is_least_squares = isinstance(solver, ChunkedLeastSquares) or (
        isinstance(solver, OptimistixSolver) and isinstance(solver.solver, optx.AbstractLeastSquaresSolver)
    )
    if is_least_squares and isinstance(problem.loss, DSSIM):
        raise ValueError(
            "DSSIM is not a sum over pixels and has no least-squares form: use solver=optimistix.BFGS(rtol=1e-6, atol=1e-8)"
        )
    if isinstance(problem.loss, DSSIM) and given.are_weighted:
        raise ValueError(
            "DSSIM compares whole images: leave weights and pixels that are not finite out, or use loss=jvr.AbsoluteError()"
        )
    if (
        isinstance(solver, OptimistixSolver)
        and is_least_squares
        and not (type(problem.loss) is SquaredError and not problem.priors)
    ):
        raise ValueError("Optimistix's least-squares solvers take squared errors without priors: use jvr.LevenbergMarquardt()")
    inner = march_unknowns(problem)
    if is_least_squares and inner > MOST_FORWARD:
        raise ValueError(
            f"{inner:,} unknowns are too many for a least-squares solver (at most {MOST_FORWARD} beside a table's entries): "
            "use solver=optimistix.LBFGS(rtol=1e-6, atol=1e-8), or jvr.LBFGSB() within bounds"
        )
    return is_least_squares


def _keep(problem: Problem, observations: Observations, keep: bool | int) -> tuple[Problem, Observations]:
    """Samples along the rays, where the volume and its clipping are known and memory allows."""
    among = lambda select: problem.unknowns.among(problem.model, select)
    moving = among(lambda m: (m.scene.volume, m.scene.clipping))
    # What is kept is the scalar alone.
    only_scalars = problem.integrator.marches and not problem.model.scene.needs_gradient
    if keep is False or moving or not only_scalars or isinstance(problem.loss, DSSIM):
        return problem, observations
    limit = KEEP_LIMIT if keep is True else keep
    # Colours and extinctions of a table leave its ends where they are; whatever else it has may move them.
    entries = lambda transfer: (transfer.rgb, transfer.sigma_t) if isinstance(transfer, AbstractTable) else ()
    clamped = among(lambda m: m.scene.transfer) == among(lambda m: entries(m.scene.transfer))
    kept = keep_samples(problem.model.scene, observations, problem.settings, limit, clamped=clamped)
    if kept is None:
        return problem, observations
    return problem.with_samples(kept[0]), kept[1]


def _iteration(evaluator: Evaluator, solver: AbstractSolver, state: Any, step: int, seconds: float) -> Iteration:
    unconstrained, loss = solver.iterate(state)
    level = int(getattr(state, "level", -1))
    psnr = evaluator.psnr(unconstrained, loss, getattr(state, "normal", None))
    return Iteration(step, loss, psnr, seconds, evaluator.fraction(level))


def _least_determined(
    chosen: Unknowns, model: ExposedModel, known: Identifiability, most: int = 6
) -> tuple[tuple[str, float], ...]:
    """The largest coefficients of the least-determined direction, with the names of their unknowns."""
    if not np.isfinite(known.least_determined).all():
        return ()
    labels = []
    for name, array in zip(chosen.names, chosen.values(model), strict=True):
        labels += [f"{name}[{', '.join(map(str, i))}]" for i in np.ndindex(array.shape)]
    order = np.argsort(-np.abs(known.least_determined))[:most]
    return tuple((labels[i], float(known.least_determined[i])) for i in order)


def _counted(chosen: Unknowns, model: ExposedModel, which: np.ndarray) -> tuple[tuple[str, int], ...]:
    """How many values of each unknown array are marked, of those where any are."""
    sizes = [value.size for value in chosen.values(model)]
    parts = np.split(which, np.cumsum(sizes)[:-1])
    return tuple((name, int(part.sum())) for name, part in zip(chosen.names, parts, strict=True) if part.any())


def _compare(
    found: ExposedModel, settings: Settings, cameras: Sequence[AbstractCamera], targets: Targets
) -> tuple[tuple[float, float], ...]:
    """PSNR and SSIM of views that took no part in the fit."""
    exposure = 1.0 if found.exposure is None else float(found.exposure)
    pictures = [exposure * np.asarray(render(found.scene, camera, settings).rgb) for camera in cameras]
    return tuple((psnr(*pair), similarity(*pair)) for pair in zip(targets.marked(), pictures, strict=True))
