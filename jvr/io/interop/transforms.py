"""`transforms.json`, the file of poses that NeRF's data sets, instant-ngp and Nerfstudio use.

Its cameras have our axes (x to the right, y up, -z forward); the principal point is counted from the corner of the picture.
"""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.images import read_image
from jvr.io.interop.cameras import CameraError, of_focal_lengths
from jvr.io.volumes.errors import one_line
from jvr.model.camera import PerspectiveCamera, PinholeCamera

LARGEST = 200_000_000
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(path: str | os.PathLike) -> list[tuple[Path, PerspectiveCamera | PinholeCamera]]:
    """The pictures that a `transforms.json` names, each with its camera.

    Read are `w`, `h` (where they are not there, the size of the picture), `fl_x`, `fl_y` or `camera_angle_x`, `camera_angle_y` in radians,
    `cx`, `cy`, of the file or of a frame, and `file_path`, `transform_matrix` of each frame. World lengths are what the file's are.
    **Raises** `CameraError`, a `ValueError`, for lenses that distort, for matrices that are not rigid, and for what is missing.
    """
    file = Path(path)
    if file.stat().st_size > LARGEST:
        raise CameraError(file, f"larger than {LARGEST:,} bytes, which no list of cameras is: name a transforms.json")
    try:
        said = json.loads(file.read_text(encoding="utf-8"))
        frames = [said | frame for frame in said["frames"]]
        places = [(str(frame["file_path"]), np.asarray(frame["transform_matrix"], np.float64)) for frame in frames]
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        problem = f"no transforms.json with frames of file_path and transform_matrix ({type(error).__name__}: {one_line(error)})"
        raise CameraError(file, problem) from None
    if not frames:
        raise CameraError(file, "it names no frames: name a transforms.json that was written whole")
    found = []
    for k, (frame, (name, pose)) in enumerate(zip(frames, places, strict=True)):
        try:
            found.append(_frame(file.parent / name, pose, frame))
        except (TypeError, ValueError, ArithmeticError) as error:
            raise CameraError(file, f"frame {k}: {error}") from None
    return found


def _frame(picture: Path, pose: np.ndarray, said: dict[str, Any]) -> tuple[Path, PerspectiveCamera | PinholeCamera]:
    # The first data sets leave the ending out.
    picture = picture if picture.suffix else picture.with_suffix(".png")
    if any(said.get(key) for key in DISTORTION):
        raise ValueError(f"its lens distorts ({', '.join(DISTORTION)}), which is not supported: undistort the pictures")
    if pose.shape not in ((4, 4), (3, 4)) or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-4):
        raise ValueError("its transform_matrix is not a rigid transform: it must be 4 x 4, without scale")
    pose = np.vstack([pose[:3], [0, 0, 0, 1]])
    width, height = _size(said, picture)
    focal = [_focal(said, "x", width), _focal(said, "y", height)]
    if focal == [None, None]:
        raise ValueError("it has neither fl_x nor camera_angle_x: say one of them, in the file or in each frame")
    along = [one for one in focal if one is not None]
    principal = np.array([said.get("cx", width / 2), said.get("cy", height / 2)], np.float64)
    return picture, of_focal_lengths(pose, np.array([along[0], along[-1]]), principal, width, height)


def _size(said: dict[str, Any], picture: Path) -> tuple[int, int]:
    if "w" in said and "h" in said:
        return int(said["w"]), int(said["h"])
    # Its size is the same whatever its numbers mean.
    height, width = read_image(picture, encoding="linear", alpha="ignored").shape[:2]
    return width, height


def _focal(said: dict[str, Any], axis: str, pixels: int) -> float | None:
    if f"fl_{axis}" in said:
        return float(said[f"fl_{axis}"])
    angle = said.get(f"camera_angle_{axis}")
    if angle is not None and not 0 < float(angle) < math.pi:
        raise ValueError(f"camera_angle_{axis} must be between 0 and pi, without either, in radians, not {angle!r}")
    return None if angle is None else pixels / 2 / math.tan(float(angle) / 2)
