"""The fields that rays can march through: voxels, resampled at every point, or samples cached by an earlier march."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Int, UInt

from jvr.march.medium import AbstractField
from jvr.march.steps import Point, Sample
from jvr.model.normals import AbstractNormals
from jvr.model.volume import Volume
from jvr.types import Scalar

# Stands for a cached sample that is made of missing voxels.
MISSING = 65535


class VoxelField(AbstractField):
    """The voxels of a volume, interpolated between, with the gradient that `normals` makes of them where it is not `None`."""

    volume: Volume
    normals: AbstractNormals | None = None

    def resample(self, point: Point) -> Sample:
        volume, p = self.volume, point.p
        s, gradient, neighbours = (volume.sample(p), (), ()) if self.normals is None else self.normals.resample(volume, p)
        known = () if volume.gaps is None else (volume.is_known(p).astype(s.dtype),)
        return Sample(s, gradient, neighbours, known=known)

    def deposit(self, gradient: Any, points: Point, cotangent: Sample) -> Any:
        if self.normals is None:
            return VoxelField(self.volume.deposit(gradient.volume, points.p, cotangent.s))
        return VoxelField(*self.normals.deposit(self.volume, (gradient.volume, gradient.normals), points.p, cotangent[:3]))


class CachedSamples(AbstractField):
    """Scalars cached by an earlier march along the same rays: sample `k` of a ray is `stored[start[ray] + k * stride]`, an integer
    that stands for `low + scale * stored`, or with `gaps` for a missing one where it is `MISSING`. Positions play no part, and nothing here
    is differentiable."""

    stored: UInt[Array, "samples"]
    start: Int[Array, "rays"]
    low: Scalar
    scale: Scalar
    stride: int = eqx.field(static=True)
    gaps: bool = eqx.field(static=True)

    def resample(self, point: Point) -> Sample:
        # Clipped: the index of a finished ray may lie beyond the end.
        index = self.start[point.ray] + point.k * self.stride
        stored = self.stored.at[index].get(mode="clip")
        known = ((stored != MISSING).astype(self.low.dtype),) if self.gaps else ()
        return Sample(self.low + self.scale * stored.astype(self.low.dtype), known=known)

    def deposit(self, gradient: Any, points: Point, cotangent: Sample) -> Any:
        return gradient
