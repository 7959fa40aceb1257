"""What `jvr.measure` says of settings: errors against a finer reference, samples and times."""

import itertools
from typing import Any

import numpy as np
import pytest
from scenes import OBLIQUE, lut_transfer, perspective, voxels

import jvr

VOLUME = jvr.Volume(voxels(), OBLIQUE)
SCENE = jvr.Scene(VOLUME, lut_transfer(scale=0.3), background=(0.1, 0.2, 0.3))
ENTRIES: Any = lambda scene: (scene.transfer.rgb, scene.transfer.sigma_t)
CAMERA = perspective(VOLUME, 12, 10)


@pytest.mark.slow
def test_finer_steps_cost_more_samples_and_err_less():
    settings = [jvr.Settings(step, termination=0.0) for step in (2.0, 0.25)]
    found = jvr.measure(SCENE, CAMERA, settings, repeats=1, unknowns=ENTRIES)
    assert [m.settings for m in found] == settings
    for coarse, fine in itertools.pairwise(found):
        assert fine.samples > 6 * coarse.samples
        assert fine.rmse < 0.5 * coarse.rmse
        assert fine.largest < coarse.largest
        assert fine.gradient_error is not None
        assert coarse.gradient_error is not None
        assert fine.gradient_error < 0.5 * coarse.gradient_error
        assert fine.ssim >= coarse.ssim
    assert all(m.seconds > 0 for m in found)
    assert all(m.rmse <= m.largest for m in found)


@pytest.mark.slow
def test_errors_are_those_of_the_pictures():
    """Against a reference at the same step they are rounding alone; of another picture, its own difference."""
    (same,) = jvr.measure(SCENE, CAMERA, [jvr.Settings(0.5, termination=0.0)], reference_step=0.5, repeats=1)
    assert same.largest < 1e-5
    assert same.ssim == pytest.approx(1.0, abs=1e-6)
    assert same.gradient_error is None
    (other,) = jvr.measure(SCENE, CAMERA, [jvr.Settings(2.0, termination=0.0)], reference_step=0.5, repeats=1)
    fine, coarse = (np.asarray(jvr.render(SCENE, CAMERA, jvr.Settings(step, termination=0.0)).rgb) for step in (0.5, 2.0))
    assert other.largest == pytest.approx(np.abs(coarse - fine).max(), rel=1e-3)
    assert other.rmse == pytest.approx(np.sqrt(np.mean((coarse - fine) ** 2)), rel=1e-3)


def test_needs_settings():
    with pytest.raises(ValueError, match="at least one"):
        jvr.measure(SCENE, CAMERA, [])


@pytest.mark.slow
def test_the_reference_has_the_rays_of_the_finest_pixels():
    """More rays a pixel are nearer to it, and one of them is not what it is: an edge within a pixel is its mean."""
    one, two, three = jvr.measure(SCENE, CAMERA, [jvr.Settings(1.0, pixel_samples=n) for n in (1, 2, 3)], repeats=1)
    assert three.rmse < two.rmse < one.rmse


def test_settings_of_two_filters_have_no_reference():
    settings = [jvr.Settings(1.0, pixel_samples=2), jvr.Settings(1.0, pixel_samples=2, pixel_filter=jvr.TentFilter())]
    with pytest.raises(ValueError, match="measure those of one at a time"):
        jvr.measure(SCENE, CAMERA, settings)
