"""From functions on the sphere to coefficients: by quadrature, Monte-Carlo integration or least squares; of maps; of zonal functions."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jvr.model.harmonics.basis import as_floats, band_of, basis, count, evaluate, order_of
from jvr.types import ArrayLike

Function = Callable[[Float[Array, "n 3"]], Float[Array, "n *rest"]]

# Rows of a map that are projected at a time.
ROWS = 16


def project(
    fn: Function, order: int, *, degree: int | None = None, samples: int | None = None, key: PRNGKeyArray | None = None
) -> Float[Array, "bands *rest"]:
    """Coefficients `c_j = integral Y_j(d) fn(d) dd` over the unit sphere.

    - By default by quadrature: Gauss-Legendre nodes in `z` times equally spaced angles about it, exact where `fn` is a polynomial of a
      degree up to `degree - order`; default `degree = 2 order + 32`.
    - With `samples` and a `key` by Monte-Carlo integration: directions independent and uniform over the sphere (density `1 / (4 pi)`), so
      that the standard error of `c_j` is `4 pi std(fn Y_j) / sqrt(samples)`.

    **Arguments:** `fn`: `(n, 3)` unit directions -> `(n, ...)`. Returns `((order + 1)^2, ...)`; traceable, differentiable in what `fn`
    closes over. **Raises** `ValueError` for `samples` without a `key` and a `key` without `samples`.
    """
    if (samples is None) != (key is None):
        raise ValueError("Monte-Carlo projection needs both samples and key=jax.random.key(...); leave out both for quadrature")
    if samples is None or key is None:
        nodes, weights = sphere_nodes(2 * order + 32 if degree is None else degree)
        directions, weight = jnp.asarray(nodes, jnp.result_type(float)), jnp.asarray(weights, jnp.result_type(float))
    else:
        directions = jax.random.normal(key, (samples, 3))
        directions = directions / jnp.linalg.norm(directions, axis=1, keepdims=True)
        weight = jnp.full((samples,), 4 * math.pi / samples)
    values = jnp.asarray(fn(directions))
    return jnp.tensordot(evaluate(order, directions) * weight[:, None], values, axes=(0, 0))


@functools.cache
def sphere_nodes(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions `(n, 3)` and weights `(n,)` that integrate polynomials of this degree over the unit sphere exactly."""
    z, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    angle = 2 * np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
    radius = np.sqrt((1 - z) * (1 + z))
    nodes = np.stack(
        [
            radius[:, None] * np.cos(angle),
            radius[:, None] * np.sin(angle),
            np.broadcast_to(z[:, None], (z.size, angle.size)),
        ],
        axis=-1,
    )
    return nodes.reshape(-1, 3), np.repeat(weight, angle.size) * 2 * np.pi / angle.size


def fit_samples(
    directions: ArrayLike, values: ArrayLike, order: int, *, weights: ArrayLike | None = None, ridge: float | int = 0.0
) -> Float[Array, "bands *rest"]:
    """Coefficients by least squares, for samples that do not cover the sphere: `min sum_i w_i |Y(d_i) c - f_i|^2 + ridge n |c|^2`.

    **Arguments:** `directions`: `(n, 3)`; `values`: `(n, ...)`; `weights`: `(n,)`; `ridge`: keeps what the samples do not determine small.
    **Raises** `ValueError` where there are fewer samples than coefficients and no ridge.
    """
    rows, values = evaluate(order, directions), as_floats(values)
    n, bands = rows.shape
    if n < bands and ridge <= 0:
        raise ValueError(
            f"{n} samples do not determine {bands} coefficients: give more, a smaller order, or a ridge such as 1e-3"
        )
    root = jnp.ones(n, rows.dtype) if weights is None else jnp.sqrt(jnp.asarray(weights, rows.dtype))
    flat = values.reshape(n, -1)
    system = jnp.concatenate([rows * root[:, None], math.sqrt(ridge * n) * jnp.eye(bands)])
    right = jnp.concatenate([flat * root[:, None], jnp.zeros((bands, flat.shape[1]), flat.dtype)])
    return jnp.linalg.lstsq(system, right)[0].reshape(bands, *values.shape[1:])


def map_directions(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Direction `(height, width, 3)` of each pixel of a latitude-longitude map and the solid angle `(height,)` of a pixel of each row.

    y up, OpenEXR's orientation: +X at u = 1/4, +Z at the centre, -X at u = 3/4, -Z at the edge.
    """
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    polar = np.pi * (np.arange(height) + 0.5) / height
    azimuth = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width)
    across = np.sin(polar)[:, None]
    y = np.broadcast_to(np.cos(polar)[:, None], (height, width))
    directions = np.stack([across * np.sin(azimuth), y, across * np.cos(azimuth)], axis=-1)
    return directions, (edges[:-1] - edges[1:]) * 2 * np.pi / width


def project_map(pixels: Float[Array, "height width channels"], order: int) -> Float[Array, "bands channels"]:
    """Coefficients of a latitude-longitude map, each pixel constant over its solid angle and seen at its middle."""
    pixels = as_floats(pixels)
    height, width, channels = pixels.shape
    directions, solid_angle = map_directions(height, width)
    pad = -height % ROWS
    rows = lambda x: jnp.pad(jnp.asarray(x, pixels.dtype), ((0, pad),) + ((0, 0),) * (x.ndim - 1)).reshape(-1, ROWS, *x.shape[1:])

    def some(total: Array, row: tuple[Array, Array, Array]) -> tuple[Array, None]:
        d, values, weight = row
        functions = jnp.stack(basis(order, (d[..., 0], d[..., 1], d[..., 2])), axis=-1).reshape(-1, count(order))
        weighted = (values * weight[:, None, None]).reshape(-1, channels)
        return total + functions.T @ weighted, None

    zero = jnp.zeros((count(order), channels), pixels.dtype)
    return jax.lax.scan(some, zero, (rows(directions), rows(pixels), rows(solid_angle)))[0]


def zonal(fn: Callable[[Float[Array, "n"]], Float[Array, "n *rest"]], order: int, *, nodes: int = 256) -> Float[Array, "l *rest"]:
    """Coefficients `k_l` of a function of the cosine to the polar axis, `integral Y_l0 fn`, by `nodes` Gauss-Legendre nodes on each of
    [-1, 0] and [0, 1]: exact for polynomials of the clamped cosine."""
    z, weight = np.polynomial.legendre.leggauss(nodes)
    z, weight = np.concatenate([(z - 1) / 2, (z + 1) / 2]), np.concatenate([weight, weight]) / 2
    directions = np.stack([np.sqrt(1 - z * z), np.zeros_like(z), z], axis=1)
    bands = evaluate(order, directions)[:, np.arange(order + 1) * np.arange(1, order + 2)]
    scaled = bands * jnp.asarray(2 * np.pi * weight, bands.dtype)[:, None]
    return jnp.tensordot(scaled, fn(jnp.asarray(z, bands.dtype)), axes=(0, 0))


def cap(gap: Float[Array, "..."], order: int) -> list[Array]:
    """`zonal` of the indicator of the cap `1 - z <= gap` about the pole, in closed form, of any shape: with Legendre's polynomials
    `k_l = 2 pi sqrt((2 l + 1) / (4 pi)) (1 - z^2) P_l'(z) / (l (l + 1))` at its edge, and `2 pi gap / sqrt(4 pi)` for `l = 0`.

    A small cap keeps its digits: of the half angle, `gap = 2 sin^2(angle / 2)`, nothing cancels.
    """
    z = 1 - gap
    value, slope = [jnp.ones_like(z), z], [jnp.zeros_like(z), jnp.ones_like(z)]
    for n in range(1, order):
        value.append(((2 * n + 1) * z * value[n] - n * value[n - 1]) / (n + 1))
        slope.append(slope[n - 1] + (2 * n + 1) * value[n])
    edge = gap * (2 - gap)
    fractions = [gap, *(edge * slope[n] / (n * (n + 1)) for n in range(1, order + 1))]
    return [math.sqrt(math.pi * (2 * n + 1)) * fraction for n, fraction in enumerate(fractions)]


def convolve(coefficients: ArrayLike, kernel: ArrayLike) -> Float[Array, "bands *rest"]:
    """The convolution with a circularly symmetric kernel, given by its `zonal` coefficients up to the same order or a higher one:
    `c_lm sqrt(4 pi / (2 l + 1)) k_l`, the function `d -> integral f(e) kernel(d . e) de`."""
    coefficients, kernel = as_floats(coefficients), as_floats(kernel)
    order = order_of(coefficients)
    if kernel.ndim != 1 or kernel.shape[0] <= order:
        raise ValueError(f"the kernel needs {order + 1} zonal coefficients for order {order}, not {kernel.shape}")
    factor = kernel[: order + 1] * np.sqrt(4 * np.pi / (2 * np.arange(order + 1) + 1))
    return _by_band(coefficients, factor.astype(coefficients.dtype))


def window(coefficients: ArrayLike, width: float | int) -> Float[Array, "bands *rest"]:
    """Weaker high bands against ringing: band `l` times Lanczos's `sinc(l / width)` for `l` below `width`, else 0.

    A small `width` blurs more and rings less; `width = 2 (order + 1)` is mild. Constants stay as they are. **Raises** `ValueError` where
    `width` is not positive.
    """
    if not width > 0:
        raise ValueError(f"the width of a window must be positive, not {width!r}; order + 1 is a good start")
    coefficients = as_floats(coefficients)
    band = np.arange(order_of(coefficients) + 1)
    return _by_band(coefficients, jnp.asarray(np.where(band < width, np.sinc(band / width), 0.0), coefficients.dtype))


def _by_band(coefficients: Float[Array, "bands *rest"], factor: Float[Array, "l"]) -> Float[Array, "bands *rest"]:
    spread = factor[band_of(order_of(coefficients))]
    return coefficients * spread.reshape(-1, *(1,) * (coefficients.ndim - 1))
