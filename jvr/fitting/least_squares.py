"""Least squares within bounds, over normal equations that were summed in chunks: a matrix of all rays is never held.

With the gradient `g` and the Gauss-Newton matrix `H` of the objective `F`, a step `d` minimises the model `g.d + d.H d / 2` among the
steps that stay within the bounds of the unknowns and within the trust region of each: damped (Levenberg 1944, Marquardt 1963), as it is, or
along Powell's dogleg. Because the step is found there and not cut afterwards, the model never promises more than the step can hold, and an
unknown at its bound leaves it as soon as the gradient points inwards.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import scipy.optimize
from jaxtyping import Array, Float

from jvr.fitting.normal_equations import Normal
from jvr.fitting.solvers import AbstractSolver, Functions
from jvr.model.ranges import ANY, Interval
from jvr.types import Outcome

# With so many rejected steps in a row no direction is left in which float32 can tell a descent from its own rounding.
MOST_REJECTIONS = 12
# Sensitivities below this fraction of the largest count as this fraction, so that an unknown that no ray sees is not scaled to infinity.
FLOOR = 1e-12
TINY = 1e-30
# A ridge under the rounding of the Jacobian, in units of a diagonal of ones, keeps the model convex in directions that no ray sees.
RIDGE = 1e-9


class Model(NamedTuple):
    """The quadratic model of the objective about a point, in scaled unknowns in which `matrix` has a unit diagonal."""

    loss: float
    gradient: Float[np.ndarray, "n"]
    matrix: Float[np.ndarray, "n n"]
    lower: Float[np.ndarray, "n"]
    upper: Float[np.ndarray, "n"]

    def promise(self, move: Float[np.ndarray, "n"]) -> float:
        """The decrease that the model predicts for a step."""
        return -float(self.gradient @ move + 0.5 * move @ self.matrix @ move)

    def minimum(self, damping: float = 0.0) -> Float[np.ndarray, "n"]:
        """The step to the minimum of the model, plus `damping |d|^2 / 2`, within the bounds; by bounded-variable least squares on its
        Cholesky factor (Stark and Parker 1995, in SciPy)."""
        factor = np.linalg.cholesky(self.matrix + damping * np.eye(len(self.gradient)))
        target = -np.linalg.solve(factor, self.gradient)
        found = scipy.optimize.lsq_linear(factor.T, target, (self.lower, self.upper), method="bvls", tol=1e-12).x
        # What sits at a bound is off it by a rounding.
        return np.clip(found, self.lower, self.upper)

    def steepest(self) -> float:
        """The scaled projected gradient: the largest, over unknowns, of the square root of the fraction of the objective that moving this
        unknown alone within its bounds promises to take away. Away from bounds it is the cosine between the residual and the unknown's
        column of the Jacobian (MINPACK's `gtol`)."""
        diagonal = np.diag(self.matrix)
        alone = np.clip(-self.gradient / diagonal, self.lower, self.upper)
        promised = -(self.gradient * alone + 0.5 * diagonal * alone**2)
        return float(np.sqrt(max(promised.max(initial=0.0), 0.0) / max(abs(self.loss), TINY)))


class AbstractDescent(eqx.Module):
    """The step that a model proposes for a step size."""

    @abc.abstractmethod
    def move(self, model: Model, step_size: float) -> Float[np.ndarray, "n"]:
        """A step within the model's bounds."""


class Damped(AbstractDescent):
    """The minimum of the model plus `|d|^2 / (2 step_size)`."""

    def move(self, model: Model, step_size: float) -> Float[np.ndarray, "n"]:
        return model.minimum(1 / step_size)


class Undamped(AbstractDescent):
    """The minimum of the model."""

    def move(self, model: Model, step_size: float) -> Float[np.ndarray, "n"]:
        return model.minimum()


class AlongDogleg(AbstractDescent):
    """The dogleg: from the minimum along the gradient towards the minimum of the model, as far as `step_size` allows (Powell 1970). Both
    lie within the bounds, and so does what is between them."""

    def move(self, model: Model, step_size: float) -> Float[np.ndarray, "n"]:
        cauchy, newton = self._cauchy(model), model.minimum()
        if np.linalg.norm(newton) <= step_size:
            return newton
        length = np.linalg.norm(cauchy)
        if length >= step_size:
            return cauchy * (step_size / length)
        # The one positive root of |cauchy + t (newton - cauchy)| = step_size.
        way = newton - cauchy
        a, b, c = way @ way, cauchy @ way, length**2 - step_size**2
        return cauchy + way * (np.sqrt(b * b - a * c) - b) / a

    def _cauchy(self, model: Model) -> Float[np.ndarray, "n"]:
        """The best step against the gradient, of the unknowns that it does not push out of their bounds, up to the first bound."""
        g = model.gradient
        d = np.where(((g > 0) & (model.lower >= 0)) | ((g < 0) & (model.upper <= 0)), 0.0, -g)
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(d > 0, model.upper / d, np.where(d < 0, model.lower / d, np.inf))
        return d * min(float(-(g @ d) / max(d @ model.matrix @ d, TINY)), float(room.min(initial=np.inf)))


class ChunkedState(NamedTuple):
    """The state of a least-squares solver over chunks. `done`: 0 going on, 1 converged, 2 no finite value, 3 stalled."""

    unconstrained: np.ndarray
    loss: np.ndarray
    normal: Normal
    step_size: np.ndarray
    level: np.ndarray
    rejections: np.ndarray
    done: np.ndarray


_CONVERGED, _NON_FINITE, _STALLED = 1, 2, 3


class ChunkedLeastSquares(AbstractSolver):
    """A descent within bounds and a search of Optimistix, from a subset of the rays to all of them.

    Unknowns are scaled so that the Gauss-Newton matrix has a unit diagonal: damping by a multiple of the identity is then Marquardt's.
    A level ends, and the next one with more rays begins, once a step no longer halves the objective. The last level has converged

    - after an accepted step that lowered the objective, and had promised to lower it, by no more than its fraction `rtol`, where the scaled
      projected gradient is at most `sqrt(rtol)`: no unknown alone promises more than that fraction either, or
    - where the objective is under the rounding of pictures.

    It has stalled after so many rejected steps in a row that rounding decides about them, while the model still promises more. The small
    system is solved in float64.

    **Arguments:** `descent`; `search`: of Optimistix; `rtol`: relative decrease of the objective; `first_step_size`: of the search.
    """

    descent: AbstractDescent
    search: optx.AbstractSearch
    rtol: float = eqx.field(static=True, default=1e-3)
    first_step_size: float = eqx.field(static=True, default=1.0)

    @property
    def bounds(self) -> Interval:
        return ANY

    def init(self, functions: Functions, unconstrained: Float[Array, "n"]) -> ChunkedState:
        loss, normal = functions.levels[0](unconstrained)
        done = 0 if np.isfinite(loss) else _NON_FINITE
        return _state(np.asarray(unconstrained), loss, normal, self.first_step_size, 0, 0, done)

    def step(self, functions: Functions, state: ChunkedState) -> ChunkedState:
        model, scale = _model(functions, state)
        move = self.descent.move(model, float(state.step_size))
        trial = _within(functions, state.unconstrained, scale * move)
        loss, normal = functions.levels[int(state.level)](jnp.asarray(trial))
        finite = np.isfinite(loss) and all(np.all(np.isfinite(x)) for x in normal)
        with jax.enable_x64(True):
            there = np.asarray(loss if finite else np.inf)
            step_size, accept = _search(self.search, _arrays(model), move, there, state.step_size)
        if accept:
            after = _state(trial, loss, normal, step_size, state.level, 0, 0)
            return self._accepted(functions, state, after, model.promise(move))
        state = state._replace(step_size=np.asarray(step_size), rejections=state.rejections + 1)
        if state.rejections < MOST_REJECTIONS:
            return state
        if not finite:
            return self._level_ended(functions, state, _NON_FINITE)
        at_bottom = model.promise(model.minimum()) <= self.rtol * model.loss
        return self._level_ended(functions, state, _CONVERGED if at_bottom else _STALLED)

    def _accepted(self, functions: Functions, before: ChunkedState, after: ChunkedState, promised: float) -> ChunkedState:
        loss, is_last = float(before.loss), int(before.level) + 1 == len(functions.levels)
        decrease = loss - float(after.loss)
        if float(after.loss) <= functions.rounding:
            return self._level_ended(functions, after, _CONVERGED)
        if not is_last:
            return self._level_ended(functions, after, 0) if decrease < 0.5 * loss else after
        if max(decrease, promised) > self.rtol * abs(loss):
            return after
        model, _ = _model(functions, after)
        return self._level_ended(functions, after, _CONVERGED) if model.steepest() <= self.rtol**0.5 else after

    def _level_ended(self, functions: Functions, state: ChunkedState, done: int) -> ChunkedState:
        """On to the next level, or done."""
        level = int(state.level) + 1
        if level == len(functions.levels):
            return state._replace(done=np.asarray(done))
        loss, normal = functions.levels[level](jnp.asarray(state.unconstrained))
        step_size = max(float(state.step_size), self.first_step_size)
        return _state(state.unconstrained, loss, normal, step_size, level, 0, 0)

    def iterate(self, state: ChunkedState) -> tuple[np.ndarray, float]:
        return state.unconstrained, float(state.loss)

    def outcome(self, state: ChunkedState) -> Outcome | None:
        return (None, Outcome.CONVERGED, Outcome.NON_FINITE, Outcome.STALLED)[int(state.done)]


def _model(functions: Functions, state: ChunkedState) -> tuple[Model, Float[np.ndarray, "n"]]:
    """The model about a state, and what a scaled unknown is in units of an unconstrained number."""
    gradient, matrix = functions.quadratic(state.unconstrained, state.normal)
    diagonal = np.diag(matrix)
    scale = 1 / np.sqrt(np.maximum(diagonal, FLOOR * diagonal.max(initial=TINY)))
    limits = functions.limits(state.unconstrained)
    lower = np.maximum(limits.lower - state.unconstrained, -limits.trust_radius) / scale
    upper = np.minimum(limits.upper - state.unconstrained, limits.trust_radius) / scale
    scaled = scale[:, None] * matrix * scale + RIDGE * np.eye(len(scale))
    # A start at its bound may be rounded to the other side of it.
    return Model(float(state.loss), scale * gradient, scaled, np.minimum(lower, 0.0), np.maximum(upper, 0.0)), scale


def _within(functions: Functions, unconstrained: np.ndarray, move: np.ndarray) -> np.ndarray:
    """The point that a step leads to, in the precision of `unconstrained`: rounding does not take it out of its bounds."""
    limits = functions.limits(unconstrained)
    return np.clip(unconstrained + move, limits.lower, limits.upper).astype(unconstrained.dtype)


def _state(*fields: Any) -> ChunkedState:
    return ChunkedState(*_arrays(fields))


def _arrays(tree: Any) -> Any:
    """A Python number would be compiled in, and each step would compile anew."""
    return jax.tree.map(np.asarray, tree)


@eqx.filter_jit
def _search(search: optx.AbstractSearch, model: Model, move: Any, there: Any, step_size: Any):
    """The next step size, and whether the objective `there` is good enough to go there."""
    operator = lx.MatrixLinearOperator(jnp.asarray(model.matrix), lx.positive_semidefinite_tag)
    information = optx.FunctionInfo.EvalGradHessian(jnp.asarray(model.loss), jnp.asarray(model.gradient), operator)
    origin = jnp.zeros_like(model.gradient)
    # The state of Optimistix's searches is their step size, which lives in ours.
    state = jax.tree.map(lambda _: jnp.asarray(step_size), search.init(origin, jax.eval_shape(lambda: information)))
    trial = optx.FunctionInfo.Eval(jnp.asarray(there))
    new_size, accept, _, _ = search.step(jnp.asarray(False), origin, jnp.asarray(move), information, trial, state)
    return new_size, accept


def LevenbergMarquardt(rtol: float = 1e-3) -> ChunkedLeastSquares:
    """Damped Gauss-Newton with Marquardt's scaling (Marquardt 1963; Moré 1978) and a classical trust region. The default."""
    search = optx.ClassicalTrustRegion(high_cutoff=0.75, low_cutoff=0.01, high_constant=10.0, low_constant=0.1)
    return ChunkedLeastSquares(Damped(), search, rtol, first_step_size=100.0)


def GaussNewton(rtol: float = 1e-3) -> ChunkedLeastSquares:
    """Undamped Gauss-Newton: fastest near the solution, no guard far from it but the trust region of each unknown."""
    return ChunkedLeastSquares(Undamped(), optx.LearningRate(1.0), rtol)


def Dogleg(rtol: float = 1e-3) -> ChunkedLeastSquares:
    """Powell's dogleg between the gradient and the Gauss-Newton step, with a classical trust region."""
    return ChunkedLeastSquares(AlongDogleg(), optx.ClassicalTrustRegion(), rtol)
