"""Several rays a pixel: weighted means of finer pictures, coverage of edges, and what refuses them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from scenes import linear_transfer, render, small, voxels

import jvr
from jvr.io.config import build_settings, config_from
from jvr.rendering.supersampling import filtered, mean, weights_of

N = 3
SETTINGS = jvr.Settings(0.5, termination=0, pixel_samples=N)
ONE = jvr.Settings(0.5, termination=0)
EYE, TARGET = np.array([14.0, -9, 8]), np.array([4.0, 3, 3.5])


def pose():
    return jvr.PerspectiveCamera.look_at(EYE, TARGET, [0, 0, 1], 40.0, 4, 3).world_from_camera


# Each with pixels of its own number, and with all that is in pixels `N` times as many.
CAMERAS = {
    "perspective": lambda n: jvr.PerspectiveCamera.look_at(EYE, TARGET, [0, 0, 1], 40.0, 4 * n, 3 * n),
    "orthographic": lambda n: jvr.OrthographicCamera.look_at(EYE, TARGET, [0, 0, 1], 9.0, 4 * n, 3 * n),
    "pinhole": lambda n: jvr.PinholeCamera(pose(), [5.0 * n, 6.0 * n], 4 * n, 3 * n, principal_point=[1.7 * n, 1.2 * n]),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pinhole", "perspective", "orthographic"])
def test_a_pixel_is_the_mean_of_its_rays(kind, x64):
    camera, scene = CAMERAS[kind], small()
    found, fine = render(scene, camera(1), SETTINGS), render(scene, camera(N), ONE)
    blocks = lambda x: np.asarray(x, float).reshape(3, N, 4, N, -1)
    np.testing.assert_allclose(found.rgb, blocks(fine.rgb).mean((1, 3)), rtol=1e-12)
    alpha, seen = blocks(fine.alpha).mean((1, 3))[..., 0], blocks(fine.alpha * fine.depth).mean((1, 3))[..., 0]
    np.testing.assert_allclose(found.alpha, alpha, rtol=1e-12)
    np.testing.assert_allclose(found.depth, seen / np.where(alpha > 0, alpha, 1), rtol=1e-12)
    np.testing.assert_array_equal(found.stats.steps, blocks(fine.stats.steps).sum((1, 3))[..., 0])
    assert found.alpha.max() > 0.1


FILTERS = {
    "box": jvr.BoxFilter(),
    "wide box": jvr.BoxFilter(1.0),
    "tent": jvr.TentFilter(),
    "gaussian": jvr.GaussianFilter(),
    "wide gaussian": jvr.GaussianFilter(2.2, sigma=7.0),
    "mitchell": jvr.MitchellFilter(),
}
RADII = {"box": 0.5, "wide box": 1.0, "tent": 1.0, "gaussian": 1.5, "wide gaussian": 2.2, "mitchell": 2.0}


def profile(kind, x):
    """The filters as they are defined, up to a factor, at one distance in pixels."""
    a = abs(x)
    if a > RADII[kind]:
        return 0.0
    if "box" in kind:
        return 0.5 if a == RADII[kind] else 1.0
    if kind == "tent":
        return 1 - a
    if "gaussian" in kind:
        sigma = 7.0 if "wide" in kind else 0.5
        return np.exp(-0.5 * (a / sigma) ** 2) - np.exp(-0.5 * (RADII[kind] / sigma) ** 2)
    B = C = 1 / 3
    if a < 1:
        return ((12 - 9 * B - 6 * C) * a**3 + (-18 + 12 * B + 6 * C) * a**2 + 6 - 2 * B) / 6
    return ((-B - 6 * C) * a**3 + (6 * B + 30 * C) * a**2 + (-12 * B - 48 * C) * a + 8 * B + 24 * C) / 6


def matrix(kind, n, pixels):
    """The weights of all rays along an axis for each pixel, each by its distance; those that there are count for all."""
    rays = (np.arange(pixels * n) + 0.5) / n - 0.5
    weights = np.array([[profile(kind, x - i) for x in rays] for i in range(pixels)])
    return weights / weights.sum(axis=1, keepdims=True)


def averaged(fine, n, chosen):
    return np.asarray(jax.jit(lambda x: mean(x, weights_of(chosen, n)))(fine))


def rays_of(n, rows=5, columns=7, seed=0):
    """A picture of `n x n` rays a pixel, some of which see nothing."""
    rng, shape = np.random.default_rng(seed), (rows * n, columns * n)
    alpha = np.maximum(rng.random(shape) * 1.5 - 0.5, 0)
    parts = rng.random((*shape, 3)), alpha, np.where(alpha > 0, 9 + rng.random(shape), 0)
    return jvr.Rendering(*map(jnp.asarray, parts), jvr.RenderStats(jnp.asarray(rng.integers(0, 9, shape), jnp.int32)))


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("kind", FILTERS)
def test_pixels_are_weighted_means_of_the_rays_around_them(kind, n, x64):
    fine = rays_of(n)
    found = jax.jit(filtered, static_argnums=(1, 2))(fine, n, FILTERS[kind])
    down, across = matrix(kind, n, 5), matrix(kind, n, 7)
    np.testing.assert_allclose(found.rgb, np.einsum("ia,jb,abc->ijc", down, across, fine.rgb), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.alpha, np.clip(down @ fine.alpha @ across.T, 0, 1), rtol=1e-9, atol=1e-12)
    down, across = np.maximum(down, 0), np.maximum(across, 0)
    seen = down @ (fine.alpha * fine.depth) @ across.T / (down @ fine.alpha @ across.T)
    np.testing.assert_allclose(found.depth, seen, rtol=1e-9)
    assert np.all((found.depth >= 9) & (found.depth <= 10))
    np.testing.assert_array_equal(found.stats.steps, np.asarray(fine.stats.steps).reshape(5, n, 7, n).sum((1, 3)))


@pytest.mark.parametrize("n", [2, 5])
@pytest.mark.parametrize("make", [jvr.BoxFilter, jvr.TentFilter, jvr.GaussianFilter, jvr.MitchellFilter])
def test_an_even_picture_stays_as_it_is(make, n):
    """With every radius, up to those that are wider than the picture, and at its border."""
    even = jnp.full((3 * n, 2 * n), 0.7)
    narrow = [jvr.GaussianFilter(0.5, sigma=0.05)] if make is jvr.GaussianFilter else []
    for chosen in [*(make(radius) for radius in (0.5, 0.77, 1.9, 8.0)), *narrow]:
        np.testing.assert_allclose(averaged(even, n, chosen), 0.7, rtol=3e-6, err_msg=str(chosen))


@pytest.mark.parametrize("kind", FILTERS)
def test_a_step_is_the_integral_of_the_filter(kind, x64):
    """Of a step at the side of a pixel, 16 rays wide: what of the filter's area is on its bright side."""
    n, pixels = 16, 9
    bright = jnp.asarray((np.arange(pixels * n) >= 4 * n)[:, None] * np.ones(n))
    found = averaged(bright, n, FILTERS[kind])[:, 0]
    area = lambda a, b: scipy.integrate.quad(lambda x: profile(kind, x), a, b, points=[-1, 0, 1], limit=200)[0]
    radius = RADII[kind]
    for i in range(2, 7):
        # Away from the border, from which a filter of 2.2 pixels may take a little.
        wanted = area(np.clip(3.5 - i, -radius, radius), radius) / area(-radius, radius)
        assert found[i] == pytest.approx(wanted, abs=1e-3)
    # What is dark goes below 0 by the mean of negative weights that are on the bright side.
    assert np.min(found) < -5e-3 if kind == "mitchell" else np.min(found) >= 0


@pytest.mark.parametrize("kind", FILTERS)
def test_means_converge_with_the_square_of_the_distance_of_rays(kind, x64):
    """In a smooth picture, to the filter's integral: by the midpoint rule, at least."""
    wave = lambda x: np.sin(1.1 * x + 0.3)
    product = lambda f: scipy.integrate.quad(lambda x: f(x) * profile(kind, x), -RADII[kind], RADII[kind], points=[-1, 0, 1])[0]
    exact = product(lambda x: wave(x + 4)) / product(lambda x: 1.0)

    def error(n):
        rays = jnp.asarray(wave((np.arange(9 * n) + 0.5) / n - 0.5)[:, None] * np.ones(n))
        return abs(averaged(rays, n, FILTERS[kind])[4, 0] - exact)

    # Rays are apart by whole fractions of the radius: a kink there, or a jump, lies between two or on one.
    assert error(5) < 0.03
    assert error(25) < error(5) / 23 + 1e-12


@pytest.mark.parametrize("kind", ["tent", "mitchell"])
def test_gradients_are_those_of_the_weights(kind, x64):
    """Also where nothing is seen, and where opacity would leave 0 ... 1."""
    fine, n = rays_of(3), 3
    fine = eqx.tree_at(lambda p: p.alpha, fine, fine.alpha.at[:, 6:].set(0.0).at[:6, :6].set(1.0))
    weights = np.random.default_rng(1).random((5, 7, 5))

    def loss(rgb, alpha, depth):
        made = filtered(dataclasses.replace(fine, rgb=rgb, alpha=alpha, depth=depth), n, FILTERS[kind])
        return jnp.sum(weights[..., :3] * made.rgb) + jnp.sum(weights[..., 3] * made.alpha + weights[..., 4] * made.depth)

    loss = jax.jit(loss)
    of_rgb, of_alpha, of_depth = jax.jit(jax.grad(loss, (0, 1, 2)))(fine.rgb, fine.alpha, fine.depth)
    down, across = matrix(kind, n, 5), matrix(kind, n, 7)
    np.testing.assert_allclose(of_rgb, np.einsum("ia,jb,ijc->abc", down, across, weights[..., :3]), rtol=1e-9, atol=1e-12)
    assert np.all(np.isfinite(of_alpha))
    along = np.random.default_rng(2).random(fine.depth.shape)
    h = 1e-6
    difference = (loss(fine.rgb, fine.alpha, fine.depth + h * along) - loss(fine.rgb, fine.alpha, fine.depth - h * along)) / (
        2 * h
    )
    np.testing.assert_allclose(jnp.vdot(of_depth, along), difference, rtol=1e-7)
    along = np.where((np.asarray(fine.alpha) > 0) & (np.asarray(fine.alpha) < 1), along, 0)
    difference = (loss(fine.rgb, fine.alpha + h * along, fine.depth) - loss(fine.rgb, fine.alpha - h * along, fine.depth)) / (
        2 * h
    )
    np.testing.assert_allclose(jnp.vdot(of_alpha, along), difference, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("sampling", [jvr.Uniform(), jvr.Refinement(0.0)])
def test_every_integrators_picture_is_filtered(sampling):
    camera, scene = CAMERAS["perspective"], small()
    settings = dataclasses.replace(SETTINGS, sampling=sampling, pixel_filter=jvr.GaussianFilter(), tile=40)
    found, fine = render(scene, camera(1), settings), render(scene, camera(N), dataclasses.replace(ONE, sampling=sampling))
    wanted = np.einsum("ia,jb,abc->ijc", matrix("gaussian", N, 3), matrix("gaussian", N, 4), fine.rgb)
    np.testing.assert_allclose(found.rgb, wanted, atol=2e-6)


@pytest.mark.slow
def test_an_edge_is_as_soft_as_a_pixel():
    """An opaque cube cut by an oblique plane: a pixel is covered by so many of its rays as lie on this side, and by its area to a ray's."""
    n, normal = 8, np.array([0.0, 1.0, 0.37])
    scene = jvr.Scene(
        jvr.Volume(np.ones((9, 9, 9))),
        jvr.LinearTransfer([0.0, 1.0], np.ones((2, 3)), [50.0, 50.0]),
        clipping=jvr.ClippingPlane([4.0, 4.1, 3.9], normal),
    )
    camera = jvr.OrthographicCamera.look_at([30.0, 4, 4], [4.0, 4, 4], [0, 0, 1], 6.0, 6, 6)
    found = np.asarray(render(scene, camera, jvr.Settings(0.5, pixel_samples=n)).alpha)
    across = (np.arange(6 * n) + 0.5) / n - 3
    y, z = across[None, :], -across[:, None]
    inside = (y - 0.1) * normal[1] + (z + 0.1) * normal[2] <= 0
    np.testing.assert_allclose(found, inside.reshape(6, n, 6, n).mean((1, 3)), atol=1e-6)
    assert 3 < np.count_nonzero((found > 0.02) & (found < 0.98)) < 15


@pytest.mark.slow
def test_derivatives_against_differences(x64):
    volume, camera, transfer = jvr.Volume(voxels()), CAMERAS["perspective"](1), linear_transfer()

    def loss(sigma_t):
        scene = jvr.Scene(volume, jvr.LinearTransfer(transfer.positions, transfer.rgb, sigma_t))
        return jnp.sum(jvr.render(scene, camera, SETTINGS).rgb ** 2)

    gradient, h = jax.jit(jax.grad(loss))(transfer.sigma_t), 1e-6 * np.eye(4)
    value = jax.jit(lambda points: jax.lax.map(loss, points))
    expected = (value(transfer.sigma_t + h) - value(transfer.sigma_t - h)) / 2e-6
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)


def test_is_said_and_refused():
    scene, camera = small(), CAMERAS["perspective"](1)
    assert "3 x 3 rays a pixel" in str(jvr.plan(scene, SETTINGS))
    assert "rays a pixel" not in str(jvr.plan(scene, ONE))
    assert "pixel filter" not in str(jvr.plan(scene, ONE))
    assert "TentFilter(radius=1)" in str(jvr.plan(scene, dataclasses.replace(SETTINGS, pixel_filter=jvr.TentFilter())))
    with pytest.raises(ValueError, match="set pixel_samples=2 or more"):
        jvr.Settings(pixel_filter=jvr.TentFilter())
    with pytest.raises(ValueError, match=r"radius must be in \[0.5, 8\]"):
        jvr.TentFilter(0.3)
    with pytest.raises(ValueError, match="pixel_samples"):
        jvr.Settings(pixel_samples=0)
    with pytest.raises(ValueError, match="one ray a pixel"):
        jvr.fit(scene, [camera], [np.zeros((3, 4, 3))], unknowns=lambda s: s.transfer.rgb, settings=SETTINGS)


def test_a_configuration_names_them():
    table = {"pixel_samples": 3, "pixel_filter": {"kind": "gaussian", "sigma": 0.7}}
    base = {"volume": {"builtin": "demo"}, "transfer": {"kind": "window"}}
    found = build_settings(config_from({**base, "settings": table}, "here"))
    assert found == jvr.Settings(pixel_samples=3, pixel_filter=jvr.GaussianFilter(sigma=0.7))
    assert build_settings(config_from({**base, "settings": {**table, "pixel_filter": "mitchell"}}, "here")) == jvr.Settings(
        pixel_samples=3, pixel_filter=jvr.MitchellFilter()
    )
