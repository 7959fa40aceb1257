"""Empty-space skipping: the bricks that a transfer function leaves empty, and how far rays may skip them.

A brick is empty if no value between its smallest and largest voxel has extinction, or emission of its own, above a bound, by default zero;
without either nothing is emitted (`j = sigma_t rgb + q` in every optical model). Where a transfer function takes the length of the
gradient, no length up to the longest of the brick may have any. Around each empty brick there is a cube of empty bricks, and a ray inside
of it goes on with the first sample outside. Samples stay where they are, so a picture with skips and one without take the same
contributing samples.
"""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt8

from jvr.march.steps import Rays
from jvr.model.bricks import Bricks
from jvr.model.transfer import AbstractTransfer
from jvr.numerics import materialise, read_at
from jvr.types import Scalar

# Radii of the empty cubes that are told apart, in bricks. Each is the last one plus at most itself plus one (see `_empty_radii`).
RADII = (0, 1, 2, 3, 5, 8, 13, 21)


class Occupancy(eqx.Module):
    """Which bricks are occupied, and Chebyshev distances to them. `empty_radius[b]`: 0 where brick `b` may be visible, else a number such
    that every brick nearer than it, by the largest of the three differences of indices, is empty. `empty_radius_of_slopes`: the same of
    bricks where extinction has a derivative in the scalar, as at a value that lies where an interval of a table begins to be visible;
    `None` where `empty_radius` itself is what derivatives skip. `size`: voxels along an edge of a brick."""

    empty_radius: UInt8[Array, "bx by bz"]
    empty_radius_of_slopes: UInt8[Array, "bx by bz"] | None
    size: int = eqx.field(static=True)

    @property
    def is_bounded(self) -> bool:
        """Whether what is left out may have some extinction: then derivatives skip the same, although they are not zero there."""
        return self.empty_radius_of_slopes is None

    def for_slopes(self) -> "Occupancy":
        """What derivatives may skip that have to do with where samples and entries of the transfer function lie."""
        return (
            self
            if self.empty_radius_of_slopes is None
            else Occupancy(self.empty_radius_of_slopes, self.empty_radius_of_slopes, self.size)
        )

    def skip(
        self, rays: Rays, u: Float[Array, "rays"], dt: Scalar, *, backwards: bool = False, within: bool = False
    ) -> Int[Array, "rays"]:
        """How many segments of length `dt` to go on from distance `u`: 0 where it may be visible itself.

        With midpoints at `u, u + dt, ...` none of those passed over is in a visible brick. With `within`, segments begin at `u`, and
        no point of those passed over is. Where rounding leaves a doubt, the skip is one segment shorter.
        """
        sign = -1.0 if backwards else 1.0
        p = [e + u * d for e, d in zip(rays.entry, rays.direction, strict=True)]
        b, empty_radius = self._brick_at(p)
        distance = jnp.full_like(u, jnp.inf)
        for x, d, brick in zip(p, rays.direction, b, strict=True):
            d = sign * d
            face = jnp.where(d > 0, brick + empty_radius, brick + 1 - empty_radius) * self.size
            distance = jnp.where(d == 0, distance, jnp.minimum(distance, (face - x) / jnp.where(d == 0, 1.0, d)))
        steps = jnp.floor(distance / dt - 1e-3) if within else jnp.maximum(jnp.ceil(distance / dt - 1e-3), 1.0)
        steps = jnp.clip(steps, 0, 2**30).astype(jnp.int32)
        return jnp.where(empty_radius > 0, steps, 0)

    def is_occupied(self, rays: Rays, u: Float[Array, "rays"]) -> Bool[Array, "rays"]:
        """Whether the brick at distance `u` is visible."""
        return self._brick_at([e + u * d for e, d in zip(rays.entry, rays.direction, strict=True)])[1] == 0

    def _brick_at(self, p: list[Float[Array, "rays"]]) -> tuple[list[Float[Array, "rays"]], Float[Array, "rays"]]:
        """The brick around each grid position, and its empty radius."""
        shape = self.empty_radius.shape
        b = [jnp.clip(jnp.floor(x / self.size), 0, n - 1) for x, n in zip(p, shape, strict=True)]
        index = (b[0].astype(jnp.int32) * shape[1] + b[1].astype(jnp.int32)) * shape[2] + b[2].astype(jnp.int32)
        return b, read_at(self.empty_radius.reshape(-1), index).astype(p[0].dtype)


def occupancy_of(
    bricks: Bricks,
    slope: Scalar,
    intercept: Scalar,
    transfer: AbstractTransfer,
    least: Scalar | float | None = None,
    steepest: Float[Array, "bx by bz"] | None = None,
) -> Occupancy:
    """Which bricks of a volume a transfer function makes visible; milliseconds, traceable. Not differentiable.

    With a bound `least` on extinction, what is below it is not visible, and derivatives skip it too. `steepest`: bounds on the length of
    the gradient in each brick, per world length (`jvr.march.steepest.steepest_gradients`), where that matters.
    """
    empty = lambda nearby: ~visible_bricks(bricks, slope, intercept, transfer, least, steepest, nearby=nearby)
    if least is not None:
        (empty_radius,) = _empty_radii(empty(True))
        return Occupancy(empty_radius, None, bricks.size)
    empty_radius, empty_radius_of_slopes = _empty_radii(empty(False), empty(True))
    return Occupancy(empty_radius, empty_radius_of_slopes, bricks.size)


def occupancy_of_values(bricks: Bricks, slope: Scalar, intercept: Scalar, values: Float[Array, "n"]) -> Occupancy:
    """Which bricks of a volume hold any of these scalars somewhere. Not differentiable."""
    low, high = _scalar_bounds(bricks, *jax.lax.stop_gradient((slope, intercept)))
    holds = [(low <= value) & (value <= high) for value in jax.lax.stop_gradient(values)]
    (empty_radius,) = _empty_radii(~(functools.reduce(jnp.logical_or, holds) | jnp.isnan(low + high)))
    return Occupancy(empty_radius, None, bricks.size)


def visible_bricks(
    bricks: Bricks,
    slope: Scalar,
    intercept: Scalar,
    transfer: AbstractTransfer,
    least: Scalar | float | None = None,
    steepest: Float[Array, "bx by bz"] | None = None,
    *,
    nearby: bool = False,
) -> Bool[Array, "bx by bz"]:
    """Bricks that a transfer function gives more extinction than `least`, by default none, somewhere between their bounds and with no
    gradient longer than `steepest`; `nearby`: also those where it has a derivative in the scalar. Not differentiable."""
    slope, intercept, transfer = jax.lax.stop_gradient((slope, intercept, transfer))
    low, high = _scalar_bounds(bricks, slope, intercept)
    least = 0.0 if least is None else least
    if steepest is None:
        found = jax.vmap(lambda low, high: transfer.is_visible(low, high, least, nearby=nearby))(low.ravel(), high.ravel())
    else:
        ask = jax.vmap(lambda low, high, longest: transfer.is_visible_below(low, high, longest, least, nearby=nearby))
        found = ask(low.ravel(), high.ravel(), steepest.ravel())
    return found.reshape(low.shape) | jnp.isnan(low + high)


def _scalar_bounds(bricks: Bricks, slope: Scalar, intercept: Scalar) -> tuple[Float[Array, "bx by bz"], Float[Array, "bx by bz"]]:
    """The smallest and the largest scalar that interpolation may return in each brick."""
    scaled = [slope * bound.astype(slope.dtype) for bound in (bricks.lower, bricks.upper)]
    ends = [end + intercept for end in scaled]
    # Interpolated values exceed those they are made of by a few roundings.
    margin = 8 * jnp.finfo(slope.dtype).eps * (jnp.maximum(*map(jnp.abs, scaled)) + jnp.abs(intercept))
    return jnp.minimum(*ends) - margin, jnp.maximum(*ends) + margin


def _empty_radii(*empty: Bool[Array, "bx by bz"]) -> list[UInt8[Array, "bx by bz"]]:
    """For each array one more than the radius of the largest cube of empty bricks, of `RADII`, around each; beyond the volume all is empty.

    A cube of radius `r + s` is the union of cubes of radius `r` around bricks `s` apart, as long as `s <= 2 r + 1`.
    """
    # A bit for each of the arrays, so that all of them take one walk through memory.
    bits = sum((e.astype(jnp.uint8) << i for i, e in enumerate(empty)), jnp.uint8(0))
    # Else each of the two bricks that an erosion looks at is classified anew; where none is empty, zeros say the same.
    bits = materialise(bits > 0, bits)
    of = lambda i: (bits >> i & 1) > 0
    radii = [of(i).astype(jnp.uint8) for i in range(len(empty))]
    for radius, larger in itertools.pairwise(RADII):
        for axis in range(3):
            bits = _erode(bits, axis, larger - radius)
        bits = materialise(bits > 0, bits)
        radii = [jnp.where(of(i), jnp.uint8(larger + 1), r) for i, r in enumerate(radii)]
    return radii


def _erode(bits: UInt8[Array, "bx by bz"], axis: int, shift: int) -> UInt8[Array, "bx by bz"]:
    """Which bits of elements, and of both of those `shift` from them along an axis, are set."""
    n = bits.shape[axis]
    padding = [(0, 0)] * 3
    padding[axis] = (shift, shift)
    padded = jnp.pad(bits, padding, constant_values=255)
    before, after = (jax.lax.slice_in_dim(padded, at, at + n, axis=axis) for at in (0, 2 * shift))
    return bits & before & after
