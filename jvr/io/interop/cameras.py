"""Cameras as VTK (PyVista, ParaView, 3D Slicer) and OpenCV describe them.

VTK's cameras look from `position` at `focal_point`, with the full vertical angle of view, or with `parallel_scale`, half of the height of
the picture. OpenCV's have x to the right, y down, z forward, `x_camera = R x_world + t`, and count pixels from the centre of the first one.
"""

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import one_line
from jvr.model.camera import AbstractCamera, OrthographicCamera, PerspectiveCamera, PinholeCamera
from jvr.types import ArrayLike

# From OpenCV's axes of a camera to ours, and from RAS to LPS.
FLIPPED, FROM_RAS = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
# A camera of ParaView takes a few kB.
LARGEST = 1_000_000
PLACES = ("position", "focal_point", "view_up")
KEYS = (*PLACES, "view_angle", "parallel_scale")


class CameraError(ValueError):
    """A file of cameras that cannot be read: one line that names the file, what is wrong and what would be right."""

    def __init__(self, path: str | os.PathLike, problem: str):
        super().__init__(" ".join(f"{path}: {problem}".split()))


def from_vtk(camera: Any, width: int, height: int, *, ras: bool = False) -> AbstractCamera:
    """The camera of VTK, PyVista, ParaView or 3D Slicer, for a picture of the given size.

    **Arguments:** `camera`: a `vtkCamera` (PyVista's `plotter.camera`, Slicer's `cameraNode.GetCamera()`), or a dictionary of
    `position`, `focal_point`, `view_up` (world lengths), and `view_angle` in degrees (30 where it is not there) or `parallel_scale`;
    `ras`: whether its world is RAS, as Slicer's is; ours is LPS.
    **Returns** a `jvr.PerspectiveCamera` or `jvr.OrthographicCamera`, or a `jvr.PinholeCamera` where the axis of view does not meet the
    middle of the picture. **Raises** `ValueError` for sheared views, and for keys that are missing or unknown.
    """
    world = FROM_RAS if ras else np.eye(4)
    if not isinstance(camera, dict):
        return _of_matrices(*_matrices(camera, width / max(height, 1)), world, width, height)
    missing, odd = [key for key in PLACES if key not in camera], [key for key in camera if key not in KEYS]
    if missing or odd:
        problem = f"has no {missing[0]}" if missing else f"has a key {odd[0]}"
        raise ValueError(f"the camera {problem}: its keys are {', '.join(PLACES)}, and view_angle or parallel_scale")
    eye, target, up = (world[:3, :3] @ np.asarray(camera[key], np.float64) for key in PLACES)
    if camera.get("parallel_scale") is not None:
        return OrthographicCamera.look_at(eye, target, up, 2 * camera["parallel_scale"], width, height)
    return PerspectiveCamera.look_at(eye, target, up, camera.get("view_angle", 30.0), width, height)


def _matrices(camera: Any, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    if not hasattr(camera, "GetProjectionTransformMatrix"):
        raise TypeError(f"from_vtk takes a vtkCamera or a dictionary, not {type(camera).__name__}")
    view, projection = camera.GetModelViewTransformMatrix(), camera.GetProjectionTransformMatrix(aspect, -1, 1)
    numbers = lambda matrix: np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
    return numbers(view), numbers(projection)


def _of_matrices(view: np.ndarray, projection: np.ndarray, world: np.ndarray, width: int, height: int) -> AbstractCamera:
    """Of the world to the camera, and of the camera to the window, which reaches from -1 to 1, y up."""
    parallel = projection[3, 2] == 0
    sheared = np.any([projection[0, 1], projection[1, 0], *projection[:2, 2 if parallel else 3]])
    if sheared or not np.allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=1e-6):
        raise ValueError("the camera's view is sheared or scaled, which is not supported: reset its shear and its transforms")
    pose = world @ np.linalg.inv(view)
    if parallel:
        # The middle of the window is moved along the image plane.
        pose[:3, 3] -= pose[:3, :2] @ (projection[:2, 3] / np.diagonal(projection)[:2])
        return OrthographicCamera(pose, 2 / projection[1, 1], width, height)
    focal = np.array([projection[0, 0] * width, projection[1, 1] * height]) / 2
    principal = np.array([width * (1 - projection[0, 2]), height * (1 + projection[1, 2])]) / 2
    return of_focal_lengths(pose, focal, principal, width, height)


def of_focal_lengths(
    pose: np.ndarray, focal: np.ndarray, principal: np.ndarray, width: int, height: int
) -> PerspectiveCamera | PinholeCamera:
    """The plainest camera that it is."""
    plain = focal[1] > 0 and np.allclose(focal[0], focal[1], rtol=1e-7)
    if plain and np.allclose(principal, (width / 2, height / 2), rtol=1e-7):
        return PerspectiveCamera(pose, math.degrees(2 * math.atan(height / (2 * focal[1]))), width, height)
    return PinholeCamera(pose, focal, width, height, principal_point=principal)


def from_paraview(path: str | os.PathLike, width: int, height: int) -> AbstractCamera:
    """The camera of a file that ParaView's "Adjust Camera" dialog saves (`.pvcc`), for a picture of the given size.

    **Raises** `CameraError`, a `ValueError`, for what is no such file.
    """
    with Path(path).open("rb") as file:
        content = file.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise CameraError(path, "not a camera of ParaView, which takes a few kB: save it anew in the dialog Adjust Camera")
    try:
        said = _said_by_paraview(content.decode())
    except (ElementTree.ParseError, KeyError, IndexError, ValueError) as error:
        problem = f"not a camera of ParaView ({type(error).__name__}: {one_line(error)})"
        raise CameraError(path, f"{problem}: save it anew in the dialog Adjust Camera") from None
    try:
        return from_vtk(said, width, height)
    except ValueError as error:
        raise CameraError(path, str(error)) from None


def _said_by_paraview(text: str) -> dict[str, Any]:
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise ValueError("it defines entities, which are never read")
    properties = {str(found.get("name")): found for found in ElementTree.fromstring(text).iter("Property")}
    numbers = lambda name: [float(str(e.get("value"))) for e in properties[f"Camera{name}"].iter("Element") if e.get("value")]
    said: dict[str, Any] = {
        "position": numbers("Position"),
        "focal_point": numbers("FocalPoint"),
        "view_up": numbers("ViewUp"),
        "view_angle": numbers("ViewAngle")[0],
    }
    if "CameraParallelProjection" in properties and numbers("ParallelProjection")[0]:
        said["parallel_scale"] = numbers("ParallelScale")[0]
    if any(len(said[key]) != 3 for key in PLACES):
        raise ValueError("a place has three numbers")
    return said


def to_vtk(camera: AbstractCamera) -> dict[str, Any]:
    """The keys of `from_vtk` for a perspective or orthographic camera; the focal point is at distance 1.

    **Raises** `ValueError` for a camera that VTK describes otherwise.
    """
    pose = _pose(camera)
    said = {"position": pose[:3, 3], "focal_point": pose[:3, 3] - pose[:3, 2], "view_up": pose[:3, 1]}
    if isinstance(camera, PerspectiveCamera):
        return said | {"view_angle": float(camera.fov_y)}
    if isinstance(camera, OrthographicCamera):
        return said | {"parallel_scale": float(camera.height_world) / 2}
    raise ValueError(f"to_vtk takes a PerspectiveCamera or an OrthographicCamera, not a {type(camera).__name__}")


def _pose(camera: AbstractCamera) -> np.ndarray:
    """In double precision, with what single precision leaves of it."""
    low = camera.remainder.beside(camera.world_from_camera)
    return np.asarray(camera.world_from_camera, np.float64) + np.asarray(low, np.float64)


def from_opencv(
    matrix: ArrayLike,
    rotation: ArrayLike,
    translation: ArrayLike,
    width: int,
    height: int,
    *,
    distortion: ArrayLike = (),
) -> PerspectiveCamera | PinholeCamera:
    """The camera of a calibration by OpenCV.

    **Arguments:** `matrix`: the 3x3 camera matrix in pixels; `rotation`, `translation`: of the world to the camera,
    `x_camera = R x_world + t`, `R` as 3x3 matrix or as rotation vector in radians (`rvec`); `distortion`: its coefficients.
    **Raises** `ValueError` where a lens distorts or axes of pixels are skewed: undistort the pictures first.
    """
    k, t = np.asarray(matrix, np.float64), np.asarray(translation, np.float64).reshape(-1)
    if k.shape != (3, 3) or t.shape != (3,):
        raise ValueError(f"the camera matrix must be (3, 3) and the translation (3,), not {k.shape} and {t.shape}")
    if np.any(np.asarray(distortion, np.float64)):
        raise ValueError("lenses that distort are not supported: undistort the pictures (cv2.undistort) and leave distortion out")
    if k[0, 1] or k[1, 0] or not np.array_equal(k[2], (0, 0, 1)):
        raise ValueError("a camera matrix with skew, or whose last row is not 0, 0, 1, is not supported")
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = _rotation(rotation), t
    # OpenCV counts from the centre of the first pixel.
    return of_focal_lengths(np.linalg.inv(view) @ FLIPPED, np.diagonal(k)[:2], k[:2, 2] + 0.5, width, height)


def _rotation(rotation: ArrayLike) -> np.ndarray:
    """The matrix, of itself or of a rotation vector (Rodrigues' formula)."""
    turn = np.asarray(rotation, np.float64)
    if turn.shape == (3, 3):
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-5) or np.linalg.det(turn) < 0:
            raise ValueError("the rotation is no rotation matrix: its rows must be orthogonal, of length 1 and right-handed")
        return turn
    if turn.size != 3:
        raise ValueError(f"the rotation must be a matrix (3, 3) or a vector (3,), not {turn.shape}")
    x, y, z = turn.reshape(3)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.linalg.norm(turn)
    # sin(a) / a, and (1 - cos a) / a^2 = 2 (sin(a / 2) / a)^2, without a division by zero.
    return np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / 2 / np.pi) ** 2 / 2 * cross @ cross


def to_opencv(camera: PerspectiveCamera | PinholeCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Camera matrix, rotation matrix and translation, as `from_opencv` takes them."""
    if isinstance(camera, PinholeCamera):
        focal, principal = np.asarray(camera.focal_lengths, np.float64), np.asarray(camera.principal_point, np.float64)
    elif isinstance(camera, PerspectiveCamera):
        focal = np.full(2, camera.height / 2 / np.tan(np.radians(float(camera.fov_y)) / 2))
        principal = np.array([camera.width, camera.height]) / 2
    else:
        raise ValueError(f"to_opencv takes a PerspectiveCamera or a PinholeCamera, not a {type(camera).__name__}")
    pose = _pose(camera)
    view = np.linalg.inv(pose @ FLIPPED)
    matrix = np.array([[focal[0], 0, principal[0] - 0.5], [0, focal[1], principal[1] - 0.5], [0, 0, 1]])
    return matrix, view[:3, :3], view[:3, 3]
