"""Values that the images do not determine, continued smoothly from those that they do.

Where the Gauss-Newton matrix has (nearly) no say an iteration leaves whatever it came by. Of all values that explain the images as well,
those are taken whose neighbours in a table differ least (a first-order Tikhonov regularisation by the discrepancy principle: Morozov 1966;
Constable, Parker and Constable 1987 call it Occam's inversion): linear between determined entries, constant beyond the last.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jvr.fitting.least_squares import Model
from jvr.fitting.problem import Problem
from jvr.model.ranges import Interval

# A value is not determined where its standard error exceeds this fraction of how large it may plausibly be.
UNDETERMINED = 0.25
# What the continuation may add to the objective: 0.01 dB of its error.
MOST_INCREASE = 10**0.001 - 1
# The model of the objective is quadratic; where the objective itself grows by more, less is tried, so many times.
TRIALS = 4
BISECTIONS = 20

Values = Float[np.ndarray, "unknowns"]


class Quadratic(NamedTuple):
    """The objective about the end of a fit, in the unknowns' own values: its value, gradient, Gauss-Newton matrix, and what its rounding
    is."""

    loss: float
    gradient: Values
    matrix: Float[np.ndarray, "unknowns unknowns"]
    rounding: float

    def increase(self, move: Values) -> float:
        return float(self.gradient @ move + 0.5 * move @ self.matrix @ move)


class _Roughness(NamedTuple):
    """`|differences v|^2` of an array's entries along its first axis, and which values are free to change."""

    differences: Float[np.ndarray, "pairs unknowns"]
    free: Bool[np.ndarray, "unknowns"]
    lower: Values
    upper: Values


def are_determined(problem: Problem, values: Values, errors: Values) -> Bool[np.ndarray, "unknowns"]:
    """Which values have a standard error well below how large they may plausibly be."""
    return errors <= UNDETERMINED * problem.unknowns.plausible(problem.model, values)


def continued(
    problem: Problem, values: Values, errors: Values, around: Quadratic, objective: Callable[[Values], float]
) -> tuple[Values, Bool[np.ndarray, "unknowns"]]:
    """The values with those that are not determined continued from their neighbours, and which these are.

    **Arguments:** `values`, `errors`: at the end of a fit, with their standard errors; `around`: the quadratic model of the objective
    there; `objective` itself, of values. It grows by at most `MOST_INCREASE`, or by the rounding of pictures; where nothing of the kind
    does so, the values stay.
    """
    rough = _roughness(problem, values, errors)
    allowed = max(MOST_INCREASE * around.loss, around.rounding)
    budget = allowed
    for _ in range(TRIALS if rough.free.any() else 0):
        moved = values + _smoothest(rough, values, around, budget)
        if objective(moved) - around.loss <= allowed:
            return moved, rough.free
        budget /= 4
    return values, np.zeros_like(rough.free)


def _roughness(problem: Problem, values: Values, errors: Values) -> _Roughness:
    unknowns, model, begin = problem.unknowns, problem.model, 0
    plausible, determined = unknowns.plausible(model, values), are_determined(problem, values, errors)
    free, lower, upper = np.zeros(values.size, bool), np.full(values.size, -np.inf), np.full(values.size, np.inf)
    rows = []
    for i, array in enumerate(unknowns.values(model)):
        place = np.arange(begin, begin + array.size).reshape(array.shape)
        begin += array.size
        declared = unknowns.ranges[i]
        if not unknowns.ordered[i] or not isinstance(declared, Interval):
            continue
        lower[place], upper[place] = declared.low, declared.high
        for column in place.reshape(len(place), -1).T:
            loose = ~determined[column]
            if loose.all() or not loose.any():
                continue
            free[column] = loose
            scale = float(np.max(plausible[column][~loose]))
            for one, other in itertools.pairwise(column):
                row = np.zeros(values.size)
                row[[one, other]] = -1 / scale, 1 / scale
                rows.append(row)
    return _Roughness(np.reshape(rows, (-1, values.size)), free, lower, upper)


def _smoothest(rough: _Roughness, values: Values, around: Quadratic, budget: float) -> Values:
    """The change of the free values that makes them smoothest among those by which the model grows by at most `budget`."""
    free = np.flatnonzero(rough.free)
    by_free = rough.differences[:, free]
    slope, curvature = by_free.T @ (rough.differences @ values), by_free.T @ by_free
    bounds = np.minimum(rough.lower[free] - values[free], 0), np.maximum(rough.upper[free] - values[free], 0)

    def move(weight: float) -> Values:
        gradient = slope + weight * around.gradient[free]
        matrix = curvature + weight * around.matrix[np.ix_(free, free)]
        found = np.zeros(values.size)
        ridge = 1e-12 * np.trace(matrix) / len(free) * np.eye(len(free))
        found[free] = Model(0.0, gradient, matrix + ridge, *bounds).minimum()
        return found

    low, high = -6.0, 6.0
    if around.increase(move(10**low / budget)) <= budget:
        return move(10**low / budget)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if around.increase(move(10**middle / budget)) <= budget else (middle, high)
    return move(10**high / budget)
