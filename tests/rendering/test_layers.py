"""Layers of surfaces: they sum up to the picture, say where and what surfaces are, and are found again in files."""

import equinox as eqx
import jax
import numpy as np
import OpenEXR
import pytest
from scenes import OBLIQUE, perspective
from typer.testing import CliRunner

import jvr
from jvr.cli.app import app

CLEAR = jvr.LinearTransfer([-40.0, 40.0], np.zeros((2, 3)), np.zeros(2))
SUN, AMBIENT = jvr.DirectionalLight((-0.6, 1.0, -0.8), (1.2, 1.0, 0.8)), jvr.AmbientLight(0.3)
# Where no picture is different by more than rounding.
EXACT = {"rtol": 1e-5, "atol": 1e-6}


def scene(**parts):
    """Squares of distances from the middle of an oblique volume, and a red surface where they are 9."""
    middle = np.array([4.0, 4, 4])[:, None, None, None]
    volume = jvr.Volume(-np.sum(np.square(np.indices((9, 9, 9)) - middle), axis=0), OBLIQUE)
    parts = {"surfaces": jvr.Isosurfaces([-9.0], [[0.9, 0.2, 0.1]]), "lights": (SUN, AMBIENT)} | parts
    return jvr.Scene(volume, CLEAR, **{"shading": jvr.BlinnPhong(0.5, 0.6, 0.4, 8.0)} | parts)


@pytest.fixture(scope="module")
def occluded():
    """A lit and occluded surface, its camera and its picture with layers."""
    made = scene(background=(0.1, 0.2, 0.3), occlusion=jvr.LocalOcclusion(8, radius=4.0, samples=3))
    camera = perspective(made.volume, 9, 8)
    return made, camera, jvr.render_layers(made, camera)


def test_layers_sum_up_to_the_picture(occluded):
    """Diffuse and specular where a surface is hit, the background elsewhere."""
    _, _, found = occluded
    hit = np.any(np.asarray(found.layers.normal) != 0, axis=-1)
    assert 0.1 < hit.mean() < 0.9
    total = np.asarray(found.layers.diffuse + found.layers.specular)
    np.testing.assert_allclose(np.asarray(found.rgb)[hit], total[hit], **EXACT)
    np.testing.assert_allclose(np.asarray(found.rgb)[~hit], np.broadcast_to([0.1, 0.2, 0.3], total[~hit].shape), **EXACT)
    for layer in found.layers:
        assert not np.any(np.asarray(layer)[~hit])
    # A highlight is white, and what is diffuse has the colour of the surface.
    assert np.all(np.asarray(found.layers.specular)[..., 2] > 0.5 * np.asarray(found.layers.specular)[..., 0] - 1e-6)
    ratio = np.asarray(found.layers.diffuse)[hit]
    assert np.all(ratio[:, 0] > 2 * ratio[:, 1])


def test_layers_say_where_and_what_a_surface_is(occluded):
    """Places at the isovalue and at the depth of the picture, and the gradient as differences of the interpolant in double precision."""
    made, camera, found = occluded
    layers = jax.tree.map(lambda x: np.asarray(x, np.float64), found.layers)
    hit = np.any(layers.normal != 0, axis=-1)
    np.testing.assert_allclose(layers.value[hit], -9.0, atol=2e-3)
    eye = np.asarray(camera.world_from_camera, np.float64)[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(layers.position - eye, axis=-1)[hit], np.asarray(found.depth)[hit], rtol=1e-5)
    grid = np.linalg.inv(OBLIQUE)
    values = np.asarray(made.volume.values, np.float64)

    def at(x):
        """The trilinear interpolant at a place in the world."""
        p = grid[:3, :3] @ x + grid[:3, 3]
        low = np.floor(p).astype(int)
        f, box = p - low, values[tuple(slice(i, i + 2) for i in low)]
        for w in f:
            box = box[0] * (1 - w) + box[1] * w
        return box

    checked = 0
    for x, normal, length in zip(layers.position[hit], layers.normal[hit], layers.gradient_length[hit], strict=True):
        p = grid[:3, :3] @ x + grid[:3, 3]
        if np.min(np.abs(p - np.rint(p))) > 1e-2:
            gradient = np.array([at(x + 1e-4 * e) - at(x - 1e-4 * e) for e in np.eye(3)]) / 2e-4
            np.testing.assert_allclose(length[0], np.linalg.norm(gradient), rtol=1e-3)
            np.testing.assert_allclose(normal, -gradient / np.linalg.norm(gradient), atol=1e-3)
            checked += 1
    assert checked > 5


def test_files_have_layers_by_their_names(occluded, tmp_path):
    """As OpenEXR reads them, and those of colours as `jvr.read_image` does."""
    _, _, found = occluded
    path = tmp_path / "layers.exr"
    found.save(path)
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    colours = {f"{name}.{c}" for name in ("diffuse", "specular") for c in "RGB"}
    vectors = {f"{name}.{c}" for name in ("position", "normal") for c in "XYZ"}
    assert set(channels) == {"R", "G", "B", "Z", "value.Y", "gradient_length.Y", "occlusion.Y"} | colours | vectors
    for name, layer in found.layers._asdict().items():
        own = {1: "Y", 3: "XYZ" if f"{name}.X" in channels else "RGB"}[layer.shape[-1]]
        np.testing.assert_array_equal(np.stack([channels[f"{name}.{c}"].pixels for c in own], axis=-1), layer)
    np.testing.assert_array_equal(jvr.read_image(path), found.rgb)
    np.testing.assert_array_equal(jvr.read_image(path, layer="diffuse"), found.layers.diffuse)
    np.testing.assert_array_equal(jvr.read_image(path, layer="occlusion")[..., 0], found.layers.occlusion[..., 0])
    # In a PNG there is the picture alone.
    found.save(tmp_path / "layers.png")
    with pytest.raises(ValueError, match=r"a PNG has no room for layers; write \.exr, or leave layers out"):
        jvr.write_image(tmp_path / "a.png", found.rgb, layers={"normal": found.layers.normal})
    with pytest.raises(ValueError, match=r"the layer odd has shape \(8, 9, 2\): give numbers of each pixel, \(8, 9, 1 or 3\)"):
        jvr.write_image(tmp_path / "a.exr", found.rgb, layers={"odd": found.layers.normal[..., :2]})


def test_what_has_no_layers_says_so():
    made = scene()
    camera = perspective(made.volume)
    with pytest.raises(ValueError, match=r"set jvr\.Scene\(surfaces=jvr\.Isosurfaces\(\.\.\.\)\), or call jvr\.render"):
        jvr.render_layers(made.replaced(surfaces=None), camera)
    with pytest.raises(ValueError, match=r"leave Settings\(pixel_samples=\.\.\.\) at 1"):
        jvr.render_layers(made, camera, jvr.Settings(pixel_samples=2))
    done = CliRunner().invoke(app, ["render", "configs/isosurface.toml", "-o", "a.png", "--layers"])
    assert done.exit_code != 0
    assert str(done.exception) == "--layers: a PNG has no room for them; name an .exr with -o"


@pytest.mark.slow
def test_places_have_derivatives(x64):
    """Of a ball of radius `sqrt(-s)` in the isovalue along the ray: `dt = ds / (grad s . d)`, against differences, unlit."""
    made = scene(lights=(), shading=None)
    camera = perspective(made.volume, 5, 5)

    def place(level):
        return jvr.render_layers(eqx.tree_at(lambda s: s.surfaces.values, made, level[None]), camera).layers.position

    level, h = np.float64(-9.1), 1e-5
    difference = (place(jax.numpy.asarray(level + h)) - place(jax.numpy.asarray(level - h))) / (2 * h)
    slope = jax.jacfwd(place)(jax.numpy.asarray(level))
    hit = np.abs(difference).max(axis=-1) < 5
    np.testing.assert_allclose(np.asarray(slope)[hit], np.asarray(difference)[hit], rtol=1e-3, atol=1e-4)
    assert np.any(np.asarray(slope)[hit] != 0)


@pytest.mark.slow
def test_the_command_writes_layers(tmp_path):
    path = tmp_path / "a.exr"
    arguments = ["render", "configs/isosurface.toml", "-o", str(path), "--layers", "--size", "12", "--set", "settings.step=4"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert {"normal.X", "diffuse.R", "value.Y"} <= set(OpenEXR.File(str(path), separate_channels=True).channels())
