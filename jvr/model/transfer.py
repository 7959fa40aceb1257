"""Transfer functions: from the scalar `s` to colour and extinction."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.model.parameters import assign, parameter
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.ranges import COLOUR, EXTINCTION, INCREASING, POSITIVE
from jvr.numerics import clamp, divide_or_zero, read_run
from jvr.types import ArrayLike, Channels, Scalar, Triple


class Classified(NamedTuple):
    """What a transfer function makes of a scalar: source colour (linear RGB) and extinction (1 / world length),
    the latter one component for grey media and three for coloured ones."""

    rgb: Triple
    sigma_t: Channels


def extinction(*, ordered: bool) -> Any:
    """The declaration of an extinction for each entry, grey or coloured."""
    return parameter(EXTINCTION, shapes=(("n",), ("n", 3)), ordered=ordered, doc="extinction", unit="1 / mm")


class AbstractTransfer(AbstractPart):
    """A map from the scalar `s` (in the data's own units) to source colour and extinction."""

    # Whether `evaluate` takes the length of the gradient (per world length) as well.
    takes_gradient: ClassVar[bool] = False

    @property
    def needs_gradient(self) -> bool:
        return self.takes_gradient

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        arguments = (scene.volume.slope,) * (2 if self.takes_gradient else 1)
        coloured = len(jax.eval_shape(self.evaluate, *arguments).sigma_t) == 3
        return (PlanEntry(name, True, f"{type(self).__name__}, {'coloured' if coloured else 'grey'} extinction"),)

    @abc.abstractmethod
    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        """Colour and extinction at one scalar value; traceable and differentiable in `s` and in every array."""

    @abc.abstractmethod
    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        """Whether any value from `low` to `high` may have extinction above `least`; never falsely `False`.

        With `nearby`, whether any may however little it is changed: where none is, extinction has no derivative in the value nor in
        where entries lie.
        """

    def _repr_html_(self) -> str:
        """What notebooks show."""
        from jvr.model.html import transfer_html

        return transfer_html(self)


class AbstractTable(AbstractTransfer):
    """A transfer function that interpolates the rows of a table linearly, colour and extinction separately."""

    rgb: eqx.AbstractVar[Float[Array, "n 3"]]
    sigma_t: eqx.AbstractVar[Float[Array, "..."]]

    @property
    @abc.abstractmethod
    def ends(self) -> tuple[Scalar, Scalar]:
        """Scalar values of the first and the last entry."""

    @abc.abstractmethod
    def coordinate(self, s: Scalar) -> Scalar:
        """Where `s` falls in the table, 0 ... n-1, clamped; entry `i` has weight `max(0, 1 - |coordinate - i|)`."""

    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        visible = jnp.any(~(jnp.abs(self.sigma_t.reshape(self.sigma_t.shape[0], -1)) <= least), axis=1)
        beyond = high < self.ends[0], low > self.ends[1]
        return any_between(visible, self.coordinate(low), self.coordinate(high), beyond if nearby else None)


class LinearTransfer(AbstractTable):
    """A piecewise linear transfer function: linear between control points, constant beyond the first and the last.

    **Arguments:** `positions`: `(n,)`, strictly increasing, in the data's units; `rgb`: `(n, 3)`, linear; `sigma_t`: `(n,)`, or
    `(n, 3)` for coloured extinction, per world length, not negative. All differentiable, positions too.
    **Raises** `ValueError` for other shapes, positions that do not increase, negative or non-finite values.
    """

    positions: Float[Array, "n"] = parameter(INCREASING, least=2, doc="in the data's own units")
    rgb: Float[Array, "n 3"] = parameter(COLOUR, ordered=True, doc="red, green, blue, linear")
    sigma_t: Float[Array, "..."] = extinction(ordered=True)

    def __init__(self, positions: ArrayLike, rgb: ArrayLike, sigma_t: ArrayLike):
        assign(self, positions=positions, rgb=rgb, sigma_t=sigma_t)

    @property
    def ends(self) -> tuple[Scalar, Scalar]:
        return self.positions[0], self.positions[-1]

    def coordinate(self, s: Scalar) -> Scalar:
        n = self.positions.shape[0]
        above = jnp.searchsorted(self.positions, s, side="right", method="scan_unrolled")
        i = jnp.clip(above - 1, 0, n - 2)
        low, high = self.positions[i], self.positions[i + 1]
        # Clamped before the division: far outside of a narrow interval the quotient would overflow.
        fraction = divide_or_zero(clamp(s, low, high) - low, high - low)
        return i + fraction

    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        return _interpolate(self, self.coordinate(s))


class LutTransfer(AbstractTable):
    """A lookup table with equally spaced entries: entries 0 and n-1 sit at the ends of `domain`, values clamp outside of it.

    **Arguments:** `rgb`: `(n, 3)`; `sigma_t`: `(n,)` or `(n, 3)`; `domain`: `(low, high)` in the data's units. All
    differentiable. **Raises** `ValueError` as `LinearTransfer`, and where `low >= high`.
    """

    rgb: Float[Array, "n 3"] = parameter(COLOUR, ordered=True, least=2, doc="red, green, blue, linear")
    sigma_t: Float[Array, "..."] = extinction(ordered=True)
    domain: Float[Array, "2"] = parameter(INCREASING, doc="low < high in the data's own units")

    def __init__(self, rgb: ArrayLike, sigma_t: ArrayLike, domain: ArrayLike):
        assign(self, rgb=rgb, sigma_t=sigma_t, domain=domain)

    @property
    def positions(self) -> Float[Array, "n"]:
        """Scalar value of each entry."""
        return jnp.linspace(self.domain[0], self.domain[1], self.rgb.shape[0])

    @property
    def ends(self) -> tuple[Scalar, Scalar]:
        return self.domain[0], self.domain[1]

    def coordinate(self, s: Scalar) -> Scalar:
        last = self.rgb.shape[0] - 1
        low, high = self.domain[0], self.domain[1]
        return clamp((s - low) * (last / (high - low)), 0, last)

    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        return _interpolate(self, self.coordinate(s))


class GaussianTransfer(AbstractTransfer):
    """A sum of Gaussians, `sigma_t(s) = sum_g height_g exp(-(s - center_g)^2 / (2 width_g^2))`, and as colour the mean of the
    Gaussians' colours, each weighted by its (mean) extinction. The weights are a softmax, so the colour stays defined where
    every Gaussian underflows. Where all heights are zero the weights do not depend on them: then the derivative in a height has
    the mean colour instead of its Gaussian's own.

    **Arguments:** `center`, `width`: `(n,)` in the data's units, widths positive; `height`: `(n,)` or `(n, 3)`, per world length;
    `rgb`: `(n, 3)`. All differentiable. **Raises** `ValueError` for other shapes, widths not positive, negative heights.
    """

    center: Float[Array, "n"] = parameter(doc="in the data's own units")
    width: Float[Array, "n"] = parameter(POSITIVE, doc="in the data's own units")
    height: Float[Array, "..."] = extinction(ordered=False)
    rgb: Float[Array, "n 3"] = parameter(COLOUR, doc="red, green, blue, linear")

    def __init__(self, center: ArrayLike, width: ArrayLike, height: ArrayLike, rgb: ArrayLike):
        assign(self, center=center, width=width, height=height, rgb=rgb)

    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        limit = jnp.finfo(self.center.dtype).max
        # Squared below: farther out the square would overflow, and the colour of two overflows is undefined.
        z = jnp.clip((s - self.center) / self.width, -0.5 * limit**0.5, 0.5 * limit**0.5)
        exponent = -0.5 * jnp.square(z)
        sigma_t = tuple(jnp.sum(channel * jnp.exp(exponent)) for channel in _columns(self.height))
        # A softmax of log(height) + exponent, but linear in the height: the logarithm's derivative at zero is infinite.
        height = self.height if self.height.ndim == 1 else jnp.mean(self.height, axis=1)
        height = jnp.where(jnp.any(height > 0), height, 1.0)
        log_height = jnp.log(jnp.where(height > 0, height, 1.0))
        largest = jax.lax.stop_gradient(jnp.max(exponent + log_height, where=height > 0, initial=-limit))
        weight = height * jnp.exp(jnp.minimum(exponent - largest, 0.9 * jnp.log(limit)))
        weight = divide_or_zero(weight, jnp.broadcast_to(jnp.sum(weight), weight.shape))
        return Classified(_three(self.rgb.T @ weight), sigma_t)

    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        # The largest extinction of each Gaussian in the range: at its centre, or at the end nearer to it. Zero is where it underflows,
        # and so does its derivative.
        nearest = jnp.clip(self.center, low, high)
        height = self.height if self.height.ndim == 1 else jnp.max(self.height, axis=1)
        return ~(jnp.sum(jnp.abs(height) * jnp.exp(-0.5 * jnp.square((nearest - self.center) / self.width))) <= least)


def any_between(
    visible: Bool[Array, "n"], u: Scalar, v: Scalar, beyond: tuple[Bool[Array, ""], Bool[Array, ""]] | None
) -> Bool[Array, ""]:
    """Whether any entry is `visible` that has a weight in a table's coordinates `u` ... `v`, both clamped to 0 ... n-1.

    Where `beyond` says whether what was clamped lies in front of the first entry and behind the last one, also those that have one next
    to `u` and `v`: at an entry both of its neighbours, beyond an end none.
    """
    n = visible.shape[0]
    first, last = jnp.floor(u), jnp.ceil(v)
    if beyond is not None:
        first = jnp.where(beyond[1], n - 1, jnp.maximum(jnp.ceil(u) - 1, 0))
        last = jnp.where(beyond[0], 0, jnp.minimum(jnp.floor(v) + 1, n - 1))
    # Entries are counted: a difference of sums of the extinctions themselves would round small ones away.
    before = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(visible, dtype=jnp.int32)])
    return before[last.astype(jnp.int32) + 1] > before[first.astype(jnp.int32)]


def _columns(table: Float[Array, "..."]) -> tuple[Float[Array, "n"], ...]:
    return (table,) if table.ndim == 1 else tuple(table[:, c] for c in range(table.shape[1]))


def _three(v: Float[Array, "3"]) -> Triple:
    return v[0], v[1], v[2]


def _interpolate(table: AbstractTable, u: Scalar) -> Classified:
    # Each row beside the next, so that one read brings both around `u` with all their columns.
    rows = jnp.stack([*_columns(table.rgb), *_columns(table.sigma_t)], axis=1)
    pairs, columns = jnp.concatenate([rows[:-1], rows[1:]], axis=1), rows.shape[1]
    low = jnp.clip(jnp.floor(u), 0, rows.shape[0] - 2)
    fraction = u - low
    pair = read_run(pairs, low.astype(jnp.int32), 1)[0]
    # The weighted sum, not a + f (b - a): at an end of an interval it returns the entry exactly.
    r, g, b, *sigma_t = ((1 - fraction) * pair[c] + fraction * pair[columns + c] for c in range(columns))
    return Classified((r, g, b), tuple(sigma_t))
