"""Eight-bit voxels packed for interpolation: one read brings four of them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8, UInt32

from jvr.numerics import read_at
from jvr.types import Triple


class Squares(eqx.Module):
    """Voxels packed by fours: entry `(i, j, k)` holds the voxels `(i, j, k)`, `(i, j, k + 1)`, `(i, j + 1, k)` and `(i, j + 1, k + 1)`, a
    byte each from the lowest on; beyond an edge, the edge's. A trilinear sample is two reads in place of four, for four bytes a voxel."""

    entries: UInt32[Array, "x y z"]

    def interpolate(self, p: Triple) -> Float[Array, ""]:
        """The voxels interpolated trilinearly at one grid position inside the domain."""
        nx, ny, nz = self.entries.shape
        low = [jnp.clip(jnp.floor(x), 0, max(n - 2, 0)) for x, n in zip(p, self.entries.shape, strict=True)]
        # On an axis of one voxel there is nothing to interpolate.
        x, y, z = (x - i if n > 1 else jnp.zeros_like(x) for x, i, n in zip(p, low, self.entries.shape, strict=True))
        i, j, k = (i.astype(jnp.int32) for i in low)
        flat, start = self.entries.reshape(-1), (i * ny + j) * nz + k
        front = _bilinear(read_at(flat, start), y, z)
        if nx == 1:
            return front
        back = _bilinear(read_at(flat, start + ny * nz), y, z)
        return (1 - x) * front + x * back


def squares_of(values: UInt8[Array, "x y z"]) -> Squares:
    """The squares of 8-bit voxels; one pass over memory."""
    v = jnp.pad(values, ((0, 0), (0, 1), (0, 1)), mode="edge").astype(jnp.uint32)
    rows = v[:, :, :-1] | v[:, :, 1:] << 8
    return Squares(rows[:, :-1] | rows[:, 1:] << 16)


def _bilinear(entry: UInt32[Array, ""], y: Float[Array, ""], z: Float[Array, ""]) -> Float[Array, ""]:
    # Through int32: converting unsigned numbers to floating point takes the CPU three times as long.
    a, b, c, d = ((entry >> shift & 255).astype(jnp.int32).astype(y.dtype) for shift in (0, 8, 16, 24))
    return (1 - y) * ((1 - z) * a + z * b) + y * ((1 - z) * c + z * d)
