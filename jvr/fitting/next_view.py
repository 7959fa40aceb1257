"""Which view to take next: what each candidate would add to what a fit knows."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.fitting.bijectors import Identity
from jvr.fitting.fit import without_stale
from jvr.fitting.identifiability import TINY
from jvr.fitting.losses import SquaredError
from jvr.fitting.normal_equations import light_tangents, normal_equations
from jvr.fitting.observations import is_mostly_empty, observe
from jvr.fitting.problem import Problem
from jvr.fitting.result import FitResult
from jvr.fitting.targets import check_cameras
from jvr.fitting.unknowns import ExposedModel, choose_unknowns, leaves_by_name
from jvr.model.camera import AbstractCamera, fibonacci_sphere
from jvr.model.exact import Remainder, in_double
from jvr.model.scene import Scene
from jvr.rendering.settings import Settings
from jvr.types import Affine, Scalar, Triple

# Pixels that are looked at of each candidate.
PIXELS = 1024
# Candidates where none are given.
COUNT = 32


class Candidate(NamedTuple):
    """What one more view would bring.

    - `number`: of the camera among the candidates, from 0; `camera`.
    - `gain`: information about the unknowns together, in bits: `log2(det(F + F_view) / det(F)) / 2` (D-optimality).
    - `errors`: standard errors of the unknowns afterwards by name, as plain noise would have them; `before`: those without the view.
    """

    number: int
    camera: AbstractCamera
    gain: float
    errors: dict[str, np.ndarray]
    before: dict[str, np.ndarray]


class Knowledge(NamedTuple):
    """What a fit knows of its unknowns: their names in the fitted scene, the information matrix of `FitResult`, the variance of its
    residuals, and the exposure, which counts among the unknowns where the matrix has a row for it."""

    scene: Scene
    unknowns: tuple[str, ...]
    information: Float[np.ndarray, "unknowns unknowns"]
    variance: float
    exposure: float

    @classmethod
    def of(cls, result: FitResult) -> "Knowledge":
        """**Raises** `ValueError` for a fit of voxels, or of cameras alone."""
        if result.information is None:
            raise ValueError(
                "the fit has too many unknowns for an information matrix: next_view ranks views for tables and other few unknowns"
            )
        result = _about_the_scene(result)
        assert result.information is not None
        return cls(result.scene, result.unknowns, result.information, result.stats.residual_variance, result.exposure)


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


def next_view(
    result: FitResult,
    candidates: Sequence[AbstractCamera] | None = None,
    settings: Settings | None = None,
    *,
    pixels: int = PIXELS,
) -> tuple[Candidate, ...]:
    """Ranks views that could be taken by what they would add to a fit, the best first.

    With the information `F` of a fit, `sum J^T J / s^2` over its pixels with the residual variance `s^2`, a view adds the same sum over its
    own pixels: their rows `J` at the fitted values need no picture. Views are compared by the determinant (D-optimality: Chaloner and
    Verdinelli 1995), which no choice of units changes. What the fit leaves open counts as uncertain by as much as it may plausibly be: the
    width of a range, else a value's own size (`jvr.fitting.unknowns.Unknowns.plausible`). Gains of several views do not add up: take the
    first, fit again, ask again.

    **Arguments:** `result`: of `jvr.fit`, of a table or other few unknowns; `candidates`: cameras of any kind and size, by default
    `around` the volume; they are lit by the scene's own lights; `settings`: by default those of the fit; `pixels`: how many of each
    candidate are looked at, spread evenly, each for its neighbours as well.
    **Raises** `ValueError` for a fit that has no information matrix (voxels) or has found cameras alone, without candidates, and for a
    candidate that does not see the volume.
    """
    if not isinstance(result, FitResult):
        raise TypeError(f"jvr.next_view takes what jvr.fit returns, not {type(result).__name__}")
    known = Knowledge.of(result)
    candidates = around(result.scene, result.cameras) if candidates is None else candidates
    return ranked(known, candidates, result.settings if settings is None else settings, pixels)


def around(scene: Scene, cameras: Sequence[AbstractCamera], count: int = COUNT) -> tuple[AbstractCamera, ...]:
    """Cameras like the first one, spread evenly over a sphere around the volume, as far away as `cameras` are (their median).

    **Raises** `ValueError` without cameras.
    """
    if not cameras:
        raise ValueError("there are no candidates, and no cameras of a fit to go by: give cameras, such as jvr.orbit(...)")
    first, center = cameras[0], in_double(scene.volume.center)
    eyes = [in_double(camera.world_from_camera, camera.remainder)[:3, 3] for camera in cameras]
    distance = float(np.median(np.linalg.norm(np.array(eyes) - center, axis=1)))
    # A camera in the middle of the volume says nothing of how far others may be.
    distance = distance if distance > 0 else 3 * float(scene.volume.radius)
    place = lambda camera: (camera.world_from_camera, camera.remainder)
    places = [place(camera) for camera in fibonacci_sphere(center, distance, count, 30.0, 1, 1)]
    return tuple(eqx.tree_at(place, first, there) for there in places)


def ranked(
    known: Knowledge, candidates: Sequence[AbstractCamera], settings: Settings, pixels: int = PIXELS, most: int | None = None
) -> tuple[Candidate, ...]:
    """`next_view` of what a fit knows, the `most` first."""
    if isinstance(candidates, AbstractCamera):
        raise TypeError("candidates must be a sequence: put a single one in brackets, as [camera]")
    check_cameras(candidates, "candidates")
    if not len(candidates):
        raise ValueError("there are no candidates: give cameras that could be taken, such as jvr.orbit(...)")
    if pixels < 1:
        raise ValueError(f"pixels must be at least 1, not {pixels}")
    problem, values = _problem(known, settings)
    size = problem.unknowns.plausible(problem.model, np.asarray(values, np.float64))
    named = lambda errors: _by_name(problem, known.unknowns, errors)
    # In units of what is plausible, so that the small matrix is well scaled.
    before = size[:, None] * known.information * size + np.eye(size.size)
    # As in the information of a fit whose residuals are all zero.
    variance = max(known.variance, TINY)
    added = [_information(problem, values, i, camera, pixels) / variance for i, camera in enumerate(candidates)]
    after = [before + size[:, None] * matrix * size for matrix in added]
    gains = np.array([np.linalg.slogdet(matrix)[1] for matrix in after]) - np.linalg.slogdet(before)[1]
    errors = lambda matrix: named(size * np.sqrt(np.diag(np.linalg.inv(matrix))))
    without = errors(before)
    order = np.argsort(-gains, kind="stable")[:most].tolist()
    return tuple(Candidate(i, candidates[i], float(gains[i]) / (2 * np.log(2)), errors(after[i]), without) for i in order)


def scene_with(start: Scene, values: dict[str, np.ndarray]) -> Scene:
    """What a fit from `start` has found: the scene with other values of the named arrays."""
    select = lambda m: tuple(leaves_by_name(m.scene)[name] for name in values)
    choose = lambda model: choose_unknowns(model, select, (Identity(),) * len(values))
    model = ExposedModel(start.current(), None)
    model = without_stale(model, choose(model))
    return choose(model).insert(model, [jnp.asarray(value) for value in values.values()]).scene


def _by_name(problem: Problem, names: Sequence[str], vector: np.ndarray) -> dict[str, np.ndarray]:
    values = problem.unknowns.values(problem.model)
    parts = np.split(vector, np.cumsum([value.size for value in values])[:-1])
    shaped = {n: part.reshape(np.shape(v)) for n, part, v in zip(problem.unknowns.names, parts, values, strict=True)}
    return {name: shaped[name] for name in names}


def _problem(known: Knowledge, settings: Settings) -> tuple[Problem, jax.Array]:
    """The fit again, at its end, and its values."""
    select = lambda m: tuple(leaves_by_name(m.scene)[name] for name in known.unknowns)
    model = ExposedModel(known.scene, None)
    fitted = sum(np.size(leaf) for leaf in select(model))
    if len(known.information) > fitted:
        model, without = ExposedModel(known.scene, jnp.asarray(known.exposure, jnp.result_type(float))), select
        select = lambda m: (*without(m), m.exposure)
    # Values may lie outside of their declared range, where the fit had transforms of its own.
    chosen = choose_unknowns(model, select, (Identity(),) * len(select(model)))
    problem = Problem(model, chosen, settings, SquaredError(), (), None, is_mostly_empty(known.scene, settings))
    return problem, jnp.concatenate([jnp.ravel(value) for value in chosen.values(model)])


class _Sparse(AbstractCamera):
    """A camera that sees one pixel of each square of `side` by `side` of a `dense` one."""

    world_from_camera: Affine
    remainder: Remainder
    dense: AbstractCamera
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    side: int = eqx.field(static=True)

    @classmethod
    def of(cls, dense: AbstractCamera, side: int) -> "_Sparse":
        width, height = -(-dense.width // side), -(-dense.height // side)
        pose = {"world_from_camera": dense.world_from_camera, "remainder": dense.remainder}
        return cls(**pose, dense=dense, width=width, height=height, side=side)

    def rays_ahead(self, pixels: Int[Array, "rays"], ahead: Scalar) -> tuple[Triple, Triple, Float[Array, "rays"]]:
        dense = eqx.tree_at(lambda c: (c.world_from_camera, c.remainder), self.dense, (self.world_from_camera, self.remainder))
        middle = lambda k, n: jnp.minimum(k * self.side + self.side // 2, n - 1)
        row, column = jnp.divmod(pixels, self.width)
        return dense.rays_ahead(middle(row, dense.height) * dense.width + middle(column, dense.width), ahead)


def _information(
    problem: Problem, values: jax.Array, index: int, camera: AbstractCamera, pixels: int
) -> Float[np.ndarray, "unknowns unknowns"]:
    """`sum J^T J` over the pixels of a view."""
    count = camera.width * camera.height
    if count > pixels:
        camera = _Sparse.of(camera, int(np.ceil(np.sqrt(count / pixels))))
    nothing: list[Any] = [np.zeros((camera.height, camera.width, 3), values.dtype)]
    try:
        rays = observe(problem.model.scene, [camera], nothing, None, problem.settings)
    except ValueError as error:
        raise ValueError(f"candidate {index}: {error}") from error
    lit = light_tangents(problem, values)
    tiles = (normal_equations(problem, values, rays, i, 1, lit) for i in range(rays.tile_count()))
    return np.sum([np.asarray(tile.matrix, np.float64) for tile in tiles], axis=0) * count / (camera.width * camera.height)


def best_of(result: FitResult) -> Candidate | None:
    """The best of default candidates, `None` for a fit of voxels or cameras, and where these do not see the volume, as through a clipping
    box."""
    if result.information is None or not result.cameras:
        return None
    try:
        return ranked(Knowledge.of(result), around(result.scene, result.cameras), result.settings, most=1)[0]
    except ValueError:
        return None
