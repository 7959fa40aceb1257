"""Bounds on how the scalar changes along the axes of the grid, by which steps towards a surface may be long."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.march.steps import Rays
from jvr.model.bricks import bricks_of
from jvr.model.volume import Volume
from jvr.numerics import divide_or_zero
from jvr.types import Scalar


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
    values = volume.values.astype(volume.slope.dtype)
    bounds = []
    for axis in range(3):
        change = jnp.abs(
            jnp.diff(values, axis=axis, append=jax.lax.slice_in_dim(values, values.shape[axis] - 1, None, axis=axis))
        )
        largest = bricks_of(change, size).upper
        around = jax.lax.reduce_window(largest, -jnp.inf, jax.lax.max, (width, width, width), (1, 1, 1), "SAME")
        bounds.append(jnp.abs(volume.slope) * around)
    return jax.lax.stop_gradient(Steepest(tuple(bounds), size))
