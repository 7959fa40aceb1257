"""Cameras from their tables."""

import itertools

import numpy as np

from jvr.io.config.schema.whole import AnyCamera, OrthographicTable, PerspectiveTable, RigTable
from jvr.model.camera import AbstractCamera, OrthographicCamera, PerspectiveCamera, fibonacci_sphere, orbit
from jvr.model.exact import in_double
from jvr.model.volume import Volume

# From the front of a patient (-y in LPS), a little from above and from the left.
AUTOMATIC_DIRECTION = np.array([0.45, -1.0, 0.35])
# How much larger than the box of the volume a picture is.
MARGIN = 1.05


def cameras_of(table: AnyCamera, volume: Volume) -> tuple[AbstractCamera, ...]:
    """The cameras of one table; what it leaves out comes from the box of the volume."""
    corners = _corners(volume)
    center = np.mean(corners, axis=0) if table.target is None else np.asarray(table.target, float)
    if isinstance(table, RigTable):
        return _rig(table, center, float(volume.radius))
    right, up, back = _pose(table, center)
    corners = corners - center
    x, y, depth = np.abs(corners @ right), np.abs(corners @ up), corners @ back
    aspect = table.width / table.height
    if isinstance(table, PerspectiveTable):
        half = np.tan(np.radians(table.fov_y / 2))
        distance = np.max(np.maximum(x / (half * aspect), y / half) * MARGIN + depth)
        eye = center + distance * back if table.eye is None else table.eye
        return (PerspectiveCamera.look_at(eye, center, up, table.fov_y, table.width, table.height),)
    extent = 2 * MARGIN * np.max(np.maximum(x / aspect, y)) if table.height_world is None else table.height_world
    eye = center + (np.max(depth) + extent) * back if table.eye is None else table.eye
    return (OrthographicCamera.look_at(eye, center, up, extent, table.width, table.height),)


def _corners(volume: Volume) -> np.ndarray:
    """World positions of the eight corners of the domain, `(8, 3)`."""
    low, high = volume.domain
    grid = np.array(list(itertools.product(*zip(low, high, strict=True))))
    matrix = in_double(volume.world_from_grid, volume.remainder)
    return grid @ matrix[:3, :3].T + matrix[:3, 3]


def _pose(table: PerspectiveTable | OrthographicTable, center: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes of the camera: right, up and back. z is up unless the view is along it."""
    back = AUTOMATIC_DIRECTION if table.eye is None else np.asarray(table.eye) - center
    if np.allclose(back, 0):
        raise ValueError("eye and target are the same point: move one of them")
    back = back / np.linalg.norm(back)
    upward = np.eye(3)[2 if abs(back[2]) < 0.999 else 1] if table.up is None else np.asarray(table.up)
    right = np.cross(upward, back)
    if not np.linalg.norm(right) > 1e-6 * np.linalg.norm(upward):
        raise ValueError("up must not be zero or parallel to the view: choose another")
    right = right / np.linalg.norm(right)
    return right, np.cross(back, right), back


def _rig(table: RigTable, center: np.ndarray, reach: float) -> tuple[PerspectiveCamera, ...]:
    if table.half_angle_tangent is not None:
        fov_y = 2 * np.degrees(np.arctan(table.half_angle_tangent))
    else:
        fov_y = 30.0 if table.fov_y is None else table.fov_y
    aspect = min(1.0, table.width / table.height)
    half = np.arctan(np.tan(np.radians(fov_y / 2)) * aspect)
    radius = reach / np.sin(half) if table.radius is None else table.radius
    if table.kind == "fibonacci":
        return fibonacci_sphere(center, radius, table.count, fov_y, table.width, table.height)
    axis = (0.0, 0.0, 1.0) if table.axis is None else table.axis
    return orbit(center, radius, table.count, fov_y, table.width, table.height, axis=axis)
