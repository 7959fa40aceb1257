"""Cameras of other programs from files."""

import json
import os
from pathlib import Path
from typing import Any

from jvr.io.interop.cameras import CameraError, from_paraview, from_vtk
from jvr.io.interop.transforms import read_transforms
from jvr.io.volumes.errors import one_line
from jvr.model.camera import AbstractCamera

# Of a picture whose file does not say it.
SIZE = 512
LARGEST = 100_000_000


def read_cameras(
    path: str | os.PathLike, width: int | None = None, height: int | None = None, *, ras: bool = False
) -> tuple[AbstractCamera, ...]:
    """The cameras of a file.

    - `.pvcc`: one camera, of ParaView or by PyVista's `camera.to_paraview_pvcc`.
    - `.json` with `frames`: `jvr.io.interop.read_transforms`, whose frames say their own sizes.
    - `.json`: a dictionary as `jvr.io.interop.from_vtk` takes it, or a list of them; each may have a `width` and a `height`.

    **Arguments:** `width`, `height`: of pictures whose file does not say it, by default 512; `ras`: whether the world of VTK's cameras is
    RAS.
    **Raises** `CameraError`, a `ValueError`, for anything else.
    """
    file, size = Path(path), {"width": width or SIZE, "height": height or SIZE}
    if file.suffix.lower() == ".pvcc":
        return (from_paraview(file, **size),)
    if file.suffix.lower() != ".json":
        raise CameraError(file, "cameras are read from .pvcc (ParaView, PyVista) and .json (transforms.json, or VTK's cameras)")
    if file.stat().st_size > LARGEST:
        raise CameraError(file, f"larger than {LARGEST:,} bytes, which no list of cameras is")
    try:
        said = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CameraError(file, f"no JSON ({one_line(error)})") from None
    if isinstance(said, dict) and "frames" in said:
        return tuple(camera for _, camera in read_transforms(file))
    listed = said if isinstance(said, list) else [said]
    if not listed:
        raise CameraError(file, "holds no cameras: each is an object with position, focal_point and view_up")
    return tuple(_camera(file, i, one, size, ras) for i, one in enumerate(listed))


def _camera(file: Path, i: int, said: Any, size: dict[str, int], ras: bool) -> AbstractCamera:
    if not isinstance(said, dict):
        raise CameraError(file, f"camera {i} must be an object with position, focal_point and view_up, not {said!r:.40}")
    try:
        own = {key: int(said[key]) for key in size if key in said}
        return from_vtk({key: value for key, value in said.items() if key not in size}, **(size | own), ras=ras)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise CameraError(file, f"camera {i}: {one_line(error)}") from None
