"""How far apart samples may be: oracles for adaptive sampling (Kraus, Strengert, Klein and Ertl, "Adaptive sampling in three dimensions
for volume rendering on GPUs", section 3: an oracle "returns a preferable sampling distance d for any point in space").

An oracle says for every brick of voxels what distance that brick asks for by itself; a point is then given the smallest of what any
brick asks for plus the way to it. It may look at the volume, the transfer function and the view, or know the answer beforehand. What
bricks ask for is measured by what one voxel length of the medium, if it were all alike, would add to a picture: its opacity and the
radiance that it emits, both 0 ... 1 for colours of 0 ... 1. No derivative goes through any of this.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import unvmap_any
from jaxtyping import Array, Float, Int

from jvr.integrators.image_plane import ImagePlane
from jvr.model.bricks import bricks_along, bricks_of
from jvr.model.checks import known
from jvr.model.optical import AbstractOpticalModel
from jvr.model.parameters import array_of, assign, choice, declared, parameter
from jvr.model.ranges import AT_LEAST_ONE, INCREASING, POSITIVE, Interval
from jvr.model.transfer import LinearTransfer, LutTransfer
from jvr.model.volume import Volume
from jvr.numerics import one_minus_exp, read_at
from jvr.types import ArrayLike, Scalar, Triple

DISTANCE = Interval(low=0.0, takes_infinity=True)


class DistanceField(eqx.Module):
    """The distance that is wanted between samples, a world length for each brick of `brick` voxels an edge, and never less than
    `pixels` are wide."""

    distance: Float[Array, "bx by bz"]
    brick: int = eqx.field(static=True)
    pixels: float = eqx.field(static=True, default=0.0)

    def at(self, p: Triple, pixel: Scalar) -> Float[Array, "points"]:
        """The wanted distance at grid positions, all as far from the eye as a pixel is `pixel` wide."""
        index = [
            jnp.clip(jnp.floor(x / self.brick), 0, n - 1).astype(jnp.int32) for x, n in zip(p, self.distance.shape, strict=True)
        ]
        flat = (index[0] * self.distance.shape[1] + index[1]) * self.distance.shape[2] + index[2]
        wanted = read_at(self.distance.reshape(-1), flat)
        return jnp.maximum(wanted, self.pixels * pixel) if self.pixels else wanted


class AbstractOracle(eqx.Module):
    """An oracle: where samples may be far apart. `brick`: voxels along an edge of the bricks that are looked at."""

    brick: ClassVar[int]

    @abc.abstractmethod
    def wanted(self, volume: Volume, features: "Features", plane: ImagePlane) -> Float[Array, "bx by bz"]:
        """The distance between samples that each brick asks for by itself, a world length, infinite where any will do; traceable.

        `features`: what the medium may add to a picture, by scalar; `plane`: the view, in whose world the volume is. Brick `b` of an
        axis holds voxels `b * brick ... (b + 1) * brick` (`jvr.model.bricks`).
        """

    @property
    def least(self) -> float:
        """How many pixels any distance is wide at least, whatever bricks ask for."""
        return 0.0


class Finest(AbstractOracle):
    """The smallest distance everywhere, so that every sample is taken (the column "min." of the paper's tables 2 and 3)."""

    brick: ClassVar[int] = 64

    def wanted(self, volume: Volume, features: "Features", plane: ImagePlane) -> Float[Array, "bx by bz"]:
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

    def wanted(self, volume: Volume, features: "Features", plane: ImagePlane) -> Float[Array, "bx by bz"]:
        change = _spread(features._replace(rows=features.rows[-1:]), *_bounds(volume, self.brick))
        return jnp.where(change <= self.tolerance, jnp.inf, 0.0)


class BrickRange(_Tolerant):
    """A brick of 4^3 voxels in which opacity and emission of one voxel length range over `R` asks for `4 tolerance / R` voxels: the
    distance over which they change by `tolerance` if they change evenly. **Raises** `ValueError` for a tolerance out of range."""

    brick: ClassVar[int] = 4

    def wanted(self, volume: Volume, features: "Features", plane: ImagePlane) -> Float[Array, "bx by bz"]:
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

    def wanted(self, volume: Volume, features: "Features", plane: ImagePlane) -> Float[Array, "bx by bz"]:
        c1, c2, largest = (bricks_of(c, self.brick).upper for c in _curvatures(volume))
        low, high = _bounds(volume, self.brick)
        # Interpolated values leave the range of the voxels by no more than a second difference.
        slope = _steepest(features, low - largest, high + largest)
        ask = lambda c, scale: _quotient(scale * self.tolerance, slope * c)
        distance = jnp.minimum(ask(c1, 4.0), jnp.sqrt(ask(c2, 8.0)))
        return jnp.where(jnp.isnan(low + high), 0.0, distance)


class PixelSize(AbstractOracle):
    """What another oracle wants, but nowhere less than `pixels` pixels are wide there: what is smaller on the picture is not looked for.

    With `d` what the other oracle wants at a point, and `w` the width of a pixel at the point's distance `r` from the eye, in the middle of
    the picture, which is `2 r tan(fov_y / 2) / height` for a perspective camera, this wants

        max(d, pixels * w(r)).

    Where pixels are wider than slices are apart, as far from the eye, one in `2^l` is then sampled at most in each direction, `2^l`
    the largest power of two up to `pixels`; where they are narrower, as near the eye, more are. **Arguments:** `oracle`: the other one,
    `jvr.LocalError()` by default. **Raises** `ValueError` for pixels out of range.
    """

    oracle: AbstractOracle = parameter(doc="the oracle that is asked first")
    pixels: float = choice(POSITIVE, doc="pixels in a row of which one is enough", hint="2 is a good start")
    brick: int = eqx.field(static=True, default=1)  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, oracle: AbstractOracle = LocalError(), *, pixels: float | int = 2.0):
        assign(self, oracle=oracle, pixels=pixels)
        self.brick = oracle.brick  # pyright: ignore[reportIncompatibleVariableOverride]

    def wanted(self, volume: Volume, features: "Features", plane: ImagePlane) -> Float[Array, "bx by bz"]:
        return self.oracle.wanted(volume, features, plane)

    @property
    def least(self) -> float:
        return max(self.pixels, self.oracle.least)


class GivenDistances(AbstractOracle):
    """Distances that are known beforehand, as by an oracle that is "pre-computed and stored with the data set" (section 4).

    **Arguments:** `distances`: the world length that each brick asks for, `(bricks along x, y, z)`, 0 for every sample, infinite where
    any will do; `brick`: voxels along an edge of a brick, of which an axis of `n` voxels has `ceil((n - 1) / brick)`, at least one. Both
    are static: a picture is compiled for them. What a program computes anew, such as for each view, is a class of its own.
    **Raises** `ValueError` for distances that are negative or NaN, and, when a picture is made, for a volume of other bricks.
    """

    distances: Any = choice(DISTANCE, doc="that bricks ask for, along x, y, z", unit="mm")
    brick: int = choice(AT_LEAST_ONE, doc="voxels along an edge of a brick")  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, distances: ArrayLike, *, brick: int = 4):
        assign(self, brick=brick)
        about = declared(GivenDistances)["distances"].metadata["parameter"]
        array = known(array_of(distances, "distances", about, (("x", "y", "z"),)))
        if array is None:
            raise ValueError(
                "distances must be known when a picture is compiled: derive an oracle that computes them from its class"
            )
        self.distances = tuple(tuple(tuple(row) for row in plane) for plane in array.tolist())

    @classmethod
    def from_errors(cls, errors: ArrayLike, lengths: ArrayLike, tolerance: float, *, brick: int = 4) -> "GivenDistances":
        """Of errors `(levels, bricks along x, y, z)` that samples make which are `lengths` `(levels,)` apart, increasing world lengths:
        each brick asks for the longest whose error, and that of all shorter ones, is at most `tolerance`, and for every sample where
        there is none. **Raises** `ValueError` for shapes that do not fit and lengths that do not increase."""
        errors, lengths = np.asarray(errors), np.asarray(lengths)
        if errors.ndim != 4 or lengths.shape != errors.shape[:1]:
            raise ValueError(
                f"errors must be (levels, x, y, z) and lengths (levels,), not {errors.shape} and {lengths.shape}: give an array of "
                "errors in bricks for each length"
            )
        if not INCREASING.holds(lengths) or lengths[0] <= 0:
            raise ValueError("lengths must be positive and strictly increasing: sort levels from the finest on")
        good = np.cumprod(errors <= tolerance, axis=0).sum(axis=0)
        return cls(np.array([0.0, *lengths])[good], brick=brick)

    def wanted(self, volume: Volume, features: "Features", plane: ImagePlane) -> Float[Array, "bx by bz"]:
        return jnp.asarray(np.array(self.distances), volume.slope.dtype)


def distance_field(
    oracle: AbstractOracle,
    volume: Volume,
    table: LinearTransfer | LutTransfer,
    optical: AbstractOpticalModel,
    plane: ImagePlane,
    farthest: Scalar,
) -> DistanceField:
    """What `oracle` says, up to the world length `farthest`; traceable, not differentiable. Where it says NaN, every sample is wanted.
    **Raises** `ValueError` where it speaks of other bricks than the volume has."""
    oracle, volume, table, optical, plane, farthest = jax.lax.stop_gradient((oracle, volume, table, optical, plane, farthest))
    wanted = oracle.wanted(volume, features_of(volume, table, optical), plane)
    bricks = tuple(bricks_along(n, oracle.brick) for n in volume.shape)
    if wanted.shape != bricks:
        raise ValueError(
            f"{type(oracle).__name__} asks for the distances of {wanted.shape} bricks; of {oracle.brick}^3 voxels, a volume of "
            f"{volume.shape} has {bricks}: give as many, or another brick="
        )
    wanted = jnp.where(jnp.isnan(wanted), 0.0, wanted).astype(farthest.dtype)
    return DistanceField(envelope(wanted, thickness(volume, oracle.brick), farthest), oracle.brick, oracle.least)


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
