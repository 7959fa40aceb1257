"""Grids over one domain: the voxels of a volume on a coarser or a finer grid."""

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.model.volume import Volume

Shape = tuple[int, int, int]


def resampled(values: Float[Array, "x y z"], shape: Shape) -> Float[Array, "x2 y2 z2"]:
    """Voxels on another grid over the same domain, by trilinear interpolation: the first and the last voxel of each axis stay where they
    are, and a linear field is reproduced. Linear in `values` and differentiable in them.

    Places and weights are found in double precision. An axis of one voxel is constant.
    """
    for axis, (old, new) in enumerate(zip(values.shape, shape, strict=True)):
        if old == new:
            continue
        place = np.linspace(0.0, old - 1.0, new) if new > 1 else np.array([(old - 1) / 2])
        low = np.clip(np.floor(place), 0, max(old - 2, 0)).astype(np.int32)
        along = [1] * 3
        along[axis] = new
        weight = jnp.asarray((place - low).reshape(along), values.dtype)
        lower, upper = (jnp.take(values, np.minimum(i, old - 1), axis=axis) for i in (low, low + 1))
        values = (1 - weight) * lower + weight * upper
    return values


def resampled_cubic(nodes: Float[Array, "x y z channels"], shape: Shape) -> Float[Array, "x2 y2 z2 channels"]:
    """Nodes on a finer grid over the same domain, by cubic convolution (Keys 1981): through all nodes, with a continuous slope, a quadratic
    field is reproduced but for the cells at the border. Linear in the nodes and differentiable in them. What is interpolated may lie beyond
    its nodes."""
    for axis, (old, new) in enumerate(zip(nodes.shape, shape, strict=False)):
        if old != new:
            matrix = jnp.asarray(_cubic_matrix(old, new), nodes.dtype)
            nodes = jnp.moveaxis(jnp.tensordot(matrix, nodes, (1, axis)), 0, axis)
    return nodes


def _cubic_matrix(old: int, new: int) -> Float[np.ndarray, "new old"]:
    """What takes values along an axis to more of them. Beyond the border they go on in a straight line."""
    place = np.linspace(0.0, old - 1.0, new)
    low = np.clip(np.floor(place), 0, max(old - 2, 0)).astype(int)
    t = place - low
    weights = (-t + 2 * t**2 - t**3) / 2, 1 - (5 * t**2 - 3 * t**3) / 2, (t + 4 * t**2 - 3 * t**3) / 2, (t**3 - t**2) / 2
    # One value more at either end.
    padded = np.zeros((new, old + 2))
    for i, weight in enumerate(weights):
        padded[np.arange(new), low + i] += weight
    matrix, first, last = padded[:, 1:-1].copy(), padded[:, :1], padded[:, -1:]
    matrix[:, :2] += first * [2, -1]
    matrix[:, -2:] += last * [-1, 2]
    return matrix


def on_grid(volume: Volume, shape: Shape) -> Volume:
    """The volume on another grid over the same domain, its voxels in floating point (`resampled`).

    **Raises** `ValueError` where voxels are missing: what lies around them on another grid is not known.
    """
    if volume.gaps is not None:
        raise ValueError("voxels are missing, which have no place on another grid: fill them in, or fit on the volume's own grid")
    matrix = np.asarray(volume.world_from_grid, np.float64) + np.asarray(
        volume.remainder.beside(volume.world_from_grid), np.float64
    )
    longer = [(old - 1) / (new - 1) if old > 1 and new > 1 else 1.0 for old, new in zip(volume.shape, shape, strict=True)]
    matrix[:3, :3] *= np.array(longer)
    values = resampled(volume.values.astype(jnp.result_type(float)), shape)
    return dataclasses.replace(volume, values=values, world_from_grid=matrix)


def coarser(shape: Shape) -> Shape:
    """The grid whose voxels lie twice as far apart, or a little less where the ends of an axis would not be among them."""
    x, y, z = (n // 2 + 1 if n > 1 else 1 for n in shape)
    return x, y, z


def node_shape(volume: Volume, resolution: float) -> Shape:
    """The grid with so many nodes for each voxel along an axis, or a few more where the ends of an axis would not be among them."""
    x, y, z = (1 if n == 1 else max(2, math.ceil((n - 1) * resolution) + 1) for n in volume.shape)
    return x, y, z


def node_positions(volume: Volume, shape: Shape) -> Float[np.ndarray, "nodes 3"]:
    """Grid positions of the nodes of a grid over a volume: equally distant, the first and the last at the border."""
    axes = [np.linspace(0, n - 1, m) if n > 1 else np.zeros(1) for n, m in zip(volume.shape, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


def fractions_at_voxels(
    volume: Volume, nodes: Float[Array, "nodes channels"], resolution: float
) -> Float[Array, "x y z channels"]:
    """Fractions of light at all nodes, 0 ... 1, on the grid of the voxels: straight lines between nodes would let light into whatever is
    not much thicker than they are apart."""
    coarse = nodes.reshape(*node_shape(volume, resolution), -1)
    return jnp.clip(resampled_cubic(coarse, volume.shape), 0.0, 1.0)


def nodes_for_each_voxel(volume: Volume, shape: Shape) -> tuple[float, float, float]:
    """What takes a grid position to the coordinates of such a grid's nodes, along each axis."""
    x, y, z = ((m - 1) / (n - 1) if n > 1 else 0.0 for n, m in zip(volume.shape, shape, strict=True))
    return x, y, z
