"""Pre-integration: what one segment of a ray adds while the scalar goes linearly from `s0` at its front to `s1` at its back,
seen through a piecewise-linear table (Engel, Kraus and Ertl 2001, "High-quality pre-integrated volume rendering").

Extinction and emission `sigma_t rgb` are piecewise polynomials of the scalar, so their means over `s0 ... s1` are exact, and a thin
peak between two samples is seen. A segment covers a stretch of the interval of the table that its lower end lies in, whole intervals,
and a stretch of the interval of its upper end. The whole intervals are not the difference of two prefix sums, which would cancel:
they are the union of two blocks that meet at the entry between whose number is divisible by the highest power of two, and means over
all such blocks are computed beforehand. So nothing but positive numbers is added, in the value and in the gradient of the table.

Self-attenuation: with `tau` the optical depth in front of a point of the segment, `d` that of all of it, and `y = d / 2`,

    emitted = integral of rgb exp(-tau) dtau  ~  integral of rgb phi1(d) (1 - (tau - d / 2) (1 + y^4)^(-1/4)) dtau.

The kernel on the right is linear in `tau`, so that the mean and the first moment of the colour are all that it needs, and they are
exact, too. It has the same integral as `exp(-tau)`, nearly the same first moment, and it is never negative: colours stay between those
of the table. One colour has no error; colours that are linear in `tau` have one of order `d^5`, and the curvature of the others adds
the next term of Legendre's expansion of `exp(-tau)`, of order `d^5` also. With the segment in `parts` equal parts, the error falls as
`parts^-4`, once a part is not opaque.

Emission `q` of its own is seen through the same kernel, by its mean and by the mean of `q (tau - d / 2)`, both exact. Without extinction
that is exact; else it has no error where `q` is proportional to the extinction, and one of order `d^2` and of how `q / sigma_t` bends along
the segment elsewhere: what glows in front of something opaque wants steps, or parts, that are not opaque.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.model.optical import AbstractOpticalModel, with_own
from jvr.model.stretches import Ramp, Stretch, means_of_blocks, own_ramp, ramp, union
from jvr.model.transfer import AbstractTransfer, Classified, LinearTransfer, LutTransfer
from jvr.numerics import attenuated, divide_or_zero, read_run
from jvr.types import Channels, Scalar, Triple

# How many intervals away from a table a scalar is clamped: beyond all precision, and its square does not overflow.
_FAR = 1e18


class SegmentMeans(NamedTuple):
    """Means over a segment. The mean of extinction times colour is `sigma_t rgb + surplus` in each channel.

    With both ends in one interval of the table or in neighbouring ones, `rgb` is the mean colour of the ends, and `surplus` and `lag`
    are small and vanish with the change of the colour: nearly equal ends, or one colour, are a segment of constant properties to the
    last digit, opaque or not. Else `rgb` is zero. `lag` is the mean of extinction times colour times `tau - d / 2`, the optical depth
    from the middle of the segment, for a length of 1. `own` and `own_lag`: the same means of emission of its own, where there is any.
    """

    rgb: Triple
    sigma_t: Channels
    surplus: Triple
    lag: Triple
    own: Channels = ()
    own_lag: Channels = ()

    def emit(self, optical: AbstractOpticalModel, dt: Scalar) -> tuple[Channels, Channels, Channels]:
        """Radiance that leaves the segment of length `dt`, by its extinction and by its own emission, and its optical depth, in the
        channels of `optical.evaluate_segment`."""
        emitted, dtau = optical.evaluate_segment(Classified(self.rgb, self.sigma_t), dt)
        if not emitted:
            return emitted, (), dtau
        if not dtau:
            coloured = tuple(e + more * dt for e, more in zip(emitted, self.surplus, strict=True))
            return coloured, tuple(q * dt for q in self.own), dtau
        sigma_t = self.sigma_t * (3 // len(self.sigma_t))

        def through(means: Channels, lags: Channels) -> Channels:
            tilted = (j - lag * dt * _tilt(s * dt) for j, lag, s in zip(means, lags, sigma_t, strict=True))
            return tuple(attenuated(j, s, dt) for j, s in zip(tilted, sigma_t, strict=True))

        coloured = tuple(e + more for e, more in zip(emitted, through(self.surplus, self.lag), strict=True))
        return coloured, through(self.own, self.own_lag) if self.own else (), dtau


class PreIntegratedTable(AbstractTransfer):
    """A table with the means over its blocks of intervals, ready for `evaluate_segment`. Made once, outside of a march's loop.

    **Arguments:** `table`: `LinearTransfer` or `LutTransfer`; `parts`: how many equal parts of a segment its self-attenuation takes
    apart, a rule of order 4. Extinction, and emission without attenuation, are exact whatever `parts`.

    Memory: `n ceil(log2 n)` rows of 8 numbers, 10 for coloured extinction, and 6 more for emission of its own. Differentiable in every
    array of `table`.
    **Raises** `TypeError` for another transfer function, `ValueError` where `parts` is not a positive integer.
    """

    table: LinearTransfer | LutTransfer
    entries: Float[Array, "entries columns"]
    blocks: Float[Array, "blocks means"]
    parts: int = eqx.field(static=True)

    def __init__(self, table: LinearTransfer | LutTransfer, parts: int = 1):
        if not isinstance(table, LinearTransfer | LutTransfer):
            raise TypeError(f"pre-integration needs a LinearTransfer or a LutTransfer, not a {type(table).__name__}")
        if not isinstance(parts, int) or parts < 1:
            raise ValueError(f"parts must be a positive whole number, not {parts}")
        self.table, self.parts = table, parts
        n = table.rgb.shape[0]
        # An equally spaced table is measured in its own intervals: its entries sit at integers, exactly.
        x = table.positions if isinstance(table, LinearTransfer) else jnp.arange(n, dtype=table.rgb.dtype)
        sigma_t, own = table.sigma_t.reshape(n, -1), [] if table.emission is None else [table.emission]
        # Both ends are repeated: outside of the table lies an interval of no width between equal entries.
        self.entries = jnp.pad(jnp.concatenate([x[:, None], table.rgb, sigma_t, *own], axis=1), ((1, 1), (0, 0)), mode="edge")
        mean, rise = lambda v: 0.5 * (v[1:] + v[:-1]), lambda v: v[1:] - v[:-1]
        of = lambda ramp, values: ramp(mean(sigma_t), rise(sigma_t), mean(values), rise(values))
        self.blocks = means_of_blocks(x, (of(ramp, table.rgb), *(of(own_ramp, q) for q in own)))

    def evaluate(self, s: Scalar, magnitude: Scalar | None = None) -> Classified:
        return self.table.evaluate(s)

    def is_visible(self, low: Scalar, high: Scalar, least: Scalar | float = 0.0, *, nearby: bool = False) -> Bool[Array, ""]:
        return self.table.is_visible(low, high, least, nearby=nearby)

    def evaluate_segment(self, optical: AbstractOpticalModel, s0: Scalar, s1: Scalar, dt: Scalar) -> tuple[Channels, Channels]:
        """Radiance that leaves a segment of length `dt` along which the scalar goes linearly from `s0` to `s1`, and its optical
        depth, in the channels of `optical.evaluate_segment`.

        Differentiable in everything. Where an end lies at an entry the derivative in the scalar is that of one side. The place of an
        entry between those of a `LutTransfer`'s domain is known to rounding: so is which side a scalar nearer than that lies on.
        """
        emitted, own, dtau = self.evaluate_apart(optical, s0, s1, dt)
        return with_own(emitted, own), dtau

    def evaluate_apart(
        self, optical: AbstractOpticalModel, s0: Scalar, s1: Scalar, dt: Scalar
    ) -> tuple[Channels, Channels, Channels]:
        """The same with the radiance in two: that of the extinction's colour, and that of own emission, empty where there is none."""
        emitted, own, dtau = self.means(s0, s1).emit(optical, dt)
        if self.parts == 1 or not emitted or not dtau:
            return emitted, own, dtau
        ends = [s0 + (s1 - s0) * (k / self.parts) for k in range(self.parts)] + [s1]
        parts = [self.means(a, b).emit(optical, dt / self.parts) for a, b in itertools.pairwise(ends)]
        emitted, own, dtau = parts[0]
        for more, own_too, depth in parts[1:]:
            T = tuple(jnp.exp(-tau) for tau in dtau) * (3 // len(dtau))
            emitted = tuple(e + t * m for e, t, m in zip(emitted, T, more, strict=True))
            own = tuple(e + t * m for e, t, m in zip(own, T, own_too, strict=False))
            dtau = tuple(tau + d for tau, d in zip(dtau, depth, strict=True))
        return emitted, own, dtau

    def means(self, s0: Scalar, s1: Scalar) -> SegmentMeans:
        """The means over a segment along which the scalar goes linearly from `s0` at the front to `s1` at the back."""
        # They do not depend on the direction; only `lag` changes its sign.
        falls = s1 < s0
        a, b = self._locate(jnp.where(falls, s1, s0)), self._locate(jnp.where(falls, s0, s1))
        a, b, blocks = self._read(a, b)
        cut = _cut(a, b, blocks)
        n_sigma = self.table.sigma_t.size // self.table.rgb.shape[0]
        channels = []
        for c in range(3):
            sigma, colour = (_profile(a, b, cut, column) for column in (3 + c % n_sigma, c))
            whole = (Stretch(m[1 + c % n_sigma], m[1 + n_sigma + c], m[4 + n_sigma + c]) for m in blocks)
            pair = zip(_far_apart(cut, sigma, colour, ramp, *whole), _nearby(cut, sigma, colour), strict=True)
            channels.append([jnp.where(cut.whole, far, near) for far, near in pair])
        rgb, sigma_t, surplus, lag = (tuple(v) for v in zip(*channels, strict=True))
        turned: Callable[[Channels], Channels] = lambda lags: tuple(jnp.where(falls, -v, v) for v in lags)
        found = SegmentMeans(rgb, sigma_t[:n_sigma], surplus, turned(lag))
        if self.table.emission is None:
            return found
        own, own_lag = self._own_means(a, b, cut, blocks)
        return found._replace(own=own, own_lag=turned(own_lag))

    def _own_means(self, a: "_End", b: "_End", cut: "_Cut", blocks: tuple[Channels, Channels]) -> tuple[Channels, Channels]:
        """Means of the emission of its own, and of that times the depth from the middle."""
        n_sigma = self.table.sigma_t.size // self.table.rgb.shape[0]
        channels = []
        for c in range(3):
            sigma, own = (_profile(a, b, cut, column) for column in (3 + c % n_sigma, 3 + n_sigma + c))
            whole = (Stretch(m[1 + c % n_sigma], m[7 + n_sigma + c], m[10 + n_sigma + c]) for m in blocks)
            _, _, *far = _far_apart(cut, sigma, own, own_ramp, *whole)
            channels.append([jnp.where(cut.whole, *pair) for pair in zip(far, _own_nearby(cut, sigma, own), strict=True)])
        own, lag = (tuple(v) for v in zip(*channels, strict=True))
        return own, lag

    def _locate(self, s: Scalar) -> tuple[Scalar, Int[Array, ""]]:
        """A coordinate that is linear in the scalar, also outside of the table, and the interval, 0 and `n` outside of it."""
        if isinstance(self.table, LinearTransfer):
            return s, jnp.searchsorted(self.table.positions, s, side="right", method="scan_unrolled").astype(jnp.int32)
        low, high = self.table.domain[0], self.table.domain[1]
        last = self.table.rgb.shape[0] - 1
        x = jnp.clip((s - low) * (last / (high - low)), -_FAR, _FAR)
        return x, jnp.clip(jnp.floor(x), -1, last).astype(jnp.int32) + 1

    def _read(self, a: tuple[Scalar, Array], b: tuple[Scalar, Array]) -> tuple["_End", "_End", tuple[Channels, Channels]]:
        """The entries around both ends, and the rows of the two blocks between them (anything, where there are none)."""
        n = self.table.rgb.shape[0]
        (x_a, i_a), (x_b, i_b) = a, b
        # The entry that ends the interval of `a`, and the one that begins that of `b`.
        j, k = jnp.minimum(i_a, n - 1), jnp.maximum(i_b - 1, 0)
        level = jnp.where(k > j, 31 - jax.lax.clz(j ^ k), 0)
        rows = [row for i in (i_a, i_b) for row in read_run(self.entries, i, 2)]
        rows += [read_run(self.blocks, level * n + i, 1)[0] for i in (j, k)]
        columns = [_columns(row) for row in rows]
        if isinstance(self.table, LutTransfer):
            # Lengths are counted in intervals there: no derivative goes through them.
            columns = [(jax.lax.stop_gradient(length), *values) for length, *values in columns]
        below_a, above_a, below_b, above_b, *blocks = _apart(jnp.isfinite(self.entries[0, 0]), columns)
        end_a = _End(x_a, i_a, below_a[0], above_a[0], below_a[1:], above_a[1:])
        return end_a, _End(x_b, i_b, below_b[0], above_b[0], below_b[1:], above_b[1:]), (blocks[0], blocks[1])


@jax.custom_jvp
def _apart(sure: Bool[Array, ""], columns: list[Channels]) -> list[Channels]:
    """`columns`; `sure` is true. In reverse mode their cotangents end in a conditional, the one thing that the compiler does not fuse
    through: else all of their computation is repeated in each of the scattered additions, which then take thirty times as long."""
    return columns


@_apart.defjvp
def _apart_jvp(primals: tuple[Array, list[Channels]], tangents: tuple[Array, list[Channels]]):
    sure, columns = primals
    return columns, jax.lax.cond(sure, lambda t: t, lambda t: jax.tree.map(jnp.zeros_like, t), tangents[1])


def _columns(row: Float[Array, "columns"]) -> Channels:
    return tuple(row[c] for c in range(row.shape[0]))


class _End(NamedTuple):
    """An end of a segment: its coordinate and its interval, and the coordinates and the values (`rgb`, then `sigma_t`) of the entries
    below and above."""

    x: Scalar
    interval: Int[Array, ""]
    below: Scalar
    above: Scalar
    left: Channels
    right: Channels


class _Cut(NamedTuple):
    """How a segment divides into a first stretch (all of it, where both ends are in one interval), two blocks of whole intervals and
    a last stretch: `first`, `block`, `block_too`, `last` are their fractions of the segment, and `whole` says whether there are blocks.

    `of_a`, `of_b`: weights of the entries below and above in the lower and in the upper end. `covers_a`, `covers_b`: the fractions of
    their intervals that the stretches cover.
    """

    whole: Bool[Array, ""]
    first: Scalar
    block: Scalar
    block_too: Scalar
    last: Scalar
    of_a: tuple[Scalar, Scalar]
    of_b: tuple[Scalar, Scalar]
    covers_a: Scalar
    covers_b: Scalar


def _cut(a: _End, b: _End, blocks: tuple[Channels, Channels]) -> _Cut:
    same, whole, length = a.interval == b.interval, b.interval > a.interval + 1, b.x - a.x
    first = jnp.where(same, b.x, a.above) - a.x
    last = jnp.where(same, 0.0, b.x - b.below)
    of_b = _weights(b)
    return _Cut(
        whole=whole,
        first=divide_or_zero(first, length),
        # Without blocks the rows are any, and the segment may be so short that the quotients overflow.
        block=divide_or_zero(jnp.where(whole, blocks[0][0], 0.0), length),
        block_too=divide_or_zero(jnp.where(whole, blocks[1][0], 0.0), length),
        last=divide_or_zero(last, length),
        of_a=_weights(a),
        of_b=of_b,
        covers_a=divide_or_zero(first, a.above - a.below),
        covers_b=jnp.where(same, 0.0, of_b[1]),
    )


def _weights(end: _End) -> tuple[Scalar, Scalar]:
    # Not one minus the other: each keeps its digits where it is small.
    width = end.above - end.below
    below = jnp.where(width > 0, divide_or_zero(end.above - end.x, width), 1.0)
    return below, divide_or_zero(end.x - end.below, width)


class _Profile(NamedTuple):
    """Extinction or colour: mean and change along the first stretch and along the last one, and the mean of both ends."""

    first: Scalar
    rise: Scalar
    last: Scalar
    rise_too: Scalar
    ends: Scalar


def _profile(a: _End, b: _End, cut: _Cut, column: int) -> _Profile:
    # The weighted sum, not one entry and a part of the difference: it keeps the digits of an entry next to a large one.
    at_a = cut.of_a[0] * a.left[column] + cut.of_a[1] * a.right[column]
    at_b = cut.of_b[0] * b.left[column] + cut.of_b[1] * b.right[column]
    rise = cut.covers_a * (a.right[column] - a.left[column])
    rise_too = cut.covers_b * (b.right[column] - b.left[column])
    return _Profile(at_a + 0.5 * rise, rise, at_b - 0.5 * rise_too, rise_too, 0.5 * (at_a + at_b))


# Colour, extinction, surplus and lag of one channel.
_Channel = tuple[Scalar, Scalar, Scalar, Scalar]


def _nearby(cut: _Cut, sigma: _Profile, colour: _Profile) -> _Channel:
    """Both ends in one interval, or in neighbouring ones.

    The union of both stretches, in terms of the changes, which are exact where they are small: fractions of a short segment are quotients
    of small lengths with large derivatives, and a difference of means beside them would be all rounding.
    """
    last = cut.last
    first = 1 - last
    bend, bend_too = sigma.rise * colour.rise * (1 / 12), sigma.rise_too * colour.rise_too * (1 / 12)
    surplus = first * (bend - 0.5 * colour.rise_too * sigma.first) + last * (bend_too + 0.5 * colour.rise * sigma.last)
    lag = ramp(sigma.first, sigma.rise, colour.first, colour.rise).lag
    lag_too = ramp(sigma.last, sigma.rise_too, colour.last, colour.rise_too).lag
    apart = 0.5 * sigma.first * sigma.last * (colour.rise + colour.rise_too) + sigma.first * bend_too - sigma.last * bend
    lag = jnp.square(first) * lag + jnp.square(last) * lag_too + 0.5 * first * last * apart
    return colour.ends, sigma.first + 0.5 * last * (sigma.rise + sigma.rise_too), surplus, lag


def _own_nearby(cut: _Cut, sigma: _Profile, own: _Profile) -> tuple[Scalar, Scalar]:
    """The same of emission of its own: its mean, and its lag."""
    last = cut.last
    first = 1 - last
    lag = own_ramp(sigma.first, sigma.rise, own.first, own.rise).lag
    lag_too = own_ramp(sigma.last, sigma.rise_too, own.last, own.rise_too).lag
    apart = 0.5 * (sigma.first * (own.rise + own.rise_too) - own.first * (sigma.rise + sigma.rise_too))
    lag = jnp.square(first) * lag + jnp.square(last) * lag_too + 0.5 * first * last * apart
    return own.first + 0.5 * last * (own.rise + own.rise_too), lag


def _far_apart(cut: _Cut, sigma: _Profile, values: _Profile, ramp: Ramp, block: Stretch, block_too: Stretch) -> _Channel:
    """Whole intervals between the ends."""
    one = jnp.ones_like(cut.first)
    lower = union(cut.first, ramp(sigma.first, sigma.rise, values.first, values.rise), cut.block, block)
    last = ramp(sigma.last, sigma.rise_too, values.last, values.rise_too)
    whole = union(one, lower, one, union(cut.block_too, block_too, cut.last, last))
    return jnp.zeros_like(one), whole.sigma, whole.emission, whole.lag


def _tilt(depth: Scalar) -> Scalar:
    """The slope of the kernel at the top of this file, `(1 + y^4)^(-1/4)`, `y = depth / 2`."""
    # There the 1 is below the rounding of float64, and farther away the power overflows.
    steep = depth > 2e4
    y = 0.5 * jnp.where(steep, 0.0, depth)
    return jnp.where(steep, 2 / jnp.where(steep, depth, 1.0), jax.lax.rsqrt(jnp.sqrt(1 + jnp.square(jnp.square(y)))))
