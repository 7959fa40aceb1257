"""Several rays a pixel: means of finer pictures, coverage of edges, and what refuses them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import linear_transfer, render, small, voxels

import jvr

N = 3
SETTINGS = jvr.Settings(0.5, termination=0, pixel_samples=N)
ONE = jvr.Settings(0.5, termination=0)
EYE, TARGET = np.array([14.0, -9, 8]), np.array([4.0, 3, 3.5])


def pose():
    return jvr.PerspectiveCamera.look_at(EYE, TARGET, [0, 0, 1], 40.0, 4, 3).world_from_camera


# Each with pixels of its own number, and with all that is in pixels `N` times as many.
CAMERAS = {
    "perspective": lambda n: jvr.PerspectiveCamera.look_at(EYE, TARGET, [0, 0, 1], 40.0, 4 * n, 3 * n),
    "orthographic": lambda n: jvr.OrthographicCamera.look_at(EYE, TARGET, [0, 0, 1], 9.0, 4 * n, 3 * n),
    "pinhole": lambda n: jvr.PinholeCamera(pose(), [5.0 * n, 6.0 * n], 4 * n, 3 * n, principal_point=[1.7 * n, 1.2 * n]),
}


@pytest.mark.parametrize(
    "kind", ["pinhole", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("perspective", "orthographic"))]
)
def test_a_pixel_is_the_mean_of_its_rays(kind, x64):
    camera, scene = CAMERAS[kind], small()
    found, fine = render(scene, camera(1), SETTINGS), render(scene, camera(N), ONE)
    blocks = lambda x: np.asarray(x, float).reshape(3, N, 4, N, -1)
    np.testing.assert_allclose(found.rgb, blocks(fine.rgb).mean((1, 3)), rtol=1e-12)
    alpha, seen = blocks(fine.alpha).mean((1, 3))[..., 0], blocks(fine.alpha * fine.depth).mean((1, 3))[..., 0]
    np.testing.assert_allclose(found.alpha, alpha, rtol=1e-12)
    np.testing.assert_allclose(found.depth, seen / np.where(alpha > 0, alpha, 1), rtol=1e-12)
    np.testing.assert_array_equal(found.stats.steps, blocks(fine.stats.steps).sum((1, 3))[..., 0])
    assert found.alpha.max() > 0.1


@pytest.mark.slow
def test_an_edge_is_as_soft_as_a_pixel():
    """An opaque cube cut by an oblique plane: a pixel is covered by so many of its rays as lie on this side, and by its area to a ray's."""
    n, normal = 8, np.array([0.0, 1.0, 0.37])
    scene = jvr.Scene(
        jvr.Volume(np.ones((9, 9, 9))),
        jvr.LinearTransfer([0.0, 1.0], np.ones((2, 3)), [50.0, 50.0]),
        clipping=jvr.ClippingPlane([4.0, 4.1, 3.9], normal),
    )
    camera = jvr.OrthographicCamera.look_at([30.0, 4, 4], [4.0, 4, 4], [0, 0, 1], 6.0, 6, 6)
    found = np.asarray(render(scene, camera, jvr.Settings(0.5, pixel_samples=n)).alpha)
    across = (np.arange(6 * n) + 0.5) / n - 3
    y, z = across[None, :], -across[:, None]
    inside = (y - 0.1) * normal[1] + (z + 0.1) * normal[2] <= 0
    np.testing.assert_allclose(found, inside.reshape(6, n, 6, n).mean((1, 3)), atol=1e-6)
    assert 3 < np.count_nonzero((found > 0.02) & (found < 0.98)) < 15


@pytest.mark.slow
def test_derivatives_against_differences(x64):
    volume, camera, transfer = jvr.Volume(voxels()), CAMERAS["perspective"](1), linear_transfer()

    def loss(sigma_t):
        scene = jvr.Scene(volume, jvr.LinearTransfer(transfer.positions, transfer.rgb, sigma_t))
        return jnp.sum(jvr.render(scene, camera, SETTINGS).rgb ** 2)

    gradient, h = jax.jit(jax.grad(loss))(transfer.sigma_t), 1e-6 * np.eye(4)
    value = jax.jit(lambda points: jax.lax.map(loss, points))
    expected = (value(transfer.sigma_t + h) - value(transfer.sigma_t - h)) / 2e-6
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)


def test_is_said_and_refused():
    scene, camera = small(), CAMERAS["perspective"](1)
    assert "3 x 3 rays a pixel" in str(jvr.plan(scene, SETTINGS))
    assert "rays a pixel" not in str(jvr.plan(scene, ONE))
    with pytest.raises(ValueError, match="pixel_samples"):
        jvr.Settings(pixel_samples=0)
    with pytest.raises(ValueError, match="one ray a pixel"):
        jvr.fit(scene, [camera], [np.zeros((3, 4, 3))], unknowns=lambda s: s.transfer.rgb, settings=SETTINGS)
