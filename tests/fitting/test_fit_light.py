"""Light, phase functions and surfaces are recovered from pictures, alone and with the transfer function."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import render

import jvr
from jvr.model.parameters import is_by_channel

SETTINGS = jvr.Settings(0.8)
DIRECTION = np.array([0.3, 0.5, -1.0])


@pytest.fixture(scope="module")
def volume():
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 12)] * 3, indexing="ij"))
    ripple = 0.15 * np.sin(4 * grid[0]) * np.cos(5 * grid[1])
    return jvr.Volume(np.clip(1.1 - np.sqrt((grid**2).sum(0)) + ripple, 0, 1).astype(np.float32))


def scene(volume, g=0.5, albedo=0.8, direction=DIRECTION, irradiance=4.0, sigma=0.3, **parts):
    transfer = jvr.LutTransfer(np.zeros((4, 3)), sigma * np.array([0.0, 0.2, 0.6, 1.0]) + 1e-3, (0.0, 1.0))
    scattering = jvr.SingleScattering(jvr.HenyeyGreenstein(g), albedo)
    light = jvr.DirectionalLight(direction / np.linalg.norm(direction), irradiance)
    parts = {"scattering": scattering, "shadows": jvr.ShadowVolume(1.0), **parts}
    return jvr.Scene(volume, transfer, lights=(light,), **parts)


def views(one, noise=0.0):
    cameras = jvr.fibonacci_sphere(one.volume.center, 24.0, 4, 34.0, 12, 12)
    images = [np.asarray(jvr.render(one, camera, SETTINGS).rgb) for camera in cameras]
    rng = np.random.default_rng(0)
    return cameras, [image + noise * rng.standard_normal(image.shape) for image in images]


def fit(start, cameras, images, unknowns, **keywords):
    return jvr.fit(start, cameras, images, unknowns=unknowns, settings=SETTINGS, progress=False, **keywords)


@pytest.mark.slow
def test_asymmetry_albedo_and_direction(volume):
    """Within three of its own standard errors, all of them; the length of a direction is none of the unknowns."""
    cameras, images = views(scene(volume), noise=1e-3)
    unknowns = lambda s: (s.scattering.phase.g, s.scattering.albedo, s.lights[0].direction)
    start = scene(volume, g=0.0, albedo=0.5, direction=np.array([0.0, 0.2, -1.0]))
    result = fit(start, cameras, images, unknowns, max_steps=25)
    truth = unknowns(scene(volume))
    for found, true, error in zip(unknowns(result.scene), truth, result.standard_errors, strict=True):
        assert np.all(np.isfinite(error))
        assert np.all(error < 0.02)
        assert np.all(np.abs(found - true) < 3 * np.asarray(error) + 1e-5)
    assert np.linalg.norm(result.scene.lights[0].direction) == pytest.approx(1, abs=1e-5)


@pytest.mark.slow
def test_a_channel_of_light_acts_on_its_own_channel_of_a_picture_alone(volume):
    """As lights declare it, whatever becomes of their light: a fit then moves the three at once."""
    lights = (
        jvr.DirectionalLight((0.3, 0.5, -1.0), np.ones(3)),
        jvr.PointLight((9.0, 4.0, 20.0), np.full(3, 90.0)),
        jvr.SpotLight((4.0, 4.0, 20.0), (0.0, 0.0, -1.0), np.full(3, 90.0)),
        jvr.HeadLight(np.ones(3)),
        jvr.AmbientLight(np.ones(3)),
    )
    parts = {"environment": jvr.EnvironmentLight.constant(0.5, order=1), "material": jvr.LambertBRDF((0.3, 0.5, 0.7))}
    parts |= {"transfer": jvr.LutTransfer(np.full((4, 3), 0.5), np.full(4, 0.2), (0.0, 1.0)), "lights": lights}
    one = dataclasses.replace(scene(volume), shadows=None, **parts)
    (camera, *_) = jvr.fibonacci_sphere(one.volume.center, 24.0, 1, 34.0, 8, 8)
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(one) if is_by_channel(one, path)]
    assert len(paths) == len(lights) + 1
    before = render(one, camera, SETTINGS).rgb
    for path in paths:
        brighter = lambda p, x, path=path: x.at[..., 1].multiply(1.5) if p == path else x
        change = render(jax.tree_util.tree_map_with_path(brighter, one), camera, SETTINGS).rgb - before
        np.testing.assert_array_equal(change[..., 0::2], 0.0)
        assert float(jnp.max(change[..., 1])) > 1e-3


@pytest.mark.slow
def test_only_the_product_of_albedo_and_irradiance_is_determined(volume):
    cameras, images = views(scene(volume))
    unknowns = lambda s: (s.scattering.phase.g, s.scattering.albedo, s.lights[0].irradiance)
    result = fit(scene(volume, g=0.2, albedo=0.6), cameras, images, unknowns, max_steps=10)
    g, albedo, irradiance = result.standard_errors
    assert np.isfinite(g)
    assert np.isinf(albedo)
    assert np.isinf(irradiance)
    assert result.stats.rank == 2
    assert {name for name, share in result.stats.worst if abs(share) > 0.5} == {"scattering.albedo[]", "lights[0].irradiance[]"}
    product = float(result.scene.scattering.albedo * result.scene.lights[0].irradiance)
    assert product == pytest.approx(3.2, rel=1e-3)


@pytest.mark.slow
def test_transfer_function_together_with_the_phase(volume):
    """Its entries shade each other: the Jacobian is taken through the shadows."""
    cameras, images = views(scene(volume))
    unknowns = lambda s: (s.transfer.sigma_t, s.scattering.phase.g)
    result = fit(scene(volume, g=0.1, sigma=0.15), cameras, images, unknowns, max_steps=15)
    truth = scene(volume)
    np.testing.assert_allclose(result.scene.transfer.sigma_t[1:], truth.transfer.sigma_t[1:], rtol=2e-2)
    assert float(result.scene.scattering.phase.g) == pytest.approx(0.5, abs=5e-3)


@pytest.mark.slow
def test_surfaces_without_shadows_have_rows(volume):
    """Entries of the table by rows, shading by forward mode: both are the derivatives of the same residuals."""
    lit = scene(volume, scattering=None, shadows=None, shading=jvr.Lambert(0.0, 0.7))
    transfer = jvr.LutTransfer(np.linspace(0.2, 0.9, 12).reshape(4, 3), lit.transfer.sigma_t, (0.0, 1.0))
    one = jvr.Scene(volume, transfer, lights=lit.lights, shading=lit.shading)
    cameras, images = views(one)
    start = jvr.Scene(
        volume, jvr.LutTransfer(np.full((4, 3), 0.5), lit.transfer.sigma_t, (0.0, 1.0)), lights=lit.lights, shading=lit.shading
    )
    result = fit(start, cameras, images, lambda s: s.transfer.rgb, max_steps=10)
    assert result.stats.kept_bytes == 0
    np.testing.assert_allclose(result.scene.transfer.rgb[1:], transfer.rgb[1:], atol=1e-3)


@pytest.mark.slow
def test_rows_refuse_shadows_that_change(volume):
    cameras, _ = views(scene(volume))
    loss = lambda sigma: jnp.sum(jvr.render(scene(volume, sigma=sigma), cameras[0], jvr.Settings(adjoint=jvr.Rows())).rgb)
    with pytest.raises(ValueError, match="does not know shadows"):
        jax.grad(loss)(0.5)
