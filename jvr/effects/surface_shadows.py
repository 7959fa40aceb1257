"""Shadows of isosurfaces: what they leave of the light that is on its way to a point."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.shadow_rays import ways_to
from jvr.march.first_hit import Search, passed
from jvr.march.medium import AbstractVisibility
from jvr.march.steps import Point, Rays, Transmittances
from jvr.model.clipping import Clipping
from jvr.model.light import AbstractDeltaLight
from jvr.numerics import larger
from jvr.types import Channels

# How far from a point a surface begins to shade it, in voxels of the smallest spacing, and in tolerances of where it lies: a point on a
# surface does not lie in its own shadow by rounding.
LIFT, TOLERANCES = 0.1, 4.0


class SurfaceShadows(AbstractVisibility):
    """What is left of light behind surfaces: `1 - opacity` of all that a ray from each point to each light crosses. `visible`: what reaches
    points without them; `lights`: `None` for those that nothing shades; `opacity`: `None` for opaque surfaces; `most`: surfaces that a
    ray crosses.

    Differentiable in the opacities. Detached: where the edges of shadows lie.
    """

    visible: AbstractVisibility
    search: Search
    clipping: Clipping
    lights: tuple[AbstractDeltaLight | None, ...]
    opacity: Float[Array, "n"] | None
    most: int = eqx.field(static=True)

    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> Transmittances:
        found = self.visible.transmittances(points, wanted, reverse=reverse)
        pairs = zip(found.lights, self.lights, strict=True)
        return found._replace(lights=tuple(c if light is None else self._past(light, points, wanted, c) for c, light in pairs))

    @property
    def stats(self) -> Any:
        return self.visible.stats

    def _past(self, light: AbstractDeltaLight, points: Point, wanted: Bool[Array, "rays"], channels: Channels) -> Channels:
        """What of a light passes the surfaces, of what passes the medium."""
        volume, light, p = jax.lax.stop_gradient((self.search.volume, light, points.p))
        ways = ways_to(light, volume, jax.lax.stop_gradient(self.clipping), p)
        lift = larger(LIFT * jnp.min(volume.spacing), TOLERANCES * self.search.tolerance)
        reaches = wanted & (ways.end > lift)
        keep = lambda v: tuple(jnp.where(reaches, c, 0.0) for c in v)
        begin = tuple(c + lift * d for c, d in zip(p, ways.along, strict=True))
        rays = Rays(keep(begin), keep(ways.along), jnp.where(reaches, ways.end - lift, 0.0))
        clear = passed(self.search, rays, self.opacity, self.most)
        return tuple(c * clear for c in channels)
