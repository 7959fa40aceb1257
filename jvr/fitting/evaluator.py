"""The functions that solvers call, over the rays of one fit."""

import functools
import operator
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.execution.devices import everywhere, shares
from jvr.fitting.continuation import Quadratic
from jvr.fitting.groups import Group
from jvr.fitting.identifiability import Identifiability, Scores, identifiability
from jvr.fitting.losses import DSSIM, SquaredError
from jvr.fitting.normal_equations import LightTangents, Normal, light_tangents, normal_equations, prior_expansion, scored
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


# Problem, values, observations and the index of a tile.
Tile = tuple[Problem, Float[Array, "unknowns"], Observations, int]


class ValueFunction(eqx.Module):
    """The objective as Optimistix calls it."""

    groups: tuple[Group, ...]
    total: Scalar

    def __call__(self, unconstrained: Float[Array, "unknowns"], args: None) -> tuple[Scalar, None]:
        values = [value(group.problem, unconstrained, group.observations, self.total) for group in self.groups]
        return functools.reduce(operator.add, values), None


class ImageValueFunction(eqx.Module):
    """The objective of a loss over whole images."""

    problem: Problem
    cameras: tuple[AbstractCamera, ...]
    images: tuple[Array, ...]

    def __call__(self, unconstrained: Float[Array, "unknowns"], args: None) -> tuple[Scalar, None]:
        return image_value(self.problem, unconstrained, self.cameras, self.images), None


class ResidualFunction(eqx.Module):
    """`residuals` as Optimistix calls them."""

    groups: tuple[Group, ...]
    total: Scalar

    def __call__(self, unconstrained: Float[Array, "unknowns"], args: None) -> tuple[Float[Array, "residuals"], None]:
        parts = [residuals(group.problem, unconstrained, group.observations, self.total) for group in self.groups]
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts), None


class Evaluator:
    """The groups of a fit, ready for a solver; everything that is large lives here once. `problem`: the first's, for what they share."""

    def __init__(self, groups: tuple[Group, ...], cameras: Sequence[AbstractCamera], images: Any):
        self.groups = groups
        self.problem = groups[0].problem
        self.dtype = groups[0].observations.target.dtype
        # A level takes every so-manieth ray.
        self.levels = _levels(groups)
        self.sums = tuple(_sums(groups, every) for every in self.levels)
        self.functions = self._functions(cameras, images)

    def settle(self, problem: Problem) -> None:
        """Takes the problem at the end of its iteration in the place of that of the first group."""
        self.problem, self.groups = problem, (Group(problem, self.groups[0].observations), *self.groups[1:])

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
        return (ROUNDING * float(jnp.finfo(self.dtype).eps)) ** 2 * sums.squares / sums.residuals

    def solution(self, values: Float[Array, "unknowns"]) -> tuple[Identifiability, Quadratic]:
        """Standard errors at the solution, and the objective about it, over all rays."""
        normal, scores = self._scored(values)
        matrix, epsilon = normal.matrix + self._gauge(values, np.diag(normal.matrix)), float(jnp.finfo(values.dtype).eps)
        known = identifiability(matrix, float(normal.squares), self.sums[-1].measurements, epsilon, scores)
        prior, slope, curvature = self._prior(values)
        total = self.sums[-1].residuals
        loss, gradient, matrix = (x / total for x in (normal.loss, 2 * normal.vector, 2 * normal.matrix))
        return known, Quadratic(float(loss + prior), gradient + slope, matrix + curvature, self._rounding())

    def objective(self, values: np.ndarray) -> float:
        """The objective as `solution` has it, of the unknowns' own values."""
        at = jnp.asarray(values, self.dtype)
        return float(self._sum(at, 1).loss) / self.sums[-1].residuals + float(self._prior(at)[0])

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
            at, total = jnp.asarray(unconstrained), jnp.asarray(self.sums[-1].residuals)
            each = [_mean_squares(g.problem.least_squares(), at, g.observations, total) for g in self.groups]
            mean = float(functools.reduce(operator.add, each))
        return float(-10 * np.log10(max(mean, 1e-20)))

    def fraction(self, level: int) -> float:
        """Of all rays, how many a level takes."""
        count = lambda every: sum(group.observations.tile_count(every) for group in self.groups)
        return count(self.levels[level]) / count(1)

    def _tiles(self, values: Float[Array, "unknowns"], every: int) -> Iterator[tuple[Tile, LightTangents | None]]:
        """Each tile of each group, and its light. A loss over whole images has no rows; in its place are squares."""
        for group in self.groups:
            problem = group.problem.least_squares() if isinstance(group.problem.loss, DSSIM) else group.problem
            around = light_tangents(problem, values)
            for index in range(group.observations.tile_count(every)):
                yield (problem, values, group.observations, index), around

    def _sum(self, values: Float[Array, "unknowns"], every: int) -> Normal:
        """The normal equations of every `every`-th ray, all chunks together, in float64."""
        return _added(normal_equations(*tile, every, around) for tile, around in self._tiles(values, every))

    def _scored(self, values: Float[Array, "unknowns"]) -> tuple[Normal, Scores]:
        """The normal equations of all rays, and the sums that tell misfit from noise."""
        blocks = self.sums[-1].blocks
        return _added(scored(*tile, blocks, around) for tile, around in self._tiles(values, 1))

    def _functions(self, cameras: Sequence[AbstractCamera], images: Any) -> Functions:
        total = jnp.asarray(self.sums[-1].residuals)
        if isinstance(self.problem.loss, DSSIM):
            function = ImageValueFunction(self.problem, tuple(cameras), tuple(jnp.asarray(image) for image in images))
        else:
            function = ValueFunction(self.groups, total)
        levels = tuple(functools.partial(self.expand, i) for i in range(len(self.levels)))
        return Functions(function, ResidualFunction(self.groups, total), levels, self.limits, self.quadratic, self._rounding())


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


def _sums(groups: tuple[Group, ...], every: int) -> Sums:
    weight, squares, counted, last = zip(*(_weights(group.observations, every) for group in groups), strict=True)
    total = max(3 * sum(map(float, weight)), float(np.finfo(np.float32).tiny))
    return Sums(total, sum(map(float, squares)), 3 * sum(map(int, counted)), max(map(int, last)) + 1)


@functools.partial(jax.jit, static_argnums=1)
def _weights(observations: Observations, every: int) -> tuple[Array, Array, Array, Array]:
    each = observations.size // shares()
    taken = (jnp.arange(observations.size) % each % every == 0).reshape(observations.weight.shape)
    weight = jnp.where(taken, observations.weight, 0)
    squares = jnp.sum(weight[..., None] * jnp.square(observations.target))
    return everywhere((jnp.sum(weight), squares, jnp.sum(weight > 0), jnp.max(observations.block)))


def _levels(groups: tuple[Group, ...]) -> tuple[int, ...]:
    """All rays, after a subset that still over-determines the unknowns where that is much smaller."""
    problem, observations = groups[0].problem, [group.observations for group in groups]
    unknowns = sum(v.size for v in problem.unknowns.values(problem.model))
    tiles = lambda every: sum(o.tile_count(every) for o in observations)
    rays, together = sum(o.size for o in observations), sum(o.chunk for o in observations)
    every = min(MOST_THINNING, 3 * rays // max(LEAST_RESIDUALS * unknowns, together))
    # Where a subset fills as many tiles it takes as long.
    saves = lambda: (problem.model.views is None and len(groups) == 1) or tiles(every) < tiles(1)
    return (every, 1) if every >= 2 and saves() else (1,)


_mean_squares = eqx.filter_jit(value)


@eqx.filter_jit
def _prior_value(problem: Problem, unconstrained: Array) -> Any:
    return prior(problem, problem.unknowns.model_from_unconstrained(problem.model, unconstrained))


@eqx.filter_jit
def _slope(unknowns: Any, model: Any, unconstrained: Array) -> Array:
    return jax.jacfwd(lambda r: unknowns.values_from_unconstrained(r, model))(unconstrained)
