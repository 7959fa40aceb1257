"""Small scenes that several test files share. Everything random comes from fixed seeds; arrays are NumPy float64, so that a scene
takes the precision of the moment it is built in."""

import jax
import jax.numpy as jnp
import numpy as np

import jvr
from jvr.rendering.medium import medium, prepare
from jvr.rendering.trace import camera_rays, near_volume, step_length

# One jitted function for all tests: scenes of the same structure share a compiled program.
render = jax.jit(jvr.render)
SETTINGS = jvr.Settings(0.37, termination=0)


def rotation(x: float, y: float, z: float) -> np.ndarray:
    """Rotation matrix from three angles in radians."""
    result = np.eye(3)
    for axis, angle in enumerate((x, y, z)):
        i, j = [k for k in range(3) if k != axis]
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = np.cos(angle)
        turn[i, j], turn[j, i] = -np.sin(angle), np.sin(angle)
        result = turn @ result
    return result


def affine(spacing, origin=(0.0, 0.0, 0.0), angles=(0.0, 0.0, 0.0)) -> np.ndarray:
    """A `world_from_grid`."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(*angles) * np.asarray(spacing, float)
    matrix[:3, 3] = origin
    return matrix


OBLIQUE = affine((1.0, 2.1, 1.4), (-3.0, 4.0, 10.0), (0.4, -0.7, 0.3))


def voxels(shape=(5, 6, 7), seed=0) -> np.ndarray:
    """Values between 0 and 1."""
    return np.random.default_rng(seed).random(shape)


def linear_transfer(coloured=False, scale=0.6, seed=1) -> jvr.LinearTransfer:
    """Four control points inside 0 ... 1."""
    rng = np.random.default_rng(seed)
    sigma_t = scale * rng.random((4, 3) if coloured else 4)
    return jvr.LinearTransfer([0.1, 0.35, 0.6, 0.85], rng.random((4, 3)), sigma_t)


def lut_transfer(coloured=False, scale=0.6, seed=2, n=5) -> jvr.LutTransfer:
    rng = np.random.default_rng(seed)
    return jvr.LutTransfer(rng.random((n, 3)), scale * rng.random((n, 3) if coloured else n), [0.15, 0.9])


def gaussian_transfer(coloured=False, scale=0.6, seed=3) -> jvr.GaussianTransfer:
    rng = np.random.default_rng(seed)
    height = scale * rng.random((3, 3) if coloured else 3)
    return jvr.GaussianTransfer([0.2, 0.5, 0.8], [0.1, 0.15, 0.2], height, rng.random((3, 3)))


def perspective(
    volume: jvr.Volume, width=6, height=5, direction=(1.0, -0.6, 0.45), away=2.6, fov_y=38.0
) -> jvr.PerspectiveCamera:
    """A camera that looks at the middle of a volume from outside, some rays missing it."""
    center, radius = np.asarray(volume.center), float(volume.radius)
    eye = center + away * radius * np.asarray(direction) / np.linalg.norm(direction)
    return jvr.PerspectiveCamera.look_at(eye, center, [0.1, 0.2, 1.0], fov_y, width, height)


def orthographic(volume: jvr.Volume, width=6, height=5, direction=(1.0, -0.6, 0.45)) -> jvr.OrthographicCamera:
    center, radius = np.asarray(volume.center), float(volume.radius)
    eye = center + 3 * radius * np.asarray(direction) / np.linalg.norm(direction)
    return jvr.OrthographicCamera.look_at(eye, center, [0.1, 0.2, 1.0], 2 * radius, width, height)


def small() -> jvr.Scene:
    """A volume of floating point through a table, on a coloured background."""
    values = np.random.default_rng(0).random((9, 7, 8)).astype(np.float32)
    return jvr.Scene(jvr.Volume(values), lut_transfer(), background=(0.2, 0.1, 0.3))


def marched_rays(scene: jvr.Scene, camera, settings: jvr.Settings):
    """What the rays of all pixels march through, the rays, and the world length of a segment."""
    scene, camera = near_volume(scene, camera)
    prepared = prepare(scene, settings, step_length(scene, settings))
    rays, _ = camera_rays(scene, camera, jnp.arange(camera.width * camera.height, dtype=jnp.int32))
    return medium(prepared), rays, prepared.dt
