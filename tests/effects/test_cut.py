"""What a clipping box cuts open, and labels: surfaces whose normals the voxels do not tell."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import linear_transfer, render

import jvr

LIGHT = np.array([-1.0, -0.6, -0.4]) / np.linalg.norm([-1.0, -0.6, -0.4])
# Nothing below 0.3, and light does not get through half a voxel of what is above 0.5.
OPAQUE = jvr.LinearTransfer([0.3, 0.5], np.ones((2, 3)), [0.0, 20.0])


def block(noise, seed=0):
    """Voxels that are all the same up to a relative noise."""
    return 0.6 * (1 + noise * np.random.default_rng(seed).standard_normal((16, 16, 16)))


def cut_open(values, shading, normals, x=8.3):
    """A block seen along -x, cut at `x`."""
    box = jvr.ClippingBox([-1.0, -1, -1], [x, 40, 40])
    scene = jvr.Scene(
        jvr.Volume(values), OPAQUE, lights=(jvr.DirectionalLight(LIGHT),), shading=shading, clipping=box, normals=normals
    )
    camera = jvr.OrthographicCamera.look_at([60, 7.5, 7.5], [7.5, 7.5, 7.5], [0, 0, 1], 9.0, 8, 8)
    return np.asarray(render(scene, camera, jvr.Settings(0.5)).rgb[..., 0])


@pytest.mark.slow
@pytest.mark.parametrize("normals", [jvr.AnalyticGradient(), jvr.CentralDifferences()], ids=lambda n: type(n).__name__)
def test_a_cut_face_is_lit_as_the_plane_that_cuts_it(normals):
    """Lambert's cosine of the plane, whatever the noise of the voxels, and Blinn and Phong's highlight beside it."""
    glossy = isinstance(normals, jvr.AnalyticGradient)
    shading = jvr.BlinnPhong(0.0, 1.0, 0.4, 8.0) if glossy else jvr.Lambert(0.0)
    half = np.array([1.0, 0, 0]) - LIGHT
    expected = -LIGHT[0] + (0.4 * (half[0] / np.linalg.norm(half)) ** 8 if glossy else 0.0)
    for noise in (0.0, 1e-6, 1e-3):
        np.testing.assert_allclose(cut_open(block(noise), shading, normals), expected, rtol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("normals", [jvr.CentralDifferences(), jvr.SobelDifferences()], ids=lambda n: type(n).__name__)
def test_rounding_makes_no_surfaces(normals):
    """Inside of equal voxels there is no gradient, and what has none reflects as if it faced the light."""
    volume = jvr.Volume(np.full((6, 6, 6), 0.7), intercept=-0.1)
    scene = jvr.Scene(volume, OPAQUE, lights=(jvr.DirectionalLight(LIGHT),), shading=jvr.Lambert(0.0), normals=normals)
    camera = jvr.PerspectiveCamera.look_at([20.0, 14, 11], [2.5, 2.5, 2.5], [0, 0, 1], 8.0, 8, 8)
    image = render(scene, camera, jvr.Settings(0.37))
    np.testing.assert_allclose(image.rgb[..., 0], 1.0, atol=1e-4)


@pytest.mark.slow
def test_derivatives_of_a_cut_through_a_translucent_medium(x64):
    """In the faces of the box and in the light, against central differences; finite in single precision too."""
    values = 0.5 + 0.3 * np.sin(np.arange(6 * 7 * 8)).reshape(6, 7, 8)
    camera = jvr.PerspectiveCamera.look_at([15.0, 12, 14], [2.5, 3, 3.5], [0, 0, 1], 22.0, 4, 3)
    weight = 0.5 + 0.3 * np.sin(np.arange(36)).reshape(3, 4, 3)

    def loss(p, dtype=np.float64):
        lower, upper, direction = jnp.split(p.astype(dtype), 3)
        transfer = jax.tree.map(lambda x: x.astype(dtype), linear_transfer())
        scene = jvr.Scene(
            jvr.Volume(values.astype(dtype), np.eye(4, dtype=dtype)),
            transfer,
            clipping=jvr.ClippingBox(lower, upper),
            lights=(jvr.DirectionalLight(direction),),
            shading=jvr.Lambert(0.2, threshold=0.1),
        )
        # The derivative of forward mode is the same, and takes a fraction of the time to compile.
        settings = jvr.Settings(0.5, termination=0, adjoint=jvr.Forward())
        return jnp.sum(weight * jvr.render(scene, camera, settings).rgb)

    p = jnp.asarray([0.63, 0.87, 0.71, 4.21, 5.13, 6.37, *LIGHT])
    gradient = np.asarray(jax.jit(jax.jacfwd(loss))(p))
    h = 1e-6 * np.eye(9)
    value = jax.jit(lambda points: jax.lax.map(loss, points))
    expected = (np.asarray(value(p + h)) - np.asarray(value(p - h))) / 2e-6
    np.testing.assert_allclose(gradient, expected, atol=1e-5 * np.abs(expected).max())
    assert np.abs(gradient).min() > 1e-4


def ball(radius=10.0, size=28):
    """A ball of label 2 in label 0, its centre, and the world positions of voxels."""
    center = (size - 1) / 2 + np.array([0.2, -0.1, 0.3])
    x = np.stack(np.meshgrid(*[np.arange(size)] * 3, indexing="ij"), -1)
    return np.where(np.linalg.norm(x - center, axis=-1) <= radius, 2, 0).astype(np.uint8), center


@pytest.mark.slow
def test_a_ball_of_labels_is_lit_as_a_ball():
    """Against Lambert's law of the sphere itself, within nine tenths of its outline."""
    values, center = ball()
    transfer = jvr.LutTransfer(np.ones((3, 3)), [0.0, 9.0, 9.0], [0.0, 2.0])
    volume = jvr.Volume(values, interpolation=jvr.Nearest())
    scene = jvr.Scene(volume, transfer, lights=(jvr.DirectionalLight(LIGHT),), shading=jvr.Lambert(0.0))
    camera = jvr.OrthographicCamera.look_at(center + np.array([40.0, 0, 0]), center, [0, 0, 1], 20.0, 32, 32)
    image = np.asarray(render(scene, camera, jvr.Settings(0.25)).rgb[..., 0])
    y = (np.arange(32) + 0.5 - 16) / 32 * 2
    y, z = y, -y[:, None]
    across = y**2 + z**2
    normal = [np.sqrt(np.maximum(1 - across, 0)), y, z]
    expected = np.maximum(-sum(n * w for n, w in zip(normal, LIGHT, strict=True)), 0)
    seen = across < 0.81
    error = np.abs(image - expected)[seen]
    assert error.mean() < 0.03
    assert np.percentile(error, 95) < 0.08
    # Not that there were nothing to see.
    assert expected[seen].std() > 0.2


@pytest.mark.slow
def test_labels_are_shaded_by_what_is_seen(x64):
    """Derivatives in the extinctions of labels, through their normals, by replay against central differences."""
    values = ball(2.6, 7)[0] + (np.arange(7) > 3).astype(np.uint8)
    volume = jvr.Volume(values, interpolation=jvr.Nearest())
    camera = jvr.PerspectiveCamera.look_at([15.0, 12, 14], [3, 3, 3], [0, 0, 1], 25.0, 4, 3)
    weight = 0.5 + 0.3 * np.sin(np.arange(36)).reshape(3, 4, 3)

    def loss(sigma_t):
        transfer = jvr.LutTransfer(np.linspace(0.2, 1, 12).reshape(4, 3), sigma_t, [0.0, 3.0])
        scene = jvr.Scene(volume, transfer, lights=(jvr.DirectionalLight(LIGHT),), shading=jvr.Lambert(0.1))
        return jnp.sum(weight * jvr.render(scene, camera, jvr.Settings(0.5, termination=0)).rgb)

    sigma_t, h = jnp.asarray([0.05, 0.3, 0.2, 0.6]), 1e-6 * np.eye(4)
    value = jax.jit(lambda points: jax.lax.map(loss, points))
    expected = (np.asarray(value(sigma_t + h)) - np.asarray(value(sigma_t - h))) / 2e-6
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(sigma_t), expected, atol=1e-6 * np.abs(expected).max())
