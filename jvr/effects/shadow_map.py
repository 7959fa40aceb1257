"""Shadow maps: how far light comes before it meets something opaque (Williams 1978; Reeves, Salesin and Cook 1987 for the filter)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.light_space import AbstractLightSpace, depth_nodes, light_space
from jvr.effects.shadow_volume import samples_a_layer, texels
from jvr.march.medium import AbstractVisibility, LightPath, Medium
from jvr.march.steps import Point, Transmittances
from jvr.model.effects import AbstractShadows
from jvr.model.parameters import assign, choice
from jvr.model.parts import Knob, multiples
from jvr.model.ranges import FRACTION, NOT_NEGATIVE
from jvr.model.scene import Scene
from jvr.numerics import read_at, transformed
from jvr.types import Affine, Scalar, Triple

# Layers in which the depth of an occluder is looked for; inside of one it is interpolated.
LAYERS = 256


class ShadowMap(AbstractShadows):
    """A shadow map: the depth at which each of the light's rays has lost `threshold` of its light: what is behind is dark.

    For opaque occluders only. It does not converge to `ShadowRays` in translucent media, whatever the map's size: light is there or not,
    and what is half-way through a cloud has a hard shadow. It has no useful gradient: both depths and comparison are detached, so that
    nothing about the occluder can be fitted through it.

    **Arguments:** `texels`: rays along each axis of the map; `threshold`: opacity of an occluder, above 0, below 1; `softness`: the
    comparison is averaged over `(2 softness + 1)^2` texels around a point (percentage-closer filtering), with bilinear weights; `bias`:
    depth in voxels that a point must be behind the map to be dark, against shadows of a surface on itself.
    """

    texels: int = texels()
    threshold: float = choice(FRACTION, doc="opacity of an occluder")
    softness: int = choice(NOT_NEGATIVE, doc="texels to each side")
    bias: float = choice(NOT_NEGATIVE, doc="depth that a point is behind the map to be dark", unit="voxels")

    def __init__(self, texels: int = 256, *, threshold: float = 0.5, softness: int = 1, bias: float | int = 1.5):
        assign(self, texels=texels, threshold=threshold, softness=softness, bias=bias)

    def visibility(self, scene: Scene, path: LightPath) -> AbstractVisibility:
        medium = path(scene.transfer.takes_gradient)
        spacing, maps = jnp.min(scene.volume.spacing), []
        for light in scene.shadow_casters:
            space = None if light is None else light_space(light, scene.volume)
            maps.append(None if space is None else self._map(space, scene, medium, spacing))
        return jax.lax.stop_gradient(MapVisibility(scene.volume.world_from_grid, tuple(maps), self.softness))

    def _map(self, space: AbstractLightSpace, scene: Scene, medium: Medium, spacing: Scalar) -> "DepthMap":
        nodes = depth_nodes(space, scene, medium, self.texels, LAYERS, samples_a_layer(scene, LAYERS))
        # The clearest channel decides: an occluder holds all of them back.
        tau = jnp.min(nodes, axis=-1)
        depth = jnp.log1p(-jnp.asarray(self.threshold, tau.dtype))
        first = jnp.sum(tau < -depth, axis=0)
        before, behind = (jnp.take_along_axis(tau, jnp.clip(k, 0, LAYERS)[None], axis=0)[0] for k in (first - 1, first))
        fraction = jnp.where(behind > before, (-depth - before) / jnp.where(behind > before, behind - before, 1.0), 0.0)
        w = jnp.where(first > LAYERS, jnp.inf, (first - 1 + fraction) / LAYERS)
        _, _, length = space.ray(jnp.zeros_like(spacing), jnp.zeros_like(spacing))
        return DepthMap(space, w + self.bias * spacing / length)

    def knobs(self, scene: Scene) -> tuple[Knob, ...]:
        return (multiples("texels", self.texels, (1 / 4, 1 / 2, 1, 2), 4, least=2),)


class DepthMap(eqx.Module):
    """The shadow map of one light: the depth `w` from which on each ray is dark, infinite where it never is."""

    space: AbstractLightSpace
    depths: Float[Array, "u v"]

    def lit_fraction(self, x: Triple, softness: int) -> Scalar:
        """Fraction of the texels around a world position whose light reaches it."""
        texels, depths = self.depths.shape[0], self.depths.reshape(-1)
        u, v, w = self.space.coordinates(x)
        at = [jnp.clip((c + 1) / 2 * (texels - 1), 0, texels - 1) for c in (u, v)]
        low = [jnp.clip(jnp.floor(c), 0, texels - 2) for c in at]
        fraction = [c - b for c, b in zip(at, low, strict=True)]
        # A box of 2 softness + 1 texels that slides with the point: its ends are weighted.
        weight = lambda k, f: jnp.where(k == -softness, 1 - f, jnp.where(k == softness + 1, f, 1.0))
        total = jnp.zeros_like(w)
        for a in range(-softness, softness + 2):
            for b in range(-softness, softness + 2):
                i, j = (jnp.clip(base.astype(jnp.int32) + k, 0, texels - 1) for base, k in zip(low, (a, b), strict=True))
                lit = (w < read_at(depths, i * texels + j)).astype(w.dtype)
                total += lit * weight(a, fraction[0]) * weight(b, fraction[1])
        return total / (2 * softness + 1) ** 2


class MapVisibility(AbstractVisibility):
    """Visibility by a shadow map for each light, or `None` for those that nothing shades."""

    world_from_grid: Affine
    maps: tuple[DepthMap | None, ...]
    softness: int = eqx.field(static=True)

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        x = jax.lax.stop_gradient(transformed(self.world_from_grid, points.p))
        fraction = lambda depths: jax.vmap(lambda x: depths.lit_fraction(x, self.softness))(x)
        return Transmittances(tuple(() if depths is None else (fraction(depths),) for depths in self.maps))

    @property
    def stats(self) -> None:
        return None
