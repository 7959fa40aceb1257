"""What a fit is told beside its targets: priors, and where voxels start and what they keep to."""

import dataclasses
from typing import Any

import jax.numpy as jnp

from jvr.io.config.schema.whole import LEAST_SQUARES, VOXELS, FitTable
from jvr.model.volume import Volume


def priors_of(fit: FitTable) -> tuple[Any, ...]:
    """The priors of `[fit.priors]`."""
    from jvr.fitting.losses import ColourSmoothness, ExtinctionSmoothness, Sparsity
    from jvr.fitting.voxel_priors import Tikhonov, TotalVariation

    kinds = {
        "colour_smoothness": ColourSmoothness,
        "extinction_smoothness": ExtinctionSmoothness,
        "sparsity": Sparsity,
        "total_variation": TotalVariation,
    }
    strengths = {name: getattr(fit.priors, name) for name in kinds}
    found = [kinds[name](strength) for name, strength in strengths.items() if strength]
    tikhonov = fit.priors.tikhonov
    if tikhonov is not None and (tikhonov.gradient or tikhonov.values):
        found.append(Tikhonov(**tikhonov.given()))
    return tuple(found)


def start_voxels(fit: FitTable, volume: Volume) -> Volume:
    """The volume with the voxels that a fit starts from."""
    if fit.voxels is None or fit.voxels.start is None:
        return volume
    stored = (fit.voxels.start - volume.intercept) / volume.slope
    return dataclasses.replace(volume, values=jnp.full(volume.shape, stored), gaps=None, missing=None)


def transforms_of(fit: FitTable, volume: Volume, views: int) -> tuple[Any, ...] | None:
    """One for each unknown array: the voxels in their range, all others as their classes declare. A name such as `cameras.fov_y` is an
    array of each of as many views."""
    if fit.voxels is None or fit.voxels.range is None:
        return None
    from jvr.fitting.bijectors import Bounded, Sigmoid

    low, high = sorted(float((end - volume.intercept) / volume.slope) for end in fit.voxels.range)
    within = Bounded(low, high, high - low) if fit.solver in ("lbfgsb", *LEAST_SQUARES) else Sigmoid(low, high)
    arrays = (name for name in fit.unknowns for _ in range(views if name.startswith("cameras.") else 1))
    return tuple(within if name == VOXELS else None for name in arrays)
