"""As many points as one function of the scalar needs to be met by straight lines between them.

VTK goes straight in opacity and in colours as they are shown, `jvr.LinearTransfer` in extinction and in linear light. Points are added
until both ways agree between neighbours, so that what is handed from one to the other comes back as the same function.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jvr.pictures import linear_from_srgb, srgb_from_linear

# Opacity over the unit distance and over any shorter one, and colours as they are shown, are met to half a step of eight bits.
ERROR = 1 / 512
# Points are no nearer than so many steps of single precision, nor than this share of the range: a jump is that wide.
STEPS, SHARE = 16, 1e-6
# Where a straight line from point to point goes by one in between as near as this, it is left out.
COLLINEAR = 1e-6
INSIDE = np.linspace(0, 1, 9)[1:-1]


class Samples(NamedTuple):
    """Optical depth over the unit distance `(n,)` and linear light `(n, 3)` at some scalars."""

    depth: np.ndarray
    light: np.ndarray


Function = Callable[[np.ndarray], Samples]


def width(x: np.ndarray) -> float:
    """How wide a jump is among points `x`, so that single precision tells its ends apart."""
    return float(max(STEPS * np.finfo(np.float32).eps * np.max(np.abs(x)), SHARE * np.ptp(x)))


def refined(x: np.ndarray, function: Function, encoding: str) -> tuple[np.ndarray, Samples]:
    """Points, those of `x` among them, in single precision, between which both kinds of straight lines meet the function."""
    x = in_single(x)
    least = width(x)
    while True:
        bad = (np.diff(x) > least) & ~_agree(x, function, encoding)
        more = in_single(np.concatenate([x, 0.5 * (x[:-1] + x[1:])[bad]]))
        if len(more) == len(x):
            return x, function(x)
        x = more


def in_single(x: np.ndarray) -> np.ndarray:
    """Sorted, each once, as single precision has them."""
    return np.unique(single(x))


def single(x: np.ndarray) -> np.ndarray:
    """As single precision has them. **Raises** `ValueError` for what is too large for it."""
    with np.errstate(over="ignore"):
        rounded = np.asarray(x, np.float64).astype(np.float32).astype(np.float64)
    if not np.all(np.isfinite(rounded)):
        raise ValueError("a scalar is too large for single precision")
    return rounded


def _agree(x: np.ndarray, function: Function, encoding: str) -> np.ndarray:
    """Of each interval, whether the function, and straight lines of VTK's kind, are near straight lines of jvr's kind."""
    ends, inner = function(x), function((x[:-1, None] + np.diff(x)[:, None] * INSIDE).ravel())
    straight = lambda values: _between(values).reshape(-1, *values.shape[1:])
    depth, light = straight(ends.depth), straight(ends.light)
    of_opacity = -np.log1p(straight(np.expm1(-ends.depth)))
    good = opacity_error(depth, inner.depth) <= ERROR
    good &= opacity_error(depth, of_opacity) <= ERROR
    seen = shown(light, encoding)
    for other in (shown(inner.light, encoding), straight(shown(ends.light, encoding))):
        good &= np.all(np.abs(seen - other) <= ERROR, axis=1)
    return np.all(good.reshape(-1, len(INSIDE)), axis=1)


def _between(values: np.ndarray) -> np.ndarray:
    weight = INSIDE.reshape(1, -1, *[1] * (values.ndim - 1))
    return (1 - weight) * values[:-1, None] + weight * values[1:, None]


def opacity_error(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The most that opacities of two optical depths differ by over the distance itself or a part of it."""
    low, high = np.minimum(a, b), np.maximum(a, b)
    # Derivative in the distance r: low exp(-r low) = high exp(-r high).
    with np.errstate(divide="ignore", invalid="ignore"):
        worst = np.log(high / low) / (high - low)
    r = np.where(np.isfinite(worst), np.minimum(worst, 1), 1)
    return np.exp(-r * low) - np.exp(-r * high)


def needed(x: np.ndarray, values: np.ndarray, tolerance: float = COLLINEAR) -> np.ndarray:
    """Indices of the points `(n,)` that straight lines of `values` `(n, channels)` need: the ends, and where they bend."""
    kept, last = [0], len(x) - 1
    while kept[-1] < last:
        first = kept[-1]
        end = first + 1
        while end < last and _is_straight(x, values, first, end + 1, tolerance):
            end += 1
        kept.append(end)
    return np.array(kept)


def _is_straight(x: np.ndarray, values: np.ndarray, first: int, last: int, tolerance: float) -> bool:
    inside = slice(first + 1, last)
    t = ((x[inside] - x[first]) / (x[last] - x[first]))[:, None]
    return bool(np.all(np.abs((1 - t) * values[first] + t * values[last] - values[inside]) <= tolerance))


def shown(light: np.ndarray, encoding: str) -> np.ndarray:
    """Colours as another program says them, of linear light."""
    return srgb_from_linear(light) if encoding == "srgb" else light


def light_of(colours: np.ndarray, encoding: str) -> np.ndarray:
    """Linear light of colours as another program says them."""
    return linear_from_srgb(colours) if encoding == "srgb" else colours
