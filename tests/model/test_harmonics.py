"""Spherical harmonics by identities: orthonormality, rotation of functions, products of functions, convolution, Parseval."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scenes import rotation
from scipy.special import sph_harm_y

import jvr
from jvr.model.harmonics.projection import cap, map_directions, sphere_nodes

ORDERS = (0, 1, 3, 6, 10)
TURN = rotation(0.4, -1.1, 2.3)


def directions(n, seed=0):
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def coefficients(order, seed=0, channels=()):
    return np.random.default_rng(seed).normal(size=((order + 1) ** 2, *channels))


@pytest.mark.parametrize("order", ORDERS)
def test_harmonics_are_orthonormal(order):
    with jax.enable_x64(True):
        nodes, weights = sphere_nodes(2 * order)
        functions = np.asarray(jvr.sh.evaluate(order, nodes))
    np.testing.assert_allclose(functions.T * weights @ functions, np.eye((order + 1) ** 2), atol=1e-13)


def test_harmonics_are_those_of_an_independent_library():
    d, order = directions(20), 10
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    with jax.enable_x64(True):
        functions = np.asarray(jvr.sh.evaluate(order, d))
    for band in range(order + 1):
        for m in range(-band, band + 1):
            y = sph_harm_y(band, abs(m), theta, phi) * (-1) ** m
            expected = y.real if m == 0 else math.sqrt(2) * (y.real if m > 0 else y.imag)
            np.testing.assert_allclose(functions[:, band * (band + 1) + m], expected, atol=1e-12)


def test_poles_and_directions_of_any_length():
    functions = jvr.sh.evaluate(10, [[0, 0, 1], [0, 0, 1e-20], [0, 0, -1e20]])
    assert np.all(np.isfinite(functions))
    np.testing.assert_array_equal(functions[0], functions[1])
    slope = jax.jacfwd(lambda d: jvr.sh.evaluate(10, d[None])[0])(jnp.array([0.0, 0.0, 1.0]))
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize("order", ORDERS)
def test_rotated_coefficients_are_those_of_the_rotated_function(order):
    c, d = coefficients(order, channels=(3,)), directions(30)
    with jax.enable_x64(True):
        turned = jvr.sh.evaluate(order, d) @ jvr.sh.rotate(c, TURN)
        expected = jvr.sh.evaluate(order, d @ TURN) @ c
    np.testing.assert_allclose(turned, expected, atol=1e-12)


def test_rotations_compose_and_keep_the_norm():
    c, other = coefficients(6), rotation(-0.3, 0.2, 0.9)
    with jax.enable_x64(True):
        twice = jvr.sh.rotate(jvr.sh.rotate(c, TURN), other)
        np.testing.assert_allclose(twice, jvr.sh.rotate(c, other @ TURN), atol=1e-12)
        assert float(jnp.sum(twice**2)) == pytest.approx(float(np.sum(c**2)), rel=1e-12)


@pytest.mark.parametrize(("a", "b"), [(0, 3), (2, 2), (3, 5)])
def test_a_product_is_the_projection_of_the_product(a, b):
    c, e, d = coefficients(a), coefficients(b, 1), directions(30)
    with jax.enable_x64(True):
        product = jvr.sh.evaluate(a + b, d) @ jvr.sh.product(c, e)
        expected = (jvr.sh.evaluate(a, d) @ c) * (jvr.sh.evaluate(b, d) @ e)
    np.testing.assert_allclose(product, expected, atol=1e-12)


def test_coupling_coefficients_make_the_triple_product():
    a, b, c = (coefficients(order, order) for order in (3, 2, 4))
    with jax.enable_x64(True):
        by_coupling = np.einsum("i,j,k,ijk", a, b, c, jvr.sh.coupling(3, 2, 4))
        nodes, weights = sphere_nodes(9)
        values = [np.asarray(jvr.sh.evaluate(order, nodes) @ x) for order, x in ((3, a), (2, b), (4, c))]
        assert float(jvr.sh.triple_product(a, b, c)) == pytest.approx(by_coupling, rel=1e-12)
        assert by_coupling == pytest.approx(np.sum(weights * values[0] * values[1] * values[2]), rel=1e-12)


def test_the_shortcut_is_exact_where_light_or_transfer_is_the_same_from_everywhere():
    material, light = coefficients(3), coefficients(3, 1)
    everywhere = np.zeros(16)
    everywhere[0] = math.sqrt(4 * math.pi)
    with jax.enable_x64(True):
        clear = jvr.sh.two_double_products(material, light, everywhere)
        assert float(clear) == pytest.approx(material @ light, rel=1e-12)
        transfer = coefficients(3, 2)
        even = jvr.sh.two_double_products(material, 0.7 * everywhere, transfer)
        assert float(even) == pytest.approx(material[0] * math.sqrt(4 * math.pi) * 0.7 * transfer[0] / math.sqrt(4 * math.pi))
        assert float(jvr.sh.two_double_products(material, 0 * light, transfer)) == 0.0


def test_parseval():
    polynomial = lambda d: d[:, 0] ** 3 - 2 * d[:, 1] * d[:, 2] + 0.3
    with jax.enable_x64(True):
        c = jvr.sh.project(polynomial, 3)
        nodes, weights = sphere_nodes(6)
        assert float(jnp.sum(c**2)) == pytest.approx(np.sum(weights * polynomial(nodes) ** 2), rel=1e-12)


@pytest.mark.slow
def test_monte_carlo_projection_is_within_its_standard_error():
    polynomial = lambda d: jnp.exp(d[:, 0] - 0.5 * d[:, 2])
    exact = jvr.sh.project(polynomial, 3)
    samples = 4096
    drawn = jnp.stack([jvr.sh.project(polynomial, 3, samples=samples, key=jax.random.key(i)) for i in range(20)])
    d = jnp.asarray(directions(20000), jnp.float32)
    terms = polynomial(d)[:, None] * jvr.sh.evaluate(3, d)
    error = 4 * math.pi * np.std(terms, axis=0) / math.sqrt(samples)
    z = (np.asarray(drawn) - np.asarray(exact)) / error
    assert np.mean(z**2) == pytest.approx(1, abs=0.2)
    assert np.all(np.abs(np.mean(z, axis=0)) < 4 / math.sqrt(20))


def test_least_squares_finds_what_incomplete_samples_determine():
    d = directions(200)
    d = d[d[:, 2] > -0.3]
    c = coefficients(3, channels=(3,))
    with jax.enable_x64(True):
        found = jvr.sh.fit_samples(d, jvr.sh.evaluate(3, d) @ c, 3)
    np.testing.assert_allclose(found, c, atol=1e-9)
    with pytest.raises(ValueError, match="ridge"):
        jvr.sh.fit_samples(d[:5], np.ones(5), 3)
    assert np.all(np.isfinite(jvr.sh.fit_samples(d[:5], np.ones(5), 3, ridge=1e-3)))


@pytest.mark.slow
def test_convolution_with_a_kernel():
    kernel = lambda z: jnp.exp(2 * z)
    c, d = coefficients(3), directions(5)
    with jax.enable_x64(True):
        nodes, weights = sphere_nodes(60)
        f = np.asarray(jvr.sh.evaluate(3, nodes) @ c)
        expected = np.array([np.sum(weights * f * np.exp(2 * nodes @ e)) for e in d])
        found = jvr.sh.evaluate(3, d) @ jvr.sh.convolve(c, jvr.sh.zonal(kernel, 3))
    np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize("cosine", [-1.0, -0.4, 0.0, 0.9, 1.0])
def test_the_cap_in_closed_form(cosine):
    with jax.enable_x64(True):
        # The indicator jumps: nodes on either side of it are exact for the polynomials in between.
        z, weight = np.polynomial.legendre.leggauss(20)
        z, weight = (1 + cosine) / 2 + (1 - cosine) / 2 * z, weight * (1 - cosine) / 2
        d = np.stack([np.sqrt(1 - z * z), 0 * z, z], axis=1)
        functions = np.asarray(jvr.sh.evaluate(8, d))[:, np.arange(9) * np.arange(1, 10)]
        np.testing.assert_allclose(jnp.stack(cap(jnp.asarray(1 - cosine), 8)), 2 * np.pi * weight @ functions, atol=1e-12)


def test_a_window_keeps_constants_and_ends_ringing():
    lamp = jvr.EnvironmentLight.disc([0, 0, 1], 5.0, 100.0, order=6).coefficients
    d = directions(500)
    least = lambda c: float((jvr.sh.evaluate(6, d) @ c).min() / (jvr.sh.evaluate(6, d) @ c).max())
    widths = (100.0, 14.0, 7.0)
    rings = [least(jvr.sh.window(lamp, width)) for width in widths]
    assert rings == sorted(rings)
    assert rings[0] < -0.1
    assert rings[-1] > 0.5 * rings[0]
    np.testing.assert_array_equal(jvr.sh.window(lamp, 7.0)[0], lamp[0])
    with pytest.raises(ValueError, match="positive"):
        jvr.sh.window(lamp, 0)


@pytest.mark.parametrize("shape", [(8, 16), (37, 74), (64, 128)])
def test_a_constant_map_is_a_constant(shape):
    c = jvr.sh.project_map(jnp.ones((*shape, 3)), 4)
    expected = np.zeros((25, 3))
    expected[0] = math.sqrt(4 * math.pi)
    # A pixel is seen at its middle: second order.
    np.testing.assert_allclose(c, expected, atol=0.08 * (8 / shape[0]) ** 2)


def test_a_map_of_a_function_has_its_coefficients():
    c = coefficients(3, channels=(3,))
    d, solid_angle = map_directions(256, 512)
    assert np.sum(solid_angle) * 512 == pytest.approx(4 * math.pi)
    pixels = jvr.sh.evaluate(3, d.reshape(-1, 3)) @ jnp.asarray(c, jnp.float32)
    np.testing.assert_allclose(jvr.sh.project_map(pixels.reshape(256, 512, 3), 3), c, atol=2e-3)


def test_orientation_of_maps():
    d, _ = map_directions(180, 360)
    for (row, column), axis in {(90, 90): (1, 0, 0), (90, 180): (0, 0, 1), (90, 270): (-1, 0, 0), (0, 7): (0, 1, 0)}.items():
        np.testing.assert_allclose(d[row, column], axis, atol=0.02)


@pytest.mark.parametrize(
    "call",
    [
        lambda: jvr.sh.evaluate(-1, [[0, 0, 1]]),
        lambda: jvr.sh.evaluate(2, [0, 0, 1]),
        lambda: jvr.sh.order_of(jnp.ones(5)),
        lambda: jvr.sh.rotate(jnp.ones(4), 2 * np.eye(3)),
        lambda: jvr.sh.rotate(jnp.ones(4), -np.eye(3)),
        lambda: jvr.sh.convolve(jnp.ones(9), jnp.ones(2)),
        lambda: jvr.sh.project(lambda d: d[:, 0], 2, samples=10),
    ],
)
def test_bad_input_is_refused(call):
    with pytest.raises(ValueError, match=r"."):
        call()


@pytest.mark.slow
def test_gradients_of_rotation_and_products():
    with jax.enable_x64(True):
        c, e = jnp.asarray(coefficients(3)), jnp.asarray(coefficients(2, 1))

        def f(c, e, angle):
            turn = jnp.array([[jnp.cos(angle), -jnp.sin(angle), 0], [jnp.sin(angle), jnp.cos(angle), 0], [0, 0, 1]])
            return jnp.sum(jnp.sin(jvr.sh.product(jvr.sh.rotate(c, turn), e)))

        check_grads(f, (c, e, jnp.asarray(0.7)), order=1, modes=("fwd", "rev"), rtol=1e-6)
