"""`jvr.render` against a slow NumPy marcher that was written from the conventions alone."""

import numpy as np
import pytest
from reference import render as render_slowly
from scenes import (
    OBLIQUE,
    SETTINGS,
    affine,
    gaussian_transfer,
    linear_transfer,
    lut_transfer,
    orthographic,
    perspective,
    render,
    voxels,
)

import jvr

BACKGROUND = (0.2, 0.5, 0.9)
INTEGERS = np.random.default_rng(7).integers(-1000, 3000, (6, 5, 4)).astype(np.int16)
HU = dict(slope=1 / 4000, intercept=0.25)


def _oblique(**options):
    return jvr.Volume(voxels(), OBLIQUE, **options)


def _near(offset, target):
    """A camera at an offset from the middle of the volume, looking at another offset."""

    def camera(volume):
        center = np.asarray(volume.center)
        return jvr.PerspectiveCamera.look_at(center + offset, center + target, [0, 0.1, 1], 100.0, 6, 5)

    return camera


def _box(volume):
    center = np.asarray(volume.center)
    return jvr.ClippingBox(center - np.array([2, 3, 1.5]), center + np.array([1.5, 2.5, 3]))


def _scene(volume=None, transfer=None, camera=perspective, **options):
    volume = _oblique() if volume is None else volume
    return jvr.Scene(volume, transfer or linear_transfer(), **({"background": BACKGROUND} | options)), camera(volume)


# Cases that share a structure share a compiled program; independent features are paired to need few of them.
CASES = {
    "perspective, oblique, anisotropic": lambda: _scene(),
    "camera inside the volume": lambda: _scene(camera=_near([0.3, -0.2, 0.4], [3, 1, -2])),
    "mirrored axes": lambda: _scene(jvr.Volume(voxels(), affine((-1.0, 0.5, 1.0), (5, 5, 5), (0.1, 0.2, 0.3)))),
    "spacing 1 : 1000": lambda: _scene(
        jvr.Volume(voxels(), affine((0.01, 0.01, 10.0))), linear_transfer(scale=60.0), _near([0.1, -0.05, 0.03], [0, 0, 3])
    ),
    "orthographic, clipping box, coloured extinction": lambda: _scene(
        transfer=linear_transfer(coloured=True), camera=orthographic, clipping=_box(_oblique())
    ),
    "clipping box, no background, table": lambda: _scene(transfer=lut_transfer(), clipping=_box(_oblique()), background=None),
    "nearest voxel, coloured table": lambda: _scene(_oblique(interpolation=jvr.Nearest()), lut_transfer(coloured=True)),
    "integers with slope and intercept, Gaussians": lambda: _scene(
        jvr.Volume(INTEGERS, affine((2.0, 1.0, 3.0)), **HU), gaussian_transfer()
    ),
    "integers, nearest voxel, emission only": lambda: _scene(
        jvr.Volume(INTEGERS, affine((2.0, 1.0, 3.0)), interpolation=jvr.Nearest(), **HU), optical=jvr.EmissionOnly()
    ),
    "one voxel thick, coloured Gaussians": lambda: _scene(
        jvr.Volume(voxels((5, 1, 7)), OBLIQUE), gaussian_transfer(coloured=True)
    ),
    "one voxel, orthographic": lambda: _scene(jvr.Volume(voxels((1, 1, 1)), affine((3.0, 2.0, 4.0))), camera=orthographic),
    "emission only, coloured": lambda: _scene(transfer=linear_transfer(coloured=True), optical=jvr.EmissionOnly()),
    "absorption only": lambda: _scene(optical=jvr.AbsorptionOnly()),
    "absorption only, coloured": lambda: _scene(transfer=lut_transfer(coloured=True), optical=jvr.AbsorptionOnly()),
}


@pytest.mark.parametrize("name", CASES)
def test_render_is_the_slow_march(name):
    scene, camera = CASES[name]()
    image = render(scene, camera, SETTINGS)
    rgb, alpha, depth = render_slowly(scene, camera, SETTINGS.step)
    # At most 60 samples a ray, each with a few roundings of 6e-8, most of which cancel.
    np.testing.assert_allclose(image.rgb, rgb, atol=1e-5)
    np.testing.assert_allclose(image.alpha, alpha, atol=1e-5)
    np.testing.assert_allclose(image.depth, depth, atol=1e-5 * max(depth.max(), 1))
    # The picture is worth comparing: some rays hit.
    assert np.ptp(rgb[..., 0]) > 0.01


def test_both_hits_and_misses_occur():
    scene, camera = CASES["perspective, oblique, anisotropic"]()
    image = render(scene, camera, SETTINGS)
    missed = np.asarray(image.stats.steps) == 0
    assert 0 < missed.sum() < missed.size
    np.testing.assert_array_equal(np.asarray(image.rgb)[missed], np.broadcast_to(np.float32(BACKGROUND), (missed.sum(), 3)))
    assert not np.asarray(image.alpha)[missed].any()
    assert not np.asarray(image.depth)[missed].any()
