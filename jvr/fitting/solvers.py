"""The interface of a solver: it takes one step at a time, so that a fit can show progress, save itself and stop in between."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jvr.fitting.normal_equations import Normal
from jvr.model.ranges import Interval
from jvr.types import Outcome


class Limits(NamedTuple):
    """The least and the largest unconstrained number for each unknown, and how far each may move in one step."""

    lower: Float[np.ndarray, "n"]
    upper: Float[np.ndarray, "n"]
    trust_radius: Float[np.ndarray, "n"]


class Functions(NamedTuple):
    """What a solver may ask of a problem.

    - `value(unconstrained, None)`: the objective and `None`, differentiable in reverse mode.
    - `residuals(unconstrained, None)`: the whole residual vector, scaled to a squared length of the objective, and `None`; both modes.
    - `levels`: for each level, from coarse to full, `expand(unconstrained)` to `(objective, Normal in own values)`.
    - `limits(unconstrained)`: where the unknowns may go from there.
    - `quadratic(unconstrained, normal)`: gradient and Gauss-Newton matrix in unconstrained space, priors included, in float64.
    - `rounding`: an objective that differs from zero by no more than the rounding of pictures.
    """

    value: Any
    residuals: Any
    levels: tuple[Callable[[Array], tuple[float, Normal]], ...]
    limits: Callable[[np.ndarray], Limits]
    quadratic: Callable[[np.ndarray, Normal], tuple[np.ndarray, np.ndarray]]
    rounding: float


class AbstractSolver(eqx.Module):
    """Steps from one iterate to the next; its state is a pytree of arrays, which a checkpoint can hold."""

    @property
    @abc.abstractmethod
    def bounds(self) -> Interval | None:
        """Where it keeps all unknowns, beside their own ranges; then it moves the values themselves. `None`: it knows no bounds."""

    @abc.abstractmethod
    def init(self, functions: Functions, unconstrained: Float[Array, "n"]) -> Any:
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
