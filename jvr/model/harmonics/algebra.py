"""Rotations and products of functions that are given by their coefficients.

Both are integrals of polynomials over the sphere, which a quadrature of their degree computes exactly; no table of coupling coefficients or
recurrence of rotation matrices is needed for any order.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jvr.model.harmonics.basis import as_floats, band_of, basis, order_of
from jvr.model.harmonics.projection import sphere_nodes
from jvr.types import ArrayLike


def rotation_matrix(order: int, rotation: Float[Array, "3 3"]) -> Float[Array, "bands bands"]:
    """The matrix that takes the coefficients of `f` to those of `f(R^T d)`: one orthogonal block for each band."""
    nodes, functions, weights = _nodes(order, 2 * order)
    turned = jnp.asarray(nodes, rotation.dtype) @ rotation
    matrix = jnp.asarray(functions * weights[:, None], rotation.dtype).T @ jnp.stack(basis(order, tuple(turned.T)), axis=1)
    # Bands do not mix; what the quadrature leaves there is rounding.
    return jnp.where(band_of(order)[:, None] == band_of(order), matrix, 0.0)


def rotate(coefficients: ArrayLike, rotation: ArrayLike) -> Float[Array, "bands *rest"]:
    """Coefficients of the rotated function `f(R^T d)`: what `f` has at `d` the result has at `R d`.

    Differentiable in both. **Raises** `ValueError` where `rotation` is not a `(3, 3)` rotation (orthogonal, determinant 1).
    """
    coefficients = as_floats(coefficients)
    rotation = jnp.asarray(rotation, coefficients.dtype)
    if rotation.shape != (3, 3):
        raise ValueError(f"a rotation is a (3, 3) matrix, not {rotation.shape}")
    if not isinstance(rotation, Tracer):
        matrix = np.asarray(rotation, np.float64)
        if not (np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-4) and np.linalg.det(matrix) > 0):
            raise ValueError("not a rotation: it must be orthogonal with determinant 1; a reflection or a scaling is neither")
    return jnp.tensordot(rotation_matrix(order_of(coefficients), rotation), coefficients, axes=(1, 0))


def product(a: ArrayLike, b: ArrayLike) -> Float[Array, "c *rest"]:
    """Coefficients of the product of two functions, exact: of the order of `a` plus that of `b`."""
    return product_to(a, b, order_of(a) + order_of(b))


def product_to(a: ArrayLike, b: ArrayLike, order: int) -> Float[Array, "c *rest"]:
    """`product` up to an order: the projection of the product, whatever it has beyond."""
    a, b = as_floats(a), as_floats(b)
    order_a, order_b = order_of(a), order_of(b)
    degree = order_a + order_b + order
    at = lambda c, n: jnp.tensordot(jnp.asarray(_nodes(n, degree)[1], c.dtype), c, axes=(1, 0))
    _, functions, weights = _nodes(order, degree)
    return jnp.tensordot(jnp.asarray(functions * weights[:, None], a.dtype), at(a, order_a) * at(b, order_b), axes=(0, 0))


def product_matrix(b: Float[Array, "b *rest"], order: int, order_out: int) -> Float[Array, "out bands *rest"]:
    """The matrix that multiplies a function of an order by `b` and projects the product up to `order_out`."""
    degree = order + order_out + order_of(b)
    _, given, weights = _nodes(order, degree)
    values = jnp.tensordot(jnp.asarray(_nodes(order_of(b), degree)[1], b.dtype), b, axes=(1, 0))
    wanted = jnp.asarray(_nodes(order_out, degree)[1] * weights[:, None], b.dtype)
    return jnp.einsum("qi,qj,q...->ij...", wanted, jnp.asarray(given, b.dtype), values)


def coupling(order_a: int, order_b: int, order_c: int) -> np.ndarray:
    """The coupling coefficients `integral Y_i Y_j Y_k`, `((order_a + 1)^2, (order_b + 1)^2, (order_c + 1)^2)`; few are not zero."""
    degree = order_a + order_b + order_c
    a, b, c = (_nodes(order, degree)[1] for order in (order_a, order_b, order_c))
    exact = np.einsum("qi,qj,qk->ijk", a * _nodes(order_a, degree)[2][:, None], b, c, optimize=True)
    return np.where(np.abs(exact) < 1e-12, 0.0, exact)


def triple_product(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> Float[Array, "*rest"]:
    """The integral of the product of three functions, exact."""
    return jnp.sum(as_floats(a) * product_to(b, c, order_of(a)), axis=0)


def two_double_products(material: ArrayLike, light: ArrayLike, transfer: ArrayLike) -> Float[Array, "*rest"]:
    """The paper's shortcut for the integral of material, light and radiance transfer: `(material . light) (transfer . light)` (Lindemann
    and Ropinski 2010, section 4.3), divided by the integral of the light, so that a radiance transfer of one leaves the light as it is.

    Exact where the radiance transfer is the same from everywhere. Zero without light.
    """
    material, light, transfer = as_floats(material), as_floats(light), as_floats(transfer)
    total = light[0] * np.sqrt(4 * np.pi)
    there = total != 0
    fraction = jnp.sum(transfer * light, axis=0) / jnp.where(there, total, 1.0)
    return jnp.where(there, jnp.sum(material * light, axis=0) * fraction, 0.0)


@functools.cache
def _nodes(order: int, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of `sphere_nodes(degree)`, the harmonics at them, `(n, (order + 1)^2)`, and weights, in double precision."""
    nodes, weights = sphere_nodes(degree)
    return nodes, np.stack(basis(order, tuple(nodes.T)), axis=1), weights
