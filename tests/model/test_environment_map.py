"""Environments in pixels: their orientation, what is read between pixels, sampling, filters, and pictures in front of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, SETTINGS, linear_transfer, orthographic, perspective, render, rotation, voxels
from scipy.stats import chi2

import jvr
from jvr.io.config import build_scene, read_config
from jvr.model.harmonics.projection import map_directions

# A polynomial of direction: what harmonics of order 2 hold exactly.
POLYNOMIAL = np.array([[2.0, 1.5, 3.0], [0.4, -0.2, 0.3], [0.1, 0.5, -0.6], [-0.3, 0.2, 0.1], *[[0.2, -0.1, 0.3]] * 5])


def noise(height=8, seed=0):
    return np.random.default_rng(seed).random((height, 2 * height, 3))


def directions(n=200, seed=1):
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def painted(fn, height):
    d, _ = map_directions(height, 2 * height)
    return fn(d.reshape(-1, 3)).reshape(height, 2 * height, -1)


def polynomial(d, bands=1.0):
    return np.asarray(jvr.sh.evaluate(2, d)) @ (np.reshape(bands, (-1, 1)) * POLYNOMIAL)


def looked_up(pixels, d):
    """Bilinear look-up of one direction, by angles and loops."""
    height, width, _ = pixels.shape
    polar, azimuth = np.arccos(d[1] / np.linalg.norm(d)), np.arctan2(d[0], d[2])
    x, y = (0.5 - azimuth / (2 * np.pi)) * width - 0.5, polar / np.pi * height - 0.5
    total = np.zeros(3)
    for column in (int(np.floor(x)), int(np.floor(x)) + 1):
        for row in (int(np.floor(y)), int(np.floor(y)) + 1):
            weight = (1 - abs(x - column)) * (1 - abs(y - row))
            total += weight * pixels[row, column % width]
    return total


def test_it_is_read_as_its_orientation_says():
    """+X at a quarter of the width, +Z at its middle, -X at three quarters; row 0 is at +Y."""
    pixels = np.zeros((64, 128, 3))
    pixels[:, 28:36], pixels[:, 60:68], pixels[:, 92:100] = [1, 0, 0], [0, 1, 0], [0, 0, 1]
    pixels[:4], pixels[-4:] = 7.0, 9.0
    seen = jvr.EnvironmentMap(pixels).radiance([[1.0, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 0, -1], [0, 1, 0], [0, -1, 0]])
    np.testing.assert_allclose(seen, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [7, 7, 7], [9, 9, 9]], atol=1e-6)


def test_it_is_bilinear_between_pixels_and_wraps(x64):
    pixels, d = noise(), directions(400)
    inside = np.abs(np.arccos(d[:, 1]) / np.pi - 0.5) < 0.5 - 0.5 / 8
    assert 300 < inside.sum() < 400
    wanted = [looked_up(pixels, each) for each in d[inside]]
    np.testing.assert_allclose(jvr.EnvironmentMap(pixels).radiance(3.0 * d[inside]), wanted, rtol=1e-10)


@pytest.mark.slow
def test_it_meets_its_projection_and_turns_with_it():
    found, d = jvr.EnvironmentMap(painted(polynomial, 64)), directions()
    light = found.to_harmonics(2)
    # Half a pixel of a polynomial of degree 2.
    np.testing.assert_allclose(found.radiance(d), light.radiance(d), atol=4e-3)
    turn = rotation(0.2, 0.9, -0.4)
    np.testing.assert_allclose(found.rotated(turn).radiance(d @ turn.T), light.rotated(turn).radiance(d @ turn.T), atol=8e-3)


@pytest.mark.slow
def test_its_derivatives_are_those_of_differences_and_finite_at_the_poles(x64):
    chart, pixels = jvr.EnvironmentMap(noise()), jnp.asarray(noise())
    red = jax.jit(lambda d: chart.radiance(d)[:, 0])
    slope, forward = (jax.jit(jax.vmap(f(lambda d: red(d[None])[0]))) for f in (jax.grad, jax.jacfwd))
    d = directions(6)
    steps = [(red(d + 1e-6 * e) - red(d - 1e-6 * e)) / 2e-6 for e in np.eye(3)]
    np.testing.assert_allclose(slope(jnp.asarray(d)), np.stack(steps, axis=1), rtol=1e-5, atol=1e-7)
    # As near to the poles as one comes it stays bounded: by the contrast of a row over the angle of half a pixel, times a few.
    around = [[r * np.cos(a), y, r * np.sin(a)] for a in (0.1, 2.0, 4.0) for r in (0.0, 1e-6) for y in (1.0, -1.0)]
    for way in (slope, forward):
        found = np.asarray(way(jnp.array(around)))
        assert np.all(found[np.array(around)[:, 0] == 0] == 0)
        assert 0.1 < np.abs(found).max() < 4 * 16 / np.pi
    # In pixels it is linear: the weights of a look-up add up to 1.
    weights = jax.jacrev(lambda p: jvr.EnvironmentMap(p).radiance(directions(5))[:, 1])(pixels)
    np.testing.assert_allclose(weights.sum(axis=(1, 2)), [[0, 1, 0]] * 5, atol=1e-12)


@pytest.mark.slow
def test_directions_are_drawn_as_their_density_says():
    """Also where a lamp is 10,000 times brighter than the rest, and rows and pixels are black."""
    plain = noise(8).astype(np.float32)
    lamp = plain.copy()
    lamp[2, 5], lamp[6:], lamp[4, 3:9] = 1e4, 0, 0
    u = np.random.default_rng(3).random((2, 40_000)).astype(np.float32)
    for pixels in (plain, lamp):
        chart = jvr.EnvironmentMap(pixels)
        drawn = chart.sample(*u)
        np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1, atol=1e-6)
        assert float(jnp.min(chart.pdf(drawn))) > 0
        # Cells of half a pixel, in which the density is constant.
        d, solid_angle = map_directions(16, 32)
        chance = np.asarray(chart.pdf(d.reshape(-1, 3)), np.float64) * np.repeat(solid_angle, 32)
        np.testing.assert_allclose(chance.sum(), 1, rtol=1e-5)
        x, y, z = np.asarray(drawn, np.float64).T
        cell = np.minimum((np.arccos(np.clip(y, -1, 1)) / np.pi * 16).astype(int), 15) * 32
        cell += ((0.5 - np.arctan2(x, z) / (2 * np.pi)) % 1 * 32).astype(int) % 32
        count, wanted = np.bincount(cell, minlength=512), chance * u.shape[1]
        often = wanted > 5
        rest = (count[~often].sum(), wanted[~often].sum())
        statistic = np.sum((count - wanted)[often] ** 2 / wanted[often]) + (rest[0] - rest[1]) ** 2 / max(rest[1], 1e-9)
        assert 1e-3 < chi2.sf(statistic, often.sum()) < 1 - 1e-3


@pytest.mark.slow
def test_a_mean_over_drawn_directions_is_the_integral_over_the_sphere():
    """What is beside a lamp is light, too: nothing that can be seen has the density 0."""
    pixels = 0.0 * noise(8)
    pixels[3, 6] = [5.0, 1.0, 2.0]
    chart, u = jvr.EnvironmentMap(pixels), np.random.default_rng(3).random((2, 20_000))
    drawn = chart.sample(*u)
    ratios = np.asarray(chart.radiance(drawn) / chart.pdf(drawn)[:, None], np.float64)
    d, solid_angle = map_directions(256, 512)
    wanted = np.sum(np.asarray(chart.radiance(d.reshape(-1, 3)), np.float64) * np.repeat(solid_angle, 512)[:, None], axis=0)
    error = ratios.std(axis=0) / np.sqrt(len(ratios))
    assert np.all(np.abs(ratios.mean(axis=0) - wanted) < 4 * error)
    assert np.all(error < 0.01 * wanted)
    # Where there is no light, all directions are alike.
    np.testing.assert_allclose(jvr.EnvironmentMap(0 * pixels).pdf(d[:3, 0]), 1 / (4 * np.pi), rtol=1e-5)


@pytest.mark.slow
def test_irradiance_is_that_of_harmonics_and_of_quadrature(x64):
    """Of a polynomial in closed form: bands times pi, 2 pi / 3 and pi / 4 (Ramamoorthi and Hanrahan 2001)."""
    bands = np.pi * np.array([1, *[2 / 3] * 3, *[1 / 4] * 5])
    found = jvr.EnvironmentMap(painted(polynomial, 32)).irradiance().pixels
    wanted = painted(lambda d: polynomial(d, bands), 32)
    np.testing.assert_allclose(found, wanted, atol=1e-3 * wanted.max())
    d, solid_angle = map_directions(8, 16)
    cosine = np.maximum(np.einsum("hwi,jki->hwjk", d, d), 0) * solid_angle[:, None]
    np.testing.assert_allclose(
        jvr.EnvironmentMap(noise()).irradiance().pixels,
        np.pi * np.einsum("hwjk,jkc->hwc", cosine, noise()) / cosine.sum(axis=(2, 3))[..., None],
        rtol=1e-10,
    )


def test_a_filtered_map_lies_between_its_mean_and_itself(x64):
    pixels = noise()
    chart = jvr.EnvironmentMap(pixels)
    np.testing.assert_allclose(chart.prefiltered(1e8).pixels, pixels, rtol=1e-10)
    same = jvr.EnvironmentMap(np.full((8, 16, 3), 0.7)).prefiltered(20.0).pixels
    np.testing.assert_allclose(same, 0.7, rtol=1e-12)
    d, solid_angle = map_directions(8, 16)
    lobe = np.maximum(np.einsum("i,jki->jk", d[2, 5], d), 0) ** 20 * solid_angle[:, None]
    wanted = np.sum(lobe[..., None] * pixels, axis=(0, 1)) / lobe.sum()
    np.testing.assert_allclose(chart.prefiltered(20.0).pixels[2, 5], wanted, rtol=1e-10)
    of = lambda s: jnp.sum(jnp.asarray(noise(seed=2)) * chart.prefiltered(s).pixels)
    np.testing.assert_allclose(jax.grad(of)(20.0), (of(20.001) - of(19.999)) / 0.002, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jvr.EnvironmentMap(np.ones((8, 8, 3))), "twice as wide as high, not 8 x 8: crop or resample it to 2:1"),
        (lambda: jvr.EnvironmentMap(-np.ones((4, 8, 3))), "finite and not negative"),
        (lambda: jvr.EnvironmentMap(np.ones((4, 8, 3), np.uint8)), "jvr.linear_from_srgb"),
        (lambda: jvr.EnvironmentMap(np.ones((4, 8, 3)), order=-1), "order must be a whole number"),
        (lambda: jvr.EnvironmentMap.gradient([1, 1, 1], [0, 0, 0], [1, 1]), r"above has shape \(2,\)"),
        (lambda: jvr.Scene(jvr.Volume(voxels()), linear_transfer(), background="sky"), "background must be an array"),
    ],
)
def test_bad_maps_are_refused_in_a_line(make, message):
    with pytest.raises((ValueError, TypeError), match=message) as error:
        make()
    assert "\n" not in str(error.value)


# --- behind a volume -------------------------------------------------------------------------------------------------


def scene(background, **parts):
    return jvr.Scene(jvr.Volume(voxels(), OBLIQUE), linear_transfer(), background=background, **parts)


@pytest.mark.slow
def test_a_constant_map_is_a_background_of_that_colour():
    colour = [0.2, 0.4, 0.7]
    around = jvr.EnvironmentMap(np.broadcast_to(colour, (4, 8, 3)))
    camera = perspective(scene(None).volume)
    found, wanted = render(scene(around), camera, SETTINGS), render(scene(colour), camera, SETTINGS)
    np.testing.assert_allclose(found.rgb, wanted.rgb, rtol=2e-7)
    np.testing.assert_array_equal(found.alpha, wanted.alpha)
    np.testing.assert_array_equal(found.depth, wanted.depth)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["perspective", "orthographic", "refined"])
def test_each_ray_sees_it_in_its_own_direction(x64, kind):
    """Behind what is opaque it is hidden, behind glass attenuated, beside the volume as it is."""
    around = jvr.EnvironmentMap(painted(lambda d: np.exp(d), 32))
    bare, seen = scene(None), scene(around)
    camera = (orthographic if kind == "orthographic" else perspective)(bare.volume)
    settings = jvr.Settings(0.37, termination=0, sampling=jvr.Refinement(0.0)) if kind == "refined" else SETTINGS
    picture, without = (render(s, camera, settings) for s in (seen, bare))
    _, d = camera.rays(jnp.arange(30))
    far = np.stack([looked_up(np.asarray(around.pixels), each) for each in np.stack(d, axis=1)]).reshape(5, 6, 3)
    assert 0 < np.count_nonzero(without.alpha) < 30
    np.testing.assert_allclose(picture.rgb, without.rgb + (1 - without.alpha)[..., None] * far, rtol=1e-9)
    np.testing.assert_array_equal(picture.alpha, without.alpha)


@pytest.mark.slow
def test_pictures_have_derivatives_in_its_pixels_and_in_the_pose(x64):
    camera, weights = perspective(scene(None).volume), np.random.default_rng(4).random((5, 6, 3))

    def loss(pixels, shift):
        moved = eqx.tree_at(lambda c: c.world_from_camera, camera, camera.world_from_camera.at[:3, 3].add(shift))
        turned = eqx.tree_at(lambda c: c.fov_y, moved, camera.fov_y + shift[0])
        return jnp.sum(weights * jvr.render(scene(jvr.EnvironmentMap(pixels)), turned, SETTINGS).rgb)

    pixels, shift = jnp.asarray(noise(4)), jnp.array([0.3, 0.2, -0.1])
    loss = jax.jit(loss)
    by_pixels, by_shift = jax.jit(jax.grad(loss, argnums=(0, 1)))(pixels, shift)
    for i in ((0, 1, 0), (2, 3, 1), (3, 7, 2), (1, 6, 0)):
        step = jnp.zeros_like(pixels).at[i].set(1e-4)
        difference = (loss(pixels + step, shift) - loss(pixels - step, shift)) / 2e-4
        np.testing.assert_allclose(by_pixels[i], difference, rtol=1e-6, atol=1e-9)
    for i in range(3):
        step = jnp.zeros(3).at[i].set(1e-6)
        difference = (loss(pixels, shift + step) - loss(pixels, shift - step)) / 2e-6
        np.testing.assert_allclose(by_shift[i], difference, rtol=1e-5)


@pytest.mark.slow
def test_it_lights_by_its_harmonics():
    chart, lit = jvr.EnvironmentMap(noise(), order=2), {"material": jvr.LambertBRDF()}
    camera = perspective(scene(None).volume)
    found = render(scene(None, environment=chart, **lit), camera, SETTINGS).rgb
    wanted = render(scene(None, environment=chart.to_harmonics(2), **lit), camera, SETTINGS).rgb
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    assert float(jnp.max(found)) > 0.01


def test_plans_say_what_a_map_is_there_for():
    chart, lit = jvr.EnvironmentMap(noise(), order=2), {"material": jvr.LambertBRDF()}
    both = scene(chart, environment=chart, **lit)
    assert both.material_order == 2
    text = str(jvr.plan(both))
    assert "a map of 8 x 16 pixels, seen where rays leave" in text
    assert "environment lighting, a map of 8 x 16 pixels on 9 coefficients" in text
    assert chart.without(both).background is None
    assert chart.without(both).environment is None


@pytest.mark.slow
def test_a_fit_sees_it_behind_the_volume_and_finds_it():
    camera = perspective(scene(None).volume, 12, 12)
    truth = scene(jvr.EnvironmentMap(0.2 + 0.6 * noise(2)))
    target = render(truth, camera, SETTINGS).rgb
    start = jvr.Scene(truth.volume, truth.transfer, background=truth.background)
    start = start.replaced(
        transfer=jvr.LinearTransfer(start.transfer.positions, start.transfer.rgb, 0.5 * start.transfer.sigma_t)
    )
    found = jvr.fit(start, [camera], [target], unknowns=lambda s: s.transfer.sigma_t, settings=SETTINGS)
    np.testing.assert_allclose(found.scene.transfer.sigma_t, truth.transfer.sigma_t, rtol=1e-3)
    grey = scene(jvr.EnvironmentMap(np.full((2, 4, 3), 0.5)))
    found = jvr.fit(grey, [camera], [target], unknowns=lambda s: s.background.pixels, settings=SETTINGS)
    np.testing.assert_allclose(render(found.scene, camera, SETTINGS).rgb, target, atol=1e-4)


CONFIG = """
[volume]
builtin = "demo"
[transfer]
kind = "window"
[background]
kind = "gradient"
below = [0.1, 0.08, 0.06]
horizon = [0.8, 0.7, 0.6]
above = [0.1, 0.3, 0.9]
height = 64
"""


@pytest.mark.slow
def test_configurations_and_files_name_it(tmp_path):
    (tmp_path / "a.toml").write_text(CONFIG)
    found = build_scene(read_config(tmp_path / "a.toml"))
    seen = found.background.rotated(np.eye(3)).radiance([[0.0, 0, 1], [0, 0, -1], [1, 1, 0]])
    np.testing.assert_allclose(seen, [[0.1, 0.3, 0.9], [0.1, 0.08, 0.06], [0.8, 0.7, 0.6]], atol=0.02)
    jvr.write_image(tmp_path / "sky.exr", noise(4).astype(np.float32))
    turned = "background={kind='image',path='sky.exr',scale=2.0,rotation={axis=[0,1,0],degrees=90}}"
    found = build_scene(read_config(tmp_path / "a.toml", [turned])).background
    # What came from +Z comes from +X.
    read = jvr.EnvironmentMap.from_image(tmp_path / "sky.exr")
    np.testing.assert_allclose(found.radiance([[1.0, 0, 0]]), 2 * read.radiance([[0.0, 0, 1]]), rtol=1e-4)
    saved = scene(found, environment=found, material=jvr.LambertBRDF())
    for one in (saved, scene([0.1, 0.2, 0.3])):
        jvr.save_scene(one, tmp_path / "scene.toml")
        again = jvr.load_scene(tmp_path / "scene.toml")
        assert jax.tree.structure(again) == jax.tree.structure(one)
        jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(again), jax.tree.leaves(one))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kiara_1_dawn_1k.hdr", "studio_small_03_1k.hdr"])
def test_irradiance_of_probes_is_that_of_their_harmonics(data, name):
    """By quadrature over pixels, and by bands up to order 16 times those of the clamped cosine (Ramamoorthi and Hanrahan 2001)."""
    whole = jvr.EnvironmentMap.from_image(data / "env" / name).pixels
    chart, d = jvr.EnvironmentMap(whole.reshape(32, 16, 64, 16, 3).mean(axis=(1, 3))), directions()
    cosine = jvr.sh.zonal(lambda z: jnp.maximum(z, 0.0), 16)
    wanted = jvr.sh.evaluate(16, d) @ jvr.sh.convolve(jvr.sh.project_map(chart.pixels, 16), cosine)
    # What is left out, bands from 18 on, is below 1 %, also of a lamp, and irradiance between pixels of 6 degrees is bilinear.
    np.testing.assert_allclose(chart.irradiance().radiance(d), wanted, atol=0.01 * float(jnp.max(wanted)))
