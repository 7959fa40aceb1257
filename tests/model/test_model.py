"""Constructors and their errors, cameras, transfer functions and the geometry of a volume."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import OBLIQUE, affine, gaussian_transfer, linear_transfer, lut_transfer, voxels

import jvr
from jvr.model.camera import look_at

RGB, RAMP = [[0.0, 0.1, 0.2], [1.0, 0.9, 0.8]], [0.0, 1.0]
EYE = np.eye(4)
FLAT = np.diag([1.0, 1.0, 0.0, 1.0])
SHEARED = np.array([[1, 0, 1, 0], [0, 1, 1, 0], [0, 0, 1e-9, 0], [0, 0, 0, 1.0]])


def _set(matrix, index, value):
    matrix = matrix.copy()
    matrix[index] = value
    return matrix


# What is called, the type of its error, and what the message must say: what is wrong or what would be right.
ERRORS = {
    "volume of 2 axes": (lambda: jvr.Volume(np.zeros((3, 4))), ValueError, "three non-empty axes"),
    "empty volume": (lambda: jvr.Volume(np.zeros((3, 0, 4))), ValueError, "three non-empty axes"),
    "complex voxels": (lambda: jvr.Volume(np.zeros((2, 2, 2), complex)), TypeError, "real or integer"),
    "infinite voxels": (lambda: jvr.Volume(np.full((2, 2, 2), np.inf, np.float32)), ValueError, "must not be infinite"),
    "only missing voxels": (lambda: jvr.Volume(np.full((2, 2, 2), -2000), missing=-2000), ValueError, "every voxel is missing"),
    "wide integers": (lambda: jvr.Volume(np.full((2, 2, 2), 2**40)), ValueError, "do not fit 32 bits"),
    "huge doubles": (lambda: jvr.Volume(np.full((2, 2, 2), 1e300)), ValueError, "exceed the range of float32"),
    "slope of zero": (lambda: jvr.Volume(voxels(), slope=0.0), ValueError, "slope must be finite and not 0"),
    "slope NaN": (lambda: jvr.Volume(voxels(), slope=np.nan), ValueError, "slope must be finite"),
    "intercept infinite": (lambda: jvr.Volume(voxels(), intercept=np.inf), ValueError, "intercept must be finite"),
    "spacing zero": (lambda: jvr.Volume(voxels(), FLAT), ValueError, "spacing must be positive"),
    "axes in one plane": (lambda: jvr.Volume(voxels(), SHEARED), ValueError, "singular"),
    "3x3 affine": (lambda: jvr.Volume(voxels(), np.eye(3)), ValueError, "must be (4, 4)"),
    "non-finite affine": (lambda: jvr.Volume(voxels(), _set(EYE, (0, 3), np.nan)), ValueError, "finite"),
    "projective": (lambda: jvr.Volume(voxels(), _set(EYE, (3, 0), 0.5)), ValueError, "0 0 0 1"),
    "slope of 2": (lambda: jvr.Volume(voxels(), slope=[1.0, 2.0]), ValueError, "slope"),
    "empty clipping box": (lambda: jvr.ClippingBox([0, 0, 0], [1, 0, 1]), ValueError, "lower < upper"),
    "1 position": (lambda: jvr.LinearTransfer([0.0], RGB[:1], [1.0]), ValueError, "at least 2 entries"),
    "positions fall": (lambda: jvr.LinearTransfer([1.0, 0.0], RGB, RAMP), ValueError, "strictly increasing"),
    "positions repeat": (lambda: jvr.LinearTransfer([1.0, 1.0], RGB, RAMP), ValueError, "remove duplicates"),
    "position NaN": (lambda: jvr.LinearTransfer([0.0, np.nan], RGB, RAMP), ValueError, "finite"),
    "3 extinctions for 2": (lambda: jvr.LinearTransfer([0.0, 1.0], RGB, [0, 1, 2]), ValueError, "must be (2) or (2, 3)"),
    "negative extinction": (lambda: jvr.LinearTransfer([0.0, 1.0], RGB, [0, -1]), ValueError, "not negative"),
    "infinite extinction": (lambda: jvr.LinearTransfer([0.0, 1.0], RGB, [0, np.inf]), ValueError, "finite"),
    "colour NaN": (lambda: jvr.LinearTransfer([0.0, 1.0], [[0, 0, np.nan], RGB[1]], RAMP), ValueError, "rgb must be finite"),
    "colour RGBA": (lambda: jvr.LinearTransfer([0.0, 1.0], np.zeros((2, 4)), RAMP), ValueError, "must be (2, 3)"),
    "text": (lambda: jvr.LinearTransfer(["low", "high"], RGB, RAMP), TypeError, "positions must be an array of real numbers"),
    "1 entry": (lambda: jvr.LutTransfer(RGB[:1], [1.0], [0.0, 1.0]), ValueError, "at least 2 entries"),
    "domain falls": (lambda: jvr.LutTransfer(RGB, RAMP, [1.0, 1.0]), ValueError, "low < high"),
    "no Gaussian": (
        lambda: jvr.GaussianTransfer(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, 3))),
        ValueError,
        "must not be empty",
    ),
    "width zero": (lambda: jvr.GaussianTransfer([0.0], [0.0], [1.0], RGB[:1]), ValueError, "width must be positive"),
    "negative height": (lambda: jvr.GaussianTransfer([0.0], [1.0], [-1.0], RGB[:1]), ValueError, "not negative"),
    "fov 180": (lambda: jvr.PerspectiveCamera(EYE, 180.0, 4, 3), ValueError, "between 0 and 180"),
    "no pixels": (lambda: jvr.PerspectiveCamera(EYE, 30.0, 0, 3), ValueError, "width must be a whole number of at least 1"),
    "no extent": (lambda: jvr.OrthographicCamera(EYE, 0.0, 4, 3), ValueError, "height_world must be positive"),
    "eye is target": (lambda: look_at([1, 1, 1], [1, 1, 1], [0, 0, 1]), ValueError, "apart from its target"),
    "up along the view": (lambda: look_at([0, 0, 5], [0, 0, 0], [0, 0, 1]), ValueError, "choose another up"),
    "up zero": (lambda: look_at([0, 0, 5], [0, 0, 0], [0, 0, 0]), ValueError, "up"),
    "no cameras": (lambda: jvr.orbit([0, 0, 0], 1.0, 0, 30.0, 4, 3), ValueError, "at least 1"),
    "background of 4": (
        lambda: jvr.Scene(jvr.Volume(voxels()), linear_transfer(), background=[0] * 4),
        ValueError,
        "must be (3)",
    ),
    "step zero": (lambda: jvr.Settings(0.0), ValueError, "step must be positive"),
    "step infinite": (lambda: jvr.Settings(np.inf), ValueError, "step must be positive"),
    "termination 1": (lambda: jvr.Settings(termination=1.0), ValueError, "in [0, 1)"),
    "half a camera": (lambda: jvr.fibonacci_sphere((0, 0, 0), 9.0, 1.5, 30, 4, 4), ValueError, "count must be a whole number"),
    "cameras at their centre": (lambda: jvr.orbit((0, 0, 0), 0.0, 2, 30, 4, 4), ValueError, "radius must be positive"),
    "no axis": (lambda: jvr.orbit((0, 0, 0), 9, 2, 30, 4, 4, axis=(0, 0, 0)), ValueError, "axis must have a direction"),
    "disc of no size": (
        lambda: jvr.EnvironmentLight.disc((0, 0, 1), 0),
        ValueError,
        "half_angle must be above 0 and at most 180",
    ),
    "disc of radiance below zero": (lambda: jvr.EnvironmentLight.disc((0, 0, 1), 9, -1), ValueError, "radiance must be finite"),
    "parts of nothing": (lambda: jvr.PreIntegrated(0), ValueError, "parts must be a whole number of at least 1"),
    "tile zero": (lambda: jvr.Settings(tile=0), ValueError, "tile must be a whole number of at least 1"),
    "window zero": (lambda: jvr.presets.window_level(0.0, 40.0), ValueError, "window must be positive"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_errors_say_what_is_wrong_in_one_line(name):
    call, kind, says = ERRORS[name]
    with pytest.raises(kind) as caught:
        call()
    # Not the run-time check of annotations, which is there in tests alone.
    assert type(caught.value) is kind
    message = str(caught.value)
    # A shape of one axis prints as (3,).
    assert says in message.replace(",)", ")")
    assert "\n" not in message
    assert len(message) < 200


def test_constructors_work_under_tracing():
    """Values are unknown there, so nothing is raised, not even for nonsense; shapes are still checked."""
    jax.eval_shape(lambda p: jvr.LinearTransfer(p, RGB, RAMP), jnp.array([1.0, 0.0]))
    with pytest.raises(ValueError, match="must be"):
        jax.eval_shape(lambda p: jvr.LinearTransfer(p, RGB, RAMP), jnp.zeros((2, 2)))


def test_integers_become_floats_but_voxels_stay():
    transfer = jvr.LinearTransfer([0, 1], [[0, 0, 0], [1, 1, 1]], [0, 1])
    assert transfer.positions.dtype == transfer.rgb.dtype == transfer.sigma_t.dtype == jnp.float32
    assert jvr.Volume(np.zeros((2, 2, 2), np.int16)).values.dtype == jnp.int16
    assert jvr.Volume(np.zeros((2, 2, 2))).values.dtype == jnp.float32


def test_settings_are_static_and_hashable():
    assert not jax.tree.leaves(jvr.Settings())
    assert hash(jvr.Settings(0.5)) == hash(jvr.Settings(0.5))
    assert jvr.Settings(0.5) == jvr.Settings(0.5) != jvr.Settings(0.25)


@pytest.mark.parametrize("make", [linear_transfer, lut_transfer], ids=["linear", "table"])
@pytest.mark.parametrize("coloured", [False, True])
def test_a_table_is_exact_at_its_entries_and_clamps(make, coloured, x64):
    transfer = make(coloured=coloured)
    positions = np.asarray(transfer.positions)
    for i, s in [*enumerate(positions), (0, -1e9), (0, positions[0] - 1e-9), (-1, positions[-1] + 1e-9), (-1, 1e9)]:
        rgb, sigma_t, _ = transfer.evaluate(jnp.asarray(s))
        # A position computed by linspace may be a rounding away from where the entry sits.
        np.testing.assert_allclose(rgb, transfer.rgb[i], atol=1e-14)
        np.testing.assert_allclose(sigma_t, np.atleast_1d(transfer.sigma_t[i]), atol=1e-14)
    middle = (positions[1] + positions[2]) / 2
    np.testing.assert_allclose(transfer.evaluate(jnp.asarray(middle)).rgb, (transfer.rgb[1] + transfer.rgb[2]) / 2, rtol=1e-13)
    np.testing.assert_allclose(transfer.coordinate(jnp.asarray(middle)), 1.5, rtol=1e-13)


def test_control_points_are_exact_in_float32():
    transfer = linear_transfer()
    for i, s in enumerate(transfer.positions):
        np.testing.assert_array_equal(jnp.stack(transfer.evaluate(s).rgb), transfer.rgb[i])
        np.testing.assert_array_equal(transfer.evaluate(s).sigma_t[0], transfer.sigma_t[i])


def test_gaussians(x64):
    transfer = gaussian_transfer()
    rgb, (sigma_t,), _ = transfer.evaluate(jnp.asarray(0.43))
    each = np.asarray(transfer.height) * np.exp(-0.5 * ((0.43 - np.asarray(transfer.center)) / np.asarray(transfer.width)) ** 2)
    np.testing.assert_allclose(sigma_t, each.sum(), rtol=1e-14)
    np.testing.assert_allclose(rgb, each @ np.asarray(transfer.rgb) / each.sum(), rtol=1e-14)
    # Far away the nearest in units of its width decides, though every extinction underflows.
    far = transfer.evaluate(jnp.asarray(1e4))
    assert far.sigma_t[0] == 0
    np.testing.assert_allclose(far.rgb, transfer.rgb[2], rtol=1e-12)


def test_volume_geometry(x64):
    volume = jvr.Volume(voxels(), OBLIQUE)
    last = np.array(volume.shape) - 1
    corners = np.array([[i, j, k] for i in (0, last[0]) for j in (0, last[1]) for k in (0, last[2])], float)
    world = corners @ OBLIQUE[:3, :3].T + OBLIQUE[:3, 3]
    np.testing.assert_allclose(volume.center, world.mean(0), rtol=1e-14)
    np.testing.assert_allclose(volume.radius, np.linalg.norm(world - world.mean(0), axis=1).max(), rtol=1e-14)
    np.testing.assert_allclose(volume.spacing, [1.0, 2.1, 1.4], rtol=1e-14)
    back = jnp.stack(volume.grid_from_world(tuple(jnp.asarray(world.T))))
    np.testing.assert_allclose(back, corners.T, atol=1e-13)
    moved = jnp.stack(volume.grid_from_world(tuple(jnp.asarray(OBLIQUE[:3, :3] @ [1.0, 2.0, 3.0])), direction=True))
    np.testing.assert_allclose(moved, [1, 2, 3], rtol=1e-13)


def test_a_volume_one_voxel_thick_reaches_half_a_voxel_each_way(x64):
    volume = jvr.Volume(voxels((5, 1, 7)), affine((1.0, 3.0, 1.0)))
    assert volume.domain == ((0.0, -0.5, 0.0), (4.0, 0.5, 6.0))
    np.testing.assert_allclose(volume.center, [2, 0, 3])
    np.testing.assert_allclose(volume.radius, np.sqrt(4 + 1.5**2 + 9))


@pytest.mark.parametrize("spacing", [(1e-3, 1e-3, 1.0), (1e6, 1.0, 1e-3), (1e-7, 1e-7, 2e-7), (1e12, 1e12, 1e12)])
def test_grid_from_world_keeps_its_digits_in_float32(spacing):
    matrix = affine(spacing, angles=(0.3, -0.8, 0.5))
    volume = jvr.Volume(voxels(), matrix)
    matrix = np.asarray(volume.world_from_grid, float)
    world = np.float32(matrix[:3, :3] @ [1.0, 2.0, 3.0])
    expected = np.linalg.solve(matrix[:3, :3], world.astype(float))
    found = np.array([float(x) for x in volume.grid_from_world(tuple(jnp.asarray(world)))])
    # World components are sums over axes of very different lengths: their rounding counts in units of the shortest axis.
    conditioning = np.abs(np.linalg.inv(matrix[:3, :3])) @ np.abs(world)
    np.testing.assert_array_less(np.abs(found - expected), 1e-6 * conditioning)


def test_look_at(x64):
    eye, target = np.array([3.0, -2.0, 5.0]), np.array([1.0, 4.0, 2.0])
    pose = np.asarray(look_at(eye, target, [0.2, 0.1, 2.0]))
    rotation = pose[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    np.testing.assert_allclose(-rotation[:, 2], (target - eye) / np.linalg.norm(target - eye))
    np.testing.assert_allclose(pose[:3, 3], eye)
    # Up is in the plane of y and z, on the side of y.
    np.testing.assert_allclose(rotation[:, 0] @ [0.2, 0.1, 2.0], 0, atol=1e-15)
    assert rotation[:, 1] @ [0.2, 0.1, 2.0] > 0


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_rays_pass_through_pixel_centres(kind, x64):
    """Projecting the rays back by hand: row 0 on top, column 0 on the left, square pixels."""
    width, height = 6, 4
    if kind == "perspective":
        camera = jvr.PerspectiveCamera(OBLIQUE_POSE, 50.0, width, height)
        half = np.tan(np.deg2rad(25.0))
    else:
        camera = jvr.OrthographicCamera(OBLIQUE_POSE, 3.0, width, height)
        half = 1.5
    origin, direction = (np.stack(v, -1) for v in camera.rays(jnp.arange(width * height)))
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1)
    point = (origin + 2.5 * direction - OBLIQUE_POSE[:3, 3]) @ OBLIQUE_POSE[:3, :3]
    plane = point[:, :2] / (-point[:, 2:] if kind == "perspective" else 1)
    columns = (plane[:, 0] / half * height / width + 1) / 2 * width
    rows = (1 - plane[:, 1] / half) / 2 * height
    np.testing.assert_allclose(columns.reshape(height, width), np.tile(np.arange(width) + 0.5, (height, 1)), atol=1e-12)
    np.testing.assert_allclose(rows.reshape(height, width), np.tile(np.arange(height)[:, None] + 0.5, (1, width)), atol=1e-12)
    assert np.all(point[:, 2] < 0)


OBLIQUE_POSE = affine((1, 1, 1), (3.0, 4.0, -5.0), (0.4, 1.1, -0.7))


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 1, 0), (1.0, -2.0, 0.5)])
def test_orbit(axis, x64):
    center, radius = np.array([1.0, 2.0, 3.0]), 7.0
    cameras = jvr.orbit(center, radius, 5, 30.0, 4, 3, axis=axis)
    eyes = np.array([camera.world_from_camera[:3, 3] for camera in cameras]) - center
    unit = np.array(axis) / np.linalg.norm(axis)
    np.testing.assert_allclose(np.linalg.norm(eyes, axis=1), radius)
    np.testing.assert_allclose(eyes @ unit, 0, atol=1e-13)
    np.testing.assert_allclose(np.sum(eyes * np.roll(eyes, 1, axis=0), axis=1) / radius**2, np.cos(2 * np.pi / 5))
    for camera, eye in zip(cameras, eyes, strict=True):
        np.testing.assert_allclose(camera.world_from_camera[:3, 2], eye / radius, atol=1e-14)
        np.testing.assert_allclose(camera.world_from_camera[:3, 1], unit, atol=1e-14)


@pytest.mark.parametrize("count", [1, 2, 8, 100])
def test_fibonacci_sphere(count, x64):
    center, radius = np.array([1.0, 2.0, 3.0]), 7.0
    cameras = jvr.fibonacci_sphere(center, radius, count, 30.0, 4, 3)
    directions = (np.array([camera.world_from_camera[:3, 3] for camera in cameras]) - center) / radius
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    for camera, direction in zip(cameras, directions, strict=True):
        np.testing.assert_allclose(camera.world_from_camera[:3, 2], direction, atol=1e-14)
        assert np.isfinite(camera.world_from_camera).all()
    if count > 2:
        # Spread evenly: nobody's nearest neighbour is nearer than 0.8 of the spacing of `count` equal caps.
        cosines = directions @ directions.T - 2 * np.eye(count)
        assert np.arccos(cosines.max()) > 0.8 * np.sqrt(4 * np.pi / count)
        np.testing.assert_allclose(directions.mean(0), 0, atol=1.2 / count)


def test_look_at_is_differentiable_and_traceable(x64):
    point = lambda eye: jvr.PerspectiveCamera.look_at(eye, [0.0, 1.0, 0.0], [0, 0, 1], 40.0, 3, 2).rays(jnp.arange(6))[1][0]
    eye, h = jnp.array([3.0, -2.0, 1.0]), 1e-6
    jacobian = jax.jit(jax.jacfwd(point))(eye)
    for i in range(3):
        step = h * jnp.eye(3)[i]
        np.testing.assert_allclose(jacobian[:, i], (point(eye + step) - point(eye - step)) / (2 * h), atol=1e-9)


def test_presets():
    for preset in (jvr.presets.ct_bone(), jvr.presets.ct_soft_tissue(), jvr.presets.ct_lung(), jvr.presets.ct_vessels()):
        assert preset.sigma_t[0] == 0
        assert preset.sigma_t.max() > 0
        assert np.all((preset.rgb >= 0) & (preset.rgb <= 1))
    ramp = jvr.presets.window_level(400.0, 40.0, sigma_t=0.2, rgb=(1.0, 0.5, 0.25))
    for s, rgb, sigma in ((-160, 0.5, 0.0), (-1000, 0.5, 0.0), (40, 0.75, 0.1), (240, 1.0, 0.2), (3000, 1.0, 0.2)):
        classified = ramp.evaluate(jnp.array(float(s)))
        np.testing.assert_allclose(classified.rgb, rgb * np.array([1.0, 0.5, 0.25]), rtol=1e-6)
        np.testing.assert_allclose(classified.sigma_t[0], sigma, rtol=1e-6)
    # CT air is transparent, bone is not.
    assert jvr.presets.ct_bone().evaluate(jnp.array(-1000.0)).sigma_t[0] == 0
    assert jvr.presets.ct_bone().evaluate(jnp.array(1200.0)).sigma_t[0] > 0.4
