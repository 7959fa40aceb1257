"""The dipole's diffuse reflectance: its integral, its limits, its derivatives, and the published materials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.model.dipole import MEASURED

# Diffuse reflectance as the paper prints it beside the coefficients, two digits.
PRINTED = {
    "marble": (0.83, 0.79, 0.75),
    "potato": (0.77, 0.62, 0.21),
    "ketchup": (0.16, 0.01, 0.00),
    "skimmilk": (0.81, 0.81, 0.69),
    "skin1": (0.44, 0.22, 0.13),
    "skin2": (0.63, 0.44, 0.34),
    "spectralon": (1.00, 1.00, 1.00),
    "wholemilk": (0.91, 0.88, 0.76),
    "cream": (0.98, 0.90, 0.73),
}


def radial_quadrature(dipole, power):
    """The integral of `2 pi r^(1 + power) R_d dr` for each colour, in `log r`."""
    log_r, step = np.linspace(np.log(1e-6), np.log(1e6), 20_001, retstep=True)
    r = np.exp(log_r)
    return [np.sum(2 * np.pi * r ** (2 + power) * np.asarray(c)) * step for c in dipole.reflectance(jnp.asarray(r))]


@pytest.mark.parametrize("name", MEASURED)
def test_total_is_the_integral(x64, name):
    dipole = jvr.Dipole.preset(name)
    # Without absorption R_d falls with the cube of the distance, so 1e6 mm keep all but about 1e-6.
    np.testing.assert_allclose(dipole.total, radial_quadrature(dipole, 0), rtol=1e-5)


@pytest.mark.parametrize("name", PRINTED)
def test_total_is_what_the_paper_prints(name):
    np.testing.assert_allclose(jvr.Dipole.preset(name).total, PRINTED[name], atol=0.01)


def test_red_travels_farthest_in_skin(x64):
    for name in ("skin1", "skin2"):
        dipole = jvr.Dipole.preset(name)
        mean = np.divide(radial_quadrature(dipole, 1), radial_quadrature(dipole, 0))
        assert mean[0] > mean[1] > mean[2]
        # Millimetres, as seen at the edge of a shadow on a hand.
        assert 0.5 < mean[0] < 5


def test_colours_are_kept_apart():
    together = jvr.Dipole([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]).reflectance(jnp.asarray(0.7))
    for c in range(3):
        alone = jvr.Dipole([1.0 + c] * 3, [0.1 * (1 + c)] * 3).reflectance(jnp.asarray(0.7))
        np.testing.assert_allclose(alone, [together[c]] * 3, rtol=1e-6)


def test_length_has_a_unit(x64):
    """The same material in units of a tenth: coefficients a tenth, distances ten times, R_d a hundredth."""
    fine, coarse = jvr.Dipole([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]), jvr.Dipole([0.1, 0.2, 0.3], [0.01, 0.02, 0.03])
    r = jnp.asarray([0.0, 0.3, 5.0])
    np.testing.assert_allclose(coarse.reflectance(10 * r), np.asarray(fine.reflectance(r)) / 100, rtol=1e-12)
    np.testing.assert_allclose(coarse.total, fine.total, rtol=1e-12)


def test_derivatives_are_those_of_finite_differences(x64):
    r = jnp.asarray([0.0, 0.05, 0.4, 3.0])

    def value(x):
        dipole = jvr.Dipole(x[:3], x[3:6], x[6])
        return jnp.concatenate([jnp.ravel(jnp.stack(dipole.reflectance(r + x[7]))), jnp.stack(dipole.total)])

    x = jnp.asarray([0.74, 0.88, 1.01, 0.032, 0.17, 0.48, 1.3, 0.01])
    step = 1e-5
    over = jax.jit(jax.vmap(value))
    differences = np.transpose(over(x + step * jnp.eye(8)) - over(x - step * jnp.eye(8))) / (2 * step)
    # Central differences: an error of step squared.
    np.testing.assert_allclose(jax.jit(jax.jacrev(value))(x), differences, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(value))(x), differences, rtol=1e-6, atol=1e-8)


def test_derivative_without_absorption_is_the_limit(x64):
    at = lambda a: jvr.Dipole([2.0, 2.0, 2.0], jnp.stack([a] * 3)).reflectance(jnp.asarray(0.7))[0]
    # One-sided: absorption cannot be negative. The second derivative is infinite, so the error falls as the root of the step.
    step = 1e-10
    np.testing.assert_allclose(jax.grad(at)(jnp.asarray(0.0)), (at(jnp.asarray(step)) - at(jnp.asarray(0.0))) / step, rtol=1e-4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_finite_at_extremes(dtype):
    distances = [0.0, 1e-30, 1e-6, 1.0, 1e3, 1e12]
    scattering = [[1e-3, 1.0, 1e3], [11.6, 20.4, 14.9], [1e-6, 1.0, 1e4]]
    absorption = [[0.0, 1e-8, 1e-30], [0.0, 0.0, 0.0], [1e4, 1e-2, 1e4]]

    def outputs(r, s, a, eta):
        dipole = jvr.Dipole(s, a, eta)
        return jnp.stack([*dipole.reflectance(r), *dipole.total])

    over = lambda f: jax.jit(jax.vmap(jax.vmap(jax.vmap(f, (0, None, None, None)), (None, 0, 0, None)), (None, None, None, 0)))
    with jax.enable_x64(dtype == np.float64):
        x = [jnp.asarray(v, dtype) for v in (distances, scattering, absorption, [1.0, 1.3, 3.0])]
        values, slopes = over(outputs)(*x), over(jax.jacfwd(outputs, (0, 1, 2, 3)))(*x)
        assert values.dtype == dtype
        assert np.all(np.isfinite(values) & (np.asarray(values) >= 0))
        assert all(np.all(np.isfinite(slope)) for slope in (*slopes, *over(jax.jacrev(outputs, (0, 1, 2, 3)))(*x)))


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: jvr.Dipole([1.0, 1.0], [0.0, 0.0, 0.0]), r"sigma_s_prime has shape \(2,\); it must be \(3,\)"),
        (lambda: jvr.Dipole([1.0, 1.0, 0.0], [0.0, 0.0, 0.0]), "sigma_s_prime must be positive and finite"),
        (lambda: jvr.Dipole([1.0, 1.0, 1.0], [0.0, -1.0, 0.0]), "sigma_a must be finite and not negative"),
        (lambda: jvr.Dipole([1.0, 1.0, 1.0], [0.0, np.nan, 0.0]), "sigma_a must be finite and not negative"),
        (
            lambda: jvr.Dipole([1.0, 1.0, 1.0], [0.0, 0.0, 0.0], 0.5),
            r"eta must be in \[1, 3\] \(index of refraction; skin has 1.3\), not 0.5",
        ),
        (lambda: jvr.Dipole.preset("jade"), "no translucent material is called 'jade'; there are apple, .*wholemilk"),
    ],
)
def test_errors_say_what_is_wrong(call, says):
    with pytest.raises(ValueError, match=says) as caught:
        call()
    assert "\n" not in str(caught.value)
