"""The functions that solvers call, over the rays of one fit."""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.execution.devices import on_devices
from jvr.fitting.identifiability import Identifiability, identifiability
from jvr.fitting.losses import DSSIM, SquaredError
from jvr.fitting.normal_equations import Normal, light_tangents, normal_equations, prior_expansion
from jvr.fitting.objective import image_value, residuals, value
from jvr.fitting.observations import Observations
from jvr.fitting.problem import Problem
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

    def __init__(self, problem: Problem, observations: Observations, chunk: int, cameras: Sequence[AbstractCamera], images: Any):
        self.problem = problem
        self.chunk = chunk
        self.rays = observations.size
        self.total = _total(observations)
        self.levels = _levels(problem, observations, chunk)
        self.tiles = jax.tree.map(lambda x: on_devices(x.reshape(-1, chunk, *x.shape[1:])), observations)
        self.functions = self._functions(tuple(cameras), tuple(jnp.asarray(image) for image in images))

    def expand(self, level: int, unconstrained: Float[Array, "unknowns"]) -> tuple[float, Normal]:
        """The objective at `unconstrained`, over the rays of a level, and the normal equations in the unknowns' own values."""
        values = self.problem.unknowns.values_from_unconstrained(jnp.asarray(unconstrained), self.problem.model)
        observations = self.levels[level]
        normal = self._sum(values, observations)
        total = _total(observations)
        prior, _, _ = prior_expansion(self.problem, values) if self.problem.priors else (0.0, None, None)
        # Per residual, so that levels with different numbers of rays have the same scale.
        normal = jax.tree.map(lambda x: x / total, normal)
        return float(normal.loss) + float(prior), normal

    def quadratic(self, unconstrained: np.ndarray, normal: Normal) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Gauss-Newton matrix of the objective in unconstrained space."""
        unknowns, model = self.problem.unknowns, self.problem.model
        gradient, matrix = 2 * normal.vector, 2 * normal.matrix
        if self.problem.priors:
            _, prior_gradient, prior_matrix = prior_expansion(
                self.problem, unknowns.values_from_unconstrained(jnp.asarray(unconstrained), model)
            )
            gradient = gradient + np.asarray(prior_gradient, np.float64)
            matrix = matrix + np.asarray(prior_matrix, np.float64)
        slope = np.asarray(_slope(unknowns, model, jnp.asarray(unconstrained)), np.float64)
        return slope.T @ gradient, slope.T @ matrix @ slope

    def limits(self, unconstrained: np.ndarray) -> Limits:
        """Where the unknowns may go from a point of unconstrained space."""
        return Limits(*self.problem.unknowns.limits(self.problem.model, unconstrained))

    def _rounding(self) -> float:
        """The mean squared error of pictures that differ by the rounding of sums along rays alone."""
        targets, weight = self.levels[-1].target, self.levels[-1].weight
        mean = float(jnp.sum(weight[:, None] * jnp.square(targets))) / self.total
        return (ROUNDING * float(jnp.finfo(targets.dtype).eps)) ** 2 * mean

    def identifiability(self, values: Float[Array, "unknowns"]) -> Identifiability:
        """Standard errors at the solution, over all rays."""
        problem = self.problem
        if isinstance(problem.loss, DSSIM):
            # A loss over whole images has no residual variance: the errors are those that its solution has as least squares.
            problem = problem.least_squares()
        normal = self._sum(values, self.levels[-1], problem)
        matrix = normal.matrix + self._gauge(values, np.diag(normal.matrix))
        measurements = 3 * int(jnp.sum(self.levels[-1].weight > 0))
        return identifiability(matrix, float(normal.squares), measurements, float(jnp.finfo(values.dtype).eps))

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
        """Decibels relative to radiance 1. Where neither the objective nor what a solver knows is the mean squared error, that costs
        a march of its own."""
        if normal is not None:
            mean = float(normal.squares)
        elif isinstance(self.problem.loss, SquaredError) and not self.problem.priors:
            mean = loss
        else:
            mean = float(
                _mean_squares(self.problem.least_squares(), jnp.asarray(unconstrained), self.tiles, jnp.asarray(self.total))
            )
        return float(-10 * np.log10(max(mean, 1e-20)))

    def _sum(self, values: Float[Array, "unknowns"], observations: Observations, problem: Problem | None = None) -> Normal:
        """The normal equations of all chunks together, in float64."""
        problem = problem or self.problem
        around = light_tangents(problem, values)
        parts = [normal_equations(problem, values, tile, around) for tile in observations.tiles(self.chunk)]
        return jax.tree.map(lambda *p: np.sum([np.asarray(x, np.float64) for x in p], axis=0), *parts)

    def _functions(self, cameras: tuple[AbstractCamera, ...], images: tuple[Array, ...]) -> Functions:
        if isinstance(self.problem.loss, DSSIM):
            function = ImageValueFunction(self.problem, cameras, images)
        else:
            function = ValueFunction(self.problem, self.tiles, jnp.asarray(self.total))
        residuals = ResidualFunction(self.problem, self.tiles, jnp.asarray(self.total))
        levels = tuple(functools.partial(self.expand, i) for i in range(len(self.levels)))
        return Functions(function, residuals, levels, self.limits, self.quadratic, self._rounding())


def _total(observations: Observations) -> float:
    """Weighted number of residuals."""
    return max(3 * float(jnp.sum(observations.weight)), float(np.finfo(np.float32).tiny))


def _levels(problem: Problem, observations: Observations, chunk: int) -> tuple[Observations, ...]:
    """All observations, after a subset that still over-determines the unknowns where that is much smaller."""
    unknowns = sum(v.size for v in problem.unknowns.values(problem.model))
    every = min(MOST_THINNING, 3 * observations.size // max(LEAST_RESIDUALS * unknowns, chunk))
    return (observations,) if every < 2 else (observations.subsampled(every, chunk), observations)


_mean_squares = eqx.filter_jit(value)


@eqx.filter_jit
def _slope(unknowns: Any, model: Any, unconstrained: Array) -> Array:
    return jax.jacfwd(lambda r: unknowns.values_from_unconstrained(r, model))(unconstrained)
