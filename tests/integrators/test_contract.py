"""What the contract of integrators promises a class that nobody has thought of, together with a part of somebody's own."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
from scenes import render

import jvr
from jvr.io.config import build_scene, build_settings, read_config
from jvr.model.effects import AbstractShading
from jvr.model.parameters import assign, choice, parameter
from jvr.model.ranges import UNIT_INTERVAL
from jvr.rendering.integrator import AbstractRayIntegrator, Radiance
from jvr.rendering.marching import Uniform
from jvr.types import Scalar


@pytest.fixture(scope="module", autouse=True)
def _registered(_registry):
    jvr.register("chalk", Chalk)
    jvr.register("front", Front)


class Chalk(AbstractShading):
    """Reflects the same fraction of light whichever way it comes and goes."""

    albedo: Scalar = parameter(UNIT_INTERVAL, doc="reflected fraction")

    def __init__(self, albedo=0.5):
        assign(self, albedo=albedo)

    def ambient_reflectance(self):
        return self.albedo

    def surface_weight(self, magnitude):
        return jnp.ones_like(magnitude)

    def reflect(self, weight, normal, w_o, w_i):
        return self.albedo, None


class Front(AbstractRayIntegrator):
    """What is in the front of the volume: a fraction of each ray's way through it."""

    fraction: float = choice(UNIT_INTERVAL, doc="of each ray's length")

    def __init__(self, fraction=0.5):
        assign(self, fraction=fraction)

    @property
    def explanation(self):
        return f"the first {self.fraction:.0%} of each ray"

    def radiance(self, prepared, rays):
        return Uniform().radiance(prepared, rays._replace(length=self.fraction * rays.length))


class Counted(AbstractRayIntegrator):
    """Fog, in steps whose number is known when the program runs: JAX has no reverse mode for that."""

    @property
    def explanation(self):
        return "steps that are counted"

    def radiance(self, prepared, rays):
        ahead = lambda state: jnp.any(state[0] < rays.length)
        step = lambda state: (state[0] + prepared.dt, state[1] * jnp.exp(-prepared.scene.transfer.sigma_t[0] * prepared.dt))
        _, T = jax.lax.while_loop(ahead, step, (jnp.zeros_like(rays.length), jnp.ones_like(rays.length)))
        return Radiance(jnp.stack((1 - T,) * 3, axis=-1), 1 - T, 0 * T, jnp.ones(T.shape, jnp.int32))


@jax.custom_vjp
def one_way(x):
    return x


def _refuse(residuals, cotangent):
    raise NotImplementedError


one_way.defvjp(lambda x: (x, None), _refuse)


class Silent(Uniform):
    """The same as by default, by rules of whose own one refuses without a word."""

    marches = False

    def radiance(self, prepared, rays):
        return jax.tree.map(one_way, super().radiance(prepared, rays))


class Drawn(Uniform):
    """The same as by default, but that it says that it has no derivatives."""

    is_differentiable = False


COLOUR, STRENGTH = np.array([0.9, 0.6, 0.3]), 1.7
SIDE = 3.0


def slab(albedo, sigma_t):
    """A homogeneous cube of `SIDE` mm, lit evenly."""
    transfer = jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], jnp.stack([jnp.asarray(sigma_t)] * 2))
    lights = [jvr.DirectionalLight([0.3, 0.2, -1.0], STRENGTH)]
    return jvr.Scene(jvr.Volume(np.full((4, 4, 4), 0.5)), transfer, lights=lights, shading=Chalk(albedo))


def straight():
    return jvr.OrthographicCamera.look_at([1.5, 1.5, 9.0], [1.5, 1.5, 1.5], [0.0, 1.0, 0.0], 1.0, 2, 2)


def askew():
    """Rays of all lengths."""
    return jvr.PerspectiveCamera.look_at([7.0, 5.0, 9.0], [1.5, 1.5, 1.5], [0.0, 1.0, 0.0], 25.0, 6, 5)


def brightness(albedo, sigma_t, fraction):
    return albedo * STRENGTH * COLOUR * (1 - np.exp(-sigma_t * fraction * SIDE))


@pytest.mark.slow
def test_its_picture_is_right_eagerly_and_in_ones_own_program():
    for way in (jvr.render, render):
        picture = way(slab(0.6, 0.4), straight(), jvr.Settings(0.3, termination=0, sampling=Front(0.25)))
        np.testing.assert_allclose(picture.rgb[1, 0], brightness(0.6, 0.4, 0.25), rtol=1e-5)
        np.testing.assert_allclose(picture.alpha[0, 1], 1 - np.exp(-0.4 * 0.25 * SIDE), rtol=1e-5)
        # Of a medium that is hardly opaque the middle is what is seen.
        assert 9 - SIDE < float(picture.depth[0, 0]) < 9 - SIDE + 0.5 * 0.25 * SIDE
        assert int(picture.stats.steps[0, 0]) == np.ceil(0.25 * SIDE / 0.3)


def test_the_method_that_made_pictures_before_makes_them_with_a_warning():
    settings = jvr.Settings(0.3, termination=0)
    with pytest.warns(DeprecationWarning, match=r"Front\.render is jvr\.render"):
        picture = Front(0.25).render(slab(0.6, 0.4), straight(), settings)
    np.testing.assert_allclose(picture.rgb[1, 0], brightness(0.6, 0.4, 0.25), rtol=1e-5)


def test_its_derivatives_are_right_in_ones_own_program(x64):
    settings = jvr.Settings(0.3, termination=0, sampling=Front(0.25))
    red = lambda a, s: jvr.render(slab(a, s), straight(), settings).rgb[0, 0, 0]
    by_albedo, by_sigma = jax.jit(jax.grad(red, argnums=(0, 1)))(0.6, 0.4)
    np.testing.assert_allclose(by_albedo, brightness(1.0, 0.4, 0.25)[0], rtol=1e-9)
    way = 0.25 * SIDE
    np.testing.assert_allclose(by_sigma, 0.6 * STRENGTH * COLOUR[0] * way * np.exp(-0.4 * way), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, optimistix.LBFGS(rtol=1e-7, atol=1e-9)])
def test_a_fit_goes_along_its_rays(solver):
    """In forward mode and in reverse: what a march of the whole rays would explain otherwise."""
    settings, truth = jvr.Settings(0.5, termination=0, sampling=Front()), (0.7, 0.5)
    target = jvr.render(slab(*truth), askew(), settings).rgb
    unknowns = lambda s: (s.shading.albedo, s.transfer.sigma_t)
    result = jvr.fit(slab(0.4, 0.2), [askew()], [target], unknowns=unknowns, settings=settings, solver=solver)
    albedo, sigma_t = unknowns(result.scene)
    np.testing.assert_allclose(albedo, truth[0], rtol=2e-3)
    # Both ends of the table: the medium lies half-way between them.
    np.testing.assert_allclose(jnp.mean(sigma_t), truth[1], rtol=2e-3)


@pytest.mark.slow
def test_what_has_no_derivative_says_so_in_a_line():
    target = np.zeros((2, 2, 3))
    refused = {
        "a fit takes derivatives of Counted in reverse mode, which has none: Reverse-mode": Counted(),
        "a fit takes derivatives of Silent in reverse mode, which has none: NotImplementedError": Silent(),
        "a fit goes by derivatives, and Drawn has none: leave Settings(sampling=...) at jvr.Uniform()": Drawn(),
    }
    for message, integrator in refused.items():
        with pytest.raises(ValueError, match=re.escape(message)) as error:
            jvr.fit(
                slab(0.5, 0.5),
                [straight()],
                [target],
                unknowns=lambda s: s.transfer.sigma_t,
                settings=jvr.Settings(sampling=integrator),
                solver=optimistix.LBFGS(rtol=1e-6, atol=1e-8),
            )
        assert "\n" not in str(error.value)


CONFIG = """
[volume]
builtin = "demo"
[transfer]
kind = "window"
[[lights]]
kind = "directional"
direction = [0, 0, -1]
[shading]
kind = "chalk"
albedo = 0.25
[settings.sampling]
kind = "front"
fraction = 0.125
"""


def test_it_is_in_plans_and_files(tmp_path):
    (tmp_path / "a.toml").write_text(CONFIG)
    config = read_config(tmp_path / "a.toml")
    scene, settings = build_scene(config), build_settings(config)
    assert settings.sampling == Front(0.125)
    assert float(scene.shading.albedo) == 0.25
    text = str(jvr.plan(scene, settings))
    assert "Chalk" in text
    assert "the first 12% of each ray" in text
