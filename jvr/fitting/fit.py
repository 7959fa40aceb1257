"""`jvr.fit`: inverse rendering, the arrays of a scene that explain its images."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from jvr.fitting import coarse
from jvr.fitting.bijectors import Bounded
from jvr.fitting.checkpoint import fingerprint
from jvr.fitting.continuation import are_determined, continued
from jvr.fitting.descent import Checkpoint, Descent
from jvr.fitting.evaluator import Evaluator
from jvr.fitting.groups import Group, Lights, groups_of, lights_of, lit
from jvr.fitting.identifiability import Identifiability, undetermined
from jvr.fitting.kinds import march_unknowns
from jvr.fitting.least_squares import ChunkedLeastSquares, LevenbergMarquardt
from jvr.fitting.losses import DSSIM, AbstractLoss, AbstractPrior, SquaredError
from jvr.fitting.minimisers import OptimistixSolver
from jvr.fitting.objective import check_derivatives
from jvr.fitting.observations import check_settings, check_views, is_mostly_empty
from jvr.fitting.problem import Problem
from jvr.fitting.reach import known_background, say_what_is_out_of_reach
from jvr.fitting.result import FitResult, FitStats, Iteration
from jvr.fitting.solvers import AbstractSolver
from jvr.fitting.targets import Targets, check_cameras, targets_of
from jvr.fitting.unknowns import ExposedModel, Unknowns, choose_unknowns, is_shared, selected, takes_cameras
from jvr.fitting.views import Views
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.rendering.measure import psnr, similarity
from jvr.rendering.render import render
from jvr.rendering.settings import Settings
from jvr.types import Outcome

# The Jacobian of other unknowns than a table's entries takes one march for each.
MOST_FORWARD = 512


def fit(
    scene: Scene,
    cameras: Sequence[AbstractCamera],
    images: Any,
    *,
    unknowns: Callable[..., Any],
    settings: Settings = Settings(),
    solver: AbstractSolver | optx.AbstractMinimiser | optx.AbstractLeastSquaresSolver | None = None,
    loss: AbstractLoss | DSSIM = SquaredError(),
    priors: Sequence[AbstractPrior] = (),
    transforms: Any = None,
    weights: Sequence[Any] | None = None,
    lights: Any = None,
    exposure: bool = False,
    held_out: tuple[Any, ...] | None = None,
    keep_samples: bool | int = True,
    smooth_undetermined: bool = True,
    coarse_levels: int = 0,
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
    - `unknowns`: picks arrays out of the scene by their place, for example `lambda s: (s.transfer.rgb, s.transfer.sigma_t)`; a function of
      two arguments also out of the cameras, `lambda s, cameras: [c.world_from_camera for c in cameras]`; `jvr.shared` makes one value
      of several of them. A pose is six numbers: a rotation of the camera about the centre of the volume, in degrees, and a translation,
      as a world length, both in the world's axes (`jvr.model.motion`).
    - `solver`: `None` is `jvr.LevenbergMarquardt()`; also `jvr.GaussNewton()`, `jvr.Dogleg()`, `jvr.LBFGSB()`, or any minimiser or
      least-squares solver of Optimistix.
    - `loss`: `jvr.SquaredError()`, `jvr.Huber()`, `jvr.AbsoluteError()` or, for solvers that use gradients alone, `jvr.DSSIM()`.
    - `priors`: penalties added to the mean loss; `transforms`: one for each unknown array, see `jvr.fitting.unknowns`.
    - `weights`: one `(height, width)` array for each image, not negative, such as masks.
    - `lights`: of each view, a light or a sequence of them, in place of the scene's; they are known. All else is shared.
    - `exposure`: also fit the factor between rendered and target radiance.
    - `held_out`: `(cameras, images)` or `(cameras, images, lights)` that are only compared with at the end.
    - `keep_samples`: keep the resampled values along all rays (2 bytes each) while the volume is not unknown, so that no step touches
      the volume again; a number is the most bytes to take (`True`: 1 GiB), beyond which every step resamples.
    - `smooth_undetermined`: continue entries of a table that the images do not determine smoothly from those that they do, in place of what
      the iteration left there (`jvr.fitting.continuation`); it adds at most 0.01 dB of error.
    - `coarse_levels`: so many times the fit begins with pictures averaged over squares of 3 pixels a side, 9, 27 and so on, coarsest
      first, and voxels averaged to about the size of such a pixel (`jvr.fitting.coarse`), for poses that are many pixels away
      (`experiments/pose_recovery.py` says how far it helps). Levels whose pictures would have fewer than 8 pixels a side are left out.
    - `max_steps`: iterations at most, those of all levels together.
    - `checkpoint`: a file written after every iteration on whole pictures, from which `resume=True` goes on.
    - `progress`: `None` shows a bar on stderr where that is a terminal; a function is called with each `Iteration`.

    Standard errors are those of weighted least squares at the solution, in the values' own coordinates, priors excluded; with a
    robust loss its final weights count as the weights. Where neighbouring residuals have something in common (another
    renderer's sampling, a camera's blur) they are those of a sandwich estimate, see `jvr.fitting.identifiability`. `settings.adjoint` plays
    no part: each solver has its own. Those of a pose are six: of a rotation about the centre of the volume, in degrees about the x, y and z
    axes of the world, and of a translation of it along these, in the world's unit, both at the solution.

    What the targets show and no values of the unknowns can is said: another background than the scene's, light that its colours do not
    reach, a camera that sees nothing of the volume.

    **Raises** `ValueError` for images that do not fit the cameras, unknowns that are not arrays of the scene or the cameras, too many
    unknowns for a least-squares solver, a loss that the solver cannot use, cameras that all miss the volume, an unknown camera that sees
    nothing of it, a negative number of steps, or an integrator whose radiance has no derivative.
    A non-finite value ends the fit with that outcome and the last
    good iterate.
    """
    began = time.perf_counter()
    solver = _as_solver(solver)
    check_settings(settings)
    if max_steps < 0:
        raise ValueError(f"max_steps must be at least 0, not {max_steps}")
    check_cameras(cameras)
    scene, views = scene.current(), () if isinstance(cameras, AbstractCamera) else tuple(cameras)
    model = _with_views(ExposedModel(scene, jnp.ones(()) if exposure else None), views, unknowns)
    choose = lambda model: _choose(model, views, unknowns, transforms, solver)
    model = without_stale(model, choose(model))
    scene, chosen = model.scene, choose(model)
    behind = known_background(model, chosen)
    targets, weights = given = targets_of(cameras, images, weights, behind)
    lights = lights_of(lights, cameras)
    held = None if held_out is None else _held_out(held_out, behind)
    check_views(scene, (*views, *(() if held is None else held[0])))
    start = chosen.model_from_unconstrained(model, chosen.unconstrained_from_model(model))
    problem = Problem(model, chosen, settings, loss, tuple(priors), None, is_mostly_empty(start.scene, settings))
    forwards = _check(problem, solver, given, coarse_levels)
    say_what_is_out_of_reach(problem, given)

    unknown = chosen.views(model)
    if lights is not None and coarse_levels:
        raise ValueError("coarse_levels know one light for all views: leave one of the two out")
    groups = groups_of(problem, choose, (cameras, given), lights, keep_samples, unknown)
    problem, observations = groups[0].problem, groups[0].observations
    check_derivatives(problem, observations, forwards=forwards)
    evaluator = Evaluator(groups, cameras, targets)
    file = None
    if checkpoint:
        file = Checkpoint(
            Path(checkpoint), fingerprint(problem, (cameras, targets, weights, lights), solver, coarse_levels), resume
        )
    with Descent(solver, max_steps, began, progress) as descent:
        # What is taken up again has left the coarse levels behind.
        for factor in () if file and file.is_there else coarse.factors(views, coarse_levels):
            rough, rays = coarse.level(problem, model, given, views, factor, choose, unknown)
            found = descent.run(Evaluator((Group(rough, rays),), views, None), rough, share=rays.size / observations.size)
            model = chosen.insert(model, rough.unknowns.split(found, rough.model))
        # The observations hold them.
        del targets, given
        values = descent.run(evaluator, problem, chosen.unconstrained_from_model(model), file)
    problem, values = _settled(problem, values)
    evaluator.settle(problem)
    # The problem of the first group has its lights.
    model = problem.model if lights is None else model
    known, quiet, determined = undetermined(values.size), np.zeros(values.size, bool), np.zeros(0, bool)
    if march_unknowns(problem) <= MOST_FORWARD:
        known, around = evaluator.solution(values)
        determined = are_determined(problem, np.asarray(values, np.float64), known.standard_errors)
        if smooth_undetermined:
            moved, quiet = continued(problem, np.asarray(values, np.float64), known.standard_errors, around, evaluator.objective)
            values = jnp.asarray(moved, values.dtype)
    found = chosen.insert(model, chosen.split(values, model))
    errors = chosen.split(jnp.asarray(known.standard_errors), model)
    marks = np.split(determined, np.cumsum([error.size for error in errors])[:-1])
    marks = [mark.reshape(error.shape) for mark, error in zip(marks, errors, strict=True)] if determined.size else []
    picked, structure = jax.tree.flatten(selected(unknowns, scene, views), is_leaf=is_shared)
    stats = FitStats(
        seconds=time.perf_counter() - began,
        kept_bytes=sum(group.problem.samples.bytes for group in groups if group.problem.samples is not None),
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
        history=tuple(descent.history),
        standard_errors=jax.tree.unflatten(structure, errors[: len(picked)]),
        unknowns=chosen.names[: len(picked)],
        information=known.information,
        outcome=descent.outcome or Outcome.STEP_LIMIT,
        exposure=1.0 if found.exposure is None else float(found.exposure),
        stats=stats,
        cameras=views if found.views is None else found.views.cameras,
        settings=settings,
        determined=jax.tree.unflatten(structure, marks[: len(picked)]) if determined.size else None,
    )


def _as_solver(solver: Any) -> AbstractSolver:
    if solver is None:
        return LevenbergMarquardt()
    if isinstance(solver, AbstractSolver):
        return solver
    if isinstance(solver, optx.AbstractMinimiser | optx.AbstractLeastSquaresSolver):
        return OptimistixSolver(solver)
    raise TypeError(f"solver must be one of jvr's or Optimistix's, not {type(solver).__name__}")


def _with_views(model: ExposedModel, cameras: tuple[AbstractCamera, ...], unknowns: Any) -> ExposedModel:
    """The model with its cameras, where the function `unknowns` names any of their arrays: what names none knows nothing of them."""
    if not cameras or not takes_cameras(unknowns):
        return model
    with_views = dataclasses.replace(model, views=Views.at_rest(cameras))
    return with_views if choose_unknowns(with_views, _select(unknowns, cameras)).views(with_views) else model


def _select(unknowns: Any, cameras: tuple[AbstractCamera, ...]) -> Callable[[ExposedModel], Any]:
    """The unknowns and then the exposure."""
    return lambda m: (selected(unknowns, m.scene, cameras if m.views is None else m.views.shown), m.exposure)


def _choose(
    model: ExposedModel, cameras: tuple[AbstractCamera, ...], unknowns: Any, transforms: Any, solver: AbstractSolver
) -> Unknowns:
    if transforms is not None:
        if solver.bounds is None and any(isinstance(t, Bounded) for t in transforms):
            raise ValueError(
                f"{type(solver).__name__} knows no bounds, which jvr.Bounded(low, high) needs: use solver=jvr.LBFGSB(), or "
                "transforms=jvr.Sigmoid(low, high) in its place"
            )
        transforms = (*transforms, *([None] if model.exposure is not None else []))
    return choose_unknowns(model, _select(unknowns, cameras), transforms, solver.bounds)


def without_stale(model: ExposedModel, chosen: Unknowns) -> ExposedModel:
    """The model without what was computed of the unknowns' start and would stay so: what its volume keeps, and precomputed parts, which
    are taken as they are."""
    for field in model.scene.precomputable:
        part = lambda m, field=field: getattr(m.scene, field)
        if chosen.among(model, lambda m, part=part: part(m).sources(m.scene)):
            model = eqx.tree_at(part, model, part(model).pinned())
    if chosen.among(model, lambda m: m.scene.volume):
        kept = lambda m: (m.scene.volume.bricks, m.scene.volume.gradients, m.scene.volume.sobel_gradients)
        model = eqx.tree_at(kept, model, (None, None, None), is_leaf=lambda x: x is None)
    return model


def _check(problem: Problem, solver: AbstractSolver, given: Targets, coarse_levels: int) -> bool:
    """Refuses combinations that cannot work; whether derivatives are taken in forward mode."""
    if problem.settings.pixel_samples > 1:
        raise ValueError("a fit compares one ray a pixel with its target: leave Settings(pixel_samples=...) at 1")
    is_least_squares = isinstance(solver, ChunkedLeastSquares) or (
        isinstance(solver, OptimistixSolver) and isinstance(solver.solver, optx.AbstractLeastSquaresSolver)
    )
    if is_least_squares and isinstance(problem.loss, DSSIM):
        raise ValueError(
            "DSSIM is not a sum over pixels and has no least-squares form: use solver=optimistix.BFGS(rtol=1e-6, atol=1e-8)"
        )
    if isinstance(problem.loss, DSSIM) and (problem.model.views is not None or coarse_levels):
        raise ValueError(
            "DSSIM compares whole images of known cameras: use loss=jvr.AbsoluteError() for unknown cameras and coarse_levels"
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


def _settled(problem: Problem, values: Float[Array, "unknowns"]) -> tuple[Problem, Float[Array, "unknowns"]]:
    """The problem at the end of its iteration, its cameras at rest where they have come to, and its values there."""
    model = problem.unknowns.insert(problem.model, problem.unknowns.split(values, problem.model))
    if model.views is None:
        return problem, values
    model = dataclasses.replace(model, views=model.views.settled(model.scene))
    values = jnp.concatenate([jnp.ravel(value) for value in problem.unknowns.values(model)])
    return eqx.tree_at(lambda p: p.model, problem, model), values


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


def _held_out(held_out: tuple[Any, ...], behind: Any) -> tuple[Sequence[AbstractCamera], Targets, Lights | None]:
    """Cameras, targets and lights of views that take no part."""
    if not isinstance(held_out, tuple | list) or len(held_out) not in (2, 3):
        raise TypeError(
            "held_out must be (cameras, images) or (cameras, images, lights), each a sequence with an entry for each view"
        )
    cameras, images, *rest = held_out
    lights = lights_of(rest[0] if rest else None, cameras, "held-out view")
    return cameras, targets_of(cameras, images, None, behind, "held-out image"), lights


def _compare(
    found: ExposedModel, settings: Settings, cameras: Sequence[AbstractCamera], targets: Targets, lights: Lights | None
) -> tuple[tuple[float, float], ...]:
    """PSNR and SSIM of views that took no part in the fit."""
    exposure = 1.0 if found.exposure is None else float(found.exposure)
    scenes = [found.scene if lights is None else lit(found.scene, lights[i], i) for i in range(len(cameras))]
    pictures = [exposure * np.asarray(render(*seen, settings).rgb) for seen in zip(scenes, cameras, strict=True)]
    return tuple((psnr(*pair), similarity(*pair)) for pair in zip(targets.marked(), pictures, strict=True))
