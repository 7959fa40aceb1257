"""How far apart samples may be: oracles for adaptive sampling (Kraus, Strengert, Klein and Ertl, "Adaptive sampling in three dimensions
for volume rendering on GPUs", section 3: an oracle "returns a preferable sampling distance d for any point in space").

The oracles here look at the volume and the transfer function, not at the view. Each says for every brick of voxels what distance
that brick asks for by itself; a point is then given the smallest of what any brick asks for plus the way to it. What bricks ask for
is measured by what one voxel length of the medium, if it were all alike, would add to a picture: its opacity and the radiance that it
emits, both 0 ... 1 for colours of 0 ... 1. No derivative goes through any of this.
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any
from jaxtyping import Array, Float, Int

from jvr.model.bricks import bricks_of
from jvr.model.optical import AbstractOpticalModel
from jvr.model.parameters import assign, choice
from jvr.model.ranges import POSITIVE
from jvr.model.transfer import LinearTransfer, LutTransfer
from jvr.model.volume import Volume
from jvr.numerics import one_minus_exp, read_at
from jvr.types import Scalar, Triple


class DistanceField(eqx.Module):
    """The distance that is wanted between samples, a world length for each brick of `size` voxels an edge."""

    distance: Float[Array, "bx by bz"]
    brick: int = eqx.field(static=True)

    def at(self, p: Triple) -> Float[Array, "points"]:
        """The wanted distance at grid positions."""
        index = [
            jnp.clip(jnp.floor(x / self.brick), 0, n - 1).astype(jnp.int32) for x, n in zip(p, self.distance.shape, strict=True)
        ]
        flat = (index[0] * self.distance.shape[1] + index[1]) * self.distance.shape[2] + index[2]
        return read_at(self.distance.reshape(-1), flat)


class AbstractOracle(eqx.Module):
    """An oracle: where samples may be far apart. `brick`: voxels along an edge of the bricks that are looked at."""

    brick: ClassVar[int]

    @abc.abstractmethod
    def wanted(self, volume: Volume, features: "Features") -> Float[Array, "bx by bz"]:
        """The distance between samples that each brick asks for by itself, a world length, infinite where any will do."""


class Finest(AbstractOracle):
    """The smallest distance everywhere, so that every sample is taken (the column "min." of the paper's tables 2 and 3)."""

    brick: ClassVar[int] = 64

    def wanted(self, volume: Volume, features: "Features") -> Float[Array, "bx by bz"]:
        return jnp.zeros_like(bricks_of(volume.values, self.brick).lower, jnp.result_type(volume.slope))


class _Tolerant(AbstractOracle):
    tolerance: float = choice(POSITIVE, doc="opacity and radiance of one voxel", hint="0.01 is a good start")

    def __init__(self, tolerance: float | int = 0.01):
        assign(self, tolerance=tolerance)


class OpacityChange(_Tolerant):
    """The distance to the nearest cell of voxels in which the opacity of one voxel length changes by more than `tolerance` (the paper's
    oracle, section 4: "the distance to the nearest voxel that features a gradient magnitude of the opacity greater than some threshold").
    Emission is looked at instead where the optical model has no opacity. **Raises** `ValueError` for a tolerance out of range.
    """

    brick: ClassVar[int] = 1

    def wanted(self, volume: Volume, features: "Features") -> Float[Array, "bx by bz"]:
        change = _spread(features._replace(rows=features.rows[-1:]), *_bounds(volume, self.brick))
        return jnp.where(change <= self.tolerance, jnp.inf, 0.0)


class BrickRange(_Tolerant):
    """A brick of 4^3 voxels in which opacity and emission of one voxel length range over `R` asks for `4 tolerance / R` voxels: the
    distance over which they change by `tolerance` if they change evenly. **Raises** `ValueError` for a tolerance out of range."""

    brick: ClassVar[int] = 4

    def wanted(self, volume: Volume, features: "Features") -> Float[Array, "bx by bz"]:
        change = _spread(features, *_bounds(volume, self.brick))
        return jnp.min(volume.spacing) * self.brick * _quotient(self.tolerance, change)


class LocalError(_Tolerant):
    """The distance over which interpolating the scalar linearly is wrong by `tolerance` in opacity and emission of one voxel length.

    A scalar whose second derivative is at most `c2`, and whose slope jumps by at most `c1` from voxel to voxel, is interpolated over a
    distance `d` with an error of at most `max(c1 d / 4, c2 d^2 / 8)`; times the steepest slope `m` of the transfer function over the
    cell's values this is the error of opacity or emission. So

        d = min(4 tolerance / (m c1), sqrt(8 tolerance / (m c2))),

    with `c1` and `c2` from second differences of the voxels, along axes and mixed. Scalars that vary linearly ask for nothing, however
    steep: segments are pre-integrated, so only the scalar has to be right. **Raises** `ValueError` for a tolerance out of range.
    """

    brick: ClassVar[int] = 1

    def wanted(self, volume: Volume, features: "Features") -> Float[Array, "bx by bz"]:
        c1, c2, largest = (bricks_of(c, self.brick).upper for c in _curvatures(volume))
        low, high = _bounds(volume, self.brick)
        # Interpolated values leave the range of the voxels by no more than a second difference.
        slope = _steepest(features, low - largest, high + largest)
        ask = lambda c, scale: _quotient(scale * self.tolerance, slope * c)
        distance = jnp.minimum(ask(c1, 4.0), jnp.sqrt(ask(c2, 8.0)))
        return jnp.where(jnp.isnan(low + high), 0.0, distance)


def distance_field(
    oracle: AbstractOracle, volume: Volume, table: LinearTransfer | LutTransfer, optical: AbstractOpticalModel, farthest: Scalar
) -> DistanceField:
    """What `oracle` says, up to the world length `farthest`; traceable, not differentiable."""
    volume, table, optical, farthest = jax.lax.stop_gradient((volume, table, optical, farthest))
    wanted = oracle.wanted(volume, features_of(volume, table, optical))
    return DistanceField(envelope(wanted, thickness(volume, oracle.brick), farthest), oracle.brick)


def thickness(volume: Volume, brick: int) -> Triple:
    """World distance between opposite faces of a brick, for each axis."""
    axes = jnp.eye(3, dtype=volume.world_from_grid.dtype)
    rows = volume.grid_from_world((axes[0], axes[1], axes[2]), direction=True)
    return tuple(brick / jnp.linalg.norm(row) for row in rows)


def envelope(wanted: Float[Array, "bx by bz"], thickness: Triple, farthest: Scalar) -> Float[Array, "bx by bz"]:
    """`min over bricks b of wanted[b] + (distance to b)`, for every brick; at most `farthest` and what is wanted there.

    Distances are between slabs, `max over axes of (|difference of indices| - 1) * thickness`: never more than the Euclidean distance
    between any two points of the bricks. With 0 and infinity in `wanted` this is a distance transform (chessboard metric).
    """
    finest = jnp.minimum(jnp.minimum(thickness[0], thickness[1]), thickness[2])
    # Bricks on each side that a radius reaches; a rounding above an integer is not one more.
    width = lambda radius: [jnp.ceil(radius / t - 1e-3) for t in thickness]

    def grow(state: tuple[Int[Array, ""], Array, Array]):
        k, smallest, distance = state
        for axis, (now, before) in enumerate(zip(width((k + 1) * finest), width(k * finest), strict=True)):
            smallest = jnp.where(now > before, _smallest_of_three(smallest, axis), smallest)
        return k + 1, smallest, jnp.minimum(distance, smallest + k * finest)

    start = (jnp.int32(0), wanted, jnp.minimum(wanted, farthest))
    # Beyond `farthest`, as far as another of a batch may look, nothing changes.
    return jax.lax.while_loop(lambda state: unvmap_any(state[0] * finest < farthest), grow, start)[2]


def _smallest_of_three(values: Float[Array, "x y z"], axis: int) -> Float[Array, "x y z"]:
    padding = [(1, 1) if a == axis else (0, 0) for a in range(3)]
    padded, n = jnp.pad(values, padding, constant_values=jnp.inf), values.shape[axis]
    before, after = (jax.lax.slice_in_dim(padded, at, at + n, axis=axis) for at in (0, 2))
    return jnp.minimum(values, jnp.minimum(before, after))


class Features(NamedTuple):
    """What one voxel length of the medium adds to a picture, a row for each feature (emission in each channel, then opacity), at the
    entries of a table."""

    table: LinearTransfer | LutTransfer
    positions: Float[Array, "n"]
    rows: Float[Array, "features n"]


def features_of(volume: Volume, table: LinearTransfer | LutTransfer, optical: AbstractOpticalModel) -> Features:
    """The features of the medium that an oracle looks at."""
    classified = jax.vmap(table.evaluate)(table.positions)
    emitted, dtau = optical.evaluate_segment(classified, jnp.min(volume.spacing))
    return Features(table, table.positions, jnp.stack([*emitted, *map(one_minus_exp, dtau)]))


def _bounds(volume: Volume, brick: int) -> tuple[Float[Array, "bx by bz"], Float[Array, "bx by bz"]]:
    """The smallest and the largest scalar of each brick."""
    bricks = bricks_of(volume.values, brick)
    ends = [volume.slope * v.astype(volume.slope.dtype) + volume.intercept for v in (bricks.lower, bricks.upper)]
    return jnp.minimum(*ends), jnp.maximum(*ends)


def _spread(features: Features, low: Float[Array, "bx by bz"], high: Float[Array, "bx by bz"]) -> Float[Array, "bx by bz"]:
    """The largest range of any feature over the scalars `low` ... `high`; infinite where they are NaN."""
    coordinate = jax.vmap(features.table.coordinate)
    u, v = coordinate(low.ravel()), coordinate(high.ravel())
    first, last = jnp.ceil(u).astype(jnp.int32), jnp.floor(v).astype(jnp.int32)
    spread = jnp.zeros_like(u)
    for feature in features.rows:
        a, b = _lerp(feature, u), _lerp(feature, v)
        inside, below = _largest(feature, first, last), -_largest(-feature, first, last)
        top = jnp.maximum(jnp.maximum(a, b), jnp.where(last >= first, inside, -jnp.inf))
        bottom = jnp.minimum(jnp.minimum(a, b), jnp.where(last >= first, below, jnp.inf))
        spread = jnp.maximum(spread, top - bottom)
    return jnp.where(jnp.isnan(low + high), jnp.inf, spread.reshape(low.shape))


def _steepest(features: Features, low: Float[Array, "bx by bz"], high: Float[Array, "bx by bz"]) -> Float[Array, "bx by bz"]:
    """The steepest slope of any feature over the scalars `low` ... `high`."""
    coordinate = jax.vmap(features.table.coordinate)
    first = jnp.floor(coordinate(low.ravel())).astype(jnp.int32)
    last = jnp.ceil(coordinate(high.ravel())).astype(jnp.int32) - 1
    slopes = jnp.max(jnp.abs(jnp.diff(features.rows, axis=1)), axis=0) / jnp.diff(features.positions)
    return jnp.where(last >= first, _largest(slopes, first, last), 0.0).reshape(low.shape)


def _lerp(feature: Float[Array, "n"], u: Float[Array, "m"]) -> Float[Array, "m"]:
    low = jnp.clip(jnp.floor(u), 0, feature.size - 2).astype(jnp.int32)
    return feature[low] + (u - low) * (feature[low + 1] - feature[low])


def _largest(values: Float[Array, "n"], first: Int[Array, "m"], last: Int[Array, "m"]) -> Float[Array, "m"]:
    """`max(values[first : last + 1])`, from the largest of every run of `2^l` entries; anything where `last < first`."""
    runs, length = [values], 1
    while 2 * length <= values.size:
        shifted = jnp.concatenate([runs[-1][length:], jnp.full(length, -jnp.inf, values.dtype)])
        runs.append(jnp.maximum(runs[-1], shifted))
        length *= 2
    runs = jnp.stack(runs)
    count = jnp.maximum(last - first + 1, 1)
    level = 31 - jax.lax.clz(count)
    at = lambda i: runs[level, jnp.clip(i, 0, values.size - 1)]
    return jnp.maximum(at(first), at(last + 1 - (1 << level)))


def _curvatures(volume: Volume) -> tuple[Array, Array, Array]:
    """For each voxel the largest jump of the slope of the scalar along an axis, its largest second derivative (both per world length),
    and the largest second difference."""
    values = volume.slope * volume.values.astype(volume.slope.dtype)
    zero = jnp.zeros_like(values)
    jump, bend, largest, h = zero, zero, zero, volume.spacing
    for a in range(3):
        second = jnp.abs(jnp.diff(values, n=2, axis=a))
        # At the border there is no second difference.
        second = _pad_ends(second, a, values.shape[a])
        jump, bend = jnp.maximum(jump, second / h[a]), jnp.maximum(bend, second / h[a] ** 2)
        largest = jnp.maximum(largest, second)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        mixed = jnp.abs(jnp.diff(jnp.diff(values, axis=a), axis=b))
        mixed = jnp.pad(mixed, [(0, n - m) for n, m in zip(values.shape, mixed.shape, strict=True)], mode="constant")
        bend, largest = bend + mixed / (h[a] * h[b]), jnp.maximum(largest, mixed)
    return jump, bend, largest


def _pad_ends(inner: Float[Array, "a b c"], axis: int, n: int) -> Float[Array, "x y z"]:
    missing = n - inner.shape[axis]
    return jnp.pad(inner, [(missing // 2, missing - missing // 2) if a == axis else (0, 0) for a in range(3)])


def _quotient(numerator: float, denominator: Float[Array, "bx by bz"]) -> Float[Array, "bx by bz"]:
    """The quotient of two numbers that are not negative, infinite where the denominator is 0."""
    return jnp.where(denominator > 0, numerator / jnp.where(denominator > 0, denominator, 1.0), jnp.inf)
