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
from jvr.io.interop.cameras import of_focal_lengths
from jvr.model.camera import PerspectiveCamera, PinholeCamera

LARGEST = 200_000_000
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_transforms(path: str | os.PathLike) -> list[tuple[Path, PerspectiveCamera | PinholeCamera]]:
    """The pictures that a `transforms.json` names, each with its camera.

    Read are `w`, `h` (where they are not there, the size of the picture), `fl_x`, `fl_y` or `camera_angle_x`, `camera_angle_y` in radians,
    `cx`, `cy`, of the file or of a frame, and `file_path`, `transform_matrix` of each frame. World lengths are what the file's are.
    **Raises** `ValueError` for lenses that distort, for matrices that are not rigid, and for what is missing.
    """
    file = Path(path)
    if file.stat().st_size > LARGEST:
        raise ValueError(f"{file}: larger than {LARGEST:,} bytes, which no list of cameras is: name a transforms.json")
    try:
        said = json.loads(file.read_text(encoding="utf-8"))
        frames = said["frames"]
        return [_frame(file, k, said | frame) for k, frame in enumerate(frames)]
    except (KeyError, TypeError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        found = " ".join(f"{type(error).__name__} {error}".split())[:80]
        raise ValueError(f"{file}: no transforms.json with frames of file_path and transform_matrix ({found})") from None


def _frame(file: Path, k: int, said: dict[str, Any]) -> tuple[Path, PerspectiveCamera | PinholeCamera]:
    picture = file.parent / str(said["file_path"])
    # The first data sets leave the ending out.
    picture = picture if picture.suffix else picture.with_suffix(".png")
    if any(said.get(key) for key in DISTORTION):
        raise ValueError(f"{file}: its lens distorts ({', '.join(DISTORTION)}), which is not supported: undistort the pictures")
    pose = np.asarray(said["transform_matrix"], np.float64)
    if pose.shape not in ((4, 4), (3, 4)) or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-4):
        raise ValueError(f"{file}: the transform_matrix of frame {k} is not a rigid transform: it must be 4 x 4, without scale")
    pose = np.vstack([pose[:3], [0, 0, 0, 1]])
    width, height = _size(said, picture)
    focal = [_focal(said, "x", width), _focal(said, "y", height)]
    if focal == [None, None]:
        raise ValueError(f"{file}: frame {k} has neither fl_x nor camera_angle_x: say one of them, in the file or in each frame")
    along = [focal[0] or focal[1], focal[1] or focal[0]]
    principal = np.array([said.get("cx", width / 2), said.get("cy", height / 2)], np.float64)
    return picture, of_focal_lengths(pose, np.array(along, np.float64), principal, width, height)


def _size(said: dict[str, Any], picture: Path) -> tuple[int, int]:
    if "w" in said and "h" in said:
        return int(said["w"]), int(said["h"])
    height, width = read_image(picture).shape[:2]
    return width, height


def _focal(said: dict[str, Any], axis: str, pixels: int) -> float | None:
    if f"fl_{axis}" in said:
        return float(said[f"fl_{axis}"])
    angle = said.get(f"camera_angle_{axis}")
    return None if angle is None else pixels / 2 / math.tan(float(angle) / 2)
