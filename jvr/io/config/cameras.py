"""Cameras from their tables."""

import itertools
import os
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jvr.atomic import replacing
from jvr.io.config.schema.whole import RigTable, SingleTable
from jvr.io.config.text import toml_of
from jvr.io.kinds import KINDS
from jvr.march.occupancy import visible_bricks
from jvr.model.bricks import bricks_of
from jvr.model.camera import AbstractCamera, OrthographicCamera, PerspectiveCamera, look_at
from jvr.model.exact import in_double
from jvr.model.parameters import declared
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import Volume
from jvr.model.voxels import VOXEL

# From where each view looks at a patient in LPS: by default from the front, a little from above and from the left.
VIEWS = {
    "oblique": [0.45, -1.0, 0.35],
    "front": [0.0, -1.0, 0.0],
    "back": [0.0, 1.0, 0.0],
    "left": [1.0, 0.0, 0.0],
    "right": [-1.0, 0.0, 0.0],
    "top": [0.0, 0.0, 1.0],
    "bottom": [0.0, 0.0, -1.0],
}
# One voxel makes up to eight bricks visible. Groups of so many are specks where they are at most this share of all.
SPECK, SPECKS = 8, 0.05
HEADER = '# Cameras of jvr, positions in mm: camera = "FILE" in a configuration, or --set camera=FILE.\n'
# How much larger than what it shows a picture is.
MARGIN = 1.05
# Of a camera that does not say it: pixels, and degrees.
SIZE, FOV_Y = {"width": 512, "height": 512}, 30.0
# Keywords of a camera besides its place.
Lens: TypeAlias = dict[str, Any]


def cameras_of(
    table: SingleTable | RigTable, volume: Volume, transfer: AbstractTransfer | None = None
) -> tuple[AbstractCamera, ...]:
    """The cameras of one table; what it leaves out comes from the box of the volume, or from what `transfer` leaves visible of it.

    **Raises** `ValueError` for a place that a camera cannot have.
    """
    corners = _corners(volume)
    if table.frame == "visible" and transfer is not None:
        seen = _visible_corners(volume, transfer)
        corners = seen if len(seen) else corners
    center = (corners.min(axis=0) + corners.max(axis=0)) / 2 if table.target is None else np.asarray(table.target, float)
    if isinstance(table, RigTable):
        return _rig(table, center, float(np.max(np.linalg.norm(corners - center, axis=1))))
    return (_single(table, center, corners),)


def write_cameras(path: str | os.PathLike, cameras: Sequence[AbstractCamera]) -> None:
    """Writes cameras as tables `[[camera]]` of a configuration, positions in double precision; the file is replaced at once or not at all.

    **Raises** `TypeError` for a kind of camera that has no form in TOML.
    """
    tables = [_table_of(camera) for camera in cameras]
    with replacing(path) as temporary:
        temporary.write_text(HEADER + toml_of({"camera": tables}), encoding="utf-8")


def _table_of(camera: AbstractCamera) -> dict[str, Any]:
    kind = next((kind for kind, name in KINDS[AbstractCamera].items() if name == type(camera).__name__), None)
    if kind is None:
        raise TypeError(f"{type(camera).__name__} cannot be written as TOML")
    pose = in_double(camera.world_from_camera, camera.remainder)
    back, eye = pose[:3, 2], pose[:3, 3]
    lens = {name: getattr(camera, name) for name in declared(type(camera)) if name not in ("world_from_camera", "remainder")}
    # As far away as what it looks at, so that both keep their digits.
    place = {"eye": eye, "target": eye - max(float(np.linalg.norm(eye)), 1.0) * back, "up": pose[:3, 1]}
    return {"kind": kind, **place, **{n: v if isinstance(v, int) else np.asarray(v) for n, v in lens.items() if v is not None}}


def _single(table: SingleTable, center: np.ndarray, corners: np.ndarray) -> AbstractCamera:
    right, up, back = _pose(table, center)
    if table.target is None and table.eye is None:
        # What is seen need not lie evenly about the middle of its box.
        for axis in (right, up):
            ends = (corners - center) @ axis
            center = center + axis * (ends.min() + ends.max()) / 2
    corners, lens = corners - center, SIZE | table.keywords()
    x, y, depth = np.abs(corners @ right), np.abs(corners @ up), corners @ back
    kind: Any = table.part
    if kind in FRAMINGS:
        lens, distance = FRAMINGS[kind](lens, x, y, depth)
        return kind.look_at(center + distance * back if table.eye is None else table.eye, center, up, **lens)
    if table.eye is None:
        raise ValueError(f"eye is missing: from where a {kind.__name__} shows the whole volume is not known")
    return kind(world_from_camera=look_at(table.eye, center, up), **lens)


def _perspective(lens: Lens, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> tuple[Lens, float]:
    """The lens, and how far away a camera is that shows points: `x`, `y` from its axis, `depth` towards it."""
    lens = {"fov_y": FOV_Y} | lens
    half, aspect = np.tan(np.radians(lens["fov_y"] / 2)), lens["width"] / lens["height"]
    return lens, np.max(np.maximum(x / (half * aspect), y / half) * MARGIN + depth)


def _orthographic(lens: Lens, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> tuple[Lens, float]:
    lens = {"height_world": 2 * MARGIN * np.max(np.maximum(x / (lens["width"] / lens["height"]), y))} | lens
    return lens, np.max(depth) + lens["height_world"]


FRAMINGS: dict[Any, Callable[..., tuple[Lens, float]]] = {PerspectiveCamera: _perspective, OrthographicCamera: _orthographic}


def _corners(volume: Volume) -> np.ndarray:
    """World positions of the eight corners of the domain, `(8, 3)`."""
    low, high = volume.domain
    grid = np.array(list(itertools.product(*zip(low, high, strict=True))))
    matrix = in_double(volume.world_from_grid, volume.remainder)
    return grid @ matrix[:3, :3].T + matrix[:3, 3]


def _visible_corners(volume: Volume, transfer: AbstractTransfer) -> np.ndarray:
    """World positions of the corners of all visible bricks, `(n, 3)`."""
    bricks = volume.bricks if volume.bricks is not None else volume.bricked().bricks
    assert bricks is not None
    visible = np.asarray(eqx.filter_jit(visible_bricks)(bricks, volume.slope, volume.intercept, transfer))
    if volume.gaps is not None:
        visible = visible & ~_without_data(volume, bricks.size)
    first = np.argwhere(_without_specks(visible))[:, None] * bricks.size
    grid = first + np.array(list(itertools.product((0, bricks.size), repeat=3)))
    low, high = volume.domain
    grid = np.clip(grid.reshape(-1, 3), low, high)
    matrix = in_double(volume.world_from_grid, volume.remainder)
    return grid @ matrix[:3, :3].T + matrix[:3, 3]


def _without_specks(seen: np.ndarray) -> np.ndarray:
    """Visible bricks without a few hot voxels: groups of bricks that are so small, where they are a small part of all that is visible."""
    from scipy import ndimage

    labelled: Any = ndimage.label(seen, np.ones((3, 3, 3)))
    groups, count = labelled
    sizes = np.bincount(groups.ravel(), minlength=count + 1)
    small = sizes <= SPECK
    small[0] = False
    if not 0 < sizes[small].sum() <= SPECKS * seen.sum():
        return seen
    return seen & ~small[groups]


def _without_data(volume: Volume, size: int) -> np.ndarray:
    """Which bricks hold missing voxels alone."""
    present = np.asarray(volume.gaps) & VOXEL == 0
    return np.asarray(bricks_of(jnp.asarray(present.astype(np.uint8)), size).upper) == 0


def _pose(table: SingleTable, center: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes of the camera: right, up and back. z is up unless the view is along it."""
    back = np.asarray(VIEWS[table.view or "oblique"]) if table.eye is None else np.asarray(table.eye) - center
    if np.allclose(back, 0):
        raise ValueError("eye and target are the same point: move one of them")
    back = back / np.linalg.norm(back)
    # Seen from above or below, the front of a patient is up.
    along_z = [0.0, 1.0, 0.0] if table.view is None else [0.0, -1.0, 0.0]
    upward = np.asarray(table.up if table.up is not None else [0.0, 0.0, 1.0] if abs(back[2]) < 0.999 else along_z)
    right = np.cross(upward, back)
    if not np.linalg.norm(right) > 1e-6 * np.linalg.norm(upward):
        raise ValueError("up must not be zero or parallel to the view: choose another")
    right = right / np.linalg.norm(right)
    return right, np.cross(back, right), back


def _rig(table: RigTable, center: np.ndarray, extent: float) -> tuple[AbstractCamera, ...]:
    tangent, keywords = table.half_angle_tangent, SIZE | {"fov_y": FOV_Y} | table.keywords()
    if tangent is not None:
        keywords["fov_y"] = 2 * np.degrees(np.arctan(tangent))
    aspect = min(1.0, keywords["width"] / keywords["height"])
    half = np.arctan(np.tan(np.radians(keywords["fov_y"] / 2)) * aspect)
    return table.part(center, **{"radius": extent / np.sin(half)} | keywords)
