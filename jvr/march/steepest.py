"""Bounds on how the scalar changes along the axes of the grid, by which steps towards a surface may be long, and on its gradient."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.march.steps import Rays
from jvr.model.bricks import bricks_along, bricks_of
from jvr.model.interpolation import Nearest, Tricubic, Trilinear
from jvr.model.normals import AbstractNormals
from jvr.model.volume import Volume
from jvr.numerics import divide_or_zero
from jvr.types import Scalar

# Roundings of the largest scalar that differences of interpolated ones may leave.
ROUNDINGS = 16


class Steepest(eqx.Module):
    """Bounds on how the scalar changes along each axis of the grid, anywhere in a brick of `size^3` voxels and in those next to it."""

    bounds: tuple[Float[Array, "bx by bz"], ...]
    size: int = eqx.field(static=True)

    def stride(self, rays: Rays, u: Float[Array, "rays"], distance: Float[Array, "rays"], dt: Scalar) -> Int[Array, "rays"]:
        """How many steps of length `dt` may be taken from distance `u` on without a change of the scalar by `distance`."""
        shape = self.bounds[0].shape
        p = (e + u * d for e, d in zip(rays.entry, rays.direction, strict=True))
        brick = tuple(jnp.clip(jnp.floor(x / self.size), 0, n - 1).astype(jnp.int32) for x, n in zip(p, shape, strict=True))
        along = [jnp.abs(d) for d in rays.direction]
        slope = sum((d * bound[brick] for d, bound in zip(along, self.bounds, strict=True)), jnp.zeros_like(u))
        # No further than the bricks that the bound is of.
        farthest = divide_or_zero(jnp.full_like(u, self.size), jnp.maximum(jnp.maximum(along[0], along[1]), along[2]))
        free = jnp.where(slope > 0, jnp.minimum(distance / jnp.where(slope > 0, slope, 1.0), farthest), farthest)
        return jnp.clip(jnp.floor((1 - 1e-3) * free / dt), 1, 2**20).astype(jnp.int32)


def steepest_of(volume: Volume, size: int) -> Steepest:
    """Bounds on the derivatives of the interpolant, means of differences of neighbouring voxels; one pass over memory for each axis."""
    # Of a brick and those next to it; a spline is made of voxels beyond these, too.
    width = 5 if volume.interpolation.reach else 3
    bounds = []
    for axis in range(3):
        largest = bricks_of(_changes(volume, axis), size).upper
        around = jax.lax.reduce_window(largest, -jnp.inf, jax.lax.max, (width, width, width), (1, 1, 1), "SAME")
        bounds.append(jnp.abs(volume.slope) * around)
    return jax.lax.stop_gradient(Steepest(tuple(bounds), size))


def steepest_gradients(volume: Volume, normals: AbstractNormals, size: int) -> Float[Array, "bx by bz"] | None:
    """A bound on the length of the gradient of the scalar, per world length, in each brick of `size^3` voxels; one pass over memory for
    each axis, not differentiable. `None` for estimators, and interpolations, of somebody's own, of which nothing is known.

    Along a grid axis every estimate is a mean, with weights that are not negative, of differences of neighbouring voxels: the derivative of
    a linear interpolant of those of its cell, that of a cubic B-spline of those around it, a difference over some distance of the
    derivatives on the way. Where all voxels around are equal the bound is 0: what their interpolation rounds to is no gradient
    (`jvr.march.shaders.GradientFrame`).
    """
    if normals.reach is None or not isinstance(volume.interpolation, Trilinear | Tricubic | Nearest):
        return None
    volume = jax.lax.stop_gradient(volume)
    reach = normals.reach + volume.interpolation.reach
    # Voxels that are nearest to two points may be up to twice as far from each other as the points, by ties and at the border.
    scale = jnp.abs(volume.slope) * (2.0 if isinstance(volume.interpolation, Nearest) else 1.0)
    along = [scale * _largest_around(_changes(volume, axis), axis, size, reach) for axis in range(3)]
    eps, offset = jnp.finfo(volume.slope.dtype).eps, jnp.abs(volume.intercept)
    largest = jnp.abs(volume.slope) * jnp.max(jnp.abs(volume.values.astype(volume.slope.dtype)))
    margin = jnp.where(functools.reduce(jnp.maximum, along) > 0, ROUNDINGS * eps * (largest + 2 * offset), 0.0)
    along = [x + margin if n > 1 else x for x, n in zip(along, volume.shape, strict=True)]
    # Linear in those along the axes, the gradient in the world is longest in a corner of the box that these are in.
    corners = [(along[0], s * along[1], t * along[2]) for s, t in itertools.product((1, -1), repeat=2)]
    in_world = lambda corner: [sum(volume.axes_inverse[j, i] * corner[j] for j in range(3)) for i in range(3)]
    squares = [sum(jnp.square(g) for g in in_world(corner)) for corner in corners]
    longest = (1 + ROUNDINGS * eps) * jnp.sqrt(functools.reduce(jnp.maximum, squares))
    return jnp.where(jnp.isnan(longest), jnp.inf, longest)


def _changes(volume: Volume, axis: int) -> Float[Array, "x y z"]:
    """The absolute difference of each stored voxel and the next along an axis, 0 for the last."""
    values = volume.values.astype(volume.slope.dtype)
    return jnp.abs(jnp.diff(values, axis=axis, append=jax.lax.slice_in_dim(values, values.shape[axis] - 1, None, axis=axis)))


def _largest_around(changes: Float[Array, "x y z"], along: int, size: int, reach: int) -> Float[Array, "bx by bz"]:
    """The largest difference along an axis of voxels that are in a brick or up to `reach` beyond it."""
    for axis, n in enumerate(changes.shape):
        # A brick that is longer than the axis holds nothing else.
        edge = min(size, max(n - 1, 1))
        count, width = bricks_along(n, edge), edge + 2 * reach + (axis != along)
        behind = max((count - 1) * edge + width - reach - n, 0)
        window, stride, padding = [1] * 3, [1] * 3, [(0, 0)] * 3
        window[axis], stride[axis], padding[axis] = width, edge, (reach, behind)
        changes = jax.lax.reduce_window(changes, -jnp.inf, jax.lax.max, window, stride, padding)
        changes = jax.lax.slice_in_dim(changes, 0, count, axis=axis)
    return changes
