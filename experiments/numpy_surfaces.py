"""An isosurface under directional lights by NumPy and SciPy in double precision, with nothing of jvr's: every ray is sampled, its first
crossing bisected, its normal taken by central differences, and light reflected by Blinn and Phong."""

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

# Voxels between samples of a ray, halvings of a crossing, rays at a time.
STEP, HALVINGS, TOGETHER = 0.5, 24, 4096


class Surface(NamedTuple):
    """Voxels, their affine transform to the world, the isovalue, its colour, and what it reflects: ambient light of radiance 1, diffuse and
    specular shares of `lights` (the ways that they travel, of irradiance 1), and the exponent of the highlight."""

    values: np.ndarray
    world_from_grid: np.ndarray
    level: float
    rgb: np.ndarray
    ambient: float
    diffuse: float
    specular: float
    shininess: float
    lights: np.ndarray


def picture(surface: Surface, camera: Any, samples: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Radiance `(height, width, 3)`, 0 where nothing is hit, the mean of `samples^2` rays a pixel, and the distances along the rays through
    the middles of finer pixels `(height samples, width samples)`, infinite where nothing is hit."""
    pose, height, width = np.asarray(camera.world_from_camera, float), camera.height * samples, camera.width * samples
    tangent = np.tan(np.radians(float(camera.fov_y)) / 2)
    row, column = np.mgrid[:height, :width] + 0.5
    x, y = (2 * column - width) / height * tangent, (1 - 2 * row / height) * tangent
    d = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3) @ pose[:3, :3].T
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    parts = [_seen(surface, pose[:3, 3], part) for part in np.array_split(d, -(-len(d) // TOGETHER))]
    rgb, depth = (np.concatenate(of) for of in zip(*parts, strict=True))
    blocks = rgb.reshape(camera.height, samples, camera.width, samples, 3)
    return blocks.mean(axis=(1, 3)), depth.reshape(height, width)


def _seen(surface: Surface, eye: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Radiance and distance along rays of unit direction."""
    inverse = np.linalg.inv(np.asarray(surface.world_from_grid, float))
    start, along = inverse[:3, :3] @ eye + inverse[:3, 3], d @ inverse[:3, :3].T
    last = np.array(surface.values.shape) - 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([-start / along, (last - start) / along]), axis=0)
    begin, end = np.nanmax(ends[0], axis=1).clip(min=0), np.nanmin(ends[1], axis=1)
    step = STEP / np.linalg.norm(along, axis=1).max()
    at = lambda t: start + t[:, None] * along
    value = lambda p: map_coordinates(surface.values, p.T, order=1, mode="nearest") - surface.level
    front, back = begin.copy(), np.full(len(d), np.inf)
    before = value(at(begin))
    for k in range(1, int(np.ceil(max((end - begin).max(), 0) / step)) + 1):
        looking = (begin + (k - 1) * step < end) & np.isinf(back)
        t = np.minimum(begin + k * step, end)[looking]
        now = value(at(np.where(looking, np.minimum(begin + k * step, end), begin)))[looking]
        crossed = (before[looking] < 0) != (now < 0)
        back[np.flatnonzero(looking)[crossed]] = t[crossed]
        front[np.flatnonzero(looking)[~crossed]] = t[~crossed]
        before[np.flatnonzero(looking)[~crossed]] = now[~crossed]
    hit = np.isfinite(back)
    low, high, sign = front[hit], back[hit], before[hit] < 0
    of_hits = lambda t: start + t[:, None] * along[hit]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        same = (value(of_hits(middle)) < 0) == sign
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    depth, rgb = np.full(len(d), np.inf), np.zeros((len(d), 3))
    depth[hit] = (low + high) / 2
    rgb[hit] = _reflected(surface, inverse, of_hits(depth[hit]), -d[hit])
    return rgb, depth


def _reflected(surface: Surface, inverse: np.ndarray, p: np.ndarray, w_o: np.ndarray) -> np.ndarray:
    """What the surface sends towards `w_o` from grid positions on it."""
    at = lambda p: map_coordinates(surface.values, p.T, order=1, mode="nearest")
    gradient = np.stack([(at(p + e) - at(p - e)) / 2 for e in np.eye(3)], axis=1) @ inverse[:3, :3]
    normal = -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    normal *= np.where(np.sum(normal * w_o, axis=1) < 0, -1.0, 1.0)[:, None]
    rgb = np.broadcast_to(surface.ambient * surface.rgb, p.shape).copy()
    for way in surface.lights:
        w_i = -way / np.linalg.norm(way)
        facing = np.maximum(normal @ w_i, 0)
        half = w_o + w_i
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        shine = np.where(facing > 0, np.maximum(np.sum(normal * half, axis=1), 0) ** surface.shininess, 0.0)
        rgb += surface.diffuse * facing[:, None] * surface.rgb + surface.specular * shine[:, None]
    return rgb
