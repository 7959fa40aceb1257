"""Embedded scenes: volumes from formulas, so that every machine measures the same."""

import numpy as np

import jvr

ENTRIES = 64


def gyroid(n: int = 128) -> jvr.Volume:
    """`sin cos + sin cos + sin cos` on an n^3 grid, values about -1.5 ... 1.5."""
    x, y, z = np.meshgrid(*[np.linspace(-6, 6, n)] * 3, indexing="ij")
    return jvr.Volume((np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)).astype(np.float32))


def camera(volume: jvr.Volume, size: int = 256) -> jvr.PerspectiveCamera:
    """A view along a diagonal that holds the whole volume."""
    eye = np.asarray(volume.center) + float(volume.radius) * np.array([1.35, 1.1, 1.65])
    return jvr.PerspectiveCamera.look_at(eye, volume.center, (0, 0, 1), 48.0, size, size)


def translucent() -> jvr.LutTransfer:
    """Every sample contributes and no ray ends early."""
    return jvr.LutTransfer(_colours(), np.linspace(0, 0.02, ENTRIES), (-1.5, 1.5))


def opaque() -> jvr.LutTransfer:
    """A surface, opaque within a few voxels."""
    x = np.linspace(0, 1, ENTRIES)
    return jvr.LutTransfer(_colours(), 2 * np.clip((x - 0.6) / 0.1, 0, 1), (-1.5, 1.5))


def _colours() -> np.ndarray:
    x = np.linspace(0, 1, ENTRIES)
    return np.stack([0.5 + 0.4 * np.sin(5 * x), 0.5 + 0.4 * np.cos(4 * x), 0.3 + 0.5 * x], axis=1)
