"""Far cameras and far worlds: what was given in double precision keeps its digits relative to the volume; float64 is the reference."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import affine, linear_transfer, render

import jvr
from jvr.fitting.observations import inside, observe

SETTINGS = jvr.Settings(0.6, termination=0)
UTM = (759186.3, -2957195.7, 1203.1)
ANGLES = (0.4, -0.7, 0.3)
RADIUS = 6.0


def smooth():
    """Voxels without kinks of note: where a sample falls from one cell into the next does not matter then."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n) for n in (9, 10, 11)], indexing="ij")
    return 0.5 + 0.4 * np.sin(2 * x + 1) * np.cos(1.5 * y) * np.cos(1.2 * z + 0.3)


def build(origin, away, kind):
    """A volume with a clipping box and a light, whose voxel (0, 0, 0) is at `origin`, from `away` of its radii."""
    matrix = affine((1, 1.1, 0.9), origin, ANGLES)
    center = matrix[:3, :3] @ [4, 4.5, 5] + origin
    scene = jvr.Scene(
        jvr.Volume(smooth(), matrix),
        linear_transfer(),
        background=(0.2, 0.5, 0.9),
        clipping=jvr.ClippingBox(center - 3.1, center + 3.6),
        lights=(jvr.PointLight(center + RADIUS * np.array([0.8, 1.1, 0.4]), 2 * RADIUS**2),),
        shading=jvr.Lambert(threshold=0.02),
    )
    eye, target = center + away * RADIUS * np.array([0.8, -0.48, 0.36]), center + 0.3
    if kind == "orthographic":
        return scene, jvr.OrthographicCamera.look_at(eye, target, [0.1, 0.2, 1], 9.0, 6, 5)
    return scene, jvr.PerspectiveCamera.look_at(eye, target, [0.1, 0.2, 1], np.degrees(2 * np.arctan(0.8 / away)), 6, 5)


def picture(arguments, *, gradients):
    """Pixels and, with `gradients`, the derivatives of a weighted sum of them, by name."""
    arrays, rest = eqx.partition(build(*arguments), eqx.is_inexact_array)
    rgb, gradient = (with_gradients if gradients else pixels)(arrays, rest)
    return np.asarray(rgb), {jax.tree_util.keystr(k): np.asarray(x) for k, x in jax.tree_util.tree_leaves_with_path(gradient)}


def pixels(arrays, rest):
    return render(*eqx.combine(arrays, rest), SETTINGS).rgb, ()


@jax.jit
def with_gradients(arrays, rest):
    def loss(arrays):
        rgb = jvr.render(*eqx.combine(arrays, rest), SETTINGS).rgb
        return jnp.sum(rgb * (0.5 + 0.3 * jnp.sin(jnp.arange(rgb.size)).reshape(rgb.shape))), rgb

    gradient, rgb = jax.grad(loss, has_aux=True)(arrays)
    return rgb, gradient


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
@pytest.mark.parametrize("gradients", [False, True])
def test_far_cameras_and_far_worlds_keep_the_digits_of_near_ones(kind, gradients):
    """A million radii away and a world like that of UTM: pixels to 1e-5, gradients to 1e-4 of the largest entry."""
    for case in (((0.0, 0, 0), 1e4, kind), ((0.0, 0, 0), 1e6, kind), (UTM, 3.0, kind)):
        rgb, gradient = picture(case, gradients=gradients)
        with jax.enable_x64(True):
            true, true_gradient = picture(case, gradients=gradients)
        np.testing.assert_allclose(rgb, true, atol=1e-5 * true.max(), err_msg=str(case))
        for name, t in true_gradient.items():
            np.testing.assert_allclose(gradient[name], t, atol=1e-4 * np.abs(t).max(), err_msg=f"{name}: {case}")


def test_a_traced_camera_far_away_aims_at_its_target():
    """In voxels of size 1: without the low part of the view its middle misses by 0.03."""
    target, eye = np.array([2.0, 2.5, 3.0], np.float32), np.array([8e5, 5e5, 3.3e5], np.float32)

    def middle(eye):
        camera = jvr.PerspectiveCamera.look_at(eye, target, [0, 0, 1], 1e-4, 1, 1)
        distance = jnp.linalg.norm(eye - target)
        origin, direction, behind = camera.rays_ahead(jnp.arange(1), distance)
        return jnp.stack(origin)[:, 0] - target, jnp.stack(direction)[:, 0], behind

    aside, direction, behind = jax.jit(middle)(eye)
    aside = aside - np.dot(aside, direction) * direction
    np.testing.assert_allclose(aside, 0, atol=1e-4)
    np.testing.assert_allclose(behind, np.linalg.norm(eye.astype(float) - target), rtol=1e-6)


def replaced(camera, matrix):
    return eqx.tree_at(lambda c: c.world_from_camera, camera, jnp.asarray(matrix))


def test_what_single_precision_has_left_goes_with_the_number_it_belongs_to():
    """A pose that is replaced, or moved by an optimiser, has no digits of the one before; copies keep theirs."""
    camera = build(UTM, 3.0, "perspective")[1]
    zero = jnp.float32(0)
    at = lambda camera: np.array(camera.moved(jvr.Volume(np.zeros((2, 2, 2)), affine((1, 1, 1), UTM)).origin).axis_at(zero))
    matrix = np.asarray(camera.world_from_camera)
    exact = matrix[:3, 3].astype(float) + np.asarray(camera.remainder.low)[:3, 3] - UTM
    assert np.abs(exact - (matrix[:3, 3].astype(float) - UTM)).max() > 0.01
    np.testing.assert_allclose(at(camera), exact, atol=1e-6)
    np.testing.assert_allclose(at(dataclasses.replace(camera, width=9)), exact, atol=1e-6)
    moved = matrix.copy()
    moved[:3, 3] += 0.5
    np.testing.assert_allclose(at(replaced(camera, moved)), moved[:3, 3].astype(float) - UTM, atol=1e-6)
    # An entry that stays where it is keeps its own.
    moved[1:3, 3] = matrix[1:3, 3]
    expected = np.concatenate([[moved[0, 3].astype(float) - UTM[0]], exact[1:]])
    np.testing.assert_allclose(at(replaced(camera, moved)), expected, atol=1e-6)


def test_rays_of_a_fit_keep_their_digits():
    """Entry, direction and length inside of a volume at UTM, seen from afar, as at the origin of the world."""

    def rays(origin):
        scene, camera = build(origin, 1e4, "perspective")
        images = [np.zeros((camera.height, camera.width, 3), np.float32)]
        observations = observe(scene, [camera], images, None, SETTINGS)
        return inside(scene, observations.tile(0).rays)

    there, here = rays(UTM), rays((0.0, 0, 0))
    for a, b in zip(jax.tree.leaves(there), jax.tree.leaves(here), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)
    assert np.asarray(here.length).max() > 5
