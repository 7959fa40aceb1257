"""Standard errors of single voxels, of which there are too many for a Gauss-Newton matrix."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse.linalg import LinearOperator, cg

from jvr.execution.devices import everywhere, on_devices, over_rays
from jvr.fitting.continuation import UNDETERMINED
from jvr.fitting.evaluator import Evaluator
from jvr.fitting.groups import Group
from jvr.fitting.losses import AbstractPrior, SquaredError
from jvr.fitting.objective import residual
from jvr.fitting.observations import Observations, observe, prepare_in_fit
from jvr.fitting.problem import Problem, prior
from jvr.fitting.reach import known_background
from jvr.fitting.result import FitResult
from jvr.fitting.targets import targets_of
from jvr.fitting.unknowns import ExposedModel, choose_unknowns
from jvr.model.camera import AbstractCamera
from jvr.model.transfer import AbstractTable
from jvr.rendering.settings import Settings

VOXELS = "volume.values"
# Vectors that are multiplied at once, for which rays are marched once.
TOGETHER = 8
# Probes of the diagonal that preconditions, and of the number of voxels that pictures determine.
FEW = 8
# Relative residual at which a linear system counts as solved, and its most iterations.
SOLVED, MOST_ITERATIONS = 1e-4, 1000


class VoxelErrors(NamedTuple):
    """What `jvr.voxel_errors` returns.

    - `errors`: standard errors of the stored voxels, `(x, y, z)`, or one for each that was asked for; infinite where not determined.
    - `uncertainty`: the relative standard error of these estimates (median), by the spread of the probes; 0 for single voxels.
    - `noise`: standard deviation of a pixel of weight 1.
    - `freedom`: how many numbers about the voxels the pictures (not the priors) determine, `trace(A^-1 J^T W J)`.
    - `iterations`: of conjugate gradients; `converged`: whether all systems were solved.
    """

    errors: np.ndarray
    uncertainty: float
    noise: float
    freedom: float
    iterations: int
    converged: bool


def voxel_errors(
    result: FitResult,
    cameras: Sequence[AbstractCamera],
    images: Any,
    settings: Settings | None = None,
    *,
    weights: Sequence[Any] | None = None,
    priors: Sequence[AbstractPrior] = (),
    noise: float | None = None,
    voxels: Sequence[tuple[int, int, int]] | None = None,
    probes: int = 64,
) -> VoxelErrors:
    """Standard errors of fitted voxels: square roots of the diagonal of `s^2 A^-1`, with `A = J^T W J + P`.

    Neither `A` nor its inverse is formed. `A v` is a march in forward mode and one in reverse, `A^-1 v` conjugate gradients with them,
    preconditioned by the diagonal. The diagonal of the inverse is the mean of `z * (A^-1 z)` over vectors `z` of random signs (Bekas,
    Kokiopoulou and Saad 2007), whose relative error falls with the square root of their number; that of a few `voxels` is exact, a
    system each.

    `P` is the curvature of `priors`, times half the number of residuals, as the objective of a fit weighs them: with them the errors are
    those of the posterior, by which a prior counts as knowledge. Without, those of the pictures alone. In both a voxel counts as uncertain
    by the range of the scene's table (else of the voxels) before any picture: without that `A` would be singular where nothing is seen.
    An error above a quarter of that range says that the pictures do not determine the voxel, and is infinite.

    Other unknowns of the fit count as known, residuals as independent; bounds, robust losses and lights of single views play no part.

    **Arguments:** `result`: of a fit of the voxels; `cameras`, `images`, `weights`, `priors`: those of the fit;
    `settings`: by default its own; `noise`: the
    standard deviation of a pixel of weight 1, by default from the residuals, `s^2 = sum w r^2 / (residuals - freedom)`;
    `voxels`: indices, by default all; `probes`: how many vectors `z`.
    **Raises** `ValueError` where the voxels were not fitted, indices lie outside, and what `jvr.fit` raises.
    """
    problem, shape = _problem(result, settings or result.settings, tuple(priors)), result.scene.volume.shape
    places = np.arange(np.prod(shape)) if voxels is None else _places(voxels, shape)
    system, rng = _System(problem, cameras, images, weights, noise), np.random.default_rng(0)
    count = max(probes, 2) if voxels is None else FEW if noise is None else 0
    signs = rng.choice([-1.0, 1.0], (count, system.size))
    found = system.solve(signs)
    if voxels is None:
        samples = signs * found
        variances, spread = samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(count)
    else:
        units = np.zeros((places.size, system.size))
        units[np.arange(places.size), places] = 1
        variances, spread = system.solve(units)[np.arange(places.size), places], np.zeros(places.size)
    freedom = system.freedom(signs, found)
    deviation = float(np.sqrt(system.squares / max(system.measurements - freedom, 1))) if noise is None else noise
    # An entry of the inverse is at least the inverse of the diagonal, which few signs know to a factor: so no estimate is negative.
    variances = np.maximum(variances, 0.25 / system.diagonal[places])
    errors = deviation * np.sqrt(variances)
    known = (system.seen[places] | bool(priors)) & (errors <= UNDETERMINED * system.plausible)
    relative = float(np.median((spread / (2 * variances))[known])) if known.any() else 0.0
    errors = np.where(known, errors, np.inf)
    errors = errors.reshape(shape) if voxels is None else errors
    return VoxelErrors(errors, relative, deviation, freedom, system.iterations, system.converged)


class _System:
    """`A = J^T W J + P` and systems of linear equations with it, over the voxels in their own unit."""

    def __init__(self, problem: Problem, cameras: Sequence[AbstractCamera], images: Any, weights: Any, noise: float | None):
        model = problem.model
        targets = targets_of(cameras, images, weights, known_background(model, problem.unknowns))
        self.problem = problem
        self.observations = observe(model.scene, cameras, *targets, problem.settings)
        self.values = problem.unknowns.unconstrained_from_model(model)
        evaluator = Evaluator((Group(problem.least_squares(), self.observations),), cameras, targets.images)
        self.size, self.plausible = self.values.size, _plausible(model)
        self.measurements = evaluator.sums[-1].measurements
        self.squares = float(evaluator.functions.value(self.values, None)[0]) * evaluator.sums[-1].residuals
        # Priors are added to a mean over residuals, `A` is that of a sum of half their squares.
        self.strength = evaluator.sums[-1].residuals / 2
        variance = self.squares / self.measurements if noise is None else noise**2
        self.ridge = max(variance, evaluator.functions.rounding) / self.plausible**2
        of_pictures = self._diagonal_of_pictures()
        self.seen = of_pictures > 0
        self.diagonal = of_pictures + self._diagonal_of_priors() + self.ridge
        self.iterations, self.converged = 0, True

    def solve(self, vectors: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
        """`A^-1 v` of each vector, a few together as one system."""
        found = np.zeros_like(vectors)
        for i in range(0, len(vectors), TOGETHER):
            found[i : i + TOGETHER] = self._solve(vectors[i : i + TOGETHER])
        return found

    def freedom(self, signs: Float[np.ndarray, "k n"], solved: Float[np.ndarray, "k n"]) -> float:
        """`trace(A^-1 J^T W J)`, of vectors of random signs and `A^-1` times them; NaN without any."""
        if not len(signs):
            return float("nan")
        return self.size - float(np.mean(np.sum(solved * self._beside_pictures(signs), axis=1)))

    def _solve(self, vectors: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
        def product(flat: np.ndarray) -> np.ndarray:
            block = flat.reshape(vectors.shape)
            of_pictures = _product(self.problem, self.values, self.observations, jnp.asarray(block, self.values.dtype))
            return (np.asarray(of_pictures, np.float64) + self._beside_pictures(block)).ravel()

        def count(_: np.ndarray) -> None:
            self.iterations += 1

        square = (vectors.size, vectors.size)
        # Its constructor makes an object of another class, which type checkers do not follow.
        operator: Any = LinearOperator
        system = operator(square, matvec=product, dtype=np.float64)
        divided = operator(square, matvec=lambda x: (x.reshape(vectors.shape) / self.diagonal).ravel(), dtype=np.float64)
        found, info = cg(system, vectors.ravel(), rtol=SOLVED, maxiter=MOST_ITERATIONS, M=divided, callback=count)
        self.converged &= info == 0
        return found.reshape(vectors.shape)

    def _beside_pictures(self, vectors: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
        """`P v`, with what is known before any picture."""
        found = self.ridge * vectors
        if self.problem.priors:
            curved = [_curvature(self.problem, self.values, jnp.asarray(v, self.values.dtype)) for v in vectors]
            found = found + self.strength * np.asarray(curved, np.float64)
        return found

    def _diagonal_of_pictures(self) -> Float[np.ndarray, "n"]:
        """The mean of `(J^T W^1/2 u)^2` over vectors `u` of random signs, one for each residual: zero where no ray reads a voxel."""
        rng, total = np.random.default_rng(1), np.zeros(self.size)
        for _ in range(FEW):
            signs = on_devices(rng.choice([-1.0, 1.0], self.observations.target.shape).astype(self.values.dtype))
            total += np.square(np.asarray(_transposed(self.problem, self.values, self.observations, signs), np.float64))
        return total / FEW

    def _diagonal_of_priors(self) -> Float[np.ndarray, "n"]:
        """Exact where priors couple voxels with their neighbours alone: of every third along each axis, none is another's."""
        total, shape = np.zeros(self.size), self.problem.model.scene.volume.shape
        for i, j, k in itertools.product(range(3), repeat=3) if self.problem.priors else ():
            comb = np.zeros(shape)
            comb[i::3, j::3, k::3] = 1
            curved = _curvature(self.problem, self.values, jnp.asarray(comb.ravel(), self.values.dtype))
            total += self.strength * comb.ravel() * np.asarray(curved, np.float64)
        return np.maximum(total, 0)


def _problem(result: FitResult, settings: Settings, priors: tuple[AbstractPrior, ...]) -> Problem:
    """The fit of the voxels alone, at its end."""
    if VOXELS not in result.unknowns:
        raise ValueError(f"voxel_errors is for fits of {VOXELS}, and this one is of {', '.join(result.unknowns)}")
    model = ExposedModel(result.scene, jnp.asarray(result.exposure, jnp.result_type(float)))
    # Free, so that what a solver moves are the voxels themselves.
    chosen = choose_unknowns(model, lambda m: m.scene.volume.values)
    # Nothing is skipped: at the very scalar where extinction begins a voxel has a derivative.
    return Problem(model, chosen, settings, SquaredError(), priors, None)


def _plausible(model: ExposedModel) -> float:
    """How uncertain a stored voxel is before any picture: the range of the table, or of the voxels where there is none."""
    volume, transfer = model.scene.volume, model.scene.transfer
    if isinstance(transfer, AbstractTable):
        low, high = transfer.ends
        return float(jnp.abs((high - low) / volume.slope))
    return float(np.ptp(np.asarray(volume.values))) or 1.0


def _places(voxels: Sequence[tuple[int, int, int]], shape: tuple[int, int, int]) -> Int[np.ndarray, "k"]:
    """Indices of voxels one after the other."""
    indices = np.asarray(voxels)
    if indices.ndim != 2 or indices.shape[1] != 3 or indices.dtype.kind not in "iu":
        raise ValueError(f"voxels must be a list of indices (i, j, k), not {voxels!r:.60}")
    if np.any(indices < 0) or np.any(indices >= shape):
        raise ValueError(f"voxels must be inside of 0 ... {', '.join(str(n - 1) for n in shape)} along x, y, z")
    return np.asarray(np.ravel_multi_index(tuple(indices.T), shape))


@eqx.filter_jit
def _product(
    problem: Problem, values: Float[Array, "n"], observations: Observations, vectors: Float[Array, "k n"]
) -> Float[Array, "k n"]:
    """`J^T W J v` of each vector."""

    def share(shared: tuple[Problem, Array, Array], tiles: Observations) -> Array:
        problem, values, vectors = shared

        def add_tile(total: Array, tile: Observations) -> tuple[Array, None]:
            along, back = _derivatives(problem, values, tile)
            return total + jax.vmap(lambda v: back(tile.weight[:, None] * along(v)))(vectors), None

        return jax.lax.scan(add_tile, jnp.zeros_like(vectors), tiles)[0][None]

    return everywhere(jnp.sum(over_rays(share, (problem, values, vectors), observations), axis=0))


@eqx.filter_jit
def _transposed(
    problem: Problem, values: Float[Array, "n"], observations: Observations, signs: Float[Array, "*tiles rays 3"]
) -> Float[Array, "n"]:
    """`J^T W^1/2 u` of a vector of residuals."""

    def share(shared: tuple[Problem, Array], rays: tuple[Observations, Array]) -> Array:
        problem, values = shared

        def add_tile(total: Array, rays: tuple[Observations, Array]) -> tuple[Array, None]:
            tile, signs = rays
            return total + _derivatives(problem, values, tile)[1](jnp.sqrt(tile.weight)[:, None] * signs), None

        return jax.lax.scan(add_tile, jnp.zeros_like(values), rays)[0][None]

    return everywhere(jnp.sum(over_rays(share, (problem, values), (observations, signs)), axis=0))


def _derivatives(problem: Problem, values: Float[Array, "n"], tile: Observations) -> tuple[Any, Any]:
    """`J` and `J^T` of the residuals of a tile, `(rays, 3)`, as functions."""

    def residuals(values: Array) -> Array:
        model = problem.unknowns.model_from_unconstrained(problem.model, values)
        prepared = prepare_in_fit(model.scene, problem.settings, problem.skips)
        return jnp.stack(residual(problem, model, tile, prepared), axis=-1)

    _, along = jax.linearize(residuals, values)
    back = jax.linear_transpose(along, values)
    return along, lambda cotangent: back(cotangent)[0]


@eqx.filter_jit
def _curvature(problem: Problem, values: Float[Array, "n"], vector: Float[Array, "n"]) -> Float[Array, "n"]:
    """The Hessian of the priors times a vector."""

    def of_values(values: Array) -> Array:
        return jnp.asarray(prior(problem, problem.unknowns.model_from_unconstrained(problem.model, values)), values.dtype)

    return jax.jvp(jax.grad(of_values), (values,), (vector,))[1]
