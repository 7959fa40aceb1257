"""Clipping planes and boxes: closed forms, derivatives against differences, and everything that marches through what they leave."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference import camera_rays
from scenes import OBLIQUE, affine, linear_transfer, perspective, render, rotation, voxels

import jvr
from jvr.model.parameters import assign
from jvr.rendering.advise import remarks_on

SETTINGS = jvr.Settings(0.5, termination=0)
SIGMA, COLOUR = 0.3, np.array([0.9, 0.5, 0.2])
SIZE = 9
NORMAL = np.array([1.0, -0.6, 0.4])
MIDDLE = np.full(3, 4.0)
ASIDE = MIDDLE + np.array([0.3, -0.2, 0.1])


def cube():
    """Everything has one extinction, so that a pixel is known by how long its ray is inside."""
    return jvr.Volume(np.ones((SIZE, SIZE, SIZE))), jvr.LinearTransfer([0.0, 2.0], [COLOUR] * 2, [SIGMA] * 2)


CUBE, SOLID = cube()


def lengths(camera, halves, lower=np.zeros(3), upper=np.full(3, SIZE - 1.0)):
    """World length of each pixel's ray inside of a box and of half-spaces `(point, normal)`, each cut by half-spaces alone."""
    found = []
    origins, directions = (a.reshape(-1, 3) for a in camera_rays(camera))
    for o, d in zip(origins, directions, strict=True):
        near, far = 0.0, np.inf
        # Each face of the box is a half-space, too.
        faces = [*((lower, -e) for e in np.eye(3)), *((upper, e) for e in np.eye(3)), *halves]
        for point, normal in faces:
            climb, height = d @ normal, (o - point) @ normal
            if climb > 0:
                far = min(far, -height / climb)
            elif climb < 0:
                near = max(near, -height / climb)
            elif height > 0:
                far = -np.inf
        found.append(max(far - near, 0.0))
    return np.array(found)


def seen(scene, camera, halves, **box):
    image = render(scene, camera, SETTINGS)
    depth = SIGMA * lengths(camera, halves, **box)
    np.testing.assert_allclose(image.alpha.ravel(), -np.expm1(-depth), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(image.rgb.reshape(-1, 3), -np.expm1(-depth)[:, None] * COLOUR, rtol=1e-9, atol=1e-11)
    return image


def views():
    """From outside, from within what is cut away and from within what is left, and parallel rays along one of the planes."""
    inside = lambda eye, target: jvr.PerspectiveCamera.look_at(eye, target, [0, 0, 1], 60.0, 6, 5)
    return {
        "outside": perspective(cube()[0], 6, 5),
        "in what is cut away": inside(MIDDLE + 2.5 * NORMAL, MIDDLE + 0.1),
        "in what is left": inside(MIDDLE - 2.5 * NORMAL, MIDDLE + 0.1),
    }


CUTS = {
    "one plane": [(ASIDE, NORMAL)],
    "two planes": [(ASIDE, NORMAL), (MIDDLE, np.array([-0.5, -1.0, 0.7]))],
    "a wedge that is empty": [(MIDDLE, NORMAL), (MIDDLE + 0.5 * NORMAL, -NORMAL)],
    "a plane that is far away": [(MIDDLE + 1e4 * NORMAL, NORMAL)],
    "a plane that leaves nothing": [(MIDDLE - 1e4 * NORMAL, NORMAL)],
}


@pytest.mark.slow
@pytest.mark.parametrize("cut", CUTS)
def test_a_homogeneous_cube_cut_by_planes(cut, x64):
    """Each ray's way inside, by half-spaces in NumPy: `rgb (1 - exp(-sigma d))`."""
    planes = tuple(jvr.ClippingPlane(point, normal) for point, normal in CUTS[cut])
    for camera in views().values():
        image = seen(jvr.Scene(*cube(), clipping=planes), camera, CUTS[cut])
    assert (image.alpha.max() > 0) == (cut not in ("a plane that leaves nothing", "a wedge that is empty"))


@pytest.mark.slow
def test_rays_along_a_plane_are_inside_or_not(x64):
    """Parallel to it to the last bit: on one side all of the way, on the other none."""
    camera = jvr.OrthographicCamera.look_at([20.0, 4, 4], [4.0, 4, 4], [0, 0, 1], 6.0, 4, 4)
    halves = [(np.array([0.0, 3.3, 0]), np.array([0.0, 1, 0]))]
    image = seen(jvr.Scene(*cube(), clipping=jvr.ClippingPlane(*halves[0])), camera, halves)
    assert 0 < np.count_nonzero(image.alpha) < 16


@pytest.mark.slow
def test_boxes_are_what_six_planes_are(x64):
    """Along the axes and oblique, sheared too: to the last digits of entry and exit."""
    volume, transfer = jvr.Volume(voxels((7, 8, 9)), OBLIQUE), linear_transfer()
    camera = perspective(volume, 6, 5)
    scene = jvr.Scene(volume, transfer)
    center, half = np.asarray(volume.center), np.array([3.0, 4.0, 3.5])
    turn = rotation(0.4, -0.3, 0.8) @ np.array([[1, 0.3, 0], [0, 1, 0], [0, 0, 2.0]])
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = turn, center
    for box, axes in (
        (jvr.ClippingBox(center - half, center + half), np.eye(3)),
        (jvr.ClippingBox(-half, half, world_from_box=placed), turn),
    ):
        # Faces are at plus and minus `half` of each axis, across the other two.
        across = np.linalg.inv(axes)
        planes = [jvr.ClippingPlane(center + sign * half[i] * axes[:, i], sign * across[i]) for i in range(3) for sign in (1, -1)]
        one, other = (render(dataclasses.replace(scene, clipping=cut), camera, SETTINGS) for cut in (box, tuple(planes)))
        np.testing.assert_allclose(one.rgb, other.rgb, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(one.depth, other.depth, rtol=1e-9, atol=1e-9)
        assert one.alpha.max() > 0.05


@pytest.mark.slow
def test_derivatives_against_differences(x64):
    """In points and normals of planes and in an oblique box, and in the light that falls on what is cut, with shadows."""
    volume, transfer = jvr.Volume(voxels((5, 6, 7))), linear_transfer()
    camera = perspective(volume, 5, 4)
    weight = jnp.sin(jnp.arange(1.0, 61)).reshape(4, 5, 3)

    def loss(p, adjoint=jvr.Forward()):
        point, normal, matrix, direction = jnp.split(p, (3, 6, 18))
        world = jnp.concatenate([matrix.reshape(3, 4), jnp.array([[0.0, 0, 0, 1]])])
        scene = jvr.Scene(
            volume,
            transfer,
            clipping=(jvr.ClippingPlane(point, normal), jvr.ClippingBox([-2.0, -2, -2], [2.0, 2, 2], world_from_box=world)),
            lights=(jvr.DirectionalLight(direction),),
            shading=jvr.Lambert(0.2, threshold=0.1),
            shadows=jvr.ShadowRays(1.1, termination=0),
        )
        return jnp.sum(weight * jvr.render(scene, camera, jvr.Settings(0.5, termination=0, adjoint=adjoint)).rgb)

    placed = affine((1.1, 0.9, 1.2), (2.1, 2.4, 3.2), (0.3, 0.2, -0.4))[:3]
    p = jnp.asarray([2.3, 2.6, 2.9, 0.4, -1.1, 0.7, *placed.ravel(), -1.0, -0.6, -0.4])
    gradient = np.asarray(jax.jit(jax.jacfwd(loss))(p))
    h = 1e-6 * np.eye(p.size)
    value = jax.jit(lambda points: jax.lax.map(loss, points))
    expected = (np.asarray(value(p + h)) - np.asarray(value(p - h))) / 2e-6
    np.testing.assert_allclose(gradient, expected, atol=2e-5 * np.abs(expected).max())
    assert np.abs(gradient[:18]).min() > 1e-5
    # A normal has no length.
    np.testing.assert_allclose(gradient[3:6] @ p[3:6], 0, atol=1e-9 * np.abs(gradient).max())


@pytest.mark.slow
def test_backwards_as_forwards(x64):
    camera = views()["outside"]

    weight = jnp.sin(jnp.arange(90.0)).reshape(5, 6, 3)

    def loss(cut, adjoint):
        settings = jvr.Settings(0.7, termination=0, adjoint=adjoint)
        return jnp.sum(weight * jvr.render(jvr.Scene(VOLUME, TABLE, clipping=cut), camera, settings).rgb)

    cut = (jvr.ClippingPlane(MIDDLE, NORMAL), jvr.ClippingBox([0.5, 0.4, 0.3], [7.1, 7.2, 7.3]))
    floats = eqx.filter(cut, eqx.is_inexact_array)
    forwards = jax.jit(jax.jacfwd(lambda cut: loss(cut, jvr.Forward())))(floats)
    backwards = jax.jit(jax.grad(lambda cut: loss(cut, jvr.Replay())))(floats)
    for a, b in zip(jax.tree.leaves(forwards), jax.tree.leaves(backwards), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
    assert np.abs(backwards[0].normal).min() > 1e-3


VOLUME = jvr.Volume(np.random.default_rng(2).random((9, 9, 9)))
TABLE = jvr.LinearTransfer([0.1, 0.5, 0.9], [[0.2, 0.5, 0.7], [0.9, 0.4, 0.1], [0.5, 0.5, 0.5]], [0.0, 0.4, 0.1])


@pytest.mark.slow
def test_a_cut_face_is_lit_as_its_plane():
    """Lambert's cosine of an oblique plane, whatever the noise of the voxels behind it."""
    light, normal = np.array([-1.0, -0.6, -0.4]), np.array([1.0, 0.4, 0.5])
    light, normal = light / np.linalg.norm(light), normal / np.linalg.norm(normal)
    noisy = 0.6 * (1 + 1e-3 * np.random.default_rng(0).standard_normal((16, 16, 16)))
    opaque = jvr.LinearTransfer([0.3, 0.5], np.ones((2, 3)), [0.0, 20.0])
    scene = jvr.Scene(
        jvr.Volume(noisy),
        opaque,
        lights=(jvr.DirectionalLight(light),),
        shading=jvr.Lambert(0.0),
        clipping=jvr.ClippingPlane([7.5, 7.5, 7.5], normal),
    )
    camera = jvr.OrthographicCamera.look_at([60, 7.5, 7.5], [7.5, 7.5, 7.5], [0, 0, 1], 5.0, 6, 6)
    np.testing.assert_allclose(render(scene, camera, jvr.Settings(0.5)).rgb, -light @ normal, rtol=2e-4)


@pytest.mark.slow
def test_light_is_cut_as_the_eye_is():
    """Behind a black wall there is no light; where a plane cuts the wall away there is all of it: by rays and by a volume."""
    values = np.zeros((13, 13, 13))
    values[:, :, 10:] = 1.0
    values[:, :, 2:4] = 0.5
    transfer = jvr.LinearTransfer([0.0, 0.4, 0.5, 0.6, 1.0], np.zeros((5, 3)), [0.0, 0.0, 1.0, 0.0, 40.0])
    scene = jvr.Scene(
        jvr.Volume(values), transfer, lights=(jvr.DirectionalLight([0.0, 0, -1]),), scattering=jvr.SingleScattering()
    )
    camera = jvr.OrthographicCamera.look_at([6.0, 6, -20], [6.0, 6, 6], [0, 1, 0], 8.0, 3, 3)
    open_ = jvr.ClippingPlane([0.0, 0, 8.0], [0.0, 0, 1])
    for shadows in (jvr.ShadowRays(), jvr.ShadowVolume(1.0)):
        pictures = [
            render(dataclasses.replace(scene, shadows=shadows, clipping=cut), camera, SETTINGS).rgb for cut in (None, open_)
        ]
        # What the layer sends on to the eye when all of the light comes.
        lit = render(dataclasses.replace(scene, clipping=open_), camera, SETTINGS).rgb
        dark, bright = np.asarray(pictures[0]).mean() / lit.mean(), np.asarray(pictures[1]).mean() / lit.mean()
        assert dark < 0.02
        # The layer dims the light by itself, and no more than that.
        assert 0.4 < bright < 1


def test_says_what_it_cuts():
    for normal, words in ((NORMAL, "cuts all of the volume away"), (-NORMAL, "cuts nothing of the volume away")):
        cut = (jvr.ClippingBox([0, 0, 0], [5, 5, 5]), jvr.ClippingPlane(MIDDLE - 100 * NORMAL, normal))
        (remark,) = remarks_on(jvr.Scene(CUBE, SOLID, clipping=cut), None)
        assert remark.startswith(f"clipping[1] {words}")
    plan = str(jvr.plan(jvr.Scene(CUBE, SOLID, clipping=cut), SETTINGS))
    assert "rays are cut by a ClippingBox, rays are cut by a ClippingPlane" in plan


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: jvr.ClippingPlane([0, 0, 0], [0, 0, 0]), "normal must have a direction"),
        (lambda: jvr.ClippingPlane([0, 0, np.nan], [0, 0, 1]), "point must be finite"),
        (lambda: jvr.ClippingBox([0, 0, 0], [1, 1, 1], world_from_box=np.zeros((4, 4))), "world_from_box"),
    ],
)
def test_refuses_what_cuts_nothing(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_refuses_other_parts():
    scene = jvr.Scene(CUBE, SOLID)
    with pytest.raises(TypeError, match="clipping must be a "):
        assign(scene, clipping=[jvr.Lambert()])


def test_one_part_stays_one_and_several_are_saved(tmp_path):
    one = jvr.ClippingBox([0.0, 1, 2], [5.0, 6, 7])
    plane = jvr.ClippingPlane(np.array([448262.4, 5411932.9, 7.0]), NORMAL)
    oblique = jvr.ClippingBox([-1.0, -1, -1], [1.0, 1, 1], world_from_box=OBLIQUE)
    for cut in (None, one, plane, (one,), (one, plane, oblique)):
        scene = jvr.Scene(CUBE, SOLID, clipping=cut)
        jvr.save_scene(scene, tmp_path / "cut.toml")
        assert eqx.tree_equal(jvr.load_scene(tmp_path / "cut.toml"), scene)
    assert jvr.Scene(CUBE, SOLID, clipping=one).clipping is one
    assert jvr.Scene(CUBE, SOLID, clipping=[]).clipping is None
    jvr.save_scene(jvr.Scene(CUBE, SOLID, clipping=one), tmp_path / "cut.toml")
    assert "ClippingBox" not in (tmp_path / "cut.toml").read_text()


@pytest.mark.slow
def test_far_from_the_origin_a_plane_has_all_digits():
    """At UTM's coordinates single precision knows half a metre; what is left of point and corners beside it places the cut."""
    origin = np.array([759186.37, -2957195.81, 120.4])
    matrix = np.eye(4)
    matrix[:3, 3] = origin
    eye = np.array([20.0, 9, 4])
    camera = lambda o: jvr.OrthographicCamera.look_at(o + eye, o + MIDDLE, [0, 0, 1], 9.0, 6, 5)
    pictures = []
    for o, volume in ((np.zeros(3), CUBE), (origin, jvr.Volume(CUBE.values, matrix))):
        placed = np.eye(4)
        placed[:3, 3] = o + 4
        cut = jvr.ClippingPlane(o + MIDDLE + 0.13, NORMAL), jvr.ClippingBox([-3.1] * 3, [3.3] * 3, world_from_box=placed)
        pictures.append(np.asarray(render(jvr.Scene(volume, SOLID, clipping=cut), camera(o), SETTINGS).rgb))
    np.testing.assert_allclose(pictures[1], pictures[0], atol=2e-6)
