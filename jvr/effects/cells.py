"""Values at the nodes of a regular grid, trilinear in between."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.numerics import computed_once
from jvr.types import Channels, Scalar, Triple

# Up to so many channels the nodes around a cell are kept side by side, at eight times the memory.
FEW = 4


class AbstractGrid(eqx.Module):
    """`cells`: their number along each axis, one less than that of nodes, and 0 along an axis of one node."""

    cells: tuple[int, int, int] = eqx.field(static=True)

    @abc.abstractmethod
    def read(self, low: tuple[Int[Array, "points"], ...], shares: list[Scalar], wanted: Bool[Array, "points"]) -> Channels:
        """Each channel inside of cells whose first node is `low`, with fractions of the way to the last."""

    def interpolate(self, at: Triple, wanted: Bool[Array, "points"]) -> Channels:
        """At a batch of positions in units of cells; beyond the border as on it. What is not `wanted` may be anything finite."""
        at = tuple(jnp.clip(c, 0, n) for c, n in zip(at, self.cells, strict=True))
        low = [jnp.clip(jnp.floor(c), 0, max(n - 1, 0)) for c, n in zip(at, self.cells, strict=True)]
        # Else places are computed anew for each number that is read.
        place = (tuple(c.astype(jnp.int32) for c in low), [c - b for c, b in zip(at, low, strict=True)])
        return self.read(*computed_once(wanted, place), wanted)


class Cells(AbstractGrid):
    """The eight nodes around every cell side by side, so that one read brings them all: nodes of cell `(i, j, k)` are
    `(i + a, j + b, k + c)` in the order of `a b c`."""

    rows: Float[Array, "channels cells 8"]

    def read(self, low: tuple[Int[Array, "points"], ...], shares: list[Scalar], wanted: Bool[Array, "points"]) -> Channels:
        _, ny, nz = (max(n, 1) for n in self.cells)
        cell = (low[0] * ny + low[1]) * nz + low[2]
        found = computed_once(wanted, [rows.at[cell].get(mode="promise_in_bounds") for rows in self.rows])
        return tuple(_trilinear([row[:, c] for c in range(8)], shares) for row in found)


class Nodes(AbstractGrid):
    """All channels of a node side by side."""

    rows: Float[Array, "nodes channels"]

    def read(self, low: tuple[Int[Array, "points"], ...], shares: list[Scalar], wanted: Bool[Array, "points"]) -> Channels:
        shape = [n + 1 for n in self.cells]
        total = jnp.zeros((shares[0].shape[0], self.rows.shape[1]), self.rows.dtype)
        for a in range(2 if shape[0] > 1 else 1):
            for b in range(2 if shape[1] > 1 else 1):
                start = ((low[0] + a) * shape[1] + low[1] + b) * shape[2] + low[2]
                weight = (shares[0] if a else 1 - shares[0]) * (shares[1] if b else 1 - shares[1])
                for c in range(2 if shape[2] > 1 else 1):
                    row = self.rows.at[start + c].get(mode="promise_in_bounds")
                    total += (weight * (shares[2] if c else 1 - shares[2]))[:, None] * row
        total = computed_once(wanted, total)
        return tuple(total[:, i] for i in range(total.shape[1]))


def grid_of(nodes: Float[Array, "x y z channels"]) -> AbstractGrid:
    """The grid of nodes at whole positions."""
    shape, channels = nodes.shape[:3], nodes.shape[3]
    cells = (shape[0] - 1, shape[1] - 1, shape[2] - 1)
    if channels > FEW:
        return Nodes(cells, nodes.reshape(-1, channels))
    last = [max(n, 1) for n in cells]
    # Along an axis of one node both ends of the only cell are that node.
    nodes = jnp.pad(nodes, [(0, int(n == 0)) for n in cells] + [(0, 0)], mode="edge")
    corners = [nodes[a : last[0] + a, b : last[1] + b, c : last[2] + c] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    return Cells(cells, jnp.moveaxis(jnp.stack(corners, axis=-1), 3, 0).reshape(channels, -1, 8))


def _trilinear(values: list[Array], shares: list[Array]) -> Array:
    for share in reversed(shares):
        values = [(1 - share) * a + share * b for a, b in zip(values[::2], values[1::2], strict=True)]
    return values[0]
