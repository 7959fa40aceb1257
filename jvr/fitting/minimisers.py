"""Minimisers of other libraries, driven one step at a time: Optimistix's own through their `init` and `step`, and a bounded one by
jaxopt."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from jvr.fitting.solvers import AbstractSolver, Functions
from jvr.model.ranges import Interval
from jvr.types import Outcome

# A first step may be so many times too long: a line search halves it four times, and shorter ones leave few unknowns where they are.
FIRST_STEP = 16


class Scaled(eqx.Module):
    """An objective times a factor. Quasi-Newton methods leave out updates whose curvature is under the rounding of float32, which a
    mean over pixels starts out with; scaled by `unknowns / objective` at the start, a step of one changes it by about itself. Where most
    unknowns are hardly seen, as voxels are, a first step along its gradient would still promise far less than nothing: it is scaled by
    `FIRST_STEP * objective / |gradient|^2` at most; by the quotient alone that step ends at zero (Polyak 1969)."""

    function: Any
    factor: Array

    def __call__(self, unconstrained: Float[Array, "n"], args: None) -> tuple[Array, None]:
        loss, aux = self.function(unconstrained, args)
        return loss * self.factor, aux


@eqx.filter_jit
def _start(function: Any, unconstrained: Array) -> tuple[Array, Array]:
    """The objective, and its factor."""
    loss, gradient = jax.value_and_grad(lambda x: function(x, None)[0])(unconstrained)
    squared = jnp.sum(jnp.square(gradient))
    known = (loss > 0) & (squared > 0)
    factor = jnp.minimum(unconstrained.size / jnp.where(known, loss, 1.0), FIRST_STEP * loss / jnp.where(known, squared, 1.0))
    return loss, jnp.where(known & jnp.isfinite(factor) & (factor > 0), factor, 1.0)


class GradientState(NamedTuple):
    """The state of a gradient solver: `inner` is the other library's state; `best` and `best_loss` the best point it has accepted;
    `factor` that of `Scaled`."""

    unconstrained: Array
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


def _moved(state: GradientState, unconstrained: Array, inner: Any, here: Array, loss: Array, finished: Array) -> GradientState:
    """The state after a step that ended at `unconstrained` and knows the objective `loss` at `here`."""
    finite = jnp.all(jnp.isfinite(unconstrained)) & jnp.isfinite(loss)
    better = finite & (loss < state.best_loss)
    best, best_loss = jnp.where(better, here, state.best), jnp.where(better, loss, state.best_loss)
    return GradientState(unconstrained, inner, best, best_loss, state.factor, jnp.where(finite, finished.astype(int), 2))


def _unless_exact(functions: Functions, state: GradientState) -> GradientState:
    """Converged where the pictures differ by their rounding alone: libraries compare changes, and of rounding there is no end."""
    exact = float(state.best_loss / state.factor) <= functions.rounding
    return state._replace(done=jnp.asarray(1)) if exact else state


def _begin(unconstrained: Array, inner: Any, factor: Array) -> GradientState:
    return GradientState(unconstrained, inner, unconstrained, jnp.asarray(jnp.inf, unconstrained.dtype), factor, jnp.asarray(0))


class OptimistixSolver(AbstractGradientSolver):
    """Drives a minimiser of Optimistix (BFGS, LBFGS, OptaxMinimiser, ...) over the value, or a least-squares solver over the whole
    residual vector, which must then fit in memory, times the number of unknowns."""

    solver: optx.AbstractMinimiser | optx.AbstractLeastSquaresSolver

    def init(self, functions: Functions, unconstrained: Float[Array, "n"]) -> GradientState:
        whole = isinstance(self.solver, optx.AbstractLeastSquaresSolver)
        factor = jnp.ones(()) if whole else _start(functions.value, unconstrained)[1]
        return _begin(unconstrained, _init(self.solver, self._function(functions, factor), unconstrained), factor)

    def step(self, functions: Functions, state: GradientState) -> GradientState:
        return _unless_exact(functions, _step(self.solver, self._function(functions, state.factor), state))

    @property
    def bounds(self) -> None:
        return None

    def _function(self, functions: Functions, factor: Array) -> Callable[..., Any]:
        whole = isinstance(self.solver, optx.AbstractLeastSquaresSolver)
        return functions.residuals if whole else Scaled(functions.value, factor)


@eqx.filter_jit
def _init(solver: Any, fn: Any, unconstrained: Array) -> Any:
    shape, aux = eqx.filter_eval_shape(fn, unconstrained, None)
    return solver.init(fn, unconstrained, None, {}, shape, aux, frozenset())


@eqx.filter_jit
def _step(solver: Any, fn: Any, state: GradientState) -> GradientState:
    unconstrained, inner, _ = solver.step(fn, state.unconstrained, None, {}, state.inner, frozenset())
    finished, _ = solver.terminate(fn, unconstrained, None, {}, inner, frozenset())
    if isinstance(solver, optx.OptaxMinimiser):
        # Optax moves on from the point that it has just evaluated; the others return the point that they have accepted.
        return _moved(state, unconstrained, inner, state.unconstrained, inner.f, finished)
    # Least-squares solvers minimise half the squared length.
    half = isinstance(solver, optx.AbstractLeastSquaresSolver)
    return _moved(state, unconstrained, inner, unconstrained, inner.f_info.as_min() * (2 if half else 1), finished)


class LBFGSB(AbstractGradientSolver):
    """Limited-memory BFGS with bounds (Byrd et al. 1995), by jaxopt, over the values themselves within the ranges that they declare.

    **Arguments:** `lower`, `upper`: narrower bounds for all unknowns alike but directions and positions (`jvr.Bounded` among the
    `transforms` of a fit bounds one of them); `tol`: of the projected gradient; `history`: corrections kept. jaxopt is unmaintained and is
    used nowhere else.
    """

    lower: float = eqx.field(static=True, default=-np.inf)
    upper: float = eqx.field(static=True, default=np.inf)
    tol: float = eqx.field(static=True, default=1e-6)
    history: int = eqx.field(static=True, default=10)

    def init(self, functions: Functions, unconstrained: Float[Array, "n"]) -> GradientState:
        bounds = _bounds(functions, unconstrained)
        unconstrained = jnp.clip(unconstrained, *bounds)
        loss, factor = _start(functions.value, unconstrained)
        scaled = Scaled(functions.value, factor)
        state = _begin(unconstrained, _bounded_init(self.tol, self.history, scaled, unconstrained, bounds), factor)
        # Its first step may end at a worse point: the start counts as one that it has accepted.
        return state._replace(best_loss=loss * factor)

    def step(self, functions: Functions, state: GradientState) -> GradientState:
        scaled = Scaled(functions.value, state.factor)
        return _unless_exact(
            functions, _bounded_step(self.tol, self.history, scaled, state, _bounds(functions, state.unconstrained))
        )

    @property
    def bounds(self) -> Interval:
        return Interval(self.lower, self.upper)


def _bounds(functions: Functions, unconstrained: Array) -> tuple[Array, Array]:
    limits = functions.limits(np.asarray(unconstrained))
    return jnp.asarray(limits.lower, unconstrained.dtype), jnp.asarray(limits.upper, unconstrained.dtype)


def _jaxopt_solver(tol: float, history: int, fn: Any) -> Any:
    with warnings.catch_warnings():
        # jaxopt announces on import that it is no longer maintained; users of one bounded fit cannot act on that.
        warnings.simplefilter("ignore")
        import jaxopt
    return jaxopt.LBFGSB(lambda unconstrained: fn(unconstrained, None)[0], tol=tol, history_size=history)


@eqx.filter_jit
def _bounded_init(tol: float, history: int, fn: Any, unconstrained: Array, bounds: tuple[Array, Array]) -> Any:
    return _jaxopt_solver(tol, history, fn).init_state(unconstrained, bounds)


@eqx.filter_jit
def _bounded_step(tol: float, history: int, fn: Any, state: GradientState, bounds: tuple[Array, Array]) -> GradientState:
    unconstrained, inner = _jaxopt_solver(tol, history, fn).update(state.unconstrained, state.inner, bounds)
    return _moved(state, unconstrained, inner, unconstrained, inner.value, inner.error <= tol)
