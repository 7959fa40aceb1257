"""Occlusion from local histograms: ambient occlusion that knows which scalars are near a point, and so any transfer function at once
(Ropinski, Meyer-Spradow, Diepenbrock, Mensmann and Hinrichs, "Interactive volume rendering with dynamic ambient occlusion and color
bleeding", Computer Graphics Forum 27(2), 2008; course notes on GPU-based volume ray-casting, Eurographics 2009, section 6.2).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt16

from jvr.effects.local_histograms import (
    Bins,
    LocalHistograms,
    Tree,
    features_of,
    grown,
    mean_histograms,
    ray_samples,
    shell_of,
)
from jvr.effects.nodes import AbstractProjection
from jvr.effects.occlusion import OcclusionVisibility, darkness_at_voxels, nodes_along, occlusion_visibility, resolutions
from jvr.effects.short_rays import Reach, short_rays
from jvr.march.medium import DENSEST, LightPath, Medium
from jvr.model.clipping import Clipping
from jvr.model.effects import AbstractNodeOcclusion, stale_message
from jvr.model.grids import Shape, node_positions
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import Knob, multiples
from jvr.model.ranges import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, UNIT_INTERVAL, Interval
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import divide_or_zero, mean_transmittance, one_minus_exp
from jvr.types import ArrayLike, Scalar

# Scalars at which the transfer function is looked at on either side of each bin.
LOOKS = 8
# Nodes at most whose rays the clusters are made of.
TAUGHT = 4096
# Levels of the tree beyond those that halves of equal size would take.
SPARE = 4


class HistogramOcclusion(AbstractNodeOcclusion):
    """Dynamic ambient occlusion: as `jvr.LocalOcclusion`, from histograms of the scalars around a point, whatever the transfer function
    makes of them.

    Each of `K` rays of a point is cut into shells, of each of which a histogram `H` is known. What a transfer function makes of it is
    homogeneous within a shell, and marched from the inside out:

        I(x) = 1 / K sum_k sum_i D_i / (R - a) exp(-sum_(j<i) D_j sigma_kj) phi1(D_i sigma_ki),
        sigma_ki = sum_b H_kib(x) sigma_t(s_b),    phi1(d) = (1 - exp(-d)) / d,

    with the length `D_i` of a shell. It is exact where no shell has more than one scalar in it; what lies in front of what within one
    shell is not known. (One histogram of the whole ball, as the paper has it, does not know that of any two points.) Ambient
    light is multiplied with `(bias + (1 - bias) I)^gamma`.

    Of all rays of all nodes `clusters` are kept, the means of those that are alike in the mean and the spread of the scalars of each shell:
    their histograms take `4 clusters x shells x bins` bytes, and each node one number of two bytes a ray. A new transfer function is one
    product of the histograms with a vector, a sum over the shells of each cluster, and one over the rays of each node.

    With a `bleeding` the medium that is near sends on a part of the light that it takes, in its own colour: to `I` is added, in each
    colour, `bleeding` times what each shell takes times the mean of `rgb` in it, with the weights `H sigma_t`.

    **Arguments:** `bins`: of a histogram, equally spaced between the least and the largest voxel, at least 2; `shells`: parts of a ray,
    at most as many as `samples`; `clusters`: at most 65536, rounded up to a power of two; `rays`, `radius`, `offset`, `samples`,
    `resolution`, `bias`, `gamma`: as of `jvr.LocalOcclusion`; `bleeding`: 0 ... 1, or `None`.

    Differentiable in transfer function, `bias`, `gamma` and `bleeding`; detached: voxels, `radius`, `offset`, which
    `jvr.LocalOcclusion` has derivatives in. `jvr.precompute(scene)` keeps the histograms: they are those of volume and clipping box.
    **Raises** `ValueError` for numbers outside their ranges, and for a transfer function that takes the gradient, of which histograms know
    nothing.
    """

    bins: int = choice(Interval(low=2.0), doc="of each histogram", most=1024)
    rays: int = choice(AT_LEAST_ONE, doc="rays for each node")
    shells: int = choice(AT_LEAST_ONE, doc="histograms along each ray", most=64)
    clusters: int = choice(Interval(1, 65536), doc="different rays that are kept")
    radius: Scalar | None = parameter(NOT_NEGATIVE, doc="of the ball around a point", unit="mm")
    offset: Scalar | None = parameter(NOT_NEGATIVE, doc="how far from a point the ball begins", unit="mm")
    samples: int = choice(AT_LEAST_ONE, doc="along each ray")
    resolution: float | None = choice(
        Interval(0.0, 1.0, "(]"), doc="nodes for each voxel along an axis", hint="0.5 is a good start"
    )
    bias: Scalar = parameter(UNIT_INTERVAL, doc="share of ambient light that nothing takes away")
    gamma: Scalar | None = parameter(POSITIVE, doc="exponent of what is left of ambient light")
    bleeding: Scalar | None = parameter(UNIT_INTERVAL, doc="share of the light that what is near sends on")
    projected: LocalHistograms | None = parameter(doc="what has been computed beforehand")

    def __init__(
        self,
        bins: int = 64,
        rays: int = 32,
        *,
        shells: int = 8,
        clusters: int = 2**14,
        radius: ArrayLike | None = None,
        offset: ArrayLike | None = None,
        samples: int = 16,
        resolution: float | int | None = None,
        bias: ArrayLike = 0.0,
        gamma: ArrayLike | None = None,
        bleeding: ArrayLike | None = None,
    ):
        assign(self, bins=bins, rays=rays, shells=shells, clusters=clusters, radius=radius, offset=offset, samples=samples)
        assign(self, resolution=resolution, bias=bias, gamma=gamma, bleeding=bleeding)
        self.projected = None

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        if self.is_frozen:
            return ()
        return (
            multiples("bins", self.bins, (1 / 2, 1), 4, least=2),
            multiples("rays", self.rays, (1 / 2, 1), 4, least=1),
            multiples("shells", self.shells, (1 / 2, 1), 2, least=1, most=64),
            multiples("clusters", self.clusters, (1 / 4, 1), 4, least=1, most=65536),
            multiples("samples", self.samples, (1 / 2, 1), 2, least=1),
            resolutions(self, scene.volume),
        )

    @property
    def reads_transfer(self) -> bool:
        return True

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
        return HistogramProjection.of(self, scene, medium)

    def finished(self, scene: Scene, projection: "HistogramProjection", *nodes: Any) -> LocalHistograms:
        codes = nodes[0].T.reshape(-1, *projection.shape)
        reach, samples = projection.reach, self.samples
        shells = np.bincount(shell_of(samples, self.shells)) / samples
        extents = reach.length * (1 - reach.beyond) * jnp.asarray(shells, reach.ends.dtype)
        key = jnp.asarray(self.cache_key(scene))
        return LocalHistograms(projection.weights, codes, projection.bins.positions, extents, reach.beyond, key)

    def visibility(self, scene: Scene, path: LightPath) -> OcclusionVisibility:
        histograms = self.projected
        if histograms is None:
            projection = self.projection(scene, path)
            histograms = self.finished(scene, projection, *projection.all_nodes())
        taken = _mean_over_rays(self._taken_by_clusters(scene, histograms), histograms.codes)
        return occlusion_visibility(self, scene.volume, darkness_at_voxels(taken, scene.volume))

    def _taken_by_clusters(self, scene: Scene, histograms: LocalHistograms) -> Float[Array, "clusters channels"]:
        """What rays take away of ambient light, by the transfer function of a scene."""
        rgb, sigma_t = _in_bins(scene, histograms.positions)
        # Not in fewer digits, as accelerators would: what is transparent has to stay so.
        mean = lambda of_bins: jnp.tensordot(histograms.weights, of_bins, 1, precision=jax.lax.Precision.HIGHEST).T
        extinctions = [mean(sigma) for sigma in sigma_t]
        taken = [_taken_by_shells(extinction, histograms) for extinction in extinctions]
        if self.bleeding is not None:
            of_rgb = lambda channels: channels * (3 // len(channels))
            colours = zip(rgb, of_rgb(sigma_t), of_rgb(extinctions), of_rgb(taken), strict=True)
            taken = [t * (1 - self.bleeding * divide_or_zero(mean(s * c), whole)) for c, s, whole, t in colours]
        return jnp.stack([jnp.sum(t, axis=0) for t in taken], axis=-1)


def _mean_over_rays(
    taken: Float[Array, "clusters channels"], codes: UInt16[Array, "rays x y z"]
) -> Float[Array, "x y z channels"]:
    """What the nodes lose of ambient light: the mean of what the clusters of their rays take. One ray after the other, since a table is
    read seven times as fast by a vector of nodes as by the rays of a node."""

    def of_ray(total: tuple[Array, ...], code: UInt16[Array, "x y z"]) -> tuple[tuple[Array, ...], None]:
        at = code.astype(jnp.int32)
        return tuple(t + channel.at[at].get(mode="promise_in_bounds") for t, channel in zip(total, taken.T, strict=True)), None

    zeros = jnp.zeros(codes.shape[1:], taken.dtype)
    total, _ = jax.lax.scan(of_ray, (zeros,) * taken.shape[1], codes)
    return jnp.stack(total, axis=-1) / len(codes)


def _in_bins(scene: Scene, positions: Float[Array, "bins"]) -> tuple[list[Array], list[Array]]:
    """Colour and extinction of each bin, as its own hat sees the transfer function."""
    at = (jnp.arange(2 * LOOKS + 1, dtype=positions.dtype) - LOOKS) / (LOOKS + 1)
    hat = (1 - jnp.abs(at)) / jnp.sum(1 - jnp.abs(at))
    scalars = jnp.clip(positions[:, None] + at * (positions[1] - positions[0]), positions[0], positions[-1])
    classified = jax.vmap(jax.vmap(scene.transfer.evaluate))(scalars)
    densest = DENSEST / jnp.min(scene.volume.spacing)
    sigma_t = [jnp.minimum(sigma, densest) for sigma in classified.sigma_t]
    extinctions = [sigma @ hat for sigma in sigma_t]
    # Of what is in a bin, colours count by how dense it is.
    weighted = zip(sigma_t * (3 // len(sigma_t)), classified.rgb, extinctions * (3 // len(sigma_t)), strict=True)
    return [divide_or_zero((sigma * colour) @ hat, whole) for sigma, colour, whole in weighted], extinctions


def _taken_by_shells(sigma_t: Float[Array, "shells clusters"], histograms: LocalHistograms) -> Float[Array, "shells clusters"]:
    """What each shell of a ray takes of the light that it would bring: what of it is scattered in the shell, and all from behind it."""
    extents = histograms.extents
    share = (1 - histograms.beyond) * divide_or_zero(extents, jnp.full_like(extents, jnp.sum(extents)))
    behind = 1 - jnp.cumsum(share)
    tau = sigma_t * extents[:, None]
    before = jnp.exp(-(jnp.cumsum(tau, axis=0) - tau))
    return before * (behind[:, None] * one_minus_exp(tau) + share[:, None] * (1 - mean_transmittance(tau)))


class HistogramProjection(AbstractProjection):
    """All that the histograms of a scene are made with. `weights`: those of the clusters that the `tree` tells apart."""

    volume: Volume
    clipping: Clipping
    medium: Medium
    reach: Reach
    bins: Bins
    tree: Tree
    weights: Float[Array, "clusters shells bins"]
    rays: int = eqx.field(static=True)
    shells: int = eqx.field(static=True)
    nodes_along: Shape = eqx.field(static=True)

    @classmethod
    def of(cls, occlusion: HistogramOcclusion, scene: Scene, medium: Medium) -> "HistogramProjection":
        """With clusters of the rays of some of the nodes."""
        shape = nodes_along(occlusion.resolution, scene.volume)
        volume, clipping, medium, reach = jax.lax.stop_gradient(
            (scene.volume, scene.clipping, medium, Reach.of(occlusion, scene.volume))
        )
        bins = Bins.of(occlusion.bins, volume)
        positions = node_positions(volume, shape)
        some = np.random.default_rng(0).permutation(len(positions))[:TAUGHT]
        samples = lambda p: ray_samples(volume, bins, short_rays(volume, clipping, occlusion.rays, p), reach)
        chunks = jnp.asarray(np.resize(positions[some], (-(-len(some) // cls.chunk), min(cls.chunk, len(some)), 3)))
        taught = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0).reshape(x.shape[1], -1), jax.lax.map(samples, chunks))
        features = features_of(taught, occlusion.shells)
        # Halves are not equal, so that it takes a few more to tell few rays apart.
        levels = min((occlusion.clusters - 1).bit_length(), features.shape[0].bit_length() + SPARE)
        tree = grown(features, levels)
        weights = mean_histograms(taught, tree.find(features), 2**levels, occlusion.shells, occlusion.bins)
        return cls(
            volume=volume,
            clipping=clipping,
            medium=medium,
            reach=reach,
            bins=bins,
            tree=tree,
            weights=weights,
            rays=occlusion.rays,
            shells=occlusion.shells,
            nodes_along=shape,
        )

    @property
    def shape(self) -> Shape:
        return self.nodes_along

    def project(self, p: Float[Array, "nodes 3"]) -> tuple[UInt16[Array, "nodes rays"]]:
        """The clusters of rays from grid positions."""
        samples = ray_samples(self.volume, self.bins, short_rays(self.volume, self.clipping, self.rays, p), self.reach)
        return (self.tree.find(features_of(samples, self.shells)).reshape(p.shape[0], -1).astype(jnp.uint16),)
