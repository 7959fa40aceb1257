"""Unknown cameras: motions against matrix exponentials, derivatives against differences in double precision, and poses that come back."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.linalg
from fits import CAMERAS, IMAGES, SETTINGS, START, TRUTH, VOLUME, both

import jvr
from jvr.fitting import coarse
from jvr.fitting.targets import targets_of
from jvr.model.motion import exponential, moved_about, moved_in_double

CENTER = np.asarray(VOLUME.center, np.float64)
NOISE = 0.01
POSES = lambda scene, cameras: [camera.world_from_camera for camera in cameras]


def expm(motion) -> np.ndarray:
    """A motion as SciPy has it, `(4, 4)`, about the origin."""
    x, y, z = np.radians(motion[:3])
    twist = np.zeros((4, 4))
    twist[:3] = [[0, -z, y, motion[3]], [z, 0, -x, motion[4]], [-y, x, 0, motion[5]]]
    return scipy.linalg.expm(twist)


def pose_of(camera) -> np.ndarray:
    matrix = np.asarray(camera.world_from_camera, np.float64)
    return matrix + np.asarray(camera.remainder.beside(camera.world_from_camera), np.float64)


def moved(pose: np.ndarray, motion) -> np.ndarray:
    """A pose after a motion about the centre of the volume."""
    at = np.eye(4)
    at[:3, 3] = CENTER
    return at @ expm(motion) @ np.linalg.inv(at) @ pose


def apart(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Degrees between two poses, and how far the centre is apart in their views."""
    turn = one[:3, :3] @ other[:3, :3].T
    angle = np.degrees(np.arcsin(min(np.linalg.norm(turn - turn.T) / np.sqrt(8), 1)))
    places = [pose[:3, :3].T @ (CENTER - pose[:3, 3]) for pose in (one, other)]
    return float(angle), float(np.linalg.norm(places[0] - places[1]))


def with_pose(camera, pose):
    return dataclasses.replace(camera, world_from_camera=pose, remainder=None)


def disturbed(turn: float, shift: float, seed: int = 0):
    """The cameras, each turned by so many degrees about the centre and moved."""
    rng, found = np.random.default_rng(seed), []
    for camera in CAMERAS:
        parts = [length * v / np.linalg.norm(v) for length, v in zip((turn, shift), rng.normal(size=(2, 3)), strict=True)]
        found.append(with_pose(camera, moved(pose_of(camera), np.concatenate(parts))))
    return tuple(found)


def noisy(seed: int, images=IMAGES):
    rng = np.random.default_rng(seed)
    return [image + rng.normal(0, NOISE, image.shape).astype(np.float32) for image in images]


def fit(cameras=CAMERAS, images=IMAGES, unknowns=POSES, scene=TRUTH, **keywords) -> jvr.FitResult:
    return jvr.fit(scene, cameras, images, unknowns=unknowns, settings=SETTINGS, progress=False, **keywords)


# --- Motions ---------------------------------------------------------------------------------------------------------

MOTIONS = [np.zeros(6), [1e-7, 0, 0, 1, 2, 3], [3, -4, 5, -10, 20, 5], [57.2, 1, 0, 2, 1, 0], [40, 41, -7, 0, 1, 3]]
MOTIONS += [[0, 179.9999, 0, 4, 5, 6], [180, 0, 0, -1, 2, 0], [100, -150, 200, 7, 0, 1]]


_with_slopes = jax.jit(lambda motion: (*exponential(motion), *jax.jacfwd(exponential)(motion)))


@pytest.mark.parametrize("motion", MOTIONS, ids=str)
def test_motions_are_matrix_exponentials(motion):
    """In both precisions, at zero and about pi, value and derivative; the differences of SciPy's are good to 1e-8."""
    with jax.enable_x64(True):
        turn, shift, of_turn, of_shift = map(np.asarray, _with_slopes(jnp.asarray(motion, float)))
    wanted = expm(motion)
    np.testing.assert_allclose(turn + np.eye(3), wanted[:3, :3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(shift, wanted[:3, 3], rtol=1e-12, atol=1e-13)
    for i, h in enumerate([1e-4] * 3 + [1e-5] * 3):
        step = h * np.eye(6)[i]
        slope = (expm(np.asarray(motion) + step) - expm(np.asarray(motion) - step)) / (2 * h)
        np.testing.assert_allclose(of_turn[:, :, i], slope[:3, :3], atol=1e-8)
        np.testing.assert_allclose(of_shift[:, i], slope[:3, 3], atol=1e-7)
    single = _with_slopes(jnp.asarray(motion, jnp.float32))[0]
    np.testing.assert_allclose(single + np.eye(3), wanted[:3, :3], atol=5e-6)


@pytest.mark.slow
def test_a_camera_that_does_not_move_is_the_same_to_the_last_digit():
    far = jvr.PerspectiveCamera.look_at((1e5 / 3, 2e5 / 7, 3.3), CENTER, (0, 0, 1), 0.02, 8, 8)
    still = moved_about(far, jnp.zeros(6), VOLUME.center)
    np.testing.assert_array_equal(pose_of(still), pose_of(far))
    there = moved_about(far, jnp.array([1.0, -2, 3, 4, 5, 6]), VOLUME.center)
    np.testing.assert_allclose(pose_of(there)[:3, :3], moved(pose_of(far), [1, -2, 3, 4, 5, 6])[:3, :3], atol=1e-8)


def test_a_moved_pose_is_rigid():
    """To the rounding of double precision, where it was given in that."""
    turn = scipy.linalg.expm(np.cross(np.eye(3), [0.3, -0.7, 0.2]))
    pose = np.block([[turn, np.array([[3.0], [30], [-5]])], [np.zeros((1, 3)), np.ones((1, 1))]])
    camera = jvr.PerspectiveCamera(pose, 30.0, 8, 8)
    found = pose_of(moved_in_double(camera, np.array([100.0, -60, 20, 1, 2, 3]), CENTER))
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=2e-14)
    np.testing.assert_allclose(found, moved(pose, [100, -60, 20, 1, 2, 3]), atol=1e-12)


# --- Derivatives -----------------------------------------------------------------------------------------------------

PINHOLES = tuple(jvr.PinholeCamera(pose_of(camera), (28.0, 27.0), 9 + i, 8) for i, camera in enumerate(CAMERAS[:2]))


def _colours(scene, poses, focal, points):
    """Pictures in double precision of cameras in double precision, one number after the other."""
    with jax.enable_x64(True):
        scene = jax.tree.map(lambda x: jnp.asarray(x, float), scene)
        found = []
        for camera, pose, point in zip(PINHOLES, poses, points, strict=True):
            camera = jvr.PinholeCamera(pose, jnp.asarray(focal, float), camera.width, camera.height, principal_point=point)
            found.append(np.ravel(_draw(scene, camera)))
    return np.concatenate(found)


_draw = jax.jit(lambda scene, camera: jvr.render(scene, camera, SETTINGS).rgb)


@pytest.fixture(scope="module")
def pictures():
    points = [np.array([4.0, 4.5]), np.array([5.6, 3.7])]
    return points, [
        np.asarray(_draw(TRUTH, dataclasses.replace(c, principal_point=p))) for c, p in zip(PINHOLES, points, strict=True)
    ]


@pytest.mark.slow
def test_rows_of_cameras_are_those_of_differences_in_double_precision(pictures):
    """`J^T J` of two views: both poses, a focal length that they share, one principal point and the background: rays enter a medium that is
    not empty at its border, and the pictures have two sizes."""
    points, images = pictures
    cameras = tuple(dataclasses.replace(c, principal_point=p) for c, p in zip(PINHOLES, points, strict=True))
    unknowns = lambda s, c: (
        [x.world_from_camera for x in c],
        s.background,
        jvr.shared([x.focal_lengths for x in c]),
        c[1].principal_point,
    )
    result = fit(cameras, noisy(0, images), unknowns, max_steps=0)
    assert result.unknowns[2:] == ("background", "shared(cameras.focal_lengths)", "cameras[1].principal_point")
    poses, focal = [pose_of(camera) for camera in cameras], np.array([28.0, 27.0])

    def colours(x):
        moved_poses = [moved(pose, part) for pose, part in zip(poses, (x[:6], x[6:12]), strict=True)]
        scene = eqx.tree_at(lambda s: s.background, TRUTH, np.asarray(TRUTH.background, np.float64) + x[12:15])
        return _colours(scene, moved_poses, focal + x[15:17], [points[0], points[1] + x[17:]])

    h = 1e-4
    rows = np.stack([(colours(h * e) - colours(-h * e)) / (2 * h) for e in np.eye(19)], axis=1)
    wanted, found = rows.T @ rows, result.information * result.stats.residual_variance
    scale = np.sqrt(np.diag(wanted))
    # Positions in a grid of a dozen voxels are good to 1e-6, slopes of the trilinear pieces change at their faces.
    np.testing.assert_allclose(found / scale / scale[:, None], wanted / scale / scale[:, None], atol=2e-4)


@pytest.mark.slow
def test_gradients_go_through_cameras():
    """What solvers of gradients see: the value's derivative in a motion is that of the normal equations."""
    result = fit(disturbed(2.0, 0.5), solver=optx.BFGS(rtol=1e-4, atol=1e-6), max_steps=25)
    assert result.history[-1].psnr > 40
    assert max(apart(pose_of(a), pose_of(b))[0] for a, b in zip(result.cameras, CAMERAS, strict=True)) < 0.2


# --- Fits ------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_poses_come_back():
    start = disturbed(4.0, 1.0)
    result = fit(start)
    assert result.unknowns == tuple(f"cameras[{i}].world_from_camera" for i in range(3))
    ends = [apart(pose_of(a), pose_of(b)) for a, b in zip(result.cameras, CAMERAS, strict=True)]
    np.testing.assert_allclose(ends, 0, atol=2e-3)
    for camera in result.cameras:
        turn = pose_of(camera)[:3, :3]
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=2e-7)
    assert result.history[-1].psnr > 70
    assert [np.shape(errors) for errors in result.standard_errors] == [(6,)] * 3
    assert "3 poses: standard error" in result._repr_html_()


@pytest.mark.slow
def test_poses_come_back_together_with_colours():
    start = eqx.tree_at(lambda s: s.transfer.rgb, TRUTH, jnp.full_like(TRUTH.transfer.rgb, 0.5))
    unknowns = lambda s, cameras: (s.transfer.rgb, cameras[0].world_from_camera, cameras[2].world_from_camera)
    result = fit((*disturbed(3.0, 0.7)[:1], CAMERAS[1], disturbed(3.0, 0.7)[2]), IMAGES, unknowns, start)
    ends = [apart(pose_of(a), pose_of(b)) for a, b in zip(result.cameras, CAMERAS, strict=True)]
    np.testing.assert_allclose(ends, 0, atol=0.02)
    np.testing.assert_array_equal(pose_of(result.cameras[1]), pose_of(CAMERAS[1]))
    np.testing.assert_allclose(result.scene.transfer.rgb, TRUTH.transfer.rgb, atol=0.01)


@pytest.mark.slow
def test_one_angle_of_view_for_all():
    wrong = [dataclasses.replace(camera, fov_y=33.0) for camera in CAMERAS]
    result = fit(wrong, unknowns=lambda s, cameras: jvr.shared([c.fov_y for c in cameras]))
    assert result.unknowns == ("shared(cameras.fov_y)",)
    np.testing.assert_allclose([camera.fov_y for camera in result.cameras], 30.0, atol=1e-3)
    assert np.shape(result.standard_errors) == ()


@pytest.mark.slow
def test_a_rig_moves_as_one():
    motion = [2.0, -1.5, 2.5, 0.5, -0.3, 0.4]
    start = [with_pose(camera, moved(pose_of(camera), motion)) for camera in CAMERAS]
    result = fit(start, unknowns=lambda s, cameras: jvr.shared(POSES(s, cameras)))
    ends = [apart(pose_of(a), pose_of(b)) for a, b in zip(result.cameras, CAMERAS, strict=True)]
    np.testing.assert_allclose(ends, 0, atol=2e-3)
    assert np.shape(result.standard_errors) == (6,)


@pytest.mark.slow
def test_a_fit_goes_on_from_its_checkpoint(tmp_path):
    start, file = disturbed(4.0, 1.0), tmp_path / "fit.npz"
    whole = fit(start, max_steps=4)
    fit(start, max_steps=2, checkpoint=file)
    resumed = fit(start, max_steps=4, checkpoint=file, resume=True)
    np.testing.assert_allclose(pose_of(resumed.cameras[0]), pose_of(whole.cameras[0]), atol=1e-6)
    with pytest.raises(ValueError, match="cameras changed since"):
        fit(CAMERAS, max_steps=4, checkpoint=file, resume=True)


@pytest.mark.slow
def test_what_names_no_camera_is_the_fit_that_it_was():
    """The cameras in the function's reach change nothing, not even a digit."""
    one, other = (
        fit(CAMERAS, IMAGES, unknowns, START, max_steps=2) for unknowns in (lambda s: s.transfer.rgb, lambda s, c: s.transfer.rgb)
    )
    np.testing.assert_array_equal(one.scene.transfer.rgb, other.scene.transfer.rgb)
    assert one.stats.kept_bytes == other.stats.kept_bytes > 0
    assert one.cameras == other.cameras


@pytest.mark.slow
def test_the_next_view_adds_to_what_unknown_poses_leave():
    """The information about a scene is less where poses are found as well, so that a view adds more."""
    known = fit(CAMERAS[:1], noisy(1)[:1], both, max_steps=0)
    unknown = fit(CAMERAS[:1], noisy(1)[:1], lambda s, c: (both(s), c[0].world_from_camera), max_steps=0)
    gains = [jvr.next_view(result, [CAMERAS[1]], SETTINGS)[0].gain for result in (known, unknown)]
    assert 0 < gains[0] < gains[1]
    with pytest.raises(ValueError, match="cameras alone"):
        jvr.next_view(fit(CAMERAS[:1], IMAGES[:1], max_steps=0), [CAMERAS[1]], SETTINGS)


@pytest.mark.slow
def test_standard_errors_of_poses_cover_the_truth():
    """Of 60 fits with fresh noise 68 % of the true motions lie within one standard error: in the world's axes, about the centre. Three
    cameras at a time are as many experiments; the binomial spread of 60 x 18 numbers that are not all independent is about 3 %."""
    within = []
    for seed in range(60):
        result = fit(images=noisy(seed))
        for camera, truth, errors in zip(result.cameras, CAMERAS, result.standard_errors, strict=True):
            step = pose_of(truth) @ np.linalg.inv(pose_of(camera))
            turn = np.degrees([step[2, 1] - step[1, 2], step[0, 2] - step[2, 0], step[1, 0] - step[0, 1]]) / 2
            shift = step[:3, :3] @ CENTER + step[:3, 3] - CENTER
            within.append(np.abs(np.concatenate([turn, shift])) < np.asarray(errors))
    assert 0.62 < np.mean(within) < 0.74
    assert np.all(np.abs(np.mean(within, axis=0) - 0.68) < 0.12)


@pytest.mark.slow
def test_another_shader_has_the_rows_of_another_way():
    """Lit scenes are replayed whole; with a light that shows nothing they are those of the plain medium's own way."""
    lit = dataclasses.replace(TRUTH, shading=jvr.Lambert(ambient=1.0, diffuse=0.0), lights=(jvr.AmbientLight(1.0),))
    plain, shaded = (fit(images=noisy(2), scene=scene, max_steps=0) for scene in (TRUTH, lit))
    scale = np.sqrt(np.diag(plain.information))
    ratio = shaded.stats.residual_variance / plain.stats.residual_variance
    np.testing.assert_allclose(ratio, 1, rtol=1e-4)
    np.testing.assert_allclose((shaded.information - plain.information) / scale / scale[:, None], 0, atol=1e-3)


# --- The coarse start ------------------------------------------------------------------------------------------------


def test_pictures_and_volumes_are_averaged_alike():
    image = np.random.default_rng(0).random((15, 16, 3))
    weight = np.ones((15, 16))
    weight[4, 5] = 0
    camera = dataclasses.replace(CAMERAS[0], width=16, height=15)
    (found,), (weighed,), (middle,) = coarse.averaged([camera], targets_of([camera], [image], [weight], np.zeros(3)), 3)
    assert middle.sum() == 25
    # Squares of columns 0 ... 14, whose middles are pixels 1, 4, ...
    np.testing.assert_allclose(found[1, 1], image[:3, :3].mean(axis=(0, 1)), rtol=1e-6)
    square = image[3:6, 3:6].reshape(9, 3)
    np.testing.assert_allclose(found[4, 4], np.delete(square, 5, axis=0).mean(axis=0), rtol=1e-6)
    assert weighed[4, 4] == pytest.approx(8 / 9)
    # A ramp stays what it is, wherever in the world, up to the border.
    n = (17, 33, 20)
    ramp = jvr.Volume(
        np.add.outer(np.add.outer(np.arange(n[0]), 2 * np.arange(n[1])), 3 * np.arange(n[2])), VOLUME.world_from_grid
    )
    flat = jvr.OrthographicCamera.look_at((0, 0, 50), (0, 0, 0), (0, 1, 0), 15 * 0.7, 16, 15)
    blurred = coarse.blurred_volume(jvr.Scene(ramp, TRUTH.transfer), [flat], 3)
    # Three pixels are 2.1, voxels 1, 1.2 and 0.9.
    assert blurred.shape == (9, 17, 10)
    point = lambda volume: volume.sample(volume.grid_from_world(tuple(jnp.array([7.0, 20.0, 8.0]))))
    np.testing.assert_allclose(point(blurred), point(ramp), rtol=1e-5)
    assert coarse.factors([camera], 3) == ()
    assert coarse.factors([dataclasses.replace(camera, width=80, height=75)], 3) == (9, 3)


# --- Bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unknowns", "problem"),
    [
        (lambda s, c: c[0].focal_lengths, "fov_y"),
        (lambda s, c: c[3].world_from_camera, "its 3 cameras have not"),
        (lambda s, c: c[0].world_from_camera + 1, "arrays of the scene itself and of the cameras"),
        (lambda s, c: (c[0].fov_y, c[0].fov_y), "an array twice"),
        (lambda s, c: jvr.shared([c[0].fov_y, s.background]), "shared takes one array of each of several cameras"),
        (lambda s, c: jvr.shared([]), "at least one array"),
        (lambda s, c: None, "returned None"),
    ],
)
def test_names_that_cameras_have_not_are_refused(unknowns, problem):
    with pytest.raises(ValueError, match=problem):
        fit(unknowns=unknowns)


@pytest.mark.slow
def test_what_cannot_be_found_is_refused():
    away = jvr.PerspectiveCamera.look_at((30, 0, 0), (60, 0, 0), (0, 0, 1), 30.0, 16, 15)
    with pytest.raises(ValueError, match=r"camera 1 is unknown and sees nothing of the volume.*look_at its centre"):
        fit((CAMERAS[0], away, CAMERAS[2]))
    with pytest.raises(ValueError, match="3 images for 2 cameras"):
        fit(CAMERAS[:2])
    with pytest.raises(ValueError, match="DSSIM compares whole images of known cameras"):
        fit(solver=optx.BFGS(1e-3, 1e-3), loss=jvr.DSSIM())
    different = [dataclasses.replace(camera, fov_y=30.0 + i) for i, camera in enumerate(CAMERAS)]
    with pytest.raises(ValueError, match=r"cameras\[0\].fov_y and cameras\[1\].fov_y are shared and start at 30.0 and 31.0"):
        fit(different, unknowns=lambda s, c: jvr.shared([x.fov_y for x in c]))
    with pytest.raises(ValueError, match="coarse_levels must be a whole number"):
        fit(coarse_levels=-1)
