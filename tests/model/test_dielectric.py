"""Snell's law and Fresnel's equations, against the form with angles in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jvr.model.dielectric import fresnel, mirrored, refracted


def triple(*v):
    return tuple(jnp.asarray(c) for c in v)


def at(angle, eta):
    """Reflected fraction, and the refraction, of an eye at an angle from the normal."""
    angle = jnp.asarray(angle)
    zero = jnp.zeros_like(angle)
    normal, w_o = (zero, zero, zero + 1), (jnp.sin(angle), zero, jnp.cos(angle))
    behind = refracted(normal, w_o, jnp.asarray(eta, angle.dtype))
    return fresnel(w_o[2], behind, jnp.asarray(eta, angle.dtype)), behind


@pytest.mark.parametrize("eta", [1 / 1.5, 1.5, 1 / 2.4])
def test_angles_are_snell_s_and_fractions_fresnel_s(x64, eta):
    """`(sin^2(i - t) / sin^2(i + t) + tan^2(i - t) / tan^2(i + t)) / 2`, which needs no care away from right angles."""
    critical = np.arcsin(min(1 / eta, 1.0))
    i = np.linspace(0.05, critical - 1e-3, 50)
    t = np.arcsin(eta * np.sin(i))
    fraction, behind = at(i, eta)
    np.testing.assert_allclose(np.stack(behind.direction), np.stack([-np.sin(t), 0 * t, -np.cos(t)]), atol=1e-12)
    wanted = (np.sin(i - t) ** 2 / np.sin(i + t) ** 2 + np.tan(i - t) ** 2 / np.tan(i + t) ** 2) / 2
    np.testing.assert_allclose(fraction, wanted, rtol=1e-9)
    np.testing.assert_allclose(at(0.0, eta)[0], ((1 - eta) / (1 + eta)) ** 2, rtol=1e-12)
    if eta > 1:
        # All of it beyond, and continuously so: next to the angle it lacks four cosines, and the cosine is the root of the distance.
        beyond, total = at(np.linspace(critical + 1e-9, 1.57, 9), eta)
        assert np.all(total.total)
        assert np.all(np.asarray(beyond) == 1)
        lacking = 1 - np.asarray(at(critical - np.array([1e-6, 1e-8]), eta)[0])
        np.testing.assert_allclose(lacking[0] / lacking[1], 10, rtol=1e-2)
        assert lacking[1] < 1e-3


def test_what_is_mirrored_leaves_under_the_same_angle():
    tilted = mirrored(triple(0.6, 0.0, 0.8), triple(0.0, 0.6, 0.8))
    np.testing.assert_allclose(tilted, 2 * 0.64 * np.array([0.6, 0, 0.8]) - [0, 0.6, 0.8], atol=1e-7)


@pytest.mark.parametrize("eta", [1.0, 1 / 1.5, 1.5, 1 + 1e-6])
def test_grazing_angles_and_equal_indices_keep_their_digits(eta):
    """In single precision: nothing is reflected where indices are equal, all at a right angle where they are not, and value and
    derivatives are finite everywhere."""
    cosines = jnp.asarray([0.0, 1e-30, 1e-8, 1e-4, 1e-2, 0.5, 1.0])
    sines = jnp.sqrt((1 - cosines) * (1 + cosines))

    def of(cosine, sine, eta):
        behind = refracted(triple(0.0, 0.0, 1.0), (sine, 0.0 * sine, cosine), eta)
        return fresnel(cosine, behind, eta), behind.direction

    every = jax.vmap(jax.jacfwd(of, argnums=(0, 2)), in_axes=(0, 0, None))
    fraction, direction = jax.vmap(of, in_axes=(0, 0, None))(cosines, sines, jnp.float32(eta))
    for found in jax.tree.leaves((fraction, direction, every(cosines, sines, jnp.float32(eta)))):
        assert np.all(np.isfinite(found))
    np.testing.assert_allclose(sum(np.square(d) for d in direction), 1, rtol=1e-5)
    if eta == 1:
        np.testing.assert_allclose(fraction[2:], 0, atol=1e-7)
        np.testing.assert_allclose(np.stack(direction)[:, 2:], np.stack([-sines, 0 * sines, -cosines])[:, 2:], atol=1e-6)
    else:
        np.testing.assert_allclose(fraction[0], 1, rtol=1e-6)
