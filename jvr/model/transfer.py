"""Transfer functions: from the scalar `s` to colour and extinction."""

import abc
import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.model.parameters import assign, parameter
from jvr.model.parts import AbstractPart, PlanEntry, is_zero
from jvr.model.ranges import COLOUR, EMISSION, EXTINCTION, INCREASING, POSITIVE
from jvr.numerics import clamp, divide_or_zero, read_run
from jvr.types import ArrayLike, Channels, Scalar, Triple


class Classified(NamedTuple):
    """What a transfer function makes of a scalar: source colour (linear RGB), extinction (1 / world length), one component for grey media
    and three for coloured ones, and emission of its own (radiance / world length), three components or none."""

    rgb: Triple
    sigma_t: Channels
    emission: Channels = ()


def extinction(*, ordered: bool) -> Any:
    """The declaration of an extinction for each entry, grey or coloured."""
    return parameter(EXTINCTION, shapes=(("n",), ("n", 3)), ordered=ordered, doc="extinction", unit="1 / mm")


def own_emission(*, ordered: bool) -> Any:
    """The declaration of an emission for each entry."""
    return parameter(EMISSION, ordered=ordered, doc="emission of its own: red, green, blue", unit="radiance / mm")


class AbstractTransfer(AbstractPart):
    """A map from the scalar `s` (in the data's own units) to source colour and extinction."""

    # Whether `evaluate` takes the length of the gradient (per world length) as well.
    takes_gradient: ClassVar[bool] = False
    # Whether it shows nothing whatever the scalar is: no medium is then marched through.
    is_clear: ClassVar[bool] = False

    @property
    def needs_gradient(self) -> bool:
        return self.takes_gradient

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        arguments = (scene.volume.slope,) * (2 if self.takes_gradient else 1)
        found = jax.eval_shape(self.evaluate, *arguments)
        words = f"{type(self).__name__}, {'coloured' if len(found.sigma_t) == 3 else 'grey'} extinction"
        return (PlanEntry(name, True, f"{words}, emission of its own" if found.emission else words),)

    def title(self, name: str, scene: Any) -> str:
        return "emission of its own"

    def without(self, scene: Any) -> Any:
        # A medium cannot do without extinction, but without what it emits beside.
        if getattr(self, "emission", None) is None:
            return None
        return dataclasses.replace(scene, transfer=dataclasses.replace(cast(Any, self), emission=None))

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        emission = getattr(self, "emission", None)
        if emission is not None and is_zero(emission):
            yield f"{name}.emission is zero everywhere: leave it out"
        if emission is not None and not scene.optical.emits:
            yield f"{name}.emission does not show: nothing glows under {type(scene.optical).__name__}"

    @abc.abstractmethod
    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        """Colour and extinction at one scalar value; traceable and differentiable in `s` and in every array."""

    @abc.abstractmethod
    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        """Whether any value from `low` to `high` may have extinction or emission of its own above `least`; never falsely `False`.

        With `nearby`, whether any may however little it is changed: where none is, neither has a derivative in the value nor in where
        entries lie.
        """

    def is_visible_below(
        self, low: Scalar, high: Scalar, steepest: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False
    ) -> Bool[Array, ""]:
        """`is_visible` of those whose gradient is no longer than `steepest`; where a class does not say, of any."""
        return self.is_visible(low, high, least, nearby=nearby)

    def _repr_html_(self) -> str:
        """What notebooks show."""
        from jvr.model.html import transfer_html

        return transfer_html(self)


# Fields of a table whose entries are what it interpolates between.
ENTRIES = ("rgb", "sigma_t", "emission")


class AbstractTable(AbstractTransfer):
    """A transfer function that interpolates the rows of a table linearly, colour, extinction and (in a field `emission`, where it has one)
    emission separately."""

    rgb: eqx.AbstractVar[Float[Array, "n 3"]]
    sigma_t: eqx.AbstractVar[Float[Array, "..."]]

    @property
    @abc.abstractmethod
    def ends(self) -> tuple[Scalar, Scalar]:
        """Scalar values of the first and the last entry."""

    @abc.abstractmethod
    def coordinate(self, s: Scalar) -> Scalar:
        """Where `s` falls in the table, 0 ... n-1, clamped; entry `i` has weight `max(0, 1 - |coordinate - i|)`."""

    @property
    def entries(self) -> dict[str, Float[Array, "n *channels"]]:
        """Its columns by their field's name, those that it has."""
        found = {name: getattr(self, name, None) for name in ENTRIES}
        return {name: column for name, column in found.items() if column is not None}

    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        columns = [column for name, column in self.entries.items() if name != "rgb"]
        visible = shown_entries(columns, least)
        beyond = high < self.ends[0], low > self.ends[1]
        return any_between(visible, self.coordinate(low), self.coordinate(high), beyond if nearby else None)


class LinearTransfer(AbstractTable):
    """A piecewise linear transfer function: linear between control points, constant beyond the first and the last.

    **Arguments:** `positions`: `(n,)`, strictly increasing, in the data's units; `rgb`: `(n, 3)`, linear; `sigma_t`: `(n,)`, or
    `(n, 3)` for coloured extinction, per world length, not negative; `emission`: `(n, 3)`, radiance per world length, what the medium
    emits by itself beside `sigma_t rgb`, also where it absorbs nothing, or `None`. All differentiable, positions too.
    **Raises** `ValueError` for other shapes, positions that do not increase, negative or non-finite values.
    """

    positions: Float[Array, "n"] = parameter(INCREASING, least=2, doc="in the data's own units")
    rgb: Float[Array, "n 3"] = parameter(COLOUR, ordered=True, doc="red, green, blue, linear")
    sigma_t: Float[Array, "..."] = extinction(ordered=True)
    emission: Float[Array, "n 3"] | None = own_emission(ordered=True)

    def __init__(self, positions: ArrayLike, rgb: ArrayLike, sigma_t: ArrayLike, emission: ArrayLike | None = None):
        assign(self, positions=positions, rgb=rgb, sigma_t=sigma_t, emission=emission)

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

    **Arguments:** `rgb`: `(n, 3)`; `sigma_t`: `(n,)` or `(n, 3)`; `domain`: `(low, high)` in the data's units; `emission`: `(n, 3)` or
    `None`, as of `LinearTransfer`. All differentiable. **Raises** `ValueError` as `LinearTransfer`, and where `low >= high`.
    """

    rgb: Float[Array, "n 3"] = parameter(COLOUR, ordered=True, least=2, doc="red, green, blue, linear")
    sigma_t: Float[Array, "..."] = extinction(ordered=True)
    domain: Float[Array, "2"] = parameter(INCREASING, doc="low < high in the data's own units")
    emission: Float[Array, "n 3"] | None = own_emission(ordered=True)

    def __init__(self, rgb: ArrayLike, sigma_t: ArrayLike, domain: ArrayLike, emission: ArrayLike | None = None):
        assign(self, rgb=rgb, sigma_t=sigma_t, domain=domain, emission=emission)

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
    `rgb`: `(n, 3)`; `emission`: `(n, 3)`, radiance per world length that each Gaussian emits by itself at its centre, summed as the
    extinctions are, or `None`. All differentiable.
    **Raises** `ValueError` for other shapes, widths not positive, negative heights.
    """

    center: Float[Array, "n"] = parameter(doc="in the data's own units")
    width: Float[Array, "n"] = parameter(POSITIVE, doc="in the data's own units")
    height: Float[Array, "..."] = extinction(ordered=False)
    rgb: Float[Array, "n 3"] = parameter(COLOUR, doc="red, green, blue, linear")
    emission: Float[Array, "n 3"] | None = own_emission(ordered=False)

    def __init__(self, center: ArrayLike, width: ArrayLike, height: ArrayLike, rgb: ArrayLike, emission: ArrayLike | None = None):
        assign(self, center=center, width=width, height=height, rgb=rgb, emission=emission)

    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        limit = jnp.finfo(self.center.dtype).max
        # Squared below: farther out the square would overflow, and the colour of two overflows is undefined.
        z = jnp.clip((s - self.center) / self.width, -0.5 * limit**0.5, 0.5 * limit**0.5)
        exponent = -0.5 * jnp.square(z)
        summed = lambda heights: tuple(jnp.sum(channel * jnp.exp(exponent)) for channel in _columns(heights))
        sigma_t, emission = summed(self.height), () if self.emission is None else summed(self.emission)
        # A softmax of log(height) + exponent, but linear in the height: the logarithm's derivative at zero is infinite.
        height = self.height if self.height.ndim == 1 else jnp.mean(self.height, axis=1)
        height = jnp.where(jnp.any(height > 0), height, 1.0)
        log_height = jnp.log(jnp.where(height > 0, height, 1.0))
        largest = jax.lax.stop_gradient(jnp.max(exponent + log_height, where=height > 0, initial=-limit))
        weight = height * jnp.exp(jnp.minimum(exponent - largest, 0.9 * jnp.log(limit)))
        weight = divide_or_zero(weight, jnp.broadcast_to(jnp.sum(weight), weight.shape))
        return Classified(_three(self.rgb.T @ weight), sigma_t, emission)

    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        # The largest extinction of each Gaussian in the range: at its centre, or at the end nearer to it. Zero is where it underflows,
        # and so does its derivative.
        nearest = jnp.clip(self.center, low, high)
        height = self.height if self.height.ndim == 1 else jnp.max(self.height, axis=1)
        largest = lambda height: jnp.sum(jnp.abs(height) * jnp.exp(-0.5 * jnp.square((nearest - self.center) / self.width)))
        visible = ~(largest(height) <= least)
        return visible if self.emission is None else visible | ~(largest(jnp.max(self.emission, axis=1)) <= least)


class ClearTransfer(AbstractTransfer):
    """Shows nothing: extinction 0 of every scalar. The medium of a scene of isosurfaces or geometry alone, which is not marched through."""

    is_clear: ClassVar[bool] = True

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry(name, False, "the medium shows nothing and is not marched through"),)

    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        nothing = jnp.zeros_like(s)
        return Classified((nothing,) * 3, (nothing,))

    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        return jnp.zeros((), bool)

    def _repr_html_(self) -> str:
        return "<div>ClearTransfer: shows nothing</div>"


def shown_entries(columns: Sequence[Float[Array, "n ..."]], least: Scalar | float) -> Bool[Array, "n"]:
    """Which entries, along the first axis, have anything above `least` in any of some columns."""
    flat = (column.reshape(column.shape[0], -1) for column in columns)
    return functools.reduce(jnp.logical_or, [jnp.any(~(jnp.abs(column) <= least), axis=1) for column in flat])


def any_between(
    visible: Bool[Array, "n"], u: Scalar, v: Scalar, beyond: tuple[Bool[Array, ""], Bool[Array, ""]] | None
) -> Bool[Array, ""]:
    """Whether any entry is `visible` that has a weight in a table's coordinates `u` ... `v`, both clamped to 0 ... n-1.

    Where `beyond` says whether what was clamped lies in front of the first entry and behind the last one, also those that have one next
    to `u` and `v`: at an entry both of its neighbours, beyond an end none.
    """
    first, last = entries_between(u, v, visible.shape[0], beyond)
    # Entries are counted: a difference of sums of the extinctions themselves would round small ones away.
    before = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(visible, dtype=jnp.int32)])
    return before[last + 1] > before[first]


def entries_between(
    u: Scalar, v: Scalar, n: int, beyond: tuple[Bool[Array, ""], Bool[Array, ""]] | None
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The first and the last of the `n` entries that `any_between` looks at."""
    first, last = jnp.floor(u), jnp.ceil(v)
    if beyond is not None:
        first = jnp.where(beyond[1], n - 1, jnp.maximum(jnp.ceil(u) - 1, 0))
        last = jnp.where(beyond[0], 0, jnp.minimum(jnp.floor(v) + 1, n - 1))
    return first.astype(jnp.int32), last.astype(jnp.int32)


def _columns(table: Float[Array, "..."]) -> tuple[Float[Array, "n"], ...]:
    return (table,) if table.ndim == 1 else tuple(table[:, c] for c in range(table.shape[1]))


def _three(v: Float[Array, "3"]) -> Triple:
    return v[0], v[1], v[2]


def _interpolate(table: AbstractTable, u: Scalar) -> Classified:
    # Each row beside the next, so that one read brings both around `u` with all their columns.
    names = table.entries
    rows = jnp.stack([column for entries in names.values() for column in _columns(entries)], axis=1)
    pairs, columns = jnp.concatenate([rows[:-1], rows[1:]], axis=1), rows.shape[1]
    low = jnp.clip(jnp.floor(u), 0, rows.shape[0] - 2)
    fraction = u - low
    pair = read_run(pairs, low.astype(jnp.int32), 1)[0]
    # The weighted sum, not a + f (b - a): at an end of an interval it returns the entry exactly.
    r, g, b, *rest = ((1 - fraction) * pair[c] + fraction * pair[columns + c] for c in range(columns))
    sigma_columns = len(rest) - 3 * ("emission" in names)
    return Classified((r, g, b), tuple(rest[:sigma_columns]), tuple(rest[sigma_columns:]))
