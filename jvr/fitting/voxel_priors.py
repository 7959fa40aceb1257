"""Priors over the voxels of a volume.

They are integrals over the volume's domain, divided by its size, of the scalar `s` in units of its `contrast`, the range of the table that
classifies it, and of lengths in units of the longest edge of the domain, so that neither the unit of the data or of the world nor the
resolution of the grid changes what a strength means.
"""

import itertools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.fitting.losses import AbstractPrior
from jvr.model.grids import resampled
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable
from jvr.model.volume import Volume
from jvr.types import Scalar


class TotalVariation(AbstractPrior):
    """Smoothed total variation of the voxels: few and sharp edges (Rudin, Osher and Fatemi 1992; smoothed as by Vogel and Oman 1996),

        strength * mean(sqrt(|L grad s|^2 / contrast^2 + epsilon^2) - epsilon),

    the mean over the volume's domain, `L` its longest edge. Isotropic: in each cell of eight voxels `|grad s|^2` is the mean over its
    corners of what the three edges that meet there say. Convex and smooth, also where the volume is constant.

    **Arguments:** `strength`; `epsilon`: the slope below which it is quadratic, as the change of `s / contrast` along `L`; `contrast`: a
    difference of scalars, by default that between the ends of the scene's table.
    **Raises** `ValueError` where `epsilon` or `contrast` is not positive; `value` does without a `contrast` where there is no table.
    """

    strength: float = eqx.field(static=True)
    epsilon: float = eqx.field(static=True, default=0.3)
    contrast: float | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        _positive(epsilon=self.epsilon, contrast=self.contrast)

    def value(self, scene: Scene) -> Scalar:
        steepness = squared_gradients(scene.volume, _scalars(scene, self.contrast))
        # The same number without the difference of two nearly equal ones.
        return self.strength * jnp.mean(steepness / (jnp.sqrt(steepness + self.epsilon**2) + self.epsilon))


class Tikhonov(AbstractPrior):
    """Tikhonov regularisation of the voxels, of their gradient and of their distance from a reference (Tikhonov 1963),

        gradient * mean(|L grad s|^2) / contrast^2 + values * mean((s - reference)^2) / contrast^2,

    with `L` and `contrast` as in `TotalVariation`. Quadratic: smooth everywhere, edges included.

    **Arguments:** `gradient`, `values`: strengths; `reference`: a scalar, or one for each voxel of a grid over the same domain.
    **Raises** `ValueError` where both strengths are zero or one is negative, and where `contrast` is not positive.
    """

    gradient: float = eqx.field(static=True, default=0.0)
    values: float = eqx.field(static=True, default=0.0)
    reference: Float[Array, "..."] = eqx.field(converter=jnp.asarray, default=0.0)
    contrast: float | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        _positive(contrast=self.contrast)
        if not (min(self.gradient, self.values) >= 0 and max(self.gradient, self.values) > 0):
            raise ValueError("Tikhonov needs a strength that is positive: gradient= or values=")

    def value(self, scene: Scene) -> Scalar:
        scalars, found = _scalars(scene, self.contrast), jnp.zeros(())
        if self.gradient:
            found += self.gradient * jnp.mean(squared_gradients(scene.volume, scalars))
        if self.values:
            reference = self.reference / _contrast(scene, self.contrast)
            reference = resampled(reference, scene.volume.shape) if reference.ndim else reference
            found += self.values * jnp.mean(jnp.square(scalars - reference))
        return found


def squared_gradients(volume: Volume, scalars: Float[Array, "x y z"]) -> Float[Array, "cells_x cells_y cells_z"]:
    """`|L grad s|^2` in each cell of eight voxels, with `L` the longest edge of the domain: the mean over the cell's corners.

    Edges are not averaged before they are squared: a checkerboard is steep. The world's metric is that of the volume's axes, which may be
    oblique. Axes of one voxel take no part.
    """
    axes = [axis for axis, n in enumerate(volume.shape) if n > 1]
    # In units of L, so that the unit of the world is rounded away nowhere.
    extent = volume.spacing * (jnp.asarray(volume.shape, volume.spacing.dtype) - 1)
    inverse = volume.axes_inverse * jnp.max(extent)
    metric = inverse @ inverse.T
    steps = {axis: jnp.diff(scalars, axis=axis) for axis in axes}
    cells = tuple(max(n - 1, 1) for n in volume.shape)
    found = jnp.zeros(cells, scalars.dtype)
    for axis in axes:
        found += metric[axis, axis] * _middles(jnp.square(steps[axis]), [other for other in axes if other != axis])
    for one, other in itertools.combinations(axes, 2):
        product = _middles(steps[one], [other]) * _middles(steps[other], [one])
        found += 2 * metric[one, other] * _middles(product, [axis for axis in axes if axis not in (one, other)])
    return found


def _middles(x: Float[Array, "x y z"], axes: list[int]) -> Float[Array, "..."]:
    """Means of neighbours along some axes."""
    for axis in axes:
        n = x.shape[axis]
        x = (jnp.take(x, np.arange(n - 1), axis=axis) + jnp.take(x, np.arange(1, n), axis=axis)) / 2
    return x


def _scalars(scene: Scene, contrast: float | None) -> Float[Array, "x y z"]:
    volume = scene.volume
    return (volume.slope * volume.values.astype(volume.slope.dtype) + volume.intercept) / _contrast(scene, contrast)


def _contrast(scene: Scene, contrast: float | None) -> Any:
    if contrast is not None:
        return contrast
    if not isinstance(scene.transfer, AbstractTable):
        raise ValueError(
            f"{type(scene.transfer).__name__} has no ends: give the prior contrast=, a typical difference of scalars"
        )
    low, high = scene.transfer.ends
    return high - low


def _positive(**numbers: float | None) -> None:
    for name, number in numbers.items():
        if number is not None and not 0 < number < np.inf:
            raise ValueError(f"{name} must be positive and finite, not {number!r}")
