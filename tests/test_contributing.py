"""What CONTRIBUTING.md says how to add: its code held to closed forms, rendered, differentiated, fitted, planned, saved and read."""

import sys
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pages
import pytest
from scenes import render

import jvr
from jvr.integrators.image_plane import image_plane
from jvr.io.config import build_scene, build_settings, read_config
from jvr.model.phase import ScatteringAngle

PAGE = "CONTRIBUTING.md"


@pytest.fixture(scope="module", autouse=True)
def added(_registry):
    """The module of the page, in which lines are those of the page."""
    module = types.ModuleType("added")
    sys.modules["added"] = module
    for block in pages.blocks("python"):
        if block.page == PAGE:
            exec(compile("\n" * (block.line - 1) + block.code, PAGE, "exec"), vars(module))
    yield module
    del sys.modules["added"]


# --- Each is what it says, by closed forms ---------------------------------------------------------------------------


def test_the_light_is_that_of_a_panel(added):
    position, axis = np.array([1.0, 2.0, 3.0]), np.array([1.0, -2.0, 2.0]) / 3
    light = added.PanelLight(position, 5 * axis, 7.0)
    for x in (position + 4 * axis, position - axis, np.array([5.0, 1.0, 4.0])):
        away = x - position
        r = np.linalg.norm(away)
        found = light.sample(tuple(jnp.asarray(x)), (0.0, 0.0, 1.0))
        np.testing.assert_allclose(np.stack(found.w_i), -away / r, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(found.distance, r, rtol=1e-6)
        np.testing.assert_allclose(np.stack(found.irradiance), 7 * max(away @ axis / r, 0) / r**2, rtol=1e-5)


@pytest.mark.parametrize("b", [-1.0, -0.4, 0.0, 0.7, 1.0])
def test_the_phase_function_is_a_density_with_its_draws(added, b):
    phase = added.LinearPhase(b)
    cosines, weights = np.polynomial.legendre.leggauss(8)
    (values,) = phase.evaluate(ScatteringAngle.of_cosine(jnp.asarray(cosines)))
    np.testing.assert_allclose(2 * np.pi * weights @ np.asarray(values), 1, rtol=1e-6)
    np.testing.assert_allclose(2 * np.pi * (weights * cosines) @ np.asarray(values), phase.mean_cosine[0], atol=1e-6)
    u = np.linspace(0.01, 0.99, 50)
    (drawn,) = phase.draw(jnp.asarray(u))
    below = np.polynomial.Polynomial([0.5, 0.5 * b]).integ(lbnd=-1)
    np.testing.assert_allclose(below(np.asarray(drawn.cos)), u, atol=1e-5)


def test_a_slab_of_the_transfer_function_is_as_opaque_as_its_length_says(added):
    """Between both ends, where the cubic is exactly a half."""
    scene = jvr.Scene(jvr.Volume(np.full((4, 4, 4), 0.5, np.float32)), added.RampTransfer(0.25, 0.75, (1.0, 0.5, 0.25), 0.8))
    camera = jvr.OrthographicCamera.look_at([1.5, 1.5, 9.0], [1.5, 1.5, 1.5], [0.0, 1.0, 0.0], 1.0, 2, 2)
    opacity = 1 - np.exp(-0.4 * 3)
    picture = render(scene, camera)
    np.testing.assert_allclose(picture.alpha, opacity, rtol=1e-5)
    np.testing.assert_allclose(picture.rgb[0, 0], opacity * np.array([1, 0.5, 0.25]), rtol=1e-5)


def test_the_transfer_function_hides_nothing_that_is_visible(added):
    transfer = added.RampTransfer(0.25, 0.75, (1.0, 1.0, 1.0), 0.8)
    low = np.random.default_rng(0).random((50, 1))
    between = low + np.linspace(0, 0.3, 60)
    u = np.clip((between - 0.25) / 0.5, 0, 1)
    wanted = np.any(0.8 * u * u * (3 - 2 * u) > 1e-6, axis=1)
    found = jax.vmap(lambda a: transfer.is_visible(a, a + 0.3))(low[:, 0])
    assert np.all(np.asarray(found) >= wanted)
    assert not transfer.is_visible(0.0, 0.2)


def test_the_surface_reflects_what_its_equation_says(added):
    """Of a surface, of what is none, and without wrap as Lambert's."""
    normals = np.random.default_rng(0).normal(size=(3, 20))
    normals /= np.linalg.norm(normals, axis=0)
    w_o, _, up = (tuple(axis) for axis in jnp.eye(3))
    reflect = lambda shading, weight: jax.vmap(lambda n: shading.reflect(jnp.asarray(weight), tuple(n), w_o, up)[0], in_axes=1)(
        normals
    )
    for wrap in (0.0, 0.3, 1.0):
        facing = np.maximum((normals[2] + wrap) / (1 + wrap), 0)
        np.testing.assert_allclose(reflect(added.WrappedDiffuse(wrap), 1.0), facing, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(reflect(added.WrappedDiffuse(wrap), 0.25), 0.75 + 0.25 * facing, rtol=1e-5)
    lamberts = reflect(jvr.Lambert(two_sided=False), 1.0)
    np.testing.assert_allclose(reflect(added.WrappedDiffuse(0.0), 1.0), lamberts, rtol=1e-5, atol=1e-6)


# --- All in one scene ------------------------------------------------------------------------------------------------


def volume() -> jvr.Volume:
    """A ball with soft edges, a little uneven."""
    distance = np.linalg.norm(np.indices((7, 8, 9)).T - [3.0, 3.5, 4.0], axis=-1).T
    return jvr.Volume(1.2 - 0.25 * distance + 0.1 * np.random.default_rng(0).random((7, 8, 9)))


def camera(*eye: float) -> jvr.PerspectiveCamera:
    return jvr.PerspectiveCamera.look_at(eye or (22.0, -10.0, 13.0), (3.0, 3.5, 4.0), (0.1, 0.2, 1.0), 30.0, 5, 4)


TRUTH = (150.0, 0.6, 0.5, 0.4)


def scene(added, intensity, b, sigma_t, wrap) -> jvr.Scene:
    return jvr.Scene(
        volume(),
        added.RampTransfer(0.2, 0.7, (1.0, 0.8, 0.6), sigma_t),
        lights=[added.PanelLight((9.0, 4.0, 12.0), (-0.5, 0.0, -1.0), intensity)],
        shading=added.WrappedDiffuse(wrap, threshold=0.1),
        scattering=jvr.SingleScattering(added.LinearPhase(b), 0.7, threshold=0.1),
        shadows=jvr.ShadowVolume(1.0),
    )


def unknowns(s: jvr.Scene):
    return s.lights[0].intensity, s.scattering.phase.b, s.transfer.sigma_t, s.shading.wrap


def test_everything_is_differentiable(added, x64):
    """Reverse mode and central differences in double precision."""
    weights = np.random.default_rng(1).random((4, 5, 3))
    settings = jvr.Settings(0.5, termination=0)
    loss = jax.jit(lambda *p: jnp.sum(weights * jvr.render(scene(added, *p), camera(), settings).rgb))
    found = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))(*TRUTH)
    for i, (value, derivative) in enumerate(zip(TRUTH, found, strict=True)):
        h = 1e-5 * value
        at = lambda x, i=i: float(loss(*TRUTH[:i], x, *TRUTH[i + 1 :]))
        np.testing.assert_allclose(derivative, (at(value + h) - at(value - h)) / (2 * h), rtol=1e-6)


@pytest.mark.slow
def test_a_fit_finds_the_numbers(added):
    """In pictures from two sides."""
    settings = jvr.Settings(1.0, termination=0)
    truth = scene(added, *TRUTH)
    cameras = [camera(), camera(-18.0, 10.0, 15.0)]
    images = [jvr.render(truth, each, settings).rgb for each in cameras]
    result = jvr.fit(scene(added, 80.0, -0.3, 0.2, 0.8), cameras, images, unknowns=unknowns, settings=settings)
    np.testing.assert_allclose(np.stack(unknowns(result.scene)), TRUTH, rtol=1e-2)


def test_a_plan_names_them(added):
    text = str(jvr.plan(scene(added, *TRUTH)))
    assert all(name in text for name in ("PanelLight", "RampTransfer", "WrappedDiffuse", "LinearPhase"))


def test_they_are_saved_and_loaded(added, tmp_path):
    saved = scene(added, *TRUTH)
    jvr.save_scene(saved, tmp_path / "a.toml")
    found = jvr.load_scene(tmp_path / "a.toml")
    assert jax.tree.structure(found) == jax.tree.structure(saved)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(saved), strict=True))


CONFIG = """
[volume]
builtin = "demo"
[transfer]
kind = "ramp"
low = 0.2
high = 0.7
rgb = [1, 0.8, 0.6]
sigma_t = 0.5
[[lights]]
kind = "panel"
position = [9, 4, 12]
direction = [-0.5, 0, -1]
intensity = 150
[shading]
kind = "wrapped"
wrap = { positions = [0, 1], values = [0.2, 0.4] }
[scattering]
phase = { kind = "linear-cosine", b = 0.6 }
[settings]
sampling = { kind = "maximum", samples = 5 }
"""


def test_they_are_read_from_a_configuration(added, tmp_path):
    (tmp_path / "a.toml").write_text(CONFIG)
    config = read_config(tmp_path / "a.toml")
    assert build_settings(config) == jvr.Settings(sampling=added.MaximumProjection(5))
    found = build_scene(config)
    assert isinstance(found.lights[0], added.PanelLight)
    assert [float(x) for x in (found.lights[0].intensity, found.scattering.phase.b, found.transfer.sigma_t)] == pytest.approx(
        TRUTH[:3]
    )
    np.testing.assert_allclose(found.shading.wrap.values, [0.2, 0.4])


# --- The integrator --------------------------------------------------------------------------------------------------


def test_the_integrator_finds_the_largest_scalar(added):
    """Of a field that falls linearly with each coordinate, whose largest value along a ray is that of one of its ends."""
    values = 1.0 - np.einsum("aijk,a->ijk", np.indices((7, 8, 9)), [0.06, 0.03, 0.02])
    grey = jvr.LinearTransfer([0.0, 1.0], [[0, 0, 0], [1, 1, 1]], [0, 1])
    look = jvr.OrthographicCamera.look_at([3.0, 3.5, 30.0], [3.0, 3.5, 4.0], [0.0, 1.0, 0.0], 4.0, 4, 4)
    settings = jvr.Settings(sampling=added.MaximumProjection(400))
    picture = render(jvr.Scene(jvr.Volume(values), grey), look, settings)
    centres = (np.arange(4) + 0.5) - 2
    x, y = 3 + centres[None, :], 3.5 - centres[:, None]
    # The ray ends at z = 0, half a sample, 8 / 800, behind the last.
    np.testing.assert_allclose(picture.rgb[..., 0], 1 - 0.06 * x - 0.03 * y - 0.02 * 0.01, atol=1e-5)
    np.testing.assert_array_equal(picture.alpha, 1)
    np.testing.assert_allclose(picture.depth, 30.0 - 8.0, rtol=1e-6)
    assert int(picture.stats.samples) == 16 * 400


BRIGHTNESS = jvr.LinearTransfer([0.0, 0.6, 1.3], [[0.1, 0, 0], [0.4, 0.7, 0.2], [1, 0.8, 0.9]], [0, 0.5, 1])


@pytest.mark.slow
def test_the_integrator_is_differentiable_and_explained(added, x64):
    settings = jvr.Settings(sampling=added.MaximumProjection(12))
    loss = lambda v: jnp.sum(jvr.render(jvr.Scene(jvr.Volume(v), BRIGHTNESS), camera(), settings).rgb ** 2)
    v, direction = volume().values, np.random.default_rng(2).normal(size=(7, 8, 9))
    found = jnp.vdot(jax.jit(jax.grad(loss))(v), direction)
    h = 1e-7  # between the changes of which sample is the largest
    assert float(found) == pytest.approx(float(loss(v + h * direction) - loss(v - h * direction)) / (2 * h), rel=1e-5)
    assert "the largest of 12 scalars of each ray" in str(jvr.plan(jvr.Scene(volume(), BRIGHTNESS), settings))


@pytest.mark.slow
def test_a_fit_goes_along_the_integrators_rays(added):
    """Colours of a table are recovered from projections, which a march with them does not look like."""
    settings, truth = jvr.Settings(sampling=added.MaximumProjection(12)), jvr.Scene(volume(), BRIGHTNESS)
    cameras = [camera(), camera(-18.0, 10.0, 15.0)]
    images = [jvr.render(truth, each, settings).rgb for each in cameras]
    start = eqx.tree_at(lambda s: s.transfer.rgb, truth, jnp.full((3, 3), 0.5))
    result = jvr.fit(start, cameras, images, unknowns=lambda s: s.transfer.rgb, settings=settings)
    # No ray has a largest scalar below the second point of the table but those that pass beside the ball.
    np.testing.assert_allclose(result.scene.transfer.rgb[1:], BRIGHTNESS.rgb[1:], atol=1e-3)
    assert result.stats.kept_bytes == 0


# --- The oracle ------------------------------------------------------------------------------------------------------


def test_the_oracle_wants_more_the_nearer_bricks_are_to_its_distance(added):
    """Of bricks in a row in front of the eye, whose middles are 2, 6, 10 and 14 voxels away from the first."""
    box = jvr.Volume(np.zeros((5, 5, 17)))
    look = jvr.OrthographicCamera.look_at([2.0, 2.0, -20.0], [2.0, 2.0, 0.0], [0.0, 1.0, 0.0], 4.0, 4, 4)
    found = added.Focus(30.0).wanted(box, None, image_plane(look, jnp.zeros(())))
    np.testing.assert_allclose(found[0, 0], [0.8, 0.4, 0.0, 0.4], atol=1e-6)
