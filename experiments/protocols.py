"""The fits that jvr is measured by."""

import dataclasses
import os
from pathlib import Path

import jax
import numpy as np

import jvr

DATA = Path(os.environ.get("JVR_DATA", "data"))
# In that folder.
HEAD = "ct_head_quarter/ct_head_quarter.mhd"


@dataclasses.dataclass(frozen=True)
class Protocol:
    """A synthetic fit: the true scene, its images, the start, and a view that takes no part."""

    truth: jvr.Scene
    start: jvr.Scene
    cameras: tuple[jvr.PerspectiveCamera, ...]
    images: list[np.ndarray]
    settings: jvr.Settings
    held_out: tuple[tuple[jvr.PerspectiveCamera, ...], list[np.ndarray]]


def ct_head(entries: int = 64, size: int = 128, volume: jvr.Volume | None = None) -> Protocol | None:
    """A CT of a head (64 x 64 x 93) or another volume in its place, 8 views of 128^2, samples every millimetre; `None` where the
    head is absent."""
    volume = volume or head_volume()
    if volume is None:
        return None
    return _protocol(volume, size, entries, jvr.Settings(1 / 1.5, termination=0.0), None)


def diffdvr(entries: int = 64, size: int = 256) -> Protocol | None:
    """The transfer-function reconstruction of DiffDVR (Weiss and Westermann 2022) on the same head: 8 views, white behind."""
    volume = head_volume()
    if volume is None:
        return None
    return _protocol(volume, size, entries, jvr.Settings(1.0, termination=0.0), (1.0, 1.0, 1.0))


def head_volume() -> jvr.Volume | None:
    """`ct_head_quarter`, divided by 2500 and clamped to 0 ... 1."""
    path = DATA / HEAD
    if not path.exists():
        return None
    raw = jvr.read_volume(path)
    values = np.clip(np.asarray(raw.values, np.float32) / 2500, 0, 1)
    return jvr.Volume(values, raw.world_from_grid)


def ct_head_reference() -> jvr.LutTransfer:
    """256 entries: smooth colours; a Gaussian of skin and a ramp into bone, per millimetre."""
    x = np.linspace(0, 1, 256)
    rgb = np.stack([0.5 + 0.4 * np.sin(5 * x), 0.5 + 0.4 * np.cos(4 * x), 0.3 + 0.5 * x], axis=1)
    sigma_t = 0.02 * np.exp(-0.5 * np.square((x - 0.4) / 0.05)) + 0.5 * np.clip((x - 0.47) / 0.1, 0, 1)
    return jvr.LutTransfer(rgb, sigma_t, (0.0, 1.0))


def flat_start(entries: int) -> jvr.LutTransfer:
    """Grey, `softplus(-4)` per millimetre."""
    return jvr.LutTransfer(np.full((entries, 3), 0.5), np.full(entries, np.log1p(np.exp(-4.0))), (0.0, 1.0))


def _protocol(
    volume: jvr.Volume, size: int, entries: int, settings: jvr.Settings, background: tuple[float, float, float] | None
) -> Protocol:
    """Eight views of a Fibonacci sphere 450 mm from the centre, and one from the front that takes no part."""
    fov_y = float(np.degrees(2 * np.arctan(0.3)))
    cameras = jvr.fibonacci_sphere(volume.center, 450.0, 8, fov_y, size, size)
    front = jvr.PerspectiveCamera.look_at(
        volume.center + np.array([0.0, -450.0, 0.0]), volume.center, (0, 0, -1), fov_y, size, size
    )
    truth = jvr.Scene(volume, ct_head_reference(), background=background)
    render = jax.jit(jvr.render)
    images = [np.asarray(render(truth, camera, settings).rgb) for camera in (*cameras, front)]
    start = jvr.Scene(volume, flat_start(entries), background=background)
    return Protocol(truth, start, cameras, images[:-1], settings, ((front,), images[-1:]))
