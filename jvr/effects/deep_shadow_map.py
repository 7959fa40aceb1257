"""Deep shadow maps: transmittance along each of the light's rays as few straight pieces (Lokovic and Veach 2000)."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.effects.light_space import AbstractLightSpace, bilinear, light_space, of_swept
from jvr.effects.shadow_volume import knobs_of_layers, texels
from jvr.march.medium import AbstractVisibility, LightPath
from jvr.march.steps import Point, Transmittances
from jvr.model.effects import AbstractShadows
from jvr.model.parameters import assign, choice
from jvr.model.parts import Knob
from jvr.model.ranges import AT_LEAST_ONE, FRACTION
from jvr.model.scene import Scene
from jvr.numerics import read_run, transformed
from jvr.types import Affine, Channels, Scalar, Triple


class DeepShadowMap(AbstractShadows):
    """A deep shadow map: rays of a light, along each of which transmittance is kept as at most `layers` straight pieces.

    A piece goes on as long as the straight line from its start through the transmittance at its end stays within `error` of all that it
    passes. Where `layers` pieces do not suffice, the last one goes straight to the end of the ray, with an error that nothing bounds:
    `rendering.stats.shadows` says what fraction of the rays that were, and the largest error of any.

    **Arguments:** `texels`: rays along each axis of the map; `layers`: pieces of each, at least 1; `error`: of transmittance, above 0.

    For directional and point (spot) lights. Differentiable in transfer function, voxels, lights and pose through the transmittances where
    pieces meet; detached: where along a ray that is. Memory: `8 texels^2 (layers + 1)` bytes for each channel of extinction; while it is
    made, 4 bytes for each voxel of the volume's diagonal and ray.
    """

    texels: int = texels()
    layers: int = choice(AT_LEAST_ONE, doc="pieces along each ray of the map")
    error: float = choice(FRACTION, doc="difference of transmittance")

    def __init__(self, texels: int = 128, layers: int = 12, *, error: float = 0.01):
        assign(self, texels=texels, layers=layers, error=error)

    def visibility(self, scene: Scene, path: LightPath) -> AbstractVisibility:
        steps = max(self.layers, math.ceil(math.sqrt(sum((n - 1) ** 2 for n in scene.volume.shape))))
        maps, medium = [], path(scene.transfer.takes_gradient)
        for light in scene.shadow_casters:
            space = None if light is None else light_space(light, scene.volume)
            if space is None:
                maps.append(None)
                continue
            pieces = lambda depths: _pieces_of(jnp.exp(-depths), self.layers, self.error)
            z, clear, worst = of_swept(pieces, space, scene, medium, self.texels, steps, 1)
            stats = ShadowStats(jnp.mean(worst > self.error * (1 + 1e-3)), jnp.max(worst))
            maps.append(DeepMap(space, z, clear, stats))
        return DeepVisibility(scene.volume.world_from_grid, tuple(maps))

    def remarks(self, name: str, scene: Scene, stats: Any) -> Iterator[str]:
        if stats is not None and float(stats.shadows.overflow) > 0:
            share, error = float(stats.shadows.overflow), float(stats.shadows.error)
            yield f"{share:.0%} of the rays of a deep shadow map ran out of layers (error {error:.2g}): give it more"

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        return knobs_of_layers(self.texels, self.layers)


class ShadowStats(NamedTuple):
    """How well the pieces of a deep shadow map follow the transmittance: the fraction of rays that ran out of pieces, and the largest error
    along any ray."""

    overflow: Scalar
    error: Scalar


class DeepMap(eqx.Module):
    """The deep shadow map of one light: for each ray, the depths `w` where pieces meet and the transmittances there."""

    space: AbstractLightSpace
    depths: Float[Array, "u v nodes channels"]
    clear: Float[Array, "u v nodes channels"]
    stats: ShadowStats

    def transmittance(self, x: Triple) -> Channels:
        """At a world position: along each of the four rays around it, then bilinearly."""
        texels, _, nodes, channels = self.depths.shape
        u, v, w = self.space.coordinates(x)
        depths, clear = self.depths.reshape(-1, channels), self.clear.reshape(-1, channels)
        total = [jnp.zeros_like(u)] * channels
        for texel, weight in bilinear(texels, u, v):
            z, T = read_run(depths, texel * nodes, nodes), read_run(clear, texel * nodes, nodes)
            total = [t + weight * _along(z[:, c], T[:, c], w) for c, t in enumerate(total)]
        return tuple(total)


class DeepVisibility(AbstractVisibility):
    """Visibility by a deep shadow map for each light, or `None` for those that nothing shades."""

    world_from_grid: Affine
    maps: tuple[DeepMap | None, ...]

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        x = transformed(self.world_from_grid, points.p)
        return Transmittances(tuple(() if deep is None else jax.vmap(deep.transmittance)(x) for deep in self.maps))

    @property
    def stats(self) -> ShadowStats:
        """The worst of all maps."""
        found = [deep.stats for deep in self.maps if deep is not None]
        return ShadowStats(*(jnp.max(jnp.stack(values)) for values in zip(*found, strict=True)))


def _along(z: Float[Array, "nodes"], T: Float[Array, "nodes"], w: Scalar) -> Scalar:
    """A piecewise linear function; constant beyond its ends. Pieces that were not needed have no length."""
    value = T[0]
    for k in range(z.shape[0] - 1):
        length = z[k + 1] - z[k]
        fraction = jnp.clip((w - z[k]) / jnp.where(length > 0, length, 1.0), 0.0, 1.0)
        value += jnp.where(length > 0, fraction, 0.0) * (T[k + 1] - T[k])
    return value


def _pieces_of(
    clear: Float[Array, "rays steps channels"], layers: int, error: float
) -> tuple[Float[Array, "rays nodes channels"], Float[Array, "rays nodes channels"], Float[Array, "rays channels"]]:
    """The depths where pieces of each ray meet, the transmittances there, and the largest error anywhere along it."""
    _, n, channels = clear.shape
    rays = jnp.moveaxis(clear, -1, 1).reshape(-1, n)
    nodes = jax.vmap(lambda T: _pieces(T, layers, error))(jax.lax.stop_gradient(rays))
    z = nodes / (n - 1)
    T = jnp.take_along_axis(rays, nodes, axis=1)
    there = jnp.arange(n, dtype=z.dtype) / (n - 1)
    found = jax.vmap(lambda z, T: jax.vmap(lambda w: _along(z, T, w))(there))(z, jax.lax.stop_gradient(T))
    worst = jnp.max(jnp.abs(found - jax.lax.stop_gradient(rays)), axis=1)
    place = lambda a: jnp.moveaxis(a.reshape(-1, channels, layers + 1), 1, -1)
    return place(z.astype(clear.dtype)), place(T), worst.reshape(-1, channels)


def _pieces(T: Float[Array, "steps"], layers: int, error: float) -> Int[Array, "nodes"]:
    """Indices where pieces meet, `layers + 1` of them: from 0 to the last, which is repeated where fewer suffice.

    `lower` and `upper` bound the slopes of lines from the start of the piece that have passed all so far within the error.
    """
    n = T.shape[0]
    wide = (jnp.asarray(-jnp.inf, T.dtype), jnp.asarray(jnp.inf, T.dtype))

    def window(start: Int[Array, ""], k: Int[Array, ""]) -> tuple[Scalar, Scalar, Scalar]:
        run, rise = (k - start).astype(T.dtype), T[k] - T[start]
        return (rise - error) / run, rise / run, (rise + error) / run

    def step(carry, k):
        nodes, count, start, lower, upper = carry
        _, slope, _ = window(start, k)
        # A line that ends at k must have passed all before it; where it would not, the piece ends one sooner.
        ends = ((slope < lower) | (slope > upper)) & (count < layers)
        nodes = jnp.where(ends, nodes.at[count].set(k - 1), nodes)
        count, start = count + ends, jnp.where(ends, k - 1, start)
        lower, upper = (jnp.where(ends, bound, old) for bound, old in zip(wide, (lower, upper), strict=True))
        low, _, high = window(start, k)
        return (nodes, count, start, jnp.maximum(lower, low), jnp.minimum(upper, high)), None

    nodes = jnp.full(layers + 1, n - 1, jnp.int32).at[0].set(0)
    (nodes, *_), _ = jax.lax.scan(step, (nodes, jnp.int32(1), jnp.int32(0), *wide), jnp.arange(1, n, dtype=jnp.int32))
    return nodes
