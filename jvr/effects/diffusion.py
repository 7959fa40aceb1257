"""The scattering pass: light that the medium spreads over a neighbourhood (Lindemann and Ropinski 2010, section 4.2)."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jvr.model.dipole import Dipole
from jvr.model.volume import Volume

# Quadrature nodes in the cell of a grid node, along each axis, over which the kernel is averaged: it may be narrower than a cell.
NODES = 4


def scatter(
    dipole: Dipole,
    radius: float,
    volume: Volume,
    coefficients: Float[Array, "x y z channels bands"],
    there: Bool[Array, "x y z"],
) -> Float[Array, "x y z 3 bands"]:
    """What every node receives after scattering, in each colour.

        L'(x) = R sum_i R_d(|x - x_i|) L(x_i) / sum_i R_d(|x - x_i|)

    over the nodes `x_i` of the medium (`there`) in a neighbourhood, with the dipole's diffuse reflectance `R_d` and its total `R`.
    The paper's equation (4) divides by the number of neighbours instead, which leaves the scale of the picture to the units of `R_d`.

    **Arguments:** `radius`: of the neighbourhood, as a fraction of the volume's longest side, and at most that fraction of the longest axis
    in voxels along each (they may differ where voxels are longer than wide). By FFT, so that the time hardly depends on it.
    Differentiable in everything.
    """
    kernel = kernel_of(dipole, radius, volume, there.shape)
    inside = there.astype(coefficients.dtype)
    spread = lambda field, k: _convolved(field * inside, k)
    weight = jax.vmap(lambda k: spread(inside, k))(kernel)
    # A node of the medium has at least itself, unless all of the kernel underflows: then it keeps what it has. Elsewhere, what FFT leaves
    # of zero is rounding.
    spreads = there & (weight > 0)
    safe = jnp.where(spreads, weight, 1.0)
    mean = lambda field, c: jnp.where(spreads[c], spread(field, kernel[c]) / safe[c], field * inside)
    total, channels = dipole.total, coefficients.shape[3]

    def band(values: Float[Array, "x y z channels"]) -> Float[Array, "x y z 3"]:
        return jnp.stack([total[c] * mean(values[..., c % channels], c) for c in range(3)], axis=-1)

    scattered = jax.lax.map(band, jnp.moveaxis(coefficients, -1, 0))
    return jnp.moveaxis(scattered, 0, -1)


def kernel_of(dipole: Dipole, radius: float, volume: Volume, shape: tuple[int, ...]) -> Float[Array, "3 x y z"]:
    """`R_d` averaged over the cells of the nodes around a node, in each colour; zero beyond the radius."""
    steps = [(n - 1) / (m - 1) if m > 1 else 1.0 for n, m in zip(volume.shape, shape, strict=True)]
    longest = max(n - 1 for n in volume.shape)
    half_widths = [min(math.ceil(radius * longest / step), m - 1) if m > 1 else 0 for step, m in zip(steps, shape, strict=True)]
    offsets = np.stack(np.meshgrid(*[np.arange(-r, r + 1) for r in half_widths], indexing="ij"), axis=-1)
    axes = volume.world_from_grid[:3, :3] * jnp.asarray(steps)
    length = lambda offset: jnp.linalg.norm(offset @ axes.T, axis=-1)
    side = jnp.max(volume.spacing * (np.asarray(volume.shape) - 1))
    inside = length(jnp.asarray(offsets, axes.dtype)) <= radius * side
    fractions = np.stack(np.meshgrid(*[(np.arange(NODES) + 0.5) / NODES - 0.5] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = offsets[..., None, :] + fractions
    values = jnp.stack(dipole.reflectance(length(jnp.asarray(nodes, axes.dtype))))
    return jnp.where(inside, jnp.mean(values, axis=-1), 0.0)


def _convolved(field: Float[Array, "x y z"], kernel: Float[Array, "i j k"]) -> Float[Array, "x y z"]:
    """The sum over neighbours, by FFT of both with room for what would wrap around."""
    size = [n + m - 1 for n, m in zip(field.shape, kernel.shape, strict=True)]
    both = jnp.fft.rfftn(field, size) * jnp.fft.rfftn(kernel, size)
    whole = jnp.fft.irfftn(both, size)
    begin = [m // 2 for m in kernel.shape]
    return whole[tuple(slice(b, b + n) for b, n in zip(begin, field.shape, strict=True))].astype(field.dtype)
