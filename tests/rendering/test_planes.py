"""Near and far planes of cameras: where rays begin and end in fog, in which pictures and fits, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, SETTINGS, linear_transfer, perspective, render, voxels

import jvr
from jvr.io.config import build_cameras, build_scene, read_config
from jvr.io.config.cameras import write_cameras

SIDE, EYE = 3.0, 9.0
COLOUR, BACKGROUND, SIGMA = np.array([0.9, 0.6, 0.3]), np.array([0.4, 0.1, 0.7]), 0.4
STEP = jvr.Settings(0.25, termination=0)


def fog():
    """A homogeneous cube from z = 0 to `SIDE`."""
    transfer = jvr.LinearTransfer([0.0, 1.0], [COLOUR, COLOUR], [SIGMA, SIGMA])
    return jvr.Scene(jvr.Volume(np.full((4, 4, 4), 0.5)), transfer, background=BACKGROUND)


def above(kind="perspective", near=None, far=None, eye=EYE):
    """Straight down from `eye - SIDE` above the cube."""
    make, lens = (jvr.PerspectiveCamera, 12.0 * EYE / eye) if kind == "perspective" else (jvr.OrthographicCamera, 1.5)
    return make.look_at([1.5, 1.5, eye], [1.5, 1.5, -9.0], [0.0, 1.0, 0.0], lens, 4, 4, near=near, far=far)


def cosines(camera):
    _, d = camera.rays(jnp.arange(16))
    return -np.asarray(d[2], np.float64).reshape(4, 4)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "eye"), [("perspective", EYE), ("orthographic", EYE), ("perspective", 900.0)])
def test_fog_between_two_planes_is_as_thick_as_they_are_apart(x64, kind, eye):
    """Across the view: a slab is crossed at an angle, and is thicker at the corners of a picture."""
    near, far = eye - SIDE + 0.8, eye - SIDE + 2.1
    camera = above(kind, near, far, eye)
    for given, thick in (((near, far), 1.3), ((near, None), SIDE - 0.8), ((None, far), 2.1), ((0.0, np.inf), SIDE)):
        found = render(fog(), dataclasses.replace(camera, near=given[0], far=given[1]), STEP)
        T = np.exp(-SIGMA * thick / cosines(camera))[..., None]
        np.testing.assert_allclose(found.rgb, (1 - T) * COLOUR + T * BACKGROUND, rtol=1e-7)
        np.testing.assert_array_equal(found.stats.steps, np.ceil(thick / cosines(camera) / 0.25 - 1e-9))
    behind = render(fog(), above(kind, eye + 0.1, None, eye), STEP)
    np.testing.assert_array_equal(behind.rgb, np.broadcast_to(BACKGROUND, (4, 4, 3)))


@pytest.mark.slow
def test_geometry_is_seen_between_the_planes_alone(x64):
    wall = fog().replaced(geometry=jvr.DepthImage(np.full((4, 4), EYE - SIDE + 1.0), np.ones((4, 4, 3))))
    between = render(wall, above("orthographic", 1.0, 20.0), STEP)
    np.testing.assert_allclose(between.rgb, render(wall, above("orthographic"), STEP).rgb, rtol=1e-12)
    for planes in ((EYE - SIDE + 1.2, None), (None, EYE - SIDE + 0.9)):
        camera = above("orthographic", *planes)
        np.testing.assert_allclose(render(wall, camera, STEP).rgb, render(fog(), camera, STEP).rgb, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_in_the_planes_are_those_of_the_closed_form(x64):
    red = lambda near, far: jvr.render(fog(), above("orthographic", near, far), STEP).rgb[1, 2, 0]
    by_near, by_far = jax.jit(jax.grad(red, argnums=(0, 1)))(EYE - SIDE + 0.8, EYE - SIDE + 2.1)
    slope = SIGMA * np.exp(-SIGMA * 1.3) * (COLOUR[0] - BACKGROUND[0])
    np.testing.assert_allclose([by_near, by_far], [-slope, slope], rtol=1e-7)


@pytest.mark.slow
def test_adaptive_pictures_and_fits_see_them():
    volume, away = jvr.Volume(voxels(), OBLIQUE), 2.6
    view = perspective(volume, 12, 12)
    planes = {"near": jnp.asarray((away - 0.4) * volume.radius), "far": jnp.asarray((away + 0.5) * volume.radius)}
    cut, scene = dataclasses.replace(view, **planes), jvr.Scene(volume, linear_transfer(), background=BACKGROUND)
    target = render(scene, cut, SETTINGS).rgb
    assert float(jnp.max(jnp.abs(target - render(scene, view, SETTINGS).rgb))) > 0.05
    refined = render(scene, cut, jvr.Settings(0.37, termination=0, sampling=jvr.Refinement(0.0))).rgb
    np.testing.assert_allclose(refined, target, atol=1e-5)
    # One camera with planes, and one without.
    start = scene.replaced(
        transfer=jvr.LinearTransfer(scene.transfer.positions, scene.transfer.rgb, 0.5 * scene.transfer.sigma_t)
    )
    other = perspective(volume, 12, 12, direction=(-0.3, 1.0, 0.4))
    images = [target, render(scene, other, SETTINGS).rgb]
    found = jvr.fit(start, [cut, other], images, unknowns=lambda s: s.transfer.sigma_t, settings=SETTINGS)
    np.testing.assert_allclose(found.scene.transfer.sigma_t, scene.transfer.sigma_t, rtol=1e-3)
    begun = dataclasses.replace(cut, far=1.05 * cut.far)
    found = jvr.fit(scene, [begun, other], images, unknowns=lambda s, cameras: cameras[0].far, settings=SETTINGS)
    np.testing.assert_allclose(found.cameras[0].far, cut.far, rtol=1e-3)


def test_configurations_name_them(tmp_path):
    (tmp_path / "a.toml").write_text(
        '[volume]\nbuiltin = "demo"\n[transfer]\nkind = "window"\n[camera]\nwidth = 4\nheight = 4\nnear = 12.5\nfar = 80.0\n'
    )
    config = read_config(tmp_path / "a.toml")
    (camera,) = build_cameras(config, build_scene(config).volume)
    assert (float(camera.near), float(camera.far)) == (12.5, 80.0)
    write_cameras(tmp_path / "cameras.toml", [camera, dataclasses.replace(camera, near=None, far=None)])
    again = read_config(tmp_path / "a.toml", [f"camera={tmp_path / 'cameras.toml'}"])
    found = build_cameras(again, build_scene(config).volume)
    assert (float(found[0].near), float(found[0].far), found[1].near, found[1].far) == (12.5, 80.0, None, None)


@pytest.mark.parametrize(
    ("planes", "message"),
    [
        ({"near": -1.0}, "near must be finite and not negative"),
        ({"far": 0.0}, "far must be positive"),
        ({"near": 5.0, "far": 5.0}, "the far plane of a camera must be behind its near plane"),
    ],
)
def test_planes_that_show_nothing_are_refused(planes, message):
    with pytest.raises(ValueError, match=message):
        above("perspective", **planes)
