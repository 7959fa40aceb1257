"""Means over stretches of a table, for pre-integration (`jvr.model.preintegration`): of one interval, of two stretches together, and of
all blocks of whole intervals that a segment may cover."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.numerics import divide_or_zero


class Stretch(NamedTuple):
    """Means over a stretch of the scalar in one channel: extinction, extinction times colour, and `lag` as in `SegmentMeans`."""

    sigma: Float[Array, "..."]
    emission: Float[Array, "..."]
    lag: Float[Array, "..."]


def ramp(sigma: Array, sigma_rise: Array, colour: Array, colour_rise: Array) -> Stretch:
    """A stretch along which extinction and colour, of these means, change linearly by these amounts (its integrals in closed form)."""
    lag = colour_rise * (jnp.square(sigma) * (1 / 12) - jnp.square(sigma_rise) * (1 / 240))
    return Stretch(sigma, sigma * colour + sigma_rise * colour_rise * (1 / 12), lag)


def own_ramp(sigma: Array, sigma_rise: Array, own: Array, own_rise: Array) -> Stretch:
    """The same of emission of its own in the place of extinction times colour."""
    return Stretch(sigma, own, (own_rise * sigma - own * sigma_rise) * (1 / 12))


def union(fraction: Array, one: Stretch, fraction_too: Array, other: Stretch) -> Stretch:
    """One stretch and then another, averaged over a whole of which they are these fractions."""
    sigma, sigma_too = fraction * one.sigma, fraction_too * other.sigma
    emission, emission_too = fraction * one.emission, fraction_too * other.emission
    # The middle of the union is farther back than that of the first by half of the other's depth, and the other way round.
    apart = 0.5 * (emission_too * sigma - emission * sigma_too)
    return Stretch(
        sigma + sigma_too, emission + emission_too, jnp.square(fraction) * one.lag + jnp.square(fraction_too) * other.lag + apart
    )


# A stretch of one interval, from means and changes of extinction and of colour or emission along it.
Ramp: TypeAlias = Callable[[Array, Array, Array, Array], Stretch]

# A length and the means over it, of what is emitted with the extinction and of what is emitted beside it.
_Block = tuple[Float[Array, "..."], tuple[Stretch, ...]]


def means_of_blocks(x: Float[Array, "n"], of_intervals: tuple[Stretch, ...]) -> Float[Array, "blocks means"]:
    """Lengths and means of blocks of intervals, rows `level n + i`.

    Intervals, numbered by their lower entries, are joined in pairs, these in pairs again, and so on. On level `l` pairs of halves of
    `2^l` intervals are joined: there row `i` is from entry `i` to the middle of its pair, or from the middle to entry `i`.
    """
    n = x.shape[0]
    levels = (n - 1).bit_length()
    intervals = ((x[1:] - x[:-1])[:, None], of_intervals)
    to_end: _Block = jax.tree.map(lambda v: jnp.pad(v, ((0, 2**levels - n + 1), (0, 0))), intervals)
    i = jnp.arange(2**levels)

    def join(halves: tuple[_Block, _Block], level: Int[Array, ""]) -> tuple[tuple[_Block, _Block], Float[Array, "rows means"]]:
        # From entry `i` to the end of its half, and from the beginning of its half to entry `i`.
        to_end, from_start = halves
        is_second = ((i >> level) & 1)[:, None] == 1
        choose = lambda second, first: jax.tree.map(lambda a, b: jnp.where(is_second, a, b), second, first)
        other_half = jax.tree.map(lambda v: v[((i >> level) ^ 1) << level], to_end)
        length, (means, *own) = choose(from_start, to_end)
        joined = choose(to_end, _joined(to_end, other_half)), choose(_joined(other_half, from_start), from_start)
        return joined, jnp.concatenate([length, *means, *(x for one in own for x in (one.emission, one.lag))], axis=1)

    _, rows = jax.lax.scan(join, (to_end, jax.tree.map(jnp.zeros_like, to_end)), jnp.arange(levels))
    return rows[:, :n].reshape(levels * n, -1)


def _joined(one: _Block, other: _Block) -> _Block:
    length = one[0] + other[0]
    fractions = divide_or_zero(one[0], length), divide_or_zero(other[0], length)
    return length, tuple(union(fractions[0], a, fractions[1], b) for a, b in zip(one[1], other[1], strict=True))
