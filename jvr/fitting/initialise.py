"""Initial values of a fit: a flat transfer function, and the colours that suit given extinctions."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jvr.fitting.losses import SquaredError
from jvr.fitting.normal_equations import normal_equations
from jvr.fitting.observations import observe
from jvr.fitting.problem import Problem
from jvr.fitting.targets import check_images
from jvr.fitting.unknowns import ExposedModel, choose_unknowns
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable, LutTransfer
from jvr.model.volume import Volume
from jvr.model.voxels import typical_range
from jvr.rendering.settings import Settings


def flat_transfer(volume: Volume, entries: int = 64, *, opacity: float = 0.018, grey: float = 0.5) -> LutTransfer:
    """A transfer function that says nothing yet: one grey, one thin extinction, over the range of the volume's values. Single voxels that
    lie far beyond all others do not count, nor do missing ones; values beyond the table are those of its ends.

    **Arguments:** `entries`: of the table; `opacity`: optical depth of one voxel; `grey`: colour of every entry.
    """
    ends = np.sort([float(volume.slope * v + volume.intercept) for v in typical_range(volume.data())])
    if not ends[0] < ends[1]:
        raise ValueError(f"every voxel has the value {ends[0]:g}: a transfer function cannot be fitted to a constant volume")
    sigma_t = opacity / float(jnp.min(volume.spacing))
    return LutTransfer(np.full((entries, 3), grey), np.full(entries, sigma_t), ends)


def colours_given_extinction(
    scene: Scene, cameras: Sequence[AbstractCamera], images: Any, settings: Settings = Settings(), *, ridge: float = 1e-6
) -> Scene:
    """The scene with the colours of its table that explain the images best while its extinctions stay as they are.

    With extinction given, a ray's radiance is linear in the colours, so this is one linear least-squares problem of `entries`
    unknowns for each channel (the idea of Neuhauser and Westermann 2023, solved over entries instead of voxels). Entries that no ray
    sees keep their colour; colours are clipped to 0 ... 1.

    **Raises** `ValueError` where the transfer function is not a table, the images do not fit the cameras, or rays are not marched.
    """
    if not isinstance(scene.transfer, AbstractTable):
        raise ValueError(f"colours can be solved for in a table, not in {type(scene.transfer).__name__}")
    targets = check_images(cameras, images)
    colours: Any = lambda scene: scene.transfer.rgb
    unknowns = choose_unknowns(ExposedModel(scene, None), lambda m: colours(m.scene))
    problem = Problem(ExposedModel(scene, None), unknowns, settings, SquaredError(), (), None)
    observations = observe(scene, cameras, targets, None, settings)
    if not problem.integrator.marches:
        raise ValueError("radiance is linear in colours along marched rays: leave Settings(sampling=...) at jvr.Uniform()")
    start = jnp.ravel(scene.transfer.rgb)
    matrix, vector = np.zeros((start.size,) * 2), np.zeros(start.size)
    for i in range(observations.tile_count()):
        normal = normal_equations(problem, start, observations, i)
        matrix += np.asarray(normal.matrix, np.float64)
        vector += np.asarray(normal.vector, np.float64)
    scale = max(np.diag(matrix).max(), np.finfo(float).tiny)
    move = np.linalg.solve(matrix + ridge * scale * np.eye(start.size), -vector)
    rgb = np.clip(np.asarray(start) + move, 0, 1).reshape(scene.transfer.rgb.shape)
    return eqx.tree_at(colours, scene, jnp.asarray(rgb, scene.transfer.rgb.dtype))
