"""Local histograms: which scalars lie around the nodes of a grid, in which direction and how far away, whatever a transfer function makes
of them; kept as a few typical ones and, at each node, which of them it has (vector quantisation).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt16, UInt32

from jvr.effects.short_rays import Reach, fractions_inside
from jvr.march.secondary import SecondaryRays, points
from jvr.model.volume import Volume
from jvr.numerics import divide_or_zero, rounded_into
from jvr.types import Scalar

# Weight of the farthest shell beside that of the nearest, where two directions are compared: what is near shades what is far.
FARTHEST = 0.3
# Weight of how much of a shell lies in the volume, beside the mean and the spread of its scalars (in units of their range).
INSIDE = 0.25
# Squared spread of a feature below which what has it is not told apart.
SAME = 1e-9


class LocalHistograms(eqx.Module):
    """Histograms of the scalars around the nodes of a grid, as `jvr.precompute` makes them of a `jvr.HistogramOcclusion`.

    - `weights`: `(clusters, shells, bins)`: how much of each shell, that is of a part of a ray, has the scalar of a bin, the mean over the
      rays of a cluster; a scalar between two bins counts in both, by how near it is. The sum over the bins is 1, less what lies outside
      of the volume or has no data.
    - `codes`: `(rays, x, y, z)`: the cluster of each ray of a node.
    - `positions`: `(bins,)`: the scalars of the bins.
    - `extents`: `(shells,)`: world lengths of the shells; `beyond`: the fraction of a ray that lies behind the last of them, where there is
      nothing.
    - `cache_key`: checksums of what they were made of (`jvr.model.kept.content`).
    - `pinned`: whether they stay as they are although the volume is another.
    """

    weights: Float[Array, "clusters shells bins"]
    codes: UInt16[Array, "rays x y z"]
    positions: Float[Array, "bins"]
    extents: Float[Array, "shells"]
    beyond: Scalar
    cache_key: UInt32[Array, "parts 2"]
    pinned: bool = eqx.field(static=True, default=False)


class Bins(NamedTuple):
    """Scalars of the bins of histograms, equally spaced from the least to the largest voxel."""

    positions: Float[Array, "bins"]

    @classmethod
    def of(cls, number: int, volume: Volume) -> "Bins":
        voxels = volume.values.astype(volume.slope.dtype)
        there = jnp.isfinite(voxels)
        ends = jnp.min(jnp.where(there, voxels, jnp.inf)), jnp.max(jnp.where(there, voxels, -jnp.inf))
        ends = [jnp.where(jnp.any(there), end, 0.0) * volume.slope + volume.intercept for end in ends]
        return cls(jnp.linspace(jnp.minimum(*ends), jnp.maximum(*ends), number))

    def place(self, s: Float[Array, "..."]) -> Float[Array, "..."]:
        """Where a scalar lies between the first and the last bin, 0 ... 1. A volume of one value has all of it in its first."""
        first, last = self.positions[0], self.positions[-1]
        return jnp.clip(divide_or_zero(s - first, jnp.full_like(s, last - first)), 0.0, 1.0)


class Tree(eqx.Module):
    """Which cluster a ray belongs to: a binary tree, of which each level compares one feature of a ray with a threshold."""

    features: Int[Array, "levels branches"]
    thresholds: Float[Array, "levels branches"]

    def find(self, x: Float[Array, "rays features"]) -> Int[Array, "rays"]:
        """The cluster of each ray."""

        def descend(code: Int[Array, "rays"], level: tuple[Array, Array]) -> tuple[Int[Array, "rays"], None]:
            features, thresholds = level
            along = jnp.take_along_axis(x, features[code][:, None], axis=1)[:, 0]
            return 2 * code + (along > thresholds[code]), None

        return jax.lax.scan(descend, jnp.zeros(x.shape[0], jnp.int32), (self.features, self.thresholds))[0]


def grown(x: Float[Array, "rays features"], levels: int) -> Tree:
    """The tree of some rays: what is together is split at the mean of the feature that is spread most."""
    branches = 2 ** max(levels - 1, 0)

    def split(code: Int[Array, "rays"], _: None) -> tuple[Int[Array, "rays"], tuple[Array, Array]]:
        total = lambda values: jnp.zeros((branches, *values.shape[1:]), x.dtype).at[code].add(values)
        number = jnp.maximum(total(jnp.ones(x.shape[0], x.dtype)), 1)[:, None]
        mean = total(x) / number
        spread = total(jnp.square(x - mean[code])) / number
        feature = jnp.argmax(spread, axis=1).astype(jnp.int32)
        own = lambda values: jnp.take_along_axis(values, feature[:, None], axis=1)[:, 0]
        # Else what differs by a rounding from all that is known would end where nothing is.
        threshold = jnp.where(own(spread) > SAME, own(mean), jnp.inf)
        along = jnp.take_along_axis(x, feature[code][:, None], axis=1)[:, 0]
        return 2 * code + (along > threshold[code]), (feature, threshold)

    _, (features, thresholds) = jax.lax.scan(split, jnp.zeros(x.shape[0], jnp.int32), length=levels)
    return Tree(features, thresholds)


class RaySamples(NamedTuple):
    """Samples of rays: where their scalars lie between the first and the last bin, and how much of what they stand for is in the volume."""

    place: Float[Array, "samples rays"]
    inside: Float[Array, "samples rays"]


def ray_samples(volume: Volume, bins: Bins, rays: SecondaryRays, reach: Reach) -> RaySamples:
    """Samples of each ray, each in the middle of what of its segment lies in the volume."""

    def sample(_: None, ends: tuple[Scalar, Scalar]) -> tuple[None, tuple[Array, Array]]:
        before, inside = fractions_inside(rays, *ends)
        middle = ends[0] + (before + 0.5 * inside) * (ends[1] - ends[0])
        p = tuple(c + middle * d for c, d in zip(rays.p, rays.along, strict=True))
        # By a rounding what is at a border may be outside, where nothing may be read.
        p = tuple(rounded_into(c, first, last) for c, first, last in zip(p, *volume.domain, strict=True))
        known = inside > 0
        if volume.gaps is not None:
            known &= jax.vmap(volume.is_known)(points(p, rays.along).p)
        s = jax.vmap(volume.sample)(p)
        return None, (jnp.where(known, bins.place(s), 0.0), jnp.where(known, inside, 0.0))

    return RaySamples(*jax.lax.scan(sample, None, (reach.ends[:-1], reach.ends[1:]))[1])


def shell_of(samples: int, shells: int) -> np.ndarray:
    """The shell of each sample of a ray."""
    return np.arange(samples) * min(shells, samples) // samples


def features_of(samples: RaySamples, shells: int) -> Float[Array, "rays features"]:
    """What rays are told apart by: of each shell the mean and the spread of its scalars, and how much of it lies in the volume."""
    of = shell_of(samples.place.shape[0], shells)
    found = []
    for shell, weight in enumerate(np.linspace(1.0, FARTHEST, of[-1] + 1)):
        place, inside = (x[of == shell] for x in samples)
        total = jnp.sum(inside, axis=0)
        mean = divide_or_zero(jnp.sum(inside * place, axis=0), total)
        spread = jnp.sqrt(divide_or_zero(jnp.sum(inside * jnp.square(place - mean), axis=0), total))
        found += [weight * mean, weight * spread, weight * INSIDE * total / place.shape[0]]
    return jnp.stack(found, axis=-1)


def mean_histograms(
    samples: RaySamples, code: Int[Array, "rays"], clusters: int, shells: int, bins: int
) -> Float[Array, "clusters shells bins"]:
    """The mean histogram of each shell of the rays of a cluster."""
    of = shell_of(samples.place.shape[0], shells)
    place = samples.place * (bins - 1)
    low = jnp.clip(jnp.floor(place), 0, bins - 2)
    fraction = place - low
    row = (code * (of[-1] + 1) + jnp.asarray(of, jnp.int32)[:, None]) * bins + low.astype(jnp.int32)
    total = jnp.zeros(clusters * (of[-1] + 1) * bins, place.dtype)
    total = total.at[row].add(samples.inside * (1 - fraction)).at[row + 1].add(samples.inside * fraction)
    number = jnp.zeros(clusters, place.dtype).at[code].add(1.0)
    each = number[:, None] * jnp.asarray(np.bincount(of), place.dtype)
    return divide_or_zero(total.reshape(clusters, -1, bins), each[..., None] * jnp.ones(bins, place.dtype))
