"""Target images that others made: which pixels count, what is behind them, and what no scene can show."""

import re
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from fits import CAMERAS, IMAGES, SETTINGS, START, TRUTH, both, fit
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

import jvr
from jvr.fitting.problem import Problem
from jvr.fitting.reach import known_background, say_what_is_out_of_reach
from jvr.fitting.targets import check_cameras, targets_of
from jvr.fitting.unknowns import ExposedModel, choose_unknowns, selected
from jvr.rendering.measure import psnr, similarity

BEHIND = np.array(TRUTH.background)


def said(call):
    """What it returns, and the lines that it says."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call()
    lines = [str(one.message) for one in caught if issubclass(one.category, UserWarning)]
    assert all("\n" not in line for line in lines)
    return found, lines


def spoilt(rows=slice(0, 2), value=np.nan):
    """The targets with some rows of the first and of the last replaced, of 16 pixels each."""
    images = [image.copy() for image in IMAGES]
    images[0][rows], images[2][rows, :, 1] = value, value
    return images


# --- Pixels ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_pixels_that_are_not_finite_have_no_weight(value):
    (images, weights), lines = said(lambda: targets_of(CAMERAS, spoilt(value=value), None, BEHIND))
    assert lines == ["64 pixels that are not finite have weight 0, in target images 0, 2"]
    for i in range(3):
        wanted = np.ones((15, 16))
        wanted[:2] = 1 if i == 1 else 0
        np.testing.assert_array_equal(weights[i], wanted)
        np.testing.assert_array_equal(images[i][wanted > 0], IMAGES[i][wanted > 0])
        assert np.all(np.isfinite(images[i]))


def test_of_pixels_that_have_no_weight_already_nothing_is_said():
    masks = [np.ones((15, 16)) for _ in IMAGES]
    for mask in masks:
        mask[:2] = 0
    (_, weights), lines = said(lambda: targets_of(CAMERAS, spoilt(), masks, BEHIND))
    assert lines == []
    np.testing.assert_array_equal(weights, masks)
    assert said(lambda: targets_of(CAMERAS, IMAGES, None, BEHIND).weights) == (None, [])


def transparent(camera, scene=TRUTH):
    """Light over black and alpha."""
    picture = jvr.render(eqx.tree_at(lambda s: s.background, scene, None), camera, SETTINGS)
    return np.concatenate([picture.rgb, picture.alpha[..., None]], axis=-1)


def test_an_alpha_is_put_over_the_background():
    images = [IMAGES[0], transparent(CAMERAS[1]), IMAGES[2]]
    (found, weights), lines = said(lambda: targets_of(CAMERAS, images, None, BEHIND))
    assert lines == [
        "240 pixels with an alpha below 1 are put over the background, (0.1, 0.2, 0.3), in target image 1; their colours are taken as "
        "multiplied by alpha already"
    ]
    assert weights is None
    np.testing.assert_allclose(found[1], IMAGES[1], atol=1e-6)
    images[1][..., :3] /= np.maximum(images[1][..., 3:], 1e-3)
    _, (line,) = said(lambda: targets_of(CAMERAS, images, None, BEHIND))
    assert "are brighter than it: multiply colours that are straight by it" in line


@pytest.mark.parametrize(
    ("change", "behind", "message"),
    [
        (lambda image: image, None, "target image 1 has an alpha, and what is behind it is to be found"),
        (lambda image: image * 3, BEHIND, "the alpha of target image 1 goes from 0 to"),
        (
            lambda image: image * np.nan,
            BEHIND,
            "target image 1 is not finite in any pixel that counts: leave it and its camera out",
        ),
    ],
)
def test_images_that_say_nothing_are_refused(change, behind, message):
    images = [IMAGES[0], change(transparent(CAMERAS[1])), IMAGES[2]]
    with pytest.raises(ValueError, match=message):
        targets_of(CAMERAS, images, None, behind)
    with pytest.raises(ValueError, match="no pixel of a target image counts"):
        targets_of(CAMERAS, IMAGES, [np.zeros((15, 16))] * 3, behind)


@pytest.mark.slow
def test_a_fit_takes_holes_alphas_and_sizes_together():
    wide = jvr.PerspectiveCamera(CAMERAS[2].world_from_camera, 30.0, 9, 8)
    cameras = (*CAMERAS[:2], wide)
    images = [spoilt(slice(0, 6))[0], transparent(CAMERAS[1]), np.asarray(jvr.render(TRUTH, wide, SETTINGS).rgb)]
    call = lambda: jvr.fit(
        START,
        cameras,
        images,
        unknowns=both,
        settings=SETTINGS,
        progress=False,
        max_steps=30,
        held_out=(CAMERAS[2:], [spoilt(slice(0, 3))[2]]),
    )
    result, lines = said(call)
    assert len(lines) == 3
    assert result.history[-1].psnr > 60
    # The pixels that the held-out image has.
    rendered = np.asarray(jvr.render(result.scene, CAMERAS[2], SETTINGS).rgb)
    ((decibels, _),) = result.stats.held_out
    assert decibels == pytest.approx(peak_signal_noise_ratio(IMAGES[2][3:], rendered[3:], data_range=1.0), abs=0.2)


def test_scores_are_those_of_the_pixels_that_are_known():
    """Half of a picture, beside scikit-image's scores of that half alone."""
    rng = np.random.default_rng(0)
    true = rng.random((20, 30, 3))
    found, half = true + 0.1 * rng.normal(size=true.shape), true.copy()
    half[:, 15:] = np.nan
    assert psnr(half, found) == pytest.approx(peak_signal_noise_ratio(true[:, :15], found[:, :15], data_range=1.0))
    alone = structural_similarity(true[:, :15], found[:, :15], data_range=1.0, channel_axis=-1, win_size=7)
    assert similarity(half, found) == pytest.approx(alone)
    assert np.isnan(similarity(np.full_like(true, np.nan), found[::-1]))


def test_weights_of_a_loss_over_whole_images_are_refused():
    dssim = {"loss": jvr.DSSIM(), "solver": optx.BFGS(rtol=1e-6, atol=1e-8)}
    with pytest.raises(ValueError, match="DSSIM compares whole images: leave weights and pixels that are not finite out"):
        said(lambda: fit(images=spoilt(), **dssim))


# --- What no scene can show ------------------------------------------------------------------------------------------


def out_of_reach(images, weights=None, scene=TRUTH, unknowns=both, exposure=None):
    """What a fit would say of its targets."""
    model = ExposedModel(scene, exposure)
    chosen = choose_unknowns(model, lambda m: (selected(unknowns, m.scene), m.exposure), None, jvr.LevenbergMarquardt().bounds)
    behind = known_background(model, chosen)
    targets = targets_of(CAMERAS, images, weights, behind)
    problem = Problem(model, chosen, SETTINGS, jvr.SquaredError(), (), None)
    _, lines = said(lambda: say_what_is_out_of_reach(problem, targets))
    return lines


def over(*colours):
    """The targets in front of another background: one, or from one above to another below."""
    rows = np.linspace(colours[0], colours[-1], 15)[:, None]
    pictures = [transparent(camera) for camera in CAMERAS]
    return [picture[..., :3] + (1 - picture[..., 3:]) * rows for picture in pictures]


FAR = [camera for camera in jvr.fibonacci_sphere(TRUTH.volume.center, 80.0, 3, 30.0, 16, 15)]


@pytest.fixture
def far(monkeypatch):
    """Cameras that see past the volume in their corners."""
    monkeypatch.setitem(globals(), "CAMERAS", FAR)


def test_a_background_that_only_the_targets_have_is_named(far):
    found = "the target images seem to have the background"
    assert out_of_reach(over(BEHIND)) == []
    assert out_of_reach(over([0.2, 0.4, 0.8])) == [
        f"{found} (0.2, 0.4, 0.8), linear, that of the scene is (0.1, 0.2, 0.3): give background=(0.2, 0.4, 0.8)"
    ]
    bare = eqx.tree_at(lambda s: s.background, TRUTH, None)
    (line,) = out_of_reach(over([0.2, 0.4, 0.8]), scene=bare)
    assert "the scene has none, which is black: give background=(0.2, 0.4, 0.8)" in line
    # A factor for all images makes no light of black, but might have made this colour of another.
    assert out_of_reach(over([0.2, 0.4, 0.8]), scene=bare, exposure=jnp.ones(())) == [line]
    assert out_of_reach(over([0.2, 0.4, 0.8]), exposure=jnp.ones(())) == []
    assert out_of_reach(over([0.2, 0.4, 0.8]), unknowns=lambda s: (s.transfer.rgb, s.background)) == []


def test_eight_bits_of_the_scenes_background_are_no_other(far):
    for background in (BEHIND, [0.002, 0.5, 0.999]):
        scene = eqx.tree_at(lambda s: s.background, TRUTH, jnp.asarray(background, jnp.float32))
        pictures = over(np.asarray(background))
        codes = [np.round(255 * jvr.srgb_from_linear(picture)) for picture in pictures]
        assert out_of_reach([jvr.linear_from_srgb(code / 255) for code in codes], scene=scene) == []
        assert out_of_reach([np.round(255 * picture) / 255 for picture in pictures], scene=scene) == []


def test_a_background_that_changes_from_top_to_bottom_is_named(far):
    (line,) = out_of_reach(over([0.5, 0.5, 0.9], [0.8, 0.8, 0.8]))
    assert "seem to have a background from (0.5, 0.5, 0.9) above to (0.8, 0.8, 0.8) below" in line
    assert "or give its pixels weight 0" in line


def test_corners_that_differ_or_do_not_count_say_nothing(far):
    images = over([0.2, 0.4, 0.8])
    images[1][-1, -1] = 0.5
    assert out_of_reach(images) == []
    images = over([0.2, 0.4, 0.8])
    top = [np.r_[np.zeros((8, 16)), np.ones((7, 16))] for _ in images]
    assert out_of_reach(images, top) == []


def test_light_that_no_colours_reach_is_named():
    images = [2 * image for image in IMAGES]
    bright = sum(np.count_nonzero(image.max(axis=-1) > 1.05) for image in images)
    assert bright > 10
    of_light = lambda **keywords: [line for line in out_of_reach(images, **keywords) if "brighter" in line]
    (line,) = of_light()
    assert line.startswith(f"{bright} pixels of the target images are brighter than the scene can be, up to ")
    assert line.endswith("without light its colours reach 1 at most; exposure=True finds a factor for all images")
    assert of_light(exposure=jnp.ones(())) == []
    assert of_light(scene=eqx.tree_at(lambda s: s.optical, TRUTH, jvr.EmissionOnly())) == []
    lit = jvr.Scene(TRUTH.volume, TRUTH.transfer, background=BEHIND, lights=[jvr.HeadLight()], shading=jvr.Lambert())
    assert of_light(scene=lit) == []
    bright_table = eqx.tree_at(lambda s: s.transfer.rgb, TRUTH, 3 * TRUTH.transfer.rgb)
    assert of_light(scene=bright_table, unknowns=lambda s: s.transfer.sigma_t) == []
    assert [line for line in out_of_reach(IMAGES) if "brighter" in line] == []


# --- Cameras and unknowns --------------------------------------------------------------------------------------------


def aside(camera):
    """A camera that looks past the volume."""
    return eqx.tree_at(lambda c: c.world_from_camera, camera, camera.world_from_camera.at[:3, 3].add(500.0))


def test_cameras_that_see_nothing_of_the_volume_are_named():
    observe = lambda cameras: said(lambda: jvr.colours_given_extinction(TRUTH, cameras, IMAGES, SETTINGS))
    _, (line,) = observe([CAMERAS[0], aside(CAMERAS[1]), CAMERAS[2]])
    assert line.startswith(
        "cameras that see nothing of the volume, so that their images say nothing of it: 1; the volume is around (5.5, 7.2, 4.5)"
    )
    with pytest.raises(ValueError, match=r"no camera sees the volume; the volume is around .*check their poses"):
        observe([aside(camera) for camera in CAMERAS])


@pytest.mark.parametrize(
    ("unknowns", "message"),
    [
        (lambda s: s.transfer.rbg, r"has not \(.*no attribute 'rbg'.*\): its arrays are .*transfer.rgb, transfer.sigma_t"),
        (lambda s: s.lights[0].direction, r"has not \(tuple index out of range\): its arrays are"),
        (lambda s: (s.transfer.rgb, s.clipping), r"returned None: give the scene the part that is to be fitted"),
        (lambda s: {"a": [s.clipping]}, "returned None"),
        (("transfer.rgb",), r"must be a function that picks arrays .*, not \('transfer.rgb',\)"),
    ],
)
def test_unknowns_that_a_scene_has_not_are_named(unknowns, message):
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        selected(unknowns, TRUTH)
    assert "\n" not in str(caught.value)


def test_held_out_images_are_refused_before_the_fit():
    steps = []
    with pytest.raises(ValueError, match="held-out image 0 has shape"):
        fit(held_out=(CAMERAS[:1], [IMAGES[0][:3]]), max_steps=3, progress=steps.append)
    assert steps == []


@pytest.mark.parametrize(
    ("cameras", "wanted"),
    [
        (None, "not NoneType"),
        ((camera for camera in ()), "must be a list or tuple of jvr's cameras, such as jvr.orbit(...), not generator"),
        (["front.png"], "must hold jvr's cameras, such as jvr.PerspectiveCamera.look_at(...), not 'front.png'"),
    ],
)
def test_what_is_no_sequence_of_cameras_is_refused(cameras, wanted):
    with pytest.raises(TypeError, match=re.escape(wanted)):
        check_cameras(cameras)
