"""The functions that solvers call, over the rays of one fit."""

import functools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.execution.devices import everywhere, shares
from jvr.fitting.continuation import Quadratic
from jvr.fitting.identifiability import Identifiability, Scores, identifiability
from jvr.fitting.losses import DSSIM, SquaredError
from jvr.fitting.normal_equations import Normal, light_tangents, normal_equations, prior_expansion, scored
from jvr.fitting.objective import image_value, residuals, value
from jvr.fitting.observations import Observations
from jvr.fitting.problem import Problem, prior
from jvr.fitting.solvers import Functions, Limits
from jvr.model.camera import AbstractCamera
from jvr.model.ranges import UnitVector
from jvr.types import Scalar

# The first level of a least-squares solver takes at most every so-manieth ray ...
MOST_THINNING = 16
# ... and at least so many residuals for each unknown.
LEAST_RESIDUALS = 24
# Root mean square of the rounding of pictures, in units of the number format's epsilon and of their own.
ROUNDING = 16


class ValueFunction(eqx.Module):
    """The objective as Optimistix calls it."""

    problem: Problem
    tiles: Observations
    total: Scalar

    def __call__(self, unconstrained: Float[Array, "unknowns"], args: None) -> tuple[Scalar, None]:
        return value(self.problem, unconstrained, self.tiles, self.total), None


class ImageValueFunction(eqx.Module):
    """The objective of a loss over whole images."""

    problem: Problem
    cameras: tuple[AbstractCamera, ...]
    images: tuple[Array, ...]

    def __call__(self, unconstrained: Float[Array, "unknowns"], args: None) -> tuple[Scalar, None]:
        return image_value(self.problem, unconstrained, self.cameras, self.images), None


class ResidualFunction(eqx.Module):
    """`residuals` as Optimistix calls them."""

    problem: Problem
    tiles: Observations
    total: Scalar

    def __call__(self, unconstrained: Float[Array, "unknowns"], args: None) -> tuple[Float[Array, "residuals"], None]:
        return residuals(self.problem, unconstrained, self.tiles, self.total), None


class Evaluator:
    """A problem and its observations, ready for a solver; everything that is large lives here once."""

    def __init__(self, problem: Problem, observations: Observations, cameras: Sequence[AbstractCamera], images: Any):
        self.problem = problem
        self.observations = observations
        # A level takes every so-manieth ray.
        self.levels = _levels(problem, observations)
        self.sums = tuple(_sums(observations, every) for every in self.levels)
        self.functions = self._functions(cameras, images)

    def expand(self, level: int, unconstrained: Float[Array, "unknowns"]) -> tuple[float, Normal]:
        """The objective at `unconstrained`, over the rays of a level, and the normal equations in the unknowns' own values."""
        values = self.problem.unknowns.values_from_unconstrained(jnp.asarray(unconstrained), self.problem.model)
        normal, total = self._sum(values, self.levels[level]), self.sums[level].residuals
        prior, _, _ = self._prior(values)
        # Per residual, so that levels with different numbers of rays have the same scale.
        normal = jax.tree.map(lambda x: x / total, normal)
        return float(normal.loss) + float(prior), normal

    def quadratic(self, unconstrained: np.ndarray, normal: Normal) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Gauss-Newton matrix of the objective in unconstrained space."""
        unknowns, model = self.problem.unknowns, self.problem.model
        _, of_prior, curvature = self._prior(unknowns.values_from_unconstrained(jnp.asarray(unconstrained), model))
        gradient, matrix = 2 * normal.vector + of_prior, 2 * normal.matrix + curvature
        slope = np.asarray(_slope(unknowns, model, jnp.asarray(unconstrained)), np.float64)
        return slope.T @ gradient, slope.T @ matrix @ slope

    def limits(self, unconstrained: np.ndarray) -> Limits:
        """Where the unknowns may go from a point of unconstrained space."""
        return Limits(*self.problem.unknowns.limits(self.problem.model, unconstrained))

    def _rounding(self) -> float:
        """The mean squared error of pictures that differ by the rounding of sums along rays alone."""
        sums = self.sums[-1]
        return (ROUNDING * float(jnp.finfo(self.observations.target.dtype).eps)) ** 2 * sums.squares / sums.residuals

    def solution(self, values: Float[Array, "unknowns"]) -> tuple[Identifiability, Quadratic]:
        """Standard errors at the solution, and the objective about it, over all rays."""
        normal, scores = self._scored(values, self._squares)
        matrix, epsilon = normal.matrix + self._gauge(values, np.diag(normal.matrix)), float(jnp.finfo(values.dtype).eps)
        known = identifiability(matrix, float(normal.squares), self.sums[-1].measurements, epsilon, scores)
        prior, slope, curvature = self._prior(values)
        total = self.sums[-1].residuals
        loss, gradient, matrix = (x / total for x in (normal.loss, 2 * normal.vector, 2 * normal.matrix))
        return known, Quadratic(float(loss + prior), gradient + slope, matrix + curvature, self._rounding())

    def objective(self, values: np.ndarray) -> float:
        """The objective as `solution` has it, of the unknowns' own values."""
        at = jnp.asarray(values, self.observations.target.dtype)
        return float(self._sum(at, 1, self._squares).loss) / self.sums[-1].residuals + float(self._prior(at)[0])

    @property
    def _squares(self) -> Problem:
        """The problem as least squares: a loss over whole images has no rows."""
        return self.problem.least_squares() if isinstance(self.problem.loss, DSSIM) else self.problem

    def _prior(self, values: Float[Array, "unknowns"]) -> tuple[Any, Any, Any]:
        """Value, gradient and Hessian of the priors in float64."""
        if not self.problem.priors:
            return 0.0, 0.0, 0.0
        prior, slope, curvature = (np.asarray(x, np.float64) for x in prior_expansion(self.problem, values))
        return prior, slope, curvature

    def _gauge(self, values: Float[Array, "unknowns"], diagonal: np.ndarray) -> np.ndarray:
        """What fixes the length of directions: it is 1 by convention, and no image says anything about it."""
        fixed, begin = np.zeros((values.size,) * 2), 0
        unknowns = self.problem.unknowns
        for declared, part in zip(unknowns.ranges, unknowns.split(values, self.problem.model), strict=True):
            if isinstance(declared, UnitVector):
                columns = slice(begin, begin + part.size)
                fixed[columns, columns] = diagonal[columns].max() * np.outer(part, part)
            begin += part.size
        return fixed

    def psnr(self, unconstrained: np.ndarray, loss: float, normal: Normal | None) -> float:
        """Decibels relative to radiance 1. Where the objective is neither the mean squared error, but for priors, nor what a solver knows,
        that costs a march of its own."""
        if normal is not None:
            mean = float(normal.squares)
        elif isinstance(self.problem.loss, SquaredError):
            mean = loss - (float(_prior_value(self.problem, jnp.asarray(unconstrained))) if self.problem.priors else 0.0)
        else:
            total = jnp.asarray(self.sums[-1].residuals)
            mean = float(_mean_squares(self.problem.least_squares(), jnp.asarray(unconstrained), self.observations, total))
        return float(-10 * np.log10(max(mean, 1e-20)))

    def fraction(self, level: int) -> float:
        """Of all rays, how many a level takes."""
        every = self.levels[level]
        return self.observations.tile_count(every) / self.observations.tile_count()

    def _sum(self, values: Float[Array, "unknowns"], every: int, problem: Problem | None = None) -> Normal:
        """The normal equations of every `every`-th ray, all chunks together, in float64."""
        problem, observations = problem or self.problem, self.observations
        around = light_tangents(problem, values)
        tiles = range(observations.tile_count(every))
        return _added(normal_equations(problem, values, observations, i, every, around) for i in tiles)

    def _scored(self, values: Float[Array, "unknowns"], problem: Problem) -> tuple[Normal, Scores]:
        """The normal equations of all rays, and the sums that tell misfit from noise."""
        observations, around, blocks = self.observations, light_tangents(problem, values), self.sums[-1].blocks
        return _added(scored(problem, values, observations, i, blocks, around) for i in range(observations.tile_count()))

    def _functions(self, cameras: Sequence[AbstractCamera], images: Any) -> Functions:
        total = jnp.asarray(self.sums[-1].residuals)
        if isinstance(self.problem.loss, DSSIM):
            function = ImageValueFunction(self.problem, tuple(cameras), tuple(jnp.asarray(image) for image in images))
        else:
            function = ValueFunction(self.problem, self.observations, total)
        residuals = ResidualFunction(self.problem, self.observations, total)
        levels = tuple(functools.partial(self.expand, i) for i in range(len(self.levels)))
        return Functions(function, residuals, levels, self.limits, self.quadratic, self._rounding())


def _added(parts: Iterable[Any]) -> Any:
    """Sums over tiles, in float64."""
    total = None
    for part in parts:
        part = jax.tree.map(lambda x: np.asarray(x, np.float64), part)
        total = part if total is None else jax.tree.map(np.add, total, part)
    return total


class Sums(NamedTuple):
    """Over the rays of a level: `residuals`, their weighted number; `squares` of the targets, weighted; how many `measurements` count;
    `blocks` of pixels in all images."""

    residuals: float
    squares: float
    measurements: int
    blocks: int


def _sums(observations: Observations, every: int) -> Sums:
    weight, squares, counted, last = _weights(observations, every)
    total = max(3 * float(weight), float(np.finfo(np.float32).tiny))
    return Sums(total, float(squares), 3 * int(counted), int(last) + 1)


@functools.partial(jax.jit, static_argnums=1)
def _weights(observations: Observations, every: int) -> tuple[Array, Array, Array, Array]:
    each = observations.size // shares()
    taken = (jnp.arange(observations.size) % each % every == 0).reshape(observations.weight.shape)
    weight = jnp.where(taken, observations.weight, 0)
    squares = jnp.sum(weight[..., None] * jnp.square(observations.target))
    return everywhere((jnp.sum(weight), squares, jnp.sum(weight > 0), jnp.max(observations.block)))


def _levels(problem: Problem, observations: Observations) -> tuple[int, ...]:
    """All rays, after a subset that still over-determines the unknowns where that is much smaller."""
    unknowns = sum(v.size for v in problem.unknowns.values(problem.model))
    every = min(MOST_THINNING, 3 * observations.size // max(LEAST_RESIDUALS * unknowns, observations.chunk))
    # Where a subset fills as many tiles it takes as long.
    saves = lambda: problem.model.views is None or observations.tile_count(every) < observations.tile_count()
    return (every, 1) if every >= 2 and saves() else (1,)


_mean_squares = eqx.filter_jit(value)


@eqx.filter_jit
def _prior_value(problem: Problem, unconstrained: Array) -> Any:
    return prior(problem, problem.unknowns.model_from_unconstrained(problem.model, unconstrained))


@eqx.filter_jit
def _slope(unknowns: Any, model: Any, unconstrained: Array) -> Array:
    return jax.jacfwd(lambda r: unknowns.values_from_unconstrained(r, model))(unconstrained)
