"""Values at the nodes of a regular grid, trilinear in between."""

import itertools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.numerics import clamp, materialise
from jvr.types import Channels, Triple

Rows = Float[Array, "points channels"]


class Grid(eqx.Module):
    """Nodes of a regular grid. `cells`: their number along each axis, one less than that of nodes, and 0 along an axis of one node. All
    channels of a node lie side by side, so that one read brings them all."""

    rows: Float[Array, "nodes channels"]
    cells: tuple[int, int, int] = eqx.field(static=True)

    @classmethod
    def of(cls, nodes: Float[Array, "x y z channels"]) -> "Grid":
        """The grid of nodes at integer positions."""
        nx, ny, nz, channels = nodes.shape
        return cls(nodes.reshape(-1, channels), (nx - 1, ny - 1, nz - 1))

    def interpolate(self, at: Triple, wanted: Bool[Array, "points"], of: Callable[[Rows], Rows] = lambda rows: rows) -> Channels:
        """At a batch of positions in units of cells; beyond the border as on it. `of`: what is interpolated of the channels of nodes, one
        around each of the points. What is not `wanted` may be anything finite."""
        ny, nz = (n + 1 for n in self.cells[1:])
        # Each step once, else positions are computed anew for each fraction, and all of it for each number that is read.
        at = materialise(wanted, tuple(clamp(c, 0, n) for c, n in zip(at, self.cells, strict=True)))
        low = [jnp.clip(jnp.floor(c), 0, max(n - 1, 0)) for c, n in zip(at, self.cells, strict=True)]
        i, j, k = (c.astype(jnp.int32) for c in low)
        first, (x, y, z) = materialise(wanted, ((i * ny + j) * nz + k, [c - b for c, b in zip(at, low, strict=True)]))
        total = jnp.zeros((wanted.shape[0], self.rows.shape[1]), self.rows.dtype)
        for a, b, c in itertools.product(*[range(min(n, 1) + 1) for n in self.cells]):
            row = self.rows.at[first + (a * ny + b) * nz + c].get(mode="promise_in_bounds")
            weight = (x if a else 1 - x) * (y if b else 1 - y) * (z if c else 1 - z)
            total += weight[:, None] * of(row)
        total = materialise(wanted, total)
        return tuple(total[:, i] for i in range(total.shape[1]))
