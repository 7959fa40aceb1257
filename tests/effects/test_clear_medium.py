"""Scenes of surfaces or geometry alone: what they show is what they show in a medium of extinction 0, and nothing is marched through."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import render

import jvr
from jvr.io.config import build_scene, config_from

RED = [[0.9, 0.1, 0.2]]
SETTINGS = jvr.Settings(0.5)
LIT = {"lights": (jvr.DirectionalLight((-1.0, -0.6, -1.2)),), "shading": jvr.Lambert(0.2, 0.8)}
SCENES = {
    "opaque": {"surfaces": jvr.Isosurfaces([3.2], RED), **LIT},
    "blended": {"surfaces": jvr.Isosurfaces([2.2, 3.2], RED * 2, [0.3, 0.6]), "background": (1.0, 0.5, 0.2)},
    "mirror": {"surfaces": jvr.Isosurfaces([3.2], RED), "specular": jvr.Specular(0.5), "background": (0.2, 0.3, 0.4)},
}


def volume():
    return jvr.Volume(np.linalg.norm(np.indices((9, 10, 11)) - 5.0, axis=0) * [1.0, 1.2, 0.8, 1, 1, 1, 1, 1, 1, 1, 1])


def camera():
    return jvr.PerspectiveCamera.look_at((25, 12, 20), volume().center, (0, 0, 1), 30.0, 8, 8)


def in_vain(scene):
    """The same scene in a medium of which it is not known beforehand that it shows nothing."""
    return dataclasses.replace(scene, transfer=jvr.LinearTransfer([0.0, 9.0], np.ones((2, 3)), [0.0, 0.0]))


@pytest.mark.slow
@pytest.mark.parametrize("parts", SCENES.values(), ids=SCENES)
def test_pictures_and_derivatives_are_those_of_a_medium_without_extinction(parts):
    scene = jvr.Scene(volume(), **parts)

    def loss(values, scene):
        surfaces = dataclasses.replace(scene.surfaces, values=values)
        found = jvr.render(dataclasses.replace(scene, surfaces=surfaces), camera(), SETTINGS)
        weights = jnp.arange(found.rgb.size).reshape(found.rgb.shape)
        return jnp.sum(weights * found.rgb) + jnp.sum(found.depth), found

    both = jax.jit(jax.value_and_grad(loss, has_aux=True))
    ((_, found), gradient), ((_, wanted), wanted_gradient) = (both(s.surfaces.values, s) for s in (scene, in_vain(scene)))
    assert np.asarray(found.alpha).max() > 0.5
    for name in ("rgb", "alpha", "depth"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(gradient, wanted_gradient, rtol=1e-4)


def test_nothing_is_marched_through():
    """The program of a clear medium has fewer loops, and none of them is the march's."""
    scene = jvr.Scene(volume(), surfaces=jvr.Isosurfaces([3.2], RED))
    loops = lambda scene: str(jax.make_jaxpr(lambda s: jvr.render(s, camera(), SETTINGS))(scene)).count("while[")
    without = dataclasses.replace(in_vain(scene), surfaces=None)
    assert loops(scene) == loops(in_vain(scene)) - loops(without) > 0


def test_a_picture_of_geometry_alone():
    mesh = jvr.Mesh([[0, 0, 5], [9, 0, 5], [0, 9, 5]], [[0, 1, 2]], [0.2, 0.4, 0.6])
    found = render(jvr.Scene(volume(), geometry=mesh), camera(), jvr.Settings(quadrature=jvr.PreIntegrated()))
    seen = np.asarray(found.alpha) == 1
    assert 0 < seen.sum() < seen.size
    np.testing.assert_array_equal(found.rgb[seen], np.broadcast_to(np.float32([0.2, 0.4, 0.6]), found.rgb[seen].shape))
    np.testing.assert_array_equal(found.rgb[~seen], 0)


def test_a_scene_that_shows_nothing_is_refused():
    with pytest.raises(ValueError, match="shows nothing: give it a transfer function"):
        jvr.Scene(volume())


def test_plans_files_and_notebooks_say_so(tmp_path):
    scene = jvr.Scene(volume(), surfaces=jvr.Isosurfaces([3.2], RED))
    assert "shows nothing and is not marched through" in str(jvr.plan(scene))
    assert "shows nothing" in scene.transfer._repr_html_()
    jvr.save_scene(scene, tmp_path / "scene.toml")
    assert isinstance(jvr.load_scene(tmp_path / "scene.toml").transfer, jvr.ClearTransfer)
    config = {"volume": {"builtin": "demo"}, "transfer": {"kind": "clear"}, "surfaces": {"values": [0.5], "rgb": RED}}
    assert isinstance(build_scene(config_from(config, "clear.toml", Path(), ())).transfer, jvr.ClearTransfer)
