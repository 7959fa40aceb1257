"""The fields that rays can march through: voxels, resampled at every point, or samples kept from an earlier march."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt

from jvr.march.march import AbstractField
from jvr.march.steps import Point
from jvr.model.volume import Volume
from jvr.numerics import add_runs
from jvr.types import Scalar


class VoxelField(AbstractField):
    """The voxels of a volume, interpolated between."""

    volume: Volume

    def resample(self, point: Point) -> Scalar:
        return self.volume.sample(point.p)

    def deposit(self, gradient: Any, points: Point, cotangent: Float[Array, "rays"]) -> Any:
        volume, total = self.volume, gradient.volume
        if total.values is not None:
            flat = total.values.reshape(-1)
            for starts, weights in jax.vmap(lambda p: volume.interpolation.stencil(volume.shape, p))(points.p):
                terms = jnp.stack([w * cotangent * volume.slope for w in weights], axis=1)
                flat = add_runs(flat, starts, terms.astype(flat.dtype))
            total = eqx.tree_at(lambda v: v.values, total, flat.reshape(volume.shape))
        if total.slope is not None:
            stored = jax.vmap(volume.interpolate)(points.p)
            total = eqx.tree_at(lambda v: v.slope, total, total.slope + jnp.sum(stored * cotangent))
        if total.intercept is not None:
            total = eqx.tree_at(lambda v: v.intercept, total, total.intercept + jnp.sum(cotangent))
        return VoxelField(total)


class KeptField(AbstractField):
    """Scalars kept from an earlier march along the same rays: sample `k` of a ray is `stored[start[ray] + k * stride]`, an integer
    that stands for `low + scale * stored`. Positions play no part, and nothing here is differentiable."""

    stored: UInt[Array, "samples"]
    start: Int[Array, "rays"]
    low: Scalar
    scale: Scalar
    stride: int = eqx.field(static=True)

    def resample(self, point: Point) -> Scalar:
        # Clipped: the index of a finished ray may lie beyond the end.
        index = self.start[point.ray] + point.segment * self.stride
        return self.low + self.scale * self.stored.at[index].get(mode="clip").astype(self.low.dtype)

    def deposit(self, gradient: Any, points: Point, cotangent: Float[Array, "rays"]) -> Any:
        return gradient
