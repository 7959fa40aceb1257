"""Front-to-back compositing: what a ray has gathered, in sums of two floats for each channel.

A channel that nothing emits or absorbs in is absent: a tuple may be empty, and one transmittance may serve three channels.
"""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.numerics import one_minus_exp, two_sum
from jvr.types import Channels


class Sums(NamedTuple):
    """The running state of a ray: radiance and optical depth as unevaluated sums of two floats (see `two_sum`), and the
    opacity-weighted distance."""

    radiance: Channels
    radiance_low: Channels
    tau: Channels
    tau_low: Channels
    distance: Channels


def add_segment(sums: Sums, emitted: Channels, dtau: Channels, u: Float[Array, "rays"]) -> Sums:
    """One step of front-to-back compositing."""
    before = transmittance(sums.tau, sums.tau_low)
    radiance = add(sums.radiance, sums.radiance_low, through(before, emitted))
    tau = add(sums.tau, sums.tau_low, dtau)
    # Where the distance is not asked for, `sums.distance` is empty and nothing is computed.
    distance = tuple(total + a * u for total, a in zip(sums.distance, opacity(before, dtau), strict=False))
    return Sums(*radiance, *tau, distance)


def transmittance(tau: Channels, tau_low: Channels) -> Channels:
    """Transmittance from the optical depth, and not as a running product, whose rounding errors would add up."""
    return tuple(jnp.exp(-depth) for depth in join(tau, tau_low))


def through(transmittances: Channels, emitted: Channels) -> Channels:
    """What remains of each channel of `emitted`; a single transmittance serves all channels, none attenuates nothing."""
    if not transmittances:
        return emitted
    return tuple(T * e for T, e in zip(spread(transmittances, len(emitted)), emitted, strict=True))


def spread(channels: Channels, n: int) -> Channels:
    """One component repeated for `n` channels, or the `n` components themselves."""
    return channels * (n // len(channels)) if channels else channels


def opacity(before: Channels, dtau: Channels) -> Channels:
    """What one segment adds to the opacity of its ray, in each channel of `dtau`."""
    return tuple(T * one_minus_exp(d) for T, d in zip(before, dtau, strict=True))


def opaque_depth(dtype: Any) -> float:
    """The optical depth at which the transmittance underflows."""
    return -math.log(float(jnp.finfo(dtype).tiny))


def add(high: Channels, low: Channels, terms: Channels) -> tuple[Channels, Channels]:
    """`two_sum` in every channel."""
    sums = [two_sum(h, low_, t) for h, low_, t in zip(high, low, terms, strict=True)]
    return tuple(s[0] for s in sums), tuple(s[1] for s in sums)


def join(high: Channels, low: Channels) -> Channels:
    """Two-float sums rounded to one float."""
    return tuple(h + low_ for h, low_ in zip(high, low, strict=True))
