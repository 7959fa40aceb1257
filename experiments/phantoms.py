"""A phantom of ellipsoids, whose line integrals are known in closed form: pictures of it owe nothing to a grid."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jvr

# Value, half axes, centre, and degrees about z: the head of Shepp and Logan (1974) in three dimensions (Kak and Slaney 1988), with the
# contrast of Toft (1996), which leaves 1 in the skull, 0.2 inside of it, 0 and 0.3 in what lies there.
ELLIPSOIDS = np.array(
    [
        [1.0, 0.69, 0.92, 0.81, 0.0, 0.0, 0.0, 0.0],
        [-0.8, 0.6624, 0.874, 0.78, 0.0, -0.0184, 0.0, 0.0],
        [-0.2, 0.11, 0.31, 0.22, 0.22, 0.0, 0.0, -18.0],
        [-0.2, 0.16, 0.41, 0.28, -0.22, 0.0, 0.0, 18.0],
        [0.1, 0.21, 0.25, 0.41, 0.0, 0.35, -0.15, 0.0],
        [0.1, 0.046, 0.046, 0.05, 0.0, 0.1, 0.25, 0.0],
        [0.1, 0.046, 0.046, 0.05, 0.0, -0.1, 0.25, 0.0],
        [0.1, 0.046, 0.023, 0.05, -0.08, -0.605, 0.0, 0.0],
        [0.1, 0.023, 0.023, 0.02, 0.0, -0.606, 0.0, 0.0],
        [0.1, 0.023, 0.046, 0.02, 0.06, -0.605, 0.0, 0.0],
    ]
)


class Ellipsoids(NamedTuple):
    """The head around a point of the world, `scale` long from there to 1."""

    center: np.ndarray
    scale: float

    def density(self, points: np.ndarray) -> np.ndarray:
        """At points `(..., 3)`."""
        inside = [(value, np.sum(np.square(frame(points)), axis=-1) <= 1) for value, frame, _ in self._frames()]
        return np.clip(sum(value * np.asarray(within, float) for value, within in inside), 0, None)

    def integrals(self, camera: jvr.OrthographicCamera) -> np.ndarray:
        """The line integral along the ray of each pixel, `(height, width)`, in double precision."""
        origin, direction = (
            np.stack(np.broadcast_arrays(*map(np.asarray, part)), axis=-1).astype(float)
            for part in camera.rays(jnp.arange(camera.width * camera.height, dtype=jnp.int32))
        )
        total = np.zeros(len(origin))
        for value, frame, turned in self._frames():
            at, along = frame(origin), turned(direction)
            a, b, c = (np.sum(x * y, axis=-1) for x, y in ((along, along), (at, along), (at, at)))
            total += value * 2 * np.sqrt(np.maximum(b**2 - a * (c - 1), 0)) / a
        return np.maximum(total, 0).reshape(camera.height, camera.width)

    def voxels(self, grid: np.ndarray, shape: tuple[int, ...], parts: int = 4) -> np.ndarray:
        """Means over the cell around each voxel of a grid (4x4), of `parts^3` points."""
        offsets, total = (np.arange(parts) + 0.5) / parts - 0.5, np.zeros(shape)
        indices = np.moveaxis(np.indices(shape), 0, -1).astype(float)
        for offset in np.stack(np.meshgrid(*[offsets] * 3), axis=-1).reshape(-1, 3):
            total += self.density((indices + offset) @ grid[:3, :3].T + grid[:3, 3])
        return total / parts**3

    def _frames(self):
        """The value of each ellipsoid, and what takes points and directions to where it is the unit ball."""
        for value, *numbers in ELLIPSOIDS:
            axes, place, angle = np.array(numbers[:3]), np.array(numbers[3:6]), np.radians(numbers[6])
            cos, sin = np.cos(angle), np.sin(angle)
            inverse = np.diag(1 / axes) @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) / self.scale
            frame = lambda x, inverse=inverse, place=place: (x - self.center - self.scale * place) @ inverse.T
            yield value, frame, lambda d, inverse=inverse: d @ inverse.T
