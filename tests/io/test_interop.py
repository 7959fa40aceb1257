"""Cameras of other programs: what their own projections say of points along our rays."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import linear_transfer, voxels
from scipy.spatial.transform import Rotation

import jvr
from jvr.io import interop

WIDTH, HEIGHT = 40, 26
EYE, TARGET, UP = np.array([30.0, -45.0, 18.0]), np.array([2.0, 1.0, -3.0]), np.array([0.1, 0.2, 1.0])


def seen(camera, distances=(3.0, 60.0)):
    """Points along the rays of some pixels: `(2 x pixels, 3)`, and the places of their centres in the picture, `(column, row)`."""
    pixels = np.array([0, WIDTH - 1, 5 * WIDTH + 17, WIDTH * HEIGHT - 1])
    origin, direction = (np.stack(x, -1).astype(np.float64) for x in camera.rays(jnp.asarray(pixels)))
    places = np.stack([pixels % WIDTH + 0.5, pixels // WIDTH + 0.5], -1)
    return np.concatenate([origin + d * direction for d in distances]), np.tile(places, (len(distances), 1))


def of_vtk(**changes):
    vtk = pytest.importorskip("vtk")
    camera = vtk.vtkCamera()
    camera.SetPosition(*EYE)
    camera.SetFocalPoint(*TARGET)
    camera.SetViewUp(*UP)
    for name, value in changes.items():
        getattr(camera, f"Set{name}")(*value if isinstance(value, tuple) else (value,))
    return camera


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"ViewAngle": 23.0}, jvr.PerspectiveCamera),
        ({"ViewAngle": 23.0, "UseHorizontalViewAngle": True}, jvr.PerspectiveCamera),
        ({"ViewAngle": 50.0, "WindowCenter": (0.3, -0.2)}, jvr.PinholeCamera),
        ({"ParallelProjection": True, "ParallelScale": 17.0}, jvr.OrthographicCamera),
        ({"ParallelProjection": True, "ParallelScale": 17.0, "WindowCenter": (0.3, -0.2)}, jvr.OrthographicCamera),
        ({"ViewAngle": 30.0, "Roll": 25.0}, jvr.PerspectiveCamera),
    ],
)
def test_cameras_of_vtk_see_what_vtk_projects(changes, kind):
    theirs = of_vtk(**changes)
    ours = interop.from_vtk(theirs, WIDTH, HEIGHT)
    assert type(ours) is kind
    points, places = seen(ours)
    matrix = theirs.GetCompositeProjectionTransformMatrix(WIDTH / HEIGHT, -1, 1)
    projected = np.array([matrix.MultiplyPoint((*point, 1.0)) for point in points])
    window = projected[:, :2] / projected[:, 3:]
    expected = np.stack([(window[:, 0] + 1) * WIDTH / 2, (1 - window[:, 1]) * HEIGHT / 2], -1)
    np.testing.assert_allclose(places, expected, atol=2e-4)


def test_a_camera_in_numbers_is_that_of_vtk():
    said = {"position": EYE, "focal_point": TARGET, "view_up": UP}
    for more, changes in [
        ({"view_angle": 23.0}, {"ViewAngle": 23.0}),
        ({"parallel_scale": 7.0}, {"ParallelProjection": True, "ParallelScale": 7.0}),
        ({}, {}),
    ]:
        ours, theirs = interop.from_vtk(said | more, 8, 6), interop.from_vtk(of_vtk(**changes), 8, 6)
        for a, b in zip(ours.rays(jnp.arange(48)), theirs.rays(jnp.arange(48)), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)
        again = interop.from_vtk(interop.to_vtk(ours), 8, 6)
        np.testing.assert_allclose(again.world_from_camera, ours.world_from_camera, atol=1e-6)


def test_a_camera_in_ras_looks_at_the_same_patient():
    flip = np.array([-1.0, -1.0, 1.0])
    ras = {"position": EYE * flip, "focal_point": TARGET * flip, "view_up": UP * flip}
    lps = {"position": EYE, "focal_point": TARGET, "view_up": UP}
    ours = interop.from_vtk(ras, 8, 6, ras=True).world_from_camera
    np.testing.assert_allclose(ours, interop.from_vtk(lps, 8, 6).world_from_camera, atol=1e-6)


@pytest.mark.parametrize("by_vector", [False, True])
@pytest.mark.parametrize("centred", [False, True])
def test_cameras_of_opencv_see_what_its_formula_says(by_vector, centred):
    """u = f_x X / Z + c_x, v = f_y Y / Z + c_y, pixel (0, 0) at its centre (the manual's section on calibration)."""
    rvec, t = np.array([0.3, -1.1, 0.4]), np.array([2.0, -1.0, 70.0])
    turn = Rotation.from_rotvec(rvec).as_matrix()
    matrix = np.array([[55.0, 0, (WIDTH - 1) / 2], [0, 55.0, (HEIGHT - 1) / 2], [0, 0, 1]])
    if not centred:
        matrix += np.array([[0, 0, 3.3], [0, 6.0, -2.1], [0, 0, 0]])
    camera = interop.from_opencv(matrix, rvec if by_vector else turn, t[:, None], WIDTH, HEIGHT, distortion=np.zeros(5))
    assert type(camera) is (jvr.PerspectiveCamera if centred else jvr.PinholeCamera)
    points, places = seen(camera)
    x, y, z = turn @ points.T + t[:, None]
    assert (z > 0).all()
    expected = np.stack([matrix[0, 0] * x / z + matrix[0, 2], matrix[1, 1] * y / z + matrix[1, 2]], -1)
    np.testing.assert_allclose(places - 0.5, expected, atol=3e-4)
    for ours, theirs in zip(interop.to_opencv(camera), (matrix, turn, t), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5 * np.abs(theirs).max())


def test_small_rotation_vectors():
    for rvec in (np.zeros(3), np.array([1e-9, 0, 0]), np.array([np.pi, 0, 0])):
        camera = interop.from_opencv(np.diag([9.0, 9.0, 1.0]), rvec, np.zeros(3), 4, 4)
        expected = Rotation.from_rotvec(rvec).inv().as_matrix() @ np.diag([1, -1, -1])
        np.testing.assert_allclose(camera.world_from_camera[:3, :3], expected, atol=1e-6)


PVCC = """<?xml version="1.0"?>
<PVCameraConfiguration description="ParaView camera configuration" version="1.0">
  <Proxy group="views" type="RenderView" id="5000" servers="21">
    <Property name="CameraPosition" id="1" number_of_elements="3"><Element index="0" value="30"/><Element index="1" value="-45"/>
      <Element index="2" value="18"/></Property>
    <Property name="CameraFocalPoint" id="2" number_of_elements="3"><Element index="0" value="2"/><Element index="1" value="1"/>
      <Element index="2" value="-3"/></Property>
    <Property name="CameraViewUp" id="3" number_of_elements="3"><Element index="0" value="0.1"/><Element index="1" value="0.2"/>
      <Element index="2" value="1"/></Property>
    <Property name="CameraViewAngle" id="4" number_of_elements="1"><Element index="0" value="41"/></Property>
    <Property name="CameraParallelScale" id="5" number_of_elements="1"><Element index="0" value="12"/></Property>
    <Property name="CameraParallelProjection" id="6" number_of_elements="1"><Element index="0" value="{parallel}"/>
      <Domain name="bool" id="7"/></Property>
  </Proxy>
</PVCameraConfiguration>"""


@pytest.mark.parametrize("parallel", [0, 1])
def test_cameras_of_paraview(tmp_path, parallel):
    (tmp_path / "a.pvcc").write_text(PVCC.format(parallel=parallel))
    said = {"position": EYE, "focal_point": TARGET, "view_up": UP} | ({"parallel_scale": 12} if parallel else {"view_angle": 41})
    ours, expected = interop.from_paraview(tmp_path / "a.pvcc", 8, 6), interop.from_vtk(said, 8, 6)
    assert jax.tree.structure(ours) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, ours, expected)


def test_transforms_of_nerf(tmp_path):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.2, 0.5, -0.1]).as_matrix(), EYE
    jvr.write_image(tmp_path / "r_0.png", np.zeros((6, 8, 3), np.float32))
    blender = {"camera_angle_x": 0.7, "frames": [{"file_path": "./r_0", "transform_matrix": pose.tolist()}]}
    (tmp_path / "transforms.json").write_text(json.dumps(blender))
    [(picture, camera)] = interop.read_transforms(tmp_path / "transforms.json")
    assert picture == tmp_path / "r_0.png"
    assert isinstance(camera, jvr.PerspectiveCamera)
    # The whole width is seen under the angle.
    np.testing.assert_allclose(np.tan(np.radians(camera.fov_y) / 2) * 8 / 6, np.tan(0.35), rtol=1e-6)
    np.testing.assert_allclose(camera.world_from_camera, pose, rtol=1e-6)
    own = {"fl_x": 20.0, "fl_y": 22.0, "cx": 9.0, "cy": 5.5, "w": 16, "h": 12}
    frames = [{"file_path": "a.jpg", "transform_matrix": pose[:3].tolist()}, {**own, "fl_x": 21.0, **blender["frames"][0]}]
    (tmp_path / "transforms.json").write_text(json.dumps(own | {"frames": frames}))
    (_, first), (_, second) = interop.read_transforms(tmp_path / "transforms.json")
    np.testing.assert_allclose(first.focal_lengths, (20, 22))
    np.testing.assert_allclose(second.focal_lengths, (21, 22))
    np.testing.assert_allclose(first.principal_point, (9.0, 5.5))
    assert (first.width, first.height) == (16, 12)


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda _: interop.from_vtk({"position": EYE, "focal_point": TARGET}, 4, 4), "has no view_up: its keys are position"),
        (
            lambda _: interop.from_vtk({"position": EYE, "focal_point": TARGET, "view_up": UP, "angle": 3}, 4, 4),
            "has a key angle",
        ),
        (lambda _: interop.from_vtk(of_vtk(ViewShear=(0.1, 0.0, 1.0)), 4, 4), "sheared or scaled"),
        (lambda _: interop.from_opencv(np.eye(3), np.zeros(3), np.zeros(3), 4, 4, distortion=[0.1, 0]), "undistort the pictures"),
        (lambda _: interop.from_opencv(np.eye(3), 2 * np.eye(3), np.zeros(3), 4, 4), "no rotation matrix"),
        (lambda _: interop.from_opencv(np.eye(3) + np.eye(3, k=1), np.zeros(3), np.zeros(3), 4, 4), "with skew"),
        (lambda f: interop.from_paraview(f("<a/>"), 4, 4), "not a camera of ParaView"),
        (lambda f: interop.from_paraview(f("no XML"), 4, 4), "not a camera of ParaView"),
        (lambda f: interop.read_transforms(f("{}")), "no transforms.json with frames"),
        (lambda f: interop.read_transforms(f("[1]")), "no transforms.json with frames"),
        (lambda f: interop.read_transforms(f('{"frames": [{"file_path": "a.png"}], "w": 4, "h": 4}')), "no transforms.json"),
        (lambda f: interop.read_transforms(f(_frames(np.eye(4)))), "neither fl_x nor camera_angle_x"),
        (lambda f: interop.read_transforms(f(_frames(2 * np.eye(4)))), "frame 0: its transform_matrix is not a rigid"),
        (lambda f: interop.read_transforms(f(_frames(np.eye(4), k1=0.1))), "its lens distorts"),
        (lambda f: interop.read_transforms(f(_frames(np.eye(4), camera_angle_x=0))), "camera_angle_x must be between 0 and pi"),
        (lambda f: interop.read_transforms(f(_frames(np.eye(4), fl_x=-2))), "frame 0: focal_lengths must be positive"),
        (lambda f: interop.read_transforms(f(_frames(np.eye(4), fl_x=9, w="wide"))), "frame 0: .*'wide'"),
        (lambda f: interop.read_transforms(f(_frames(np.eye(4), fl_x=9, w=0))), "frame 0: width must be"),
        (lambda f: interop.read_transforms(f('{"frames": []}')), "it names no frames"),
        (lambda f: interop.read_transforms(f(_frames(np.eye(4)).replace("1.0", '"x"'))), "no transforms.json"),
        (lambda f: interop.from_paraview(f("<!DOCTYPE a><a/>"), 4, 4), "entities, which are never read"),
        (lambda f: interop.from_paraview(f(PVCC.format(parallel=0).replace('"41"', '"190"')), 4, 4), "file: fov_y must be"),
        (lambda _: interop.from_vtk(of_vtk(), 4, 0), "height must be"),
    ],
)
def test_what_is_no_camera_is_refused_in_one_line(tmp_path, made, said):
    def written(text):
        (tmp_path / "file").write_text(text)
        return tmp_path / "file"

    with pytest.raises(ValueError, match=said) as caught:
        made(written)
    assert "\n" not in str(caught.value)


def _frames(pose, **more):
    return json.dumps({"w": 4, "h": 4, "frames": [{"file_path": "a.png", "transform_matrix": pose.tolist()}], **more})


@pytest.mark.slow
def test_a_moved_principal_point_is_a_part_of_a_larger_picture():
    scene, settings = jvr.Scene(jvr.Volume(voxels((9, 8, 7))), linear_transfer()), jvr.Settings(0.5)
    whole = jvr.PerspectiveCamera.look_at((14, -11, 9), (4, 4, 3), (0, 0, 1), 50, 20, 16)
    focal = 8 / np.tan(np.radians(25))
    part = jvr.PinholeCamera(whole.world_from_camera, (focal, focal), 9, 7, principal_point=(10 - 4, 8 - 5))
    expected = jvr.render(scene, whole, settings).rgb[5:12, 4:13]
    assert float(jnp.ptp(expected)) > 0.05
    np.testing.assert_allclose(jvr.render(scene, part, settings).rgb, expected, atol=2e-5)


@pytest.mark.slow
def test_derivatives_of_focal_lengths_and_principal_point(x64):
    scene, settings = jvr.Scene(jvr.Volume(voxels((6, 5, 5))), linear_transfer()), jvr.Settings(0.5, termination=0)
    pose = jvr.PerspectiveCamera.look_at((12.0, -9.0, 7.0), (2.5, 2, 2), (0, 0, 1), 40, 6, 5).world_from_camera

    @jax.jit
    def loss(x):
        camera = jvr.PinholeCamera(pose, x[:2], 6, 5, principal_point=x[2:])
        return jnp.sum(jvr.render(scene, camera, settings).rgb ** 2)

    x = jnp.array([7.0, 7.9, 2.8, 2.6])
    differences = [(loss(x.at[k].add(1e-6)) - loss(x.at[k].add(-1e-6))) / 2e-6 for k in range(4)]
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(x), differences, rtol=1e-4, atol=1e-6)


VTK = {"position": EYE.tolist(), "focal_point": TARGET.tolist(), "view_up": UP.tolist()}


def test_files_of_cameras_are_those_that_they_say(tmp_path):
    """One or several of VTK, each with a size of its own, and those of other programs by their own readers."""
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps([VTK, {**VTK, "parallel_scale": 7.0, "width": 8, "height": 6}]))
    first, second = interop.read_cameras(file, WIDTH, HEIGHT)
    assert same_camera(first, interop.from_vtk(VTK, WIDTH, HEIGHT))
    assert same_camera(second, interop.from_vtk({**VTK, "parallel_scale": 7.0}, 8, 6))
    file.write_text(json.dumps(VTK))
    (turned,) = interop.read_cameras(file, ras=True)
    assert same_camera(turned, interop.from_vtk(VTK, 512, 512, ras=True))
    frames = {"w": 9, "h": 7, "fl_x": 11.0, "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]}
    file.write_text(json.dumps(frames))
    (nerf,) = interop.read_cameras(file)
    assert (nerf.width, nerf.height) == (9, 7)


def same_camera(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.txt", "", ".pvcc (ParaView, PyVista) and .json"),
        ("a.json", "{", "no JSON"),
        ("a.json", "[]", "holds no cameras"),
        ("a.json", "[3]", "camera 0 must be an object"),
        ("a.json", json.dumps([VTK, {"position": [0, 0, 1]}]), "camera 1: the camera has no focal_point"),
        ("a.json", json.dumps({**VTK, "width": 0}), "camera 0: width"),
        ("a.json", json.dumps({**VTK, "width": "x"}), "camera 0"),
        ("a.pvcc", "<a/>", "not a camera of ParaView"),
    ],
)
def test_what_is_no_file_of_cameras_is_one_line(tmp_path, name, text, problem):
    (tmp_path / name).write_text(text)
    with pytest.raises(interop.CameraError) as caught:
        interop.read_cameras(tmp_path / name)
    assert problem in str(caught.value)
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)
