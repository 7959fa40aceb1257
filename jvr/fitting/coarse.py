"""A coarse start: pictures averaged over squares of pixels, and the volume over blocks of voxels of about that size.

What is many pixels away has no slope in sharp pictures; in blurred ones it has (coarse-to-fine registration, such as Pluim, Maintz and
Viergever 2003). Squares have an odd side, so that the ray through the middle of one is that of a pixel, whatever the camera.
"""

from collections.abc import Callable, Collection, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jvr.fitting.observations import Observations, observe
from jvr.fitting.problem import Problem
from jvr.fitting.targets import Targets, check_weights
from jvr.fitting.unknowns import ExposedModel, Unknowns
from jvr.model.camera import AbstractCamera
from jvr.model.exact import in_double
from jvr.model.interpolation import Trilinear
from jvr.model.scene import Scene
from jvr.model.volume import Volume

# Pixels along an edge of a square, from one level to the next.
FACTOR = 3
# Squares along the shorter side of a picture, and blocks along an axis of the volume, that are left at least.
LEAST = 8

Cameras = Sequence[AbstractCamera]


def factors(cameras: Cameras, levels: int) -> tuple[int, ...]:
    """The sides of the squares of pixels of each level, the coarsest first.

    **Raises** `ValueError` for a negative number of levels.
    """
    if levels < 0 or levels != int(levels):
        raise ValueError(f"coarse_levels must be a whole number, 0 for none, not {levels}")
    side = min(min(camera.width, camera.height) for camera in cameras)
    sides = (FACTOR**level for level in range(int(levels), 0, -1))
    return tuple(factor for factor in sides if side // factor >= LEAST)


def level(
    problem: Problem,
    start: ExposedModel,
    given: Targets,
    cameras: Cameras,
    factor: int,
    choose: Callable[[ExposedModel], Unknowns],
    unknown: Collection[int],
) -> tuple[Problem, Observations]:
    """The problem from `start` with a blurred volume, and what it observes of the blurred pictures."""
    model = start
    if not problem.unknowns.among(start, lambda m: m.scene.volume):
        blurred = blurred_volume(start.scene, cameras, factor)
        model = eqx.tree_at(lambda m: m.scene.volume, start, blurred)
    images, weights, middles = averaged(cameras, given, factor)
    observed = observe(model.scene, cameras, images, weights, problem.settings, unknown=unknown, among=middles)
    rough = Problem(model, choose(model), problem.settings, problem.loss, problem.priors, None, problem.skips)
    return rough, observed


def averaged(cameras: Cameras, given: Targets, factor: int) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Images whose pixels in the middle of a square of `factor` pixels a side have its mean, their weights, and which these are."""
    weights = check_weights(cameras, given.weights, given.images[0].dtype)
    images, found, middles = [], [], []
    for image, weight in zip(given.images, weights, strict=True):
        rows, columns = (n // factor for n in weight.shape)
        first = [(n - factor * m) // 2 for n, m in zip(weight.shape, (rows, columns), strict=True)]
        whole = tuple(slice(f, f + factor * m) for f, m in zip(first, (rows, columns), strict=True))
        middle = tuple(slice(f + factor // 2, f + factor * m, factor) for f, m in zip(first, (rows, columns), strict=True))
        squares = lambda x, whole=whole, shape=(rows, factor, columns, factor): x[whole].reshape(*shape, -1).sum(axis=(1, 3))
        total = squares(weight)
        mean = squares(weight[..., None] * image) / np.where(total > 0, total, 1)
        blurred, weighed, mask = np.zeros_like(image), np.zeros_like(weight), np.zeros(weight.shape, bool)
        blurred[middle], weighed[middle], mask[middle] = mean, total[..., 0] / factor**2, True
        images.append(blurred)
        found.append(weighed)
        middles.append(mask)
    return images, found, middles


def blurred_volume(scene: Scene, cameras: Cameras, factor: int) -> Volume:
    """The volume averaged over blocks of voxels of about the size of `factor` pixels at its centre, at least one voxel each. As it is where
    voxels cannot be averaged: labels, voxels without data, and where something was computed for them."""
    volume = scene.volume
    if not isinstance(volume.interpolation, Trilinear) or volume.gaps is not None or scene.precomputable:
        return volume
    size = factor * float(np.median([_pixel_size(camera, np.asarray(volume.center)) for camera in cameras]))
    wanted = np.rint(size / np.asarray(volume.spacing))
    blocks = np.clip(wanted, 1, np.maximum(np.asarray(volume.shape) // LEAST, 1)).astype(int)
    if np.all(blocks == 1):
        return volume
    values = np.asarray(volume.values, np.float32)
    missing = -np.asarray(volume.shape) % blocks
    before = missing // 2
    values = np.pad(values, list(zip(before, missing - before, strict=True)), mode="edge")
    shape = [n for axis, block in enumerate(blocks) for n in (values.shape[axis] // block, block)]
    matrix = in_double(volume.world_from_grid, volume.remainder)
    grid = np.diag([*blocks, 1.0])
    grid[:3, 3] = (blocks - 1) / 2 - before
    mean = values.reshape(shape).mean(axis=(1, 3, 5))
    return Volume(mean, matrix @ grid, slope=volume.slope, intercept=volume.intercept, interpolation=volume.interpolation)


def _pixel_size(camera: AbstractCamera, center: Float[np.ndarray, "3"]) -> float:
    """How far apart the rays of neighbouring pixels in the middle of a picture are as they pass a point."""
    pixel = camera.height // 2 * camera.width + camera.width // 2
    origin, direction = (np.stack(x, axis=1).astype(np.float64) for x in camera.rays(jnp.array([pixel - 1, pixel])))
    depth = (center - origin[0]) @ direction[0]
    return float(np.linalg.norm(np.diff(origin + depth * direction, axis=0)))
