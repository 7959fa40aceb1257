"""Solvers, one step at a time, so that a fit can show progress, save itself and stop in between.

The least-squares solvers are Optimistix's descents and searches over normal equations that were summed in chunks: a matrix of all
rays is never held. Minimisers and least-squares solvers of Optimistix itself are driven through their own `init` and `step`.
"""

import abc
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from jvr.fitting.objective import Normal
from jvr.types import Outcome

# With so many rejected steps in a row no descent direction is left that float32 can tell apart.
MOST_REJECTIONS = 12
# A rejected step that promised less than this share of what ends a fit was not worth another try.
LEAST_PROMISE = 1e-3


class Functions(NamedTuple):
    """What a solver may ask of a problem.

    - `value(real, None)`: the objective and `None`, differentiable in reverse mode.
    - `residuals(real, None)`: the whole residual vector, scaled to a squared length of the objective, and `None`; both modes.
    - `levels`: for each level, from coarse to full, `expand(real)` to `(objective, Normal in own values)`.
    - `reach`: how far each unknown may move in one step on the real line.
    - `quadratic(real, normal)`: gradient and Gauss-Newton matrix on the real line, priors included, in float64.
    """

    value: Any
    residuals: Any
    levels: tuple[Callable[[Array], tuple[float, Normal]], ...]
    reach: np.ndarray
    quadratic: Callable[[np.ndarray, Normal], tuple[np.ndarray, np.ndarray]]


class AbstractSolver(eqx.Module):
    """Steps from one iterate to the next; its state is a pytree of arrays, which a checkpoint can hold."""

    @abc.abstractmethod
    def init(self, functions: Functions, real: Float[Array, "n"]) -> Any:
        """The state at the start."""

    @abc.abstractmethod
    def step(self, functions: Functions, state: Any) -> Any:
        """The next state."""

    @abc.abstractmethod
    def iterate(self, state: Any) -> tuple[np.ndarray, float]:
        """The accepted point and its objective."""

    @abc.abstractmethod
    def outcome(self, state: Any) -> Outcome | None:
        """How the iteration ended, or `None` while it goes on."""


# Sensitivities below this share of the largest count as this share, so that an unknown that no ray sees is not scaled to infinity.
FLOOR = 1e-12
TINY = 1e-30


class ChunkedState(NamedTuple):
    """`done`: 0 going on, 1 converged, 2 no finite value."""

    real: np.ndarray
    loss: np.ndarray
    normal: Normal
    step_size: np.ndarray
    level: np.ndarray
    rejections: np.ndarray
    done: np.ndarray


class ChunkedLeastSquares(AbstractSolver):
    """A descent and a search of Optimistix over normal equations, from a subset of the rays to all of them.

    Unknowns are scaled so that the Gauss-Newton matrix has a unit diagonal: damping by a multiple of the identity is then Marquardt's.
    A level ends, and the next one with more rays begins, once a step no longer halves the objective; the last level ends once a step
    lowers it by less than `rtol`. The small system is solved in float64.

    **Arguments:** `descent`, `search`: of Optimistix; `rtol`: relative decrease of the objective; `first_step_size`: of the search.
    """

    descent: optx.AbstractDescent
    search: optx.AbstractSearch
    rtol: float = eqx.field(static=True, default=1e-3)
    first_step_size: float = eqx.field(static=True, default=1.0)

    def init(self, functions: Functions, real: Float[Array, "n"]) -> ChunkedState:
        loss, normal = functions.levels[0](real)
        done = 0 if np.isfinite(loss) else 2
        return _state(np.asarray(real), loss, normal, self.first_step_size, 0, 0, done)

    def step(self, functions: Functions, state: ChunkedState) -> ChunkedState:
        gradient, matrix = functions.quadratic(state.real, state.normal)
        diagonal = np.diag(matrix)
        scale = 1 / np.sqrt(np.maximum(diagonal, FLOOR * diagonal.max(initial=TINY)))
        # A ridge under the rounding of the Jacobian keeps the factorisation alive in directions that no ray sees.
        scaled = scale[:, None] * matrix * scale + 1e-9 * np.eye(len(scale))
        model = (state.loss, scale * gradient, scaled)
        with jax.enable_x64(True):
            move = np.asarray(_descend(self.descent, *model, state.step_size))
        # Beyond its reach a transform has bent so far that the quadratic model says nothing: a saturated unknown would jump there.
        reach = functions.reach / scale
        move = np.clip(np.where(np.isfinite(move), move, 0.0), -reach, reach)
        trial = (state.real + scale * move).astype(state.real.dtype)
        loss, normal = functions.levels[int(state.level)](jnp.asarray(trial))
        finite = np.isfinite(loss) and all(np.all(np.isfinite(x)) for x in normal)
        with jax.enable_x64(True):
            step_size, accept = _search(self.search, *model, move, np.asarray(loss if finite else np.inf), state.step_size)
        if accept:
            return self._accepted(functions, state, trial, loss, normal, step_size)
        state = state._replace(step_size=np.asarray(step_size), rejections=state.rejections + 1)
        # At the bottom what a step promises is less than the rounding of the objective, which then decides about it.
        promised = -float(model[1] @ move + 0.5 * move @ scaled @ move)
        at_bottom = finite and promised < LEAST_PROMISE * self.rtol * float(state.loss)
        if state.rejections < MOST_REJECTIONS and not at_bottom:
            return state
        return self._level_ended(functions, state, done=1 if finite else 2)

    def _accepted(self, functions: Functions, before: ChunkedState, trial: Any, loss: float, normal: Normal, step_size: Any):
        decrease = (float(before.loss) - loss) / max(abs(float(before.loss)), TINY)
        state = _state(trial, loss, normal, step_size, before.level, 0, 0)
        is_last = int(state.level) + 1 == len(functions.levels)
        ended = loss == 0 or decrease < (self.rtol if is_last else 0.5)
        return self._level_ended(functions, state, done=1) if ended else state

    def _level_ended(self, functions: Functions, state: ChunkedState, done: int) -> ChunkedState:
        """On to the next level, or done."""
        level = int(state.level) + 1
        if level == len(functions.levels):
            return state._replace(done=np.asarray(done))
        loss, normal = functions.levels[level](jnp.asarray(state.real))
        step_size = max(float(state.step_size), self.first_step_size)
        return _state(state.real, loss, normal, step_size, level, 0, 0)

    def iterate(self, state: ChunkedState) -> tuple[np.ndarray, float]:
        return state.real, float(state.loss)

    def outcome(self, state: ChunkedState) -> Outcome | None:
        return (None, Outcome.CONVERGED, Outcome.NON_FINITE)[int(state.done)]


def _state(*fields: Any) -> ChunkedState:
    # Arrays all through: a Python number would be compiled in, and each step would compile anew.
    return ChunkedState(*jax.tree.map(np.asarray, fields))


def _information(loss: Any, gradient: Any, matrix: Any) -> Any:
    operator = lx.MatrixLinearOperator(jnp.asarray(matrix), lx.positive_semidefinite_tag)
    return optx.FunctionInfo.EvalGradHessian(jnp.asarray(loss), jnp.asarray(gradient), operator)


@eqx.filter_jit
def _descend(descent: optx.AbstractDescent, loss: Any, gradient: Any, matrix: Any, step_size: Any) -> Array:
    """The step that a descent proposes in scaled unknowns."""
    information, origin = _information(loss, gradient, matrix), jnp.zeros_like(gradient)
    state = descent.query(origin, information, descent.init(origin, jax.eval_shape(lambda: information)))
    return descent.step(jnp.asarray(step_size), state)[0]


@eqx.filter_jit
def _search(search: optx.AbstractSearch, loss: Any, gradient: Any, matrix: Any, move: Any, there: Any, step_size: Any):
    """The next step size, and whether the objective `there` is good enough to go there."""
    information, origin = _information(loss, gradient, matrix), jnp.zeros_like(gradient)
    # The state of Optimistix's searches is their step size, which lives in ours.
    state = jax.tree.map(lambda _: jnp.asarray(step_size), search.init(origin, jax.eval_shape(lambda: information)))
    trial = optx.FunctionInfo.Eval(jnp.asarray(there))
    new_size, accept, _, _ = search.step(jnp.asarray(False), origin, jnp.asarray(move), information, trial, state)
    return new_size, accept


def LevenbergMarquardt(rtol: float = 1e-3) -> ChunkedLeastSquares:
    """Damped Gauss-Newton with Marquardt's scaling (Marquardt 1963; Moré 1978) and a classical trust region. The default."""
    search = optx.ClassicalTrustRegion(high_cutoff=0.75, low_cutoff=0.01, high_constant=10.0, low_constant=0.1)
    return ChunkedLeastSquares(optx.DampedNewtonDescent(), search, rtol, first_step_size=100.0)


def GaussNewton(rtol: float = 1e-3) -> ChunkedLeastSquares:
    """Undamped Gauss-Newton: fastest near the solution, no guard far from it."""
    return ChunkedLeastSquares(optx.NewtonDescent(), optx.LearningRate(1.0), rtol)


def Dogleg(rtol: float = 1e-3) -> ChunkedLeastSquares:
    """Powell's dogleg between the gradient and the Gauss-Newton step, with a classical trust region."""
    return ChunkedLeastSquares(optx.DoglegDescent(), optx.ClassicalTrustRegion(), rtol)


class Scaled(eqx.Module):
    """An objective times a factor. Quasi-Newton methods leave out updates whose curvature is under the rounding of float32, which a
    mean over pixels starts out with; scaled by `unknowns / objective` at the start, a step of one changes it by about itself."""

    function: Any
    factor: Array

    def __call__(self, real: Float[Array, "n"], args: None) -> tuple[Array, None]:
        loss, aux = self.function(real, args)
        return loss * self.factor, aux


@eqx.filter_jit
def _factor(function: Any, real: Array) -> Array:
    loss, _ = function(real, None)
    return jnp.where(loss > 0, real.size / jnp.where(loss > 0, loss, 1.0), 1.0)


class GradientState(NamedTuple):
    """`inner` is the other library's state; `best` and `best_loss` the best point it has accepted; `factor` that of `Scaled`."""

    real: Array
    inner: Any
    best: Array
    best_loss: Array
    factor: Array
    done: Array


class AbstractGradientSolver(AbstractSolver):
    """A solver of another library; keeps the best point that it has accepted."""

    def iterate(self, state: GradientState) -> tuple[np.ndarray, float]:
        return np.asarray(state.best), float(state.best_loss / state.factor)

    def outcome(self, state: GradientState) -> Outcome | None:
        return (None, Outcome.CONVERGED, Outcome.NON_FINITE)[int(state.done)]


def _moved(state: GradientState, real: Array, inner: Any, here: Array, loss: Array, finished: Array) -> GradientState:
    """The state after a step that ended at `real` and knows the objective `loss` at `here`."""
    finite = jnp.all(jnp.isfinite(real)) & jnp.isfinite(loss)
    better = finite & (loss < state.best_loss)
    best, best_loss = jnp.where(better, here, state.best), jnp.where(better, loss, state.best_loss)
    return GradientState(real, inner, best, best_loss, state.factor, jnp.where(finite, finished.astype(int), 2))


def _begin(real: Array, inner: Any, factor: Array) -> GradientState:
    return GradientState(real, inner, real, jnp.asarray(jnp.inf, real.dtype), factor, jnp.asarray(0))


class OptimistixSolver(AbstractGradientSolver):
    """Drives a minimiser of Optimistix (BFGS, LBFGS, OptaxMinimiser, ...) over the value, or a least-squares solver over the whole
    residual vector, which must then fit in memory, times the number of unknowns."""

    solver: optx.AbstractMinimiser | optx.AbstractLeastSquaresSolver

    def init(self, functions: Functions, real: Float[Array, "n"]) -> GradientState:
        whole = isinstance(self.solver, optx.AbstractLeastSquaresSolver)
        factor = jnp.ones(()) if whole else _factor(functions.value, real)
        return _begin(real, _init(self.solver, self._function(functions, factor), real), factor)

    def step(self, functions: Functions, state: GradientState) -> GradientState:
        return _step(self.solver, self._function(functions, state.factor), state)

    def _function(self, functions: Functions, factor: Array) -> Callable[..., Any]:
        whole = isinstance(self.solver, optx.AbstractLeastSquaresSolver)
        return functions.residuals if whole else Scaled(functions.value, factor)


@eqx.filter_jit
def _init(solver: Any, fn: Any, real: Array) -> Any:
    shape, aux = eqx.filter_eval_shape(fn, real, None)
    return solver.init(fn, real, None, {}, shape, aux, frozenset())


@eqx.filter_jit
def _step(solver: Any, fn: Any, state: GradientState) -> GradientState:
    real, inner, _ = solver.step(fn, state.real, None, {}, state.inner, frozenset())
    finished, _ = solver.terminate(fn, real, None, {}, inner, frozenset())
    if isinstance(solver, optx.OptaxMinimiser):
        # Optax moves on from the point that it has just evaluated; the others return the point that they have accepted.
        return _moved(state, real, inner, state.real, inner.f, finished)
    # Least-squares solvers minimise half the squared length.
    half = isinstance(solver, optx.AbstractLeastSquaresSolver)
    return _moved(state, real, inner, real, inner.f_info.as_min() * (2 if half else 1), finished)


class LBFGSB(AbstractGradientSolver):
    """Limited-memory BFGS with bounds (Byrd et al. 1995), by jaxopt, over the values themselves: no transform stands between.

    **Arguments:** `lower`, `upper`: bounds for all unknowns alike, or one of each for every unknown, flat; `tol`: of the projected
    gradient; `history`: corrections kept. jaxopt is unmaintained and is used nowhere else.
    """

    lower: Any = 0.0
    upper: Any = np.inf
    tol: float = eqx.field(static=True, default=1e-6)
    history: int = eqx.field(static=True, default=10)

    def init(self, functions: Functions, real: Float[Array, "n"]) -> GradientState:
        bounds = self._bounds(real)
        real = jnp.clip(real, *bounds)
        factor = _factor(functions.value, real)
        return _begin(real, _bounded_init(self.tol, self.history, Scaled(functions.value, factor), real, bounds), factor)

    def step(self, functions: Functions, state: GradientState) -> GradientState:
        return _bounded_step(self.tol, self.history, Scaled(functions.value, state.factor), state, self._bounds(state.real))

    def _bounds(self, real: Array) -> tuple[Array, Array]:
        spread = lambda bound: jnp.broadcast_to(jnp.asarray(bound, real.dtype), real.shape)
        return spread(self.lower), spread(self.upper)


def _jaxopt_solver(tol: float, history: int, fn: Any) -> Any:
    with warnings.catch_warnings():
        # jaxopt announces on import that it is no longer maintained; users of one bounded fit cannot act on that.
        warnings.simplefilter("ignore")
        import jaxopt
    return jaxopt.LBFGSB(lambda real: fn(real, None)[0], tol=tol, history_size=history)


@eqx.filter_jit
def _bounded_init(tol: float, history: int, fn: Any, real: Array, bounds: tuple[Array, Array]) -> Any:
    return _jaxopt_solver(tol, history, fn).init_state(real, bounds)


@eqx.filter_jit
def _bounded_step(tol: float, history: int, fn: Any, state: GradientState, bounds: tuple[Array, Array]) -> GradientState:
    real, inner = _jaxopt_solver(tol, history, fn).update(state.real, state.inner, bounds)
    return _moved(state, real, inner, real, inner.value, inner.error <= tol)
