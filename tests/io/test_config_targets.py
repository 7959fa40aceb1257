"""Target images in a configuration: what their numbers mean, which of their pixels count, and pictures of several sizes."""

import numpy as np
import OpenEXR
import pytest
from PIL import Image

import jvr
from jvr.io.config import ConfigError, build_fit, config_from

CODES = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Image.fromarray(CODES).save("a.png")
    Image.fromarray(CODES[:2, :3]).save("b.png")
    grey = np.full((4, 6), 255, np.uint8)
    grey[:2], grey[3] = 0, 51
    Image.fromarray(grey).save("mask_a.png")
    Image.fromarray(grey[2:, 3:]).save("mask_b.png")
    return tmp_path


def job(folder, *sets, images=("a.png", "b.png"), **fit):
    """What is fitted, from two cameras with pictures of two sizes."""
    cameras = [{"view": "front", "width": 6, "height": 4}, {"view": "left", "width": 3, "height": 2}]
    tables = {"volume": {"builtin": "demo"}, "camera": cameras, "fit": {"images": list(images), **fit}}
    return build_fit(config_from(tables, "test", folder, sets))


def test_the_encoding_is_that_of_the_configuration(folder):
    with pytest.warns(UserWarning, match='taken as sRGB: say encoding = "srgb"'):
        guessed = job(folder).targets
    for encoding, light in (("linear", CODES / 255), ("srgb", jvr.linear_from_srgb(CODES / 255))):
        for found in (job(folder, encoding=encoding), job(folder, f"fit.encoding={encoding}")):
            assert [target.shape for target in found.targets] == [(4, 6, 3), (2, 3, 3)]
            np.testing.assert_allclose(found.targets[0], light, rtol=1e-6)
            np.testing.assert_allclose(found.targets[1], light[:2, :3], rtol=1e-6)
            assert found.keywords["weights"] is None
    np.testing.assert_array_equal(guessed[0], job(folder, encoding="srgb").targets[0])


def test_an_alpha_and_a_layer_are_those_of_the_configuration(folder):
    planes = {f"{layer}.{c}": np.full((4, 6), k, np.float32) for layer, k in (("key", 0.25), ("rim", 0.5)) for c in "RGBA"}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write("a.exr")
    sets = ('camera=[{view="front",width=6,height=4}]', "background=[0,0.5,1]")
    made = lambda **keywords: job(folder, *sets, images=["a.exr"], **keywords).targets[0][0, 0]
    np.testing.assert_allclose(made(layer="key"), [0.25, 0.625, 1.0])
    np.testing.assert_allclose(made(layer="rim", alpha="ignored"), 0.5)
    np.testing.assert_allclose(made(layer="rim", alpha="straight"), [0.25, 0.5, 0.75])


def test_weights_are_grey_pictures_as_they_are(folder):
    found = job(folder, encoding="linear", weights=["mask_a.png", "mask_b.png"])
    wanted = np.repeat([[0.0], [0.0], [1.0], [0.2]], 6, axis=1)
    np.testing.assert_allclose(found.keywords["weights"][0], wanted, rtol=1e-6)
    np.testing.assert_allclose(found.keywords["weights"][1], wanted[2:, 3:], rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(found.targets[0][..., 1]), wanted == 0)
    np.testing.assert_allclose(found.targets[0][2:], CODES[2:] / 255, rtol=1e-6)


def test_views_that_are_held_out_keep_their_own_pixels(folder):
    found = job(folder, encoding="linear", weights=["mask_a.png", "mask_b.png"], held_out=[0])
    assert [target.shape for target in found.targets] == [(2, 3, 3)]
    assert [weight.shape for weight in found.keywords["weights"]] == [(2, 3)]
    (_, (held,)) = found.held_out
    assert np.all(np.isnan(held[:2]))
    assert np.all(np.isfinite(held[2:]))


@pytest.mark.parametrize(
    ("sets", "fit", "message"),
    [
        ((), {"encoding": "sRGB"}, 'fit.encoding: unknown choice "sRGB"; known: srgb, linear'),
        ((), {"encoding": "linear", "layer": "key"}, r"fit.images\[0\]: .*a.png: only OpenEXR images have layers"),
        ((), {"encoding": "linear", "weights": ["mask_a.png"]}, "fit.weights: 1 images for 2 cameras: give one for each camera"),
        ((), {"encoding": "linear", "weights": ["mask_b.png"] * 2}, r"fit.weights\[0\]: is 3 x 2 pixels, its camera sees 6 x 4"),
        ((), {"encoding": "linear", "weights": ["a.png", "b.png"]}, r"fit.weights\[0\]: is coloured: a weight is grey"),
        ((), {"encoding": "linear", "weights": ["c.png", "b.png"]}, r"fit.weights\[0\]: 'c.png' is not in "),
        ((), {"unknowns": []}, r"fit.unknowns: must have at least 1 entry, not \[\]"),
        ((), {"encoding": "linear", "unknowns": ["volume.values"]}, "holds integers, which have no derivative; volume.scale ="),
        (("fit.images=[]",), {}, r"--set: fit.images: must have at least 1 entry, not \[\]"),
    ],
)
def test_what_does_not_fit_is_one_line(folder, sets, fit, message):
    volume = ["volume={path='v.npy',spacing=[1,1,1]}"] if fit.get("unknowns") else []
    np.save("v.npy", np.arange(60, dtype=np.uint8).reshape(3, 4, 5))
    with pytest.raises(ConfigError, match=message) as caught:
        job(folder, *sets, *volume, **fit)
    assert "\n" not in str(caught.value)


def test_how_images_are_read_is_no_key_of_rendered_ones(folder):
    tables = {"volume": {"builtin": "demo"}, "truth": {"kind": "window"}, "fit": {"encoding": "linear"}}
    with pytest.raises(ConfigError, match=r"fit.encoding: is about target images in files: name them in fit.images"):
        config_from(tables, "test", folder)
