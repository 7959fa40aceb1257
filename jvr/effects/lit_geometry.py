"""The light that reaches geometry, in the volume or outside of it: `jvr.effects.lighting` shades it as it does isosurfaces."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from jvr.effects.shadow_rays import ShadowRays, ways_to
from jvr.march.medium import AbstractVisibility, LightPath
from jvr.march.secondary import points
from jvr.march.steps import End, Point, Sample, Transmittances
from jvr.model.clipping import Clipping
from jvr.model.geometry import AbstractGeometry
from jvr.model.light import AbstractDeltaLight
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import larger, rounded_into
from jvr.types import Channels


class GeometryShadows(eqx.Module):
    """What of each light reaches points of geometry, past itself and through what is `between` points of the volume and the light: the
    medium and isosurfaces. `lights`: `None` for those that nothing shades."""

    volume: Volume
    clipping: Clipping
    geometry: AbstractGeometry
    lights: tuple[AbstractDeltaLight | None, ...]
    between: tuple[AbstractVisibility | None, ...]

    def transmittances(self, at: Point, wanted: Bool[Array, "rays"]) -> tuple[Channels, ...]:
        pairs = zip(self.lights, self.between, strict=True)
        return tuple(
            () if light is None or visible is None else self._one(light, visible, at, wanted) for light, visible in pairs
        )

    def _one(self, light: AbstractDeltaLight, visible: AbstractVisibility, at: Point, wanted: Bool[Array, "rays"]) -> Channels:
        ways = ways_to(light, self.volume, self.clipping, at.p)
        free = self.geometry.hit(ways.world, 0.0, 0.0, None).distance >= ways.distance
        begin = larger(ways.begin, 0.0)
        crosses = wanted & free & (ways.end > begin)
        # From where it enters the volume, a way is that of a point in it. No product with an infinite distance, which has no derivative.
        begin = jnp.where(crosses, begin, 0.0)
        p = tuple(jnp.where(crosses, c + begin * d, 0.0) for c, d in zip(at.p, ways.along, strict=True))
        (left,) = visible.transmittances(at._replace(p=p), crosses, reverse=True).lights
        return tuple(jnp.where(crosses, T, free.astype(T.dtype)) for T in left)


def light_on_geometry(
    scene: Scene, path: LightPath, search: Any, visible: AbstractVisibility | None, end: End
) -> tuple[Point, Sample]:
    """Where rays end, and what is known there as of a surface, with the light. `search`: what the scene's surfaces are found by; `visible`:
    what reaches points of the medium."""
    face, volume, there = end.face, scene.volume, end.opaque > 0
    assert face is not None
    along = volume.grid_from_world(tuple(-c for c in face.w_o), direction=True)
    at = points(volume.grid_from_world(face.x), along)
    shadows = _shadows(scene, path, search)
    lights = () if shadows is None else shadows.transmittances(at, there)
    light = _around(volume, visible, at, there)._replace(lights=lights)
    return at, Sample(jnp.zeros_like(end.opaque), tuple(-n for n in face.normal), light=light)


def _shadows(scene: Scene, path: LightPath, search: Any) -> GeometryShadows | None:
    """The shadows on the geometry of a scene, `None` where it has none. `search`: what its surfaces are found by. By a ray to each light,
    whatever finds the shadows of the medium: maps and volumes of these are dark in the geometry itself, and end with the volume."""
    if scene.shadows is None or scene.geometry is None:
        return None
    method = scene.shadows if isinstance(scene.shadows, ShadowRays) else ShadowRays()
    between = []
    for light in scene.shadow_casters:
        alone = eqx.tree_at(lambda s: (s.lights, s.geometry), scene, ((light,), None), is_leaf=lambda x: x is None)
        visible = None if light is None else method.visibility(alone, path)
        between.append(visible if alone.surfaces is None else alone.surfaces.shadowed(search, alone, visible))
    return GeometryShadows(scene.volume, scene.clipping, scene.geometry, scene.shadow_casters, tuple(between))


def _around(volume: Volume, visible: AbstractVisibility | None, at: Point, wanted: Bool[Array, "rays"]) -> Transmittances:
    """What reaches points of light from all around. Outside of the volume no medium takes any of ambient light, and what of the environment
    arrives is that of the nearest point of the border."""
    if visible is None:
        return Transmittances()
    p = tuple(rounded_into(c, low, high) for c, low, high in zip(at.p, *volume.domain, strict=True))
    inside = wanted & (p[0] == at.p[0]) & (p[1] == at.p[1]) & (p[2] == at.p[2])
    found = visible.transmittances(at._replace(p=p), wanted, reverse=True)
    return found._replace(ambient=tuple(jnp.where(inside, T, 1.0) for T in found.ambient))
