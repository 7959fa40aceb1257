"""Where the ray of each pixel enters the volume, for renderers that are handed rays."""

import numpy as np

from benchmarks.peers.scenes import Scene, View


def enter(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each pixel, row 0 at the top: the entry in grid coordinates `(n, 3)`, the grid displacement of a world length `(n, 3)`,
    and the world length inside `(n,)`, 0 where the ray misses."""
    along = directions(scene.view) / scene.spacing
    start = (np.asarray(scene.view.eye) - scene.origin) / scene.spacing
    last = np.asarray(scene.voxels.shape) - 1
    with np.errstate(divide="ignore"):
        faces = np.stack([(0 - start) / along, (last - start) / along])
    near = np.maximum(faces.min(axis=0).max(axis=1), 0)
    far = faces.max(axis=0).min(axis=1)
    hit = far > near
    return start + np.where(hit, near, 0)[:, None] * along, along, np.where(hit, far - near, 0)


def directions(view: View) -> np.ndarray:
    """Unit directions through the centres of pixels, `(height * width, 3)`."""
    back = np.subtract(view.eye, view.target)
    back /= np.linalg.norm(back)
    right = np.cross(view.up, back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    half = np.tan(np.deg2rad(view.fov_y) / 2)
    x = ((np.arange(view.width) + 0.5) / view.width * 2 - 1) * half * view.width / view.height
    y = (1 - (np.arange(view.height) + 0.5) / view.height * 2) * half
    y, x = np.meshgrid(y, x, indexing="ij")
    way = x[..., None] * right + y[..., None] * up - back
    return (way / np.linalg.norm(way, axis=-1, keepdims=True)).reshape(-1, 3)
