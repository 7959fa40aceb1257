"""What rays see where they end: the contract of `Rays.end`, by an integrator that lets every ray end at a wall that glows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jvr
from jvr.march.steps import End
from jvr.rendering.integrator import AbstractRayIntegrator
from jvr.rendering.marching import Uniform

WALL, COLOUR, BACKGROUND = np.array([0.2, 0.5, 0.8]), np.array([0.9, 0.6, 0.3]), np.array([0.4, 0.1, 0.7])
SIDE, EYE = 3.0, 9.0


class Walled(AbstractRayIntegrator):
    """A wall half-way through the volume, as opaque as it says."""

    opaque: float

    @property
    def explanation(self):
        return "a wall"

    def radiance(self, prepared, rays):
        half, lets = rays.length / 2, jnp.full_like(rays.length, self.opaque)
        wall = End(tuple(self.opaque * c + 0 * half for c in WALL), lets, half)
        return Uniform().radiance(prepared, rays._replace(length=half, end=wall))


def slab(sigma_t, background=None):
    transfer = jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], jnp.stack([jnp.asarray(sigma_t)] * 2))
    return jvr.Scene(jvr.Volume(np.full((4, 4, 4), 0.5)), transfer, background=background)


def picture(scene, opaque):
    camera = jvr.OrthographicCamera.look_at([1.5, 1.5, EYE], [1.5, 1.5, 1.5], [0.0, 1.0, 0.0], 1.0, 2, 2)
    return jvr.render(scene, camera, jvr.Settings(0.3, termination=0, sampling=Walled(opaque)))


@pytest.mark.slow
def test_what_a_ray_ends_at_is_seen_through_the_medium_in_front(x64):
    sigma_t, T = 0.4, np.exp(-0.4 * SIDE / 2)
    found = picture(slab(sigma_t, BACKGROUND), 1.0)
    np.testing.assert_allclose(found.rgb[0, 0], (1 - T) * COLOUR + T * WALL, rtol=1e-9)
    np.testing.assert_allclose(found.alpha, 1.0, rtol=1e-12)
    assert float(picture(slab(0.0), 1.0).depth[0, 0]) == EYE - SIDE + SIDE / 2


def test_a_background_is_behind_what_is_not_opaque(x64):
    sigma_t, T = np.array([0.1, 0.4, 1.2]), np.exp(-np.array([0.1, 0.4, 1.2]) * SIDE / 2)
    found = picture(slab(sigma_t, BACKGROUND), 0.25)
    behind = 0.25 * WALL + 0.75 * BACKGROUND
    np.testing.assert_allclose(found.rgb[0, 0], (1 - T) * COLOUR + T * behind, rtol=1e-9)
    np.testing.assert_allclose(found.alpha[0, 0], np.mean(1 - 0.75 * T), rtol=1e-9)


@pytest.mark.slow
def test_its_derivative_is_that_of_the_closed_form(x64):
    red = lambda sigma_t: picture(slab(sigma_t), 1.0).rgb[0, 0, 0]
    closed = SIDE / 2 * np.exp(-0.4 * SIDE / 2) * (COLOUR[0] - WALL[0])
    np.testing.assert_allclose(jax.grad(red)(0.4), closed, rtol=1e-9)
