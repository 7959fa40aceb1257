"""Which view to take next: what each candidate would add to what a fit knows."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jvr.fitting.identifiability import TINY
from jvr.fitting.losses import SquaredError
from jvr.fitting.normal_equations import light_tangents, normal_equations
from jvr.fitting.observations import is_mostly_empty, observe
from jvr.fitting.problem import Problem
from jvr.fitting.result import FitResult
from jvr.fitting.unknowns import ExposedModel, choose_unknowns, leaves_by_name
from jvr.model.camera import AbstractCamera
from jvr.rendering.settings import Settings


class Candidate(NamedTuple):
    """What one more view would bring.

    - `number`: of the camera among the candidates, from 0; `camera`.
    - `gain`: information about the unknowns together, in bits: `log2(det(F + F_view) / det(F)) / 2` (D-optimality).
    - `errors`: standard errors of the unknowns afterwards by name, as plain noise would have them.
    """

    number: int
    camera: AbstractCamera
    gain: float
    errors: dict[str, np.ndarray]


def next_view(result: FitResult, candidates: Sequence[AbstractCamera], settings: Settings = Settings()) -> tuple[Candidate, ...]:
    """Ranks views that could be taken by what they would add to a fit, the best first.

    With the information `F` of a fit, `sum J^T J / s^2` over its pixels with the residual variance `s^2`, a view adds the same sum over its
    own pixels: their rows `J` at the fitted values need no picture. What is not known of the fit's own cameras a candidate, whose camera is
    known, says nothing of: they are eliminated first. Views are compared by the determinant (D-optimality: Chaloner and
    Verdinelli 1995), which no choice of units changes. What the fit leaves open counts as uncertain by as much as it may plausibly be: the
    width of a range, else a value's own size (`jvr.fitting.unknowns.Unknowns.plausible`). Gains of several views do not add up: take the
    first, fit again, ask again.

    **Arguments:** `result`: of `jvr.fit`, of a table or other few unknowns; `candidates`: cameras of any kind and size;
    `settings`: those of the fit.
    **Raises** `ValueError` for a fit that has no information matrix (voxels) or has found cameras alone, without candidates, and for a
    candidate that does not see the volume.
    """
    if result.information is None:
        raise ValueError(
            "the fit has too many unknowns for an information matrix: next_view ranks views for tables and other few unknowns"
        )
    if not candidates:
        raise ValueError("there are no candidates: give cameras that could be taken, such as jvr.orbit(...)")
    result = _about_the_scene(result)
    assert result.information is not None
    problem, values = _problem(result, len(result.information), settings)
    size = problem.unknowns.plausible(problem.model, np.asarray(values, np.float64))
    # In units of what is plausible, so that the small matrix is well scaled.
    before = size[:, None] * result.information * size + np.eye(size.size)
    # As in the information of a fit whose residuals are all zero.
    variance = max(result.stats.residual_variance, TINY)
    found = []
    for i, camera in enumerate(candidates):
        after = before + size[:, None] * _information(problem, values, i, camera) * size / variance
        gain = 0.5 * (np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]) / np.log(2)
        errors = size * np.sqrt(np.diag(np.linalg.inv(after)))
        parts = np.split(errors, np.cumsum([v.size for v in problem.unknowns.values(problem.model)])[:-1])
        shaped = {
            n: p.reshape(np.shape(v))
            for n, p, v in zip(problem.unknowns.names, parts, problem.unknowns.values(problem.model), strict=True)
        }
        found.append(Candidate(i, camera, float(gain), {name: shaped[name] for name in result.unknowns}))
    return tuple(sorted(found, key=lambda candidate: -candidate.gain))


def _about_the_scene(result: FitResult) -> FitResult:
    """The result without the cameras that were found: the information about the rest is the Schur complement, with a camera's values
    uncertain by one of their unit where the fit leaves them open."""
    assert result.information is not None
    is_camera = ["cameras" in name for name in result.unknowns]
    if all(is_camera):
        raise ValueError(
            "the fit has found cameras alone, of which another view says nothing: give it unknowns of the scene as well"
        )
    if not any(is_camera):
        return result
    sizes = [errors.size for errors in result.errors_by_name.values()]
    camera = np.repeat(is_camera, sizes)
    # The exposure comes last.
    camera = np.append(camera, np.zeros(len(result.information) - camera.size, bool))
    whole = result.information
    own, crossed = whole[np.ix_(camera, camera)], whole[np.ix_(camera, ~camera)]
    rest = whole[np.ix_(~camera, ~camera)] - crossed.T @ np.linalg.solve(own + np.eye(len(own)), crossed)
    names = tuple(name for name, found in zip(result.unknowns, is_camera, strict=True) if not found)
    return result._replace(information=rest, unknowns=names)


def _problem(result: FitResult, count: int, settings: Settings) -> tuple[Problem, jax.Array]:
    """The fit of `count` unknowns again, at its end, and its values."""
    select = lambda m: tuple(leaves_by_name(m.scene)[name] for name in result.unknowns)
    model = ExposedModel(result.scene, None)
    fitted = sum(np.size(leaf) for leaf in select(model))
    if count > fitted:
        model, without = ExposedModel(result.scene, jnp.asarray(result.exposure, jnp.result_type(float))), select
        select = lambda m: (*without(m), m.exposure)
    chosen = choose_unknowns(model, select)
    problem = Problem(model, chosen, settings, SquaredError(), (), None, is_mostly_empty(result.scene, settings))
    return problem, jnp.concatenate([jnp.ravel(value) for value in chosen.values(model)])


def _information(
    problem: Problem, values: jax.Array, index: int, camera: AbstractCamera
) -> Float[np.ndarray, "unknowns unknowns"]:
    """`sum J^T J` over the pixels of a view."""
    nothing: list[Any] = [np.zeros((camera.height, camera.width, 3), values.dtype)]
    try:
        rays = observe(problem.model.scene, [camera], nothing, None, problem.settings)
    except ValueError as error:
        raise ValueError(f"candidate {index}: {error}") from error
    around = light_tangents(problem, values)
    tiles = (normal_equations(problem, values, rays, i, 1, around) for i in range(rays.tile_count()))
    return np.sum([np.asarray(tile.matrix, np.float64) for tile in tiles], axis=0)
