"""Occlusion from local histograms: ambient occlusion that knows which scalars are near a point, and so any transfer function at once
(Ropinski, Meyer-Spradow, Diepenbrock, Mensmann and Hinrichs, "Interactive volume rendering with dynamic ambient occlusion and color
bleeding", Computer Graphics Forum 27(2), 2008; course notes on GPU-based volume ray-casting, Eurographics 2009, section 6.2).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from jvr.effects.nodes import AbstractProjection
from jvr.effects.occlusion import OcclusionVisibility, occlusion_visibility
from jvr.effects.short_rays import Reach, fractions_inside, short_rays
from jvr.march.medium import DENSEST, LightPath, Medium
from jvr.march.secondary import take_midpoint
from jvr.model.clipping import Clipping
from jvr.model.effects import AbstractOcclusion, stale_message
from jvr.model.grids import Shape, node_shape
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import Knob, multiples
from jvr.model.ranges import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, UNIT_INTERVAL, Interval
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import divide_or_zero, mean_transmittance
from jvr.types import ArrayLike, Scalar

# Scalars at which the transfer function is looked at on either side of each bin.
LOOKS = 8
# Size of a grain where a scene says none, in voxels of the smallest spacing: that of the least error on the scenes of
# `experiments/occlusion_accuracy.py`.
GRAIN = 2.0


class LocalHistograms(eqx.Module):
    """Histograms of the scalars around the nodes of a grid, as `jvr.precompute` makes them of a `jvr.HistogramOcclusion`.

    - `weights`: `(x, y, z, bins)`: how much of the ball around a node has the scalar of a bin, points weighted with `1 / d^2` of their
      distance `d`, so that all distances count alike (notes, equation 6.7); a scalar between two bins counts in both, by how near it is.
      Their sum is 1, less what lies outside of the volume or has no data.
    - `positions`: `(bins,)`: the scalars of the bins.
    - `length`: from where the ball begins to where it ends, in the world.
    - `cache_key`: checksums of what they were made of (`jvr.model.kept.content`).
    - `pinned`: whether they stay as they are although the volume is another.
    """

    weights: Float[Array, "x y z bins"]
    positions: Float[Array, "bins"]
    length: Scalar
    cache_key: UInt32[Array, "parts 2"]
    pinned: bool = eqx.field(static=True, default=False)


class HistogramOcclusion(AbstractOcclusion):
    """Dynamic ambient occlusion: as `jvr.LocalOcclusion`, from the histogram of the scalars in a ball around a point, whatever the transfer
    function makes of them.

        I(x) = phi1((R - a) sum_k H_k(x) rho_k),    rho_k = (1 - exp(-sigma_t(s_k) g)) / g,    phi1(d) = (1 - exp(-d)) / d,

    the mean transmittance of a ball in which grains of `g` across lie at random, each with one scalar `s_k` of the histogram `H(x)`: exact
    where the ball is homogeneous and not opaque within a grain. What stands in front of what histograms do not know: the wall of a large
    opaque body shades more than it should, and a sheet that is thinner than a grain as well. Ambient light is multiplied with
    `(bias + (1 - bias) I)^gamma`.

    With a `bleeding` the medium that is near sends on a part of the light that it takes, in its own colour, the mean of `rgb_k` with the
    weights `H_k rho_k`: `I + bleeding (1 - I) rgb` in each colour.

    **Arguments:** `bins`: of a histogram, equally spaced between the least and the largest voxel, at least 2; `rays`, `radius`, `offset`,
    `samples`, `resolution`, `bias`, `gamma`: as of `jvr.LocalOcclusion`; `grain`: `g`, a world length, by default twice the smallest
    spacing; `bleeding`: 0 ... 1, or `None`.

    Differentiable in transfer function, `bias`, `gamma`, `grain` and `bleeding`, and where histograms are not computed beforehand in
    voxels, `radius` and `offset`; detached: where bins lie. `jvr.precompute(scene)` keeps them: they are those of volume and clipping box,
    and a new transfer function costs a product of a matrix and a vector, `bins` numbers for each node. **Raises** `ValueError` for numbers
    outside their ranges, and for a transfer function that takes the gradient, of which histograms know nothing.
    """

    bins: int = choice(Interval(low=2.0), doc="of each histogram", most=1024)
    rays: int = choice(AT_LEAST_ONE, doc="rays for each node")
    radius: Scalar | None = parameter(NOT_NEGATIVE, doc="of the ball around a point", unit="mm")
    offset: Scalar | None = parameter(NOT_NEGATIVE, doc="how far from a point the ball begins", unit="mm")
    samples: int = choice(AT_LEAST_ONE, doc="along each ray")
    resolution: float = choice(Interval(0.0, 1.0, "(]"), doc="nodes for each voxel along an axis", hint="0.5 is a good start")
    bias: Scalar = parameter(UNIT_INTERVAL, doc="share of ambient light that nothing takes away")
    gamma: Scalar | None = parameter(POSITIVE, doc="exponent of what is left of ambient light")
    grain: Scalar | None = parameter(POSITIVE, doc="size of what is opaque", unit="mm")
    bleeding: Scalar | None = parameter(UNIT_INTERVAL, doc="share of the light that what is near sends on")
    projected: LocalHistograms | None = parameter(doc="what has been computed beforehand")

    def __init__(
        self,
        bins: int = 32,
        rays: int = 32,
        *,
        radius: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        samples: int = 16,
        resolution: float | int = 0.5,
        bias: ArrayLike = 0.0,
        gamma: ArrayLike | None = None,
        grain: ArrayLike | None = None,
        bleeding: ArrayLike | None = None,
    ):
        assign(self, bins=bins, rays=rays, radius=radius, offset=offset, samples=samples, resolution=resolution)
        assign(self, bias=bias, gamma=gamma, grain=grain, bleeding=bleeding)
        self.projected = None

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        if self.is_frozen:
            return ()
        return (
            multiples("bins", self.bins, (1 / 2, 1), 4, least=2),
            multiples("rays", self.rays, (1 / 2, 1), 4, least=1),
            multiples("samples", self.samples, (1 / 2, 1), 2, least=1),
            multiples("resolution", self.resolution, (1 / 2, 1), 2, most=1.0),
        )

    @property
    def stale_message(self) -> str:
        return stale_message("occlusion", "occlusion", "volume, clipping box, radius or offset")

    def sources(self, scene: Scene) -> Any:
        volume = scene.volume
        parts = [volume.values, volume.gaps, volume.slope, volume.intercept, volume.world_from_grid, volume.interpolation]
        return parts, scene.clipping, self.radius, self.offset

    def projection(self, scene: Scene, path: LightPath) -> "HistogramProjection":
        if scene.transfer.takes_gradient:
            raise ValueError("histograms know nothing of gradients, which the transfer function takes: use jvr.LocalOcclusion")
        # Whatever the transfer function makes visible.
        medium = path(False)._replace(occupancy=None)
        return HistogramProjection(
            volume=scene.volume,
            clipping=scene.clipping,
            medium=medium,
            reach=Reach.of(self, scene.volume),
            scalars=_positions(self.bins, scene.volume),
            rays=self.rays,
            resolution=self.resolution,
        )

    def finished(self, scene: Scene, *nodes: Any) -> LocalHistograms:
        (weights,) = nodes
        weights = weights.reshape(*node_shape(scene.volume, self.resolution), -1)
        positions, length = _positions(self.bins, scene.volume), Reach.of(self, scene.volume).length
        return LocalHistograms(weights, positions, length, jnp.asarray(self.cache_key(scene)))

    def visibility(self, scene: Scene, path: LightPath) -> OcclusionVisibility:
        histograms = self.projected
        if histograms is None:
            histograms = self.finished(scene, *self.projection(scene, path).all_nodes())
        return occlusion_visibility(self, scene.volume, self._taken(scene, histograms))

    def _taken(self, scene: Scene, histograms: LocalHistograms) -> Float[Array, "x y z channels"]:
        """What nodes take away of ambient light, by the transfer function of a scene."""
        # Each bin as its own hat sees the transfer function.
        positions, at = histograms.positions, (jnp.arange(2 * LOOKS + 1, dtype=histograms.positions.dtype) - LOOKS) / (LOOKS + 1)
        hat = (1 - jnp.abs(at)) / jnp.sum(1 - jnp.abs(at))
        scalars = jnp.clip(positions[:, None] + at * (positions[1] - positions[0]), positions[0], positions[-1])
        classified = jax.vmap(jax.vmap(scene.transfer.evaluate))(scalars)
        rgb, sigma_t = classified.rgb, classified.sigma_t
        grain = GRAIN * jnp.min(scene.volume.spacing) if self.grain is None else self.grain
        # The mean extinction of a grain: so much of it as it takes of what goes through it.
        rho = [sigma * mean_transmittance(sigma * grain) for sigma in (jnp.minimum(s, DENSEST / grain) for s in sigma_t)]
        channels = [r @ hat for r in rho]
        coloured = [] if self.bleeding is None else [(r * c) @ hat for r, c in zip(rho * (3 // len(rho)), rgb, strict=True)]
        found = jnp.moveaxis(histograms.weights @ jnp.stack(channels + coloured, axis=-1), -1, 0)
        extinction = list(found[: len(channels)])
        taken = [1 - mean_transmittance(histograms.length * mean) for mean in extinction]
        if self.bleeding is not None:
            colours = zip(taken * (3 // len(taken)), extinction * (3 // len(extinction)), found[len(channels) :], strict=True)
            taken = [t * (1 - self.bleeding * divide_or_zero(c, mean)) for t, mean, c in colours]
        return jnp.stack(taken, axis=-1)


class HistogramProjection(AbstractProjection):
    """All that the histograms of a scene are made with, `rays` rays from each node. `scalars`: of the bins."""

    volume: Volume
    clipping: Clipping
    medium: Medium
    reach: Reach
    scalars: Float[Array, "bins"]
    rays: int = eqx.field(static=True)
    resolution: float = eqx.field(static=True)

    @property
    def shape(self) -> Shape:
        return node_shape(self.volume, self.resolution)

    def project(self, p: Float[Array, "nodes 3"]) -> tuple[Float[Array, "nodes bins"]]:
        """Histograms around grid positions."""
        rays, bins = short_rays(self.volume, self.clipping, self.rays, p), self.scalars.shape[0]
        ends = self.reach.ends
        first, last = self.scalars[0], self.scalars[-1]
        node = jnp.repeat(jnp.arange(p.shape[0]), self.rays)

        def step(total: Float[Array, "nodes bins"], ends: tuple[Scalar, Scalar]) -> tuple[Float[Array, "nodes bins"], None]:
            _, _, sample = take_midpoint(self.medium, self.volume, rays, *ends, True)
            share = fractions_inside(rays, *ends)[1]
            for known in sample.known:
                share = jnp.where(known > 0.5, share, 0.0)
            # A volume of one value has all of it in its first bin.
            wide = last > first
            place = jnp.where(wide, (sample.s - first) / jnp.where(wide, last - first, 1.0), 0.0) * (bins - 1)
            place = jnp.clip(jnp.where(share > 0, place, 0.0), 0.0, bins - 1)
            low = jnp.clip(jax.lax.stop_gradient(jnp.floor(place)), 0, bins - 2)
            index, fraction = low.astype(jnp.int32), place - low
            total = total.at[node, index].add(share * (1 - fraction)).at[node, index + 1].add(share * fraction)
            return total, None

        zero = jnp.zeros((p.shape[0], bins), self.scalars.dtype)
        total, _ = jax.lax.scan(jax.checkpoint(step), zero, (ends[:-1], ends[1:]))
        return (total * (1 - self.reach.beyond) / (self.rays * (ends.shape[0] - 1)),)


def _positions(bins: int, volume: Volume) -> Float[Array, "bins"]:
    """Scalars of bins, from the least to the largest of a volume."""
    voxels = jax.lax.stop_gradient(volume.values).astype(volume.slope.dtype)
    there = jnp.isfinite(voxels)
    ends = jnp.min(jnp.where(there, voxels, jnp.inf)), jnp.max(jnp.where(there, voxels, -jnp.inf))
    ends = [jnp.where(jnp.any(there), end, 0.0) * volume.slope + volume.intercept for end in ends]
    return jnp.linspace(jnp.minimum(*ends), jnp.maximum(*ends), bins)
