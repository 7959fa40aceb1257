"""Shadows that a mesh throws on a medium: umbrae of exact size on a thin screen."""

import numpy as np
import pytest
from scenes import render

import jvr

SIDE, N = 20, 40


def screen(light, shadows, mesh):
    """A thin layer of fog, z = 0 ... 1, seen from below."""
    volume = jvr.Volume(np.full((SIDE + 1, SIDE + 1, 2), 0.5))
    transfer = jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 3)), [0.1, 0.1])
    parts = {"lights": (light,), "shadows": shadows, "scattering": jvr.SingleScattering(), "geometry": mesh}
    camera = jvr.OrthographicCamera.look_at([10, 10, -5], [10, 10, 0], [0, 1, 0], SIDE, N, N)
    picture = render(jvr.Scene(volume, transfer, **parts), camera, jvr.Settings(0.5, termination=0))
    # Where the screen is seen, and how far from its middle.
    x = (np.arange(N) + 0.5) * SIDE / N - 10
    return np.asarray(picture.rgb)[..., 0], np.abs(x)[:, None], np.abs(x)[None, :]


def square(height, half):
    corners = [[10 + half * x, 10 + half * y, height] for y in (-1.0, 1.0) for x in (-1.0, 1.0)]
    return jvr.Mesh(corners, [[0, 1, 2], [1, 2, 3]], (0.0, 0.0, 0.0))


SUN, LAMP = jvr.DirectionalLight([0.0, 0.0, -1.0], 3.0), jvr.PointLight([10.0, 10.0, 30.0], 3e3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "shadows", "blur"),
    [
        (SUN, jvr.ShadowRays(), 0.0),
        (LAMP, jvr.ShadowRays(), 0.0),
        (SUN, jvr.ShadowVolume(1.0), 1.5),
        (LAMP, jvr.ShadowVolume(1.0), 1.5),
        (SUN, jvr.DeepShadowMap(64), 1.0),
        (LAMP, jvr.PiecewiseShadows(), 0.0),
    ],
)
def test_the_umbra_of_a_square_has_its_exact_size(light, shadows, blur):
    half, height = 4.1, 10.0
    rgb, y, x = screen(light, shadows, square(height, half))
    lit, _, _ = screen(light, shadows, square(height, 1e-3 * half))
    # A lamp at 30 throws the square at 10 on z = 0 and on z = 1 that much larger.
    least, most = (half, half) if light is SUN else (half * 29 / 20, half * 30 / 20)
    inside = (x < least - blur) & (y < least - blur)
    outside = (x > most + blur) | (y > most + blur)
    assert inside.sum() > 60
    assert outside.sum() > 200
    assert np.all(lit[inside] > 0.01)
    np.testing.assert_allclose(rgb[inside], 0, atol=1e-4 * lit.max())
    np.testing.assert_allclose(rgb[outside], lit[outside], rtol=2e-2 if blur else 1e-5)


@pytest.mark.slow
def test_geometry_behind_a_lamp_or_beyond_the_screen_shades_nothing():
    for light, height in ((LAMP, 35.0), (SUN, -2.0)):
        for shadows in (jvr.ShadowRays(), jvr.ShadowVolume(0.5)):
            rgb, _, _ = screen(light, shadows, square(height, 4.0))
            lit, y, x = screen(light, shadows, square(height, 1e-3))
            # What is between the screen and the eye hides it.
            seen = np.broadcast_to((x > 4.1) | (y > 4.1) | (height > 0), rgb.shape)
            np.testing.assert_allclose(rgb[seen], lit[seen], rtol=1e-5)
