"""Ambient occlusion and light that is scattered on by brute force, in NumPy's and SciPy's double precision and with nothing of jvr's:
thousands of directions from each point, four samples a voxel along each.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

# Samples for each voxel along the rays of a ball and of a hemisphere, and along those to a light.
SAMPLES, TO_LIGHT = 4, 2


class Medium(NamedTuple):
    """Voxels, their affine transform to the world, and an extinction that is linear in the scalar between `positions`."""

    values: np.ndarray
    world_from_grid: np.ndarray
    positions: np.ndarray
    sigma_t: np.ndarray

    @property
    def spacing(self) -> float:
        """The least distance between voxels, in the world."""
        return float(np.min(np.linalg.norm(self.world_from_grid[:3, :3], axis=0)))

    def extinction(self, at: np.ndarray) -> np.ndarray:
        """At grid positions `(..., 3)`; 0 outside of the voxels."""
        inside = np.all((at >= 0) & (at <= np.array(self.values.shape) - 1), axis=-1)
        s = map_coordinates(self.values, at.reshape(-1, 3).T, order=1, mode="nearest").reshape(inside.shape)
        return np.where(inside, np.interp(s, self.positions, self.sigma_t), 0.0)

    def along(self, directions: np.ndarray) -> np.ndarray:
        """Grid steps of unit directions in the world."""
        return directions @ np.linalg.inv(self.world_from_grid[:3, :3]).T


def sphere(rays: int) -> np.ndarray:
    """Unit directions on a spiral of equal areas."""
    index, golden = np.arange(rays), np.pi * (3 - np.sqrt(5))
    z = 1 - 2 * (index + 0.5) / rays
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(golden * index), r * np.sin(golden * index), z], axis=1)


def in_ball(
    medium: Medium, where: np.ndarray, rays: int, ball: tuple[float, float], light: np.ndarray | None = None
) -> np.ndarray:
    """Mean over directions and over the distances between the two radii of `ball`, in voxels, of the transmittance from grid positions
    `where` on; times that from there to a directional light which travels along `light`, if there is one."""
    along = medium.along(sphere(rays))
    first, last = ball
    steps = round(SAMPLES * (last - first))
    dt = medium.spacing * (last - first) / steps
    distances = medium.spacing * first + dt * (np.arange(steps) + 0.5)
    found = []
    for start in where:
        at = start + along[:, None] * distances[:, None]
        dtau = medium.extinction(at) * dt
        before = np.cumsum(dtau, axis=1) - dtau
        mean = np.where(dtau > 0, -np.expm1(-dtau) / np.where(dtau > 0, dtau, 1.0), 1.0)
        reached = np.exp(-before) * mean
        found.append(np.mean(reached if light is None else reached * _lit(medium, at, light, reached > 1e-6)))
    return np.array(found)


def _lit(medium: Medium, at: np.ndarray, light: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """The transmittance from grid positions to a directional light, where it is needed."""
    dt = medium.spacing / TO_LIGHT
    step = medium.along(-light / np.linalg.norm(light)) * dt
    depth, p = np.zeros(int(needed.sum())), at[needed] + step / 2
    last = np.array(medium.values.shape) - 1
    # As far as anything of the volume lies ahead.
    ahead = np.ones(len(p), bool)
    while ahead.any():
        depth[ahead] += medium.extinction(p[ahead]) * dt
        p[ahead] += step
        ahead = ~np.any(((p < 0) & (step <= 0)) | ((p > last) & (step >= 0)), axis=1) & (depth < 20)
    out = np.zeros(needed.shape)
    out[needed] = np.exp(-depth)
    return out


def above_surface(medium: Medium, level: float, where: np.ndarray, eye: np.ndarray, rays: int, reach: float) -> np.ndarray:
    """The share of the directions above grid positions on an isosurface in which nothing beyond the isovalue lies within `reach` voxels, on
    the side that is seen from the world position `eye`."""
    value = lambda p: map_coordinates(medium.values, p.reshape(-1, 3).T, order=1, mode="nearest").reshape(p.shape[:-1])
    # The slope of the interpolant, which is linear along each axis between voxels.
    gradient = np.stack([value(where + e) - value(where - e) for e in 1e-4 * np.eye(3)], axis=1)
    normals = -gradient @ np.linalg.inv(medium.world_from_grid[:3, :3])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    world = where @ medium.world_from_grid[:3, :3].T + medium.world_from_grid[:3, 3]
    # Where a border of the volume has cut a body open it is seen from within.
    side = np.where(np.sum(normals * (eye - world), axis=1) < 0, -1.0, 1.0)
    directions = sphere(2 * rays)
    distances = medium.spacing * np.arange(1, round(SAMPLES * reach) + 1) / SAMPLES
    found = []
    for start, normal, sign in zip(where, side[:, None] * normals, side, strict=True):
        along = medium.along(directions[directions @ normal > 0])
        at = start + along[:, None] * distances[:, None]
        inside = np.all((at >= 0) & (at <= np.array(medium.values.shape) - 1), axis=-1)
        found.append(1 - np.mean(np.any(inside & (sign * (value(at) - level) > 0), axis=1)))
    return np.array(found)
