"""Transfer functions of the scalar and of the length of its gradient (Kniss, Kindlmann and Hansen 2002; Levoy 1988)."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.model.checks import require
from jvr.model.parameters import assign, parameter
from jvr.model.ranges import COLOUR, EXTINCTION, INCREASING, NOT_NEGATIVE
from jvr.model.transfer import AbstractTransfer, Classified, any_between, entries_between, own_emission, shown_entries
from jvr.numerics import clamp, larger, smaller
from jvr.types import ArrayLike, Channels, Scalar


class GradientTransfer(AbstractTransfer):
    """A two-dimensional transfer function, a bilinear table over the scalar and the length of its gradient: materials by value,
    boundaries between them by gradient.

    **Arguments:** `rgb`: `(n, m, 3)`, linear; `sigma_t`: `(n, m)` or, coloured, `(n, m, 3)`, per world length, not negative; `domain`:
    `(low, high)` scalars of the first and last row; `magnitudes`: `(low, high)` lengths of the gradient, in data units per world length,
    of the first and last column; `emission`: `(n, m, 3)`, radiance per world length that the medium emits by itself, or `None`. Values
    outside count as at the border. All differentiable.
    **Raises** `ValueError` for other shapes and ranges.
    """

    takes_gradient: ClassVar[bool] = True

    rgb: Float[Array, "n m 3"] = parameter(COLOUR, least=2, doc="red, green, blue, linear")
    sigma_t: Float[Array, "..."] = parameter(EXTINCTION, shapes=(("n", "m"), ("n", "m", 3)), doc="extinction", unit="1 / mm")
    domain: Float[Array, "2"] = parameter(INCREASING, doc="low < high in the data's own units")
    magnitudes: Float[Array, "2"] = parameter(INCREASING, doc="low < high, lengths of the gradient", unit="data units per mm")
    emission: Float[Array, "n m 3"] | None = own_emission(ordered=False)

    def __init__(
        self,
        rgb: ArrayLike,
        sigma_t: ArrayLike,
        domain: ArrayLike,
        magnitudes: ArrayLike,
        emission: ArrayLike | None = None,
    ):
        assign(self, rgb=rgb, sigma_t=sigma_t, domain=domain, magnitudes=magnitudes, emission=emission)

    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        assert magnitude is not None
        n, m, _ = self.rgb.shape
        emission = () if self.emission is None else (self.emission,)
        table = jnp.concatenate([self.rgb, self.sigma_t.reshape(n, m, -1), *emission], axis=-1)
        (i, x), (j, y) = _cell(s, self.domain, n), _cell(magnitude, self.magnitudes, m)
        rows = [table[i + a, j + b] * ((x if a else 1 - x) * (y if b else 1 - y)) for a in (0, 1) for b in (0, 1)]
        r, g, b, *rest = sum(rows[1:], rows[0])
        columns = len(rest) - 3 * len(emission)
        return Classified((r, g, b), tuple(rest[:columns]), tuple(rest[columns:]))

    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        # Whatever the length of the gradient.
        n = self.rgb.shape[0]
        visible = shown_entries([self.sigma_t] if self.emission is None else [self.sigma_t, self.emission], least)
        beyond = high < self.domain[0], low > self.domain[1]
        u, v = (_coordinate(s, self.domain, n) for s in (low, high))
        return any_between(visible, u, v, beyond if nearby else None)

    def is_visible_below(
        self, low: Scalar, high: Scalar, steepest: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False
    ) -> Bool[Array, ""]:
        n, m, _ = self.rgb.shape
        flat = [x if x is None else x.reshape(n * m, -1) for x in (self.sigma_t, self.emission)]
        visible = shown_entries([x for x in flat if x is not None], least).reshape(n, m)

        def entries(low: Scalar, high: Scalar, domain: Float[Array, "2"], count: int) -> tuple[Array, Array]:
            beyond = (high < domain[0], low > domain[1]) if nearby else None
            return entries_between(_coordinate(low, domain, count), _coordinate(high, domain, count), count, beyond)

        (i, k), (j, m) = entries(low, high, self.domain, n), entries(jnp.zeros_like(low), steepest, self.magnitudes, m)
        # How many are visible in the rows and columns before each.
        before = jnp.pad(jnp.cumsum(jnp.cumsum(visible, 0, dtype=jnp.int32), 1, dtype=jnp.int32), ((1, 0), (1, 0)))
        return before[k + 1, m + 1] - before[i, m + 1] - before[k + 1, j] + before[i, j] > 0


class GradientOpacity(AbstractTransfer):
    """Another transfer function whose extinction and own emission are scaled by the length of the gradient: none at `low` and below, all
    of them from `high` on, linear in between. It shows boundaries and hides what is homogeneous.

    **Arguments:** `transfer`: of the scalar alone; `low`, `high`: lengths of the gradient in data units per world length. Differentiable.
    **Raises** `ValueError` unless `0 <= low < high`, `TypeError` for a transfer function that takes the gradient already.
    """

    takes_gradient: ClassVar[bool] = True

    transfer: AbstractTransfer = parameter(doc="a transfer function of the scalar")
    low: Scalar = parameter(NOT_NEGATIVE, doc="length of a gradient", unit="data units per mm")
    high: Scalar = parameter(NOT_NEGATIVE, doc="length of a gradient", unit="data units per mm")

    def __init__(self, transfer: AbstractTransfer, low: ArrayLike, high: ArrayLike):
        if not isinstance(transfer, AbstractTransfer) or transfer.takes_gradient:
            raise TypeError(f"GradientOpacity scales a transfer function of the scalar, not a {type(transfer).__name__}")
        assign(self, transfer=transfer, low=low, high=high)
        require(self.high - self.low, lambda width: width > 0, "GradientOpacity needs 0 <= low < high")

    def title(self, name: str, scene: Any) -> str:
        return "gradient opacity"

    def without(self, scene: Any) -> Any:
        return dataclasses.replace(scene, transfer=self.transfer)

    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        assert magnitude is not None
        # Clipped before the division: far outside of a narrow range the quotient would overflow.
        # At `low` the derivative is that of less: where there is no gradient and `low` is 0, both can only grow.
        clipped = smaller(larger(self.low, magnitude), self.high)
        fraction = (clipped - self.low) / (self.high - self.low)
        rgb, sigma_t, emission = self.transfer.evaluate(s)
        scaled: Callable[[Channels], Channels] = lambda channels: tuple(x * fraction for x in channels)
        return Classified(rgb, scaled(sigma_t), scaled(emission))

    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        return self.transfer.is_visible(low, high, least, nearby=nearby)

    def is_visible_below(
        self, low: Scalar, high: Scalar, steepest: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False
    ) -> Bool[Array, ""]:
        # At `low` there is nothing, but more of it with any longer gradient.
        reaches = steepest >= self.low if nearby else steepest > self.low
        return reaches & self.is_visible(low, high, least, nearby=nearby)


def _cell(x: Scalar, domain: Float[Array, "2"], n: int) -> tuple[Array, Scalar]:
    """The interval of `n - 1` that a value falls into, and where in it."""
    at = _coordinate(x, domain, n)
    low = jnp.clip(jnp.floor(at), 0, n - 2)
    return low.astype(jnp.int32), at - low


def _coordinate(x: Scalar, domain: Float[Array, "2"], n: int) -> Scalar:
    """Where a value falls between `n` entries, 0 ... n-1, clamped."""
    return clamp((x - domain[0]) * ((n - 1) / (domain[1] - domain[0])), 0, n - 1)
