"""Opaque geometry behind, in and in front of a volume: closed forms, what is not sampled, derivatives, and what is refused."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, SETTINGS, linear_transfer, perspective, render, voxels

import jvr
from jvr.io.config import build_scene, read_config

SIDE, EYE, SIZE = 3.0, 9.0, 4
GEOMETRY, COLOUR, BACKGROUND, SIGMA = np.array([0.2, 0.5, 0.8]), np.array([0.9, 0.6, 0.3]), np.array([0.4, 0.1, 0.7]), 0.4
STEP = jvr.Settings(0.25, termination=0)


def fog(**parts):
    """A homogeneous cube from z = 0 to `SIDE`."""
    transfer = jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], [SIGMA, SIGMA])
    return jvr.Scene(jvr.Volume(np.full((4, 4, 4), 0.5)), transfer, **{"background": BACKGROUND, **parts})


def camera(size=SIZE):
    """From above, straight down; the eye is `EYE - SIDE` away from the cube."""
    return jvr.OrthographicCamera.look_at([1.5, 1.5, EYE], [1.5, 1.5, 1.5], [0.0, 1.0, 0.0], 2.0, size, size)


def plane(distance, colour=GEOMETRY, size=SIZE):
    """Whatever is so far away from the eye, the same in each pixel."""
    return jvr.DepthImage(jnp.full((size, size), 1.0) * distance, jnp.ones((size, size, 3)) * colour)


def picture(geometry, settings=STEP, **parts):
    return render(fog(geometry=geometry, **parts), camera(), settings)


@pytest.mark.slow
def test_a_plane_in_fog_is_seen_through_what_is_in_front(x64):
    inside = 1.13
    found = picture(plane(EYE - SIDE + inside))
    T = np.exp(-SIGMA * inside)
    np.testing.assert_allclose(found.rgb, np.broadcast_to((1 - T) * COLOUR + T * GEOMETRY, (SIZE, SIZE, 3)), rtol=1e-6)
    np.testing.assert_array_equal(found.alpha, 1.0)
    # A box that is cut there, over a background of its colour.
    cut = jvr.ClippingBox([-1.0, -1, SIDE - inside], [9.0, 9, 9])
    clipped = render(fog(clipping=cut, background=GEOMETRY), camera(), STEP)
    np.testing.assert_allclose(found.rgb, clipped.rgb, rtol=1e-12)
    np.testing.assert_array_equal(found.stats.steps, clipped.stats.steps)
    # Samples in proportion: those behind are not taken.
    assert int(found.stats.steps[0, 0]) == np.ceil(inside / 0.25)


@pytest.mark.slow
def test_what_is_behind_is_a_background_and_what_is_in_front_hides_all(x64):
    far, near = picture(plane(EYE + 5.0)), picture(plane(2.0))
    np.testing.assert_allclose(far.rgb, render(fog(background=GEOMETRY), camera(), STEP).rgb, rtol=1e-12)
    np.testing.assert_array_equal(near.rgb, np.broadcast_to(GEOMETRY, near.rgb.shape))
    np.testing.assert_array_equal(near.depth, 2.0)
    assert not np.any(near.stats.steps)
    for nothing in (0.0, np.inf):
        without = picture(plane(nothing))
        np.testing.assert_allclose(without.rgb, picture(None).rgb, rtol=1e-12)
        np.testing.assert_allclose(without.depth, picture(None).depth, rtol=1e-12)


@pytest.mark.slow
def test_depth_in_front_of_nothing_is_that_of_the_geometry(x64):
    """Behind a volume that is empty, and beside it, where rays never enter."""
    wide, view = np.linspace(2.0, 20.0, 36).reshape(6, 6), dataclasses.replace(camera(6), height_world=jnp.asarray(8.0))
    clear = jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], [0.0, 0.0])
    scene = fog(geometry=jvr.DepthImage(wide, np.ones((6, 6, 3)))).replaced(transfer=clear)
    np.testing.assert_allclose(render(scene, view, STEP).depth, wide, rtol=1e-12)
    # In fog it is the mean of what is seen.
    T, inside = np.exp(-SIGMA * SIDE), np.exp(-SIGMA * SIDE) * 20.0
    mean = (1 - T) * (EYE - SIDE) + (1 - T * (1 + SIGMA * SIDE)) / SIGMA + inside
    np.testing.assert_allclose(picture(plane(20.0), jvr.Settings(0.01, termination=0)).depth, mean, rtol=1e-4)


def test_derivatives_in_distance_and_colour_are_those_of_the_closed_form(x64):
    """dC / dt = sigma T (c - C_geometry), where more fog comes in front."""
    inside = np.array([0.3, 1.13, 2.9, 4.0])
    red = lambda d, c: picture(plane(EYE - SIDE + d, c)).rgb[1, 2, 0]
    both = jax.jit(jax.vmap(jax.grad(red, argnums=(0, 1)), in_axes=(0, None)))
    by_distance, by_colour = both(jnp.asarray(inside), jnp.asarray(GEOMETRY))
    T = np.exp(-SIGMA * np.minimum(inside, SIDE))
    np.testing.assert_allclose(by_distance, np.where(inside < SIDE, SIGMA * T * (COLOUR[0] - GEOMETRY[0]), 0), rtol=1e-6)
    np.testing.assert_allclose(by_colour, T[:, None] * [1, 0, 0], rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [jvr.Replay(), jvr.Forward()])
def test_derivatives_in_a_medium_are_those_of_differences(x64, adjoint):
    volume, rng = jvr.Volume(voxels(), OBLIQUE), np.random.default_rng(2)
    view, away = perspective(volume), 2.6 * float(volume.radius)
    depth, rgb = jnp.asarray(away + 0.3 * rng.normal(size=(5, 6))), jnp.asarray(rng.random((5, 6, 3)))
    settings, weights = jvr.Settings(0.37, termination=0, adjoint=adjoint), rng.random((5, 6, 3))

    def loss(depth, rgb):
        seen = jvr.Scene(volume, linear_transfer(), geometry=jvr.DepthImage(depth, rgb))
        found = jvr.render(seen, view, settings)
        return jnp.sum(weights * found.rgb) + jnp.sum(weights[..., 0] * found.depth)

    loss, along = jax.jit(loss), jnp.asarray(rng.normal(size=depth.shape))
    step = 1e-6
    difference = (loss(depth + step * along, rgb) - loss(depth - step * along, rgb)) / (2 * step)
    if isinstance(adjoint, jvr.Forward):
        slope = jax.jvp(lambda d: loss(d, rgb), (depth,), (along,))[1]
    else:
        slope = jnp.sum(jax.grad(loss)(depth, rgb) * along)
    np.testing.assert_allclose(slope, difference, rtol=1e-5)


@pytest.mark.slow
def test_one_picture_is_the_geometry_of_another():
    """An opaque block, rendered alone, hides and is hidden as if both had been one volume."""
    values = np.zeros((8, 8, 8))
    values[:, :, :3] = 1.0
    block = jvr.LinearTransfer([0.5, 0.6], [GEOMETRY, GEOMETRY], [0.0, 1e4])
    alone = render(jvr.Scene(jvr.Volume(values), block), camera(), jvr.Settings(0.05, termination=0))
    assert float(jnp.min(alone.alpha)) > 0.999
    found = picture(jvr.DepthImage(alone.depth, alone.rgb))
    # Where its voxels pass the first half of the way from 0 to 1 on their way down, a little below z = 2.5.
    T = np.exp(-SIGMA * (SIDE - 2.5))
    np.testing.assert_allclose(found.rgb[1, 1], (1 - T) * COLOUR + T * GEOMETRY, atol=0.02)


def test_what_it_does_not_fit_is_refused_in_a_line():
    cases = {
        "4 rows and 4 columns, the camera 6 and 6: render": lambda: render(fog(geometry=plane(3.0)), camera(6), STEP),
        "in the pixels of its camera alone": lambda: picture(plane(3.0), jvr.Settings(sampling=jvr.Refinement())),
        "jvr.Slices() does not know geometry": lambda: picture(plane(3.0), jvr.Settings(sampling=jvr.Slices())),
        "depth must be not negative": lambda: jvr.DepthImage(-np.ones((2, 2)), np.ones((2, 2, 3))),
        "rgb has shape (2, 3, 3); it must be (2, 2, 3)": lambda: jvr.DepthImage(np.ones((2, 2)), np.ones((2, 3, 3))),
        "is that of one view, and there are 2: fit one": lambda: jvr.fit(
            fog(geometry=plane(3.0)), [camera()] * 2, [np.zeros((4, 4, 3))] * 2, unknowns=lambda s: s.background
        ),
    }
    for message, call in cases.items():
        with pytest.raises(ValueError, match=re.escape(message)) as error:
            call()
        assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_fit_sees_it_in_its_pixels():
    """Rays are sorted by their length; each keeps the geometry of its pixel. Also those of a camera that is unknown."""
    volume, rng = jvr.Volume(voxels(), OBLIQUE), np.random.default_rng(2)
    view, away = perspective(volume, 12, 12), 2.6 * float(volume.radius)
    geometry = jvr.DepthImage(away + 0.6 * rng.normal(size=(12, 12)), rng.random((12, 12, 3)))
    truth = jvr.Scene(volume, linear_transfer(), geometry=geometry)
    target = render(truth, view, SETTINGS).rgb
    start = truth.replaced(
        transfer=jvr.LinearTransfer(truth.transfer.positions, truth.transfer.rgb, 0.5 * truth.transfer.sigma_t)
    )
    found = jvr.fit(start, [view], [target], unknowns=lambda s: s.transfer.sigma_t, settings=SETTINGS)
    np.testing.assert_allclose(found.scene.transfer.sigma_t, truth.transfer.sigma_t, rtol=1e-3)
    wider = dataclasses.replace(view, fov_y=1.03 * view.fov_y)
    found = jvr.fit(truth, [wider], [target], unknowns=lambda s, cameras: cameras[0].fov_y, settings=SETTINGS)
    np.testing.assert_allclose(found.cameras[0].fov_y, view.fov_y, rtol=1e-3)


CONFIG = """
[volume]
builtin = "demo"
[transfer]
kind = "window"
[geometry]
kind = "image"
path = "plane.exr"
"""


def test_configurations_and_files_name_it(tmp_path):
    depth, rgb = np.arange(12.0, dtype=np.float32).reshape(3, 4), np.full((3, 4, 3), 0.25, np.float32)
    jvr.write_image(tmp_path / "plane.exr", rgb, np.full((3, 4), 0.5), depth=depth)
    (tmp_path / "a.toml").write_text(CONFIG)
    found = build_scene(read_config(tmp_path / "a.toml"))
    np.testing.assert_array_equal(found.geometry.depth, depth)
    np.testing.assert_array_equal(found.geometry.rgb, rgb)
    assert "rays end at that of a depth image, 3 x 4 pixels" in str(jvr.plan(found))
    jvr.write_image(tmp_path / "plane.exr", rgb)
    with pytest.raises(ValueError, match=r"geometry\.path: .* has no channel Z of distances"):
        build_scene(read_config(tmp_path / "a.toml"))
    jvr.save_scene(fog(geometry=plane(np.inf)), tmp_path / "scene.toml")
    np.testing.assert_array_equal(jvr.load_scene(tmp_path / "scene.toml").geometry.depth, np.inf)
    assert fog(geometry=plane(1.0)).geometry.without(fog(geometry=plane(1.0))).geometry is None
