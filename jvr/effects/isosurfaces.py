"""Isosurfaces of the volume: found by `jvr.march.first_hit`, shaded as the medium is, opaque or blended at their place on a ray."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.effects.lighting import LitShader, reflected, surface_shader
from jvr.effects.surface_shadows import SurfaceShadows
from jvr.march.first_hit import FINER, Hits, Reached, Search, leaving, next_hit, start
from jvr.march.medium import AbstractVisibility, Medium
from jvr.march.occupancy import occupancy_of_values
from jvr.march.steepest import steepest_of
from jvr.march.steps import OnSurface, Point, Rays, Sample, points_at
from jvr.model.bricks import Bricks
from jvr.model.effects import AbstractSurfaces, SurfaceLayers
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import Knob, PlanEntry, multiples
from jvr.model.ranges import AT_LEAST_ONE, COLOUR, INCREASING, NOT_NEGATIVE, POSITIVE, UNIT_INTERVAL, Interval
from jvr.model.scene import Scene
from jvr.numerics import direction_and_length
from jvr.types import ArrayLike, Scalar, Triple

# Voxels along an edge of a brick that gradients are bounded in.
BRICK = 4


class Isosurfaces(AbstractSurfaces):
    """Isosurfaces: where the scalar equals one of `values`, hit exactly, in front of, in and behind the medium that the transfer function
    shows (course notes on GPU-based volume ray-casting, Eurographics 2009, section 2.4).

    Without lights and shading a surface shows its `rgb`; with them it is shaded by the scene's `shading` or `material`, with the normal of
    its `normals`, and lies in its shadows. In a scene with `shadows` surfaces cast them on the medium and on each other, whichever method
    finds those of the medium: a ray from each point to each light. They take ambient light from each other by `jvr.SurfaceOcclusion`
    alone, and no environment light from anything.

    **Arguments:**

    - `values`: isovalues `(n,)`, ascending; `rgb`: their colours `(n, 3)`.
    - `opacity`: `(n,)`, 0 ... 1, of each surface, which is blended at its place on a ray: `L <- L1 + T1 (a c + (1 - a) L2)`. `None`: all
      are opaque, and a ray ends at the first.
    - `step`: of the samples between which a crossing is looked for, in voxels of the smallest spacing. A sheet that a ray passes within
      less may be missed.
    - `band`, `coarse`: where the scalar is at least `band` away from every isovalue, `coarse` samples are one step. No surface is missed
      for that where `band` is at least `coarse * step` times what the scalar changes by in a voxel. `None`: every sample is taken.
    - `guaranteed`: steps are instead as long as bounds on the gradient in each brick allow, and `step / 32` at least: what is missed is
      thinner than that along a ray.
    - `tolerance`: how near to a crossing its distance is, in voxels.
    - `most`: surfaces that a ray passes at most, where they are not opaque; of those behind the last nothing is seen.
    - `casts_shadows`: whether they do, which takes a ray more for each light and each sample of a lit medium, where there is any.

    Differentiable in values, colours, opacities, voxels and pose, in both modes, by the implicit function theorem, and along surfaces in
    their normals. Detached: which rays hit, and where shadows end. A silhouette moves with what is unknown, and that part of a derivative
    is missing; next to it distances change infinitely fast, which is limited to a slope of 1000. **Raises** `ValueError` for values that do
    not ascend and numbers out of range.
    """

    values: Float[Array, "n"] = parameter(INCREASING, doc="isovalues, ascending", unit="data units")
    rgb: Float[Array, "n 3"] = parameter(COLOUR, doc="red, green, blue, linear, of each surface")
    opacity: Float[Array, "n"] | None = parameter(UNIT_INTERVAL, doc="of each surface")
    band: Scalar | None = parameter(NOT_NEGATIVE, doc="distance from the isovalues at which steps are coarse", unit="data units")
    step: float = choice(POSITIVE, doc="length of a step", unit="voxels of the smallest spacing", hint="1 is a good start")
    coarse: int = choice(AT_LEAST_ONE, doc="samples to a coarse step", hint="8 is a good start", most=64)
    guaranteed: bool = choice(doc="whether steps are bounded by gradients, so that nothing is missed")
    tolerance: float = choice(Interval(1e-6, 0.5), doc="of a distance", unit="voxels of the smallest spacing")
    most: int = choice(AT_LEAST_ONE, doc="surfaces that a ray passes", most=64)
    casts_shadows: bool = choice(doc="whether they cast shadows, where the scene has any")

    def __init__(
        self,
        values: ArrayLike,
        rgb: ArrayLike,
        opacity: ArrayLike | None = None,
        *,
        step: float | int = 1.0,
        band: ArrayLike | None = None,
        coarse: int = 8,
        guaranteed: bool = False,
        tolerance: float | int = 1e-4,
        most: int = 4,
        casts_shadows: bool = True,
    ):
        assign(self, values=values, rgb=rgb, opacity=opacity, band=band, step=step, coarse=coarse)
        assign(self, guaranteed=guaranteed, tolerance=tolerance, most=most, casts_shadows=casts_shadows)
        if guaranteed and band is not None:
            raise ValueError("guaranteed steps are as long as gradients allow: leave band out, or guaranteed at False")

    @property
    def is_opaque(self) -> bool:
        return self.opacity is None

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        n, empty = self.values.shape[0], "; bricks without them are skipped" if settings.skipping else ""
        many = f"{n} isovalue{'s' * (n != 1)}, " + ("opaque" if self.is_opaque else f"at most {self.most} a ray")
        rate = f"a sample every {self.step:g} voxels"
        if self.guaranteed:
            rate = "steps bounded by gradients"
        elif self.band is not None:
            rate = f"a sample every {self.step:g} or {self.coarse * self.step:g} voxels"
        shade = "; they cast shadows" if scene.shadows is not None and self.casts_shadows else ""
        return (PlanEntry(name, True, f"{many}: {rate}{empty}{shade}"),)

    def knobs(self, scene: Any) -> tuple[Knob, ...]:
        tolerance = multiples("tolerance", self.tolerance, (1000, 100, 10, 1), 1 / 10, least=1e-6, most=0.5)
        if self.guaranteed:
            return (tolerance,)
        coarse = () if self.band is None else (multiples("coarse", self.coarse, (2, 1, 1 / 2, 1 / 4), 1 / 64, least=1, most=64),)
        return (multiples("step", self.step, (2, 1, 1 / 2), 1 / 4), *coarse, tolerance)

    def prepare(self, scene: Scene, bricks: Bricks | None) -> Search:
        volume, finer = scene.volume, FINER if self.guaranteed else 1
        dt = self.step / finer * jnp.min(volume.spacing)
        occupancy = None if bricks is None else occupancy_of_values(bricks, volume.slope, volume.intercept, self.values)
        steepest = steepest_of(volume, BRICK) if self.guaranteed else None
        tolerance = jnp.minimum(self.tolerance * jnp.min(volume.spacing), dt / 2)
        return Search(volume, self.values, dt, tolerance, occupancy, self.band, steepest, self.coarse)

    def start(self, prepared: Search, rays: Rays) -> Reached:
        return start(prepared, rays)

    def next_hit(self, prepared: Search, rays: Rays, reached: Reached) -> Hits:
        return next_hit(prepared, rays, reached)

    def leaving(self, prepared: Search, rays: Rays, hits: Hits, crosses: Bool[Array, "rays"]) -> Reached:
        return leaving(prepared, rays, hits, crosses)

    def shown(self, medium: Medium, rays: Rays, hits: Hits) -> tuple[Triple, Float[Array, "rays"]]:
        colour = self._colour(hits)
        opacity = hits.found.astype(rays.length.dtype) if self.opacity is None else _own(self.opacity, hits)
        shader = surface_shader(medium.shader)
        if shader is None:
            return colour, opacity
        factor, added, _ = _reflected(shader, medium, rays, hits, colour, self.values[hits.surface])
        lit = tuple(c * a + b for c, a, b in zip(colour, factor, added, strict=True))
        return tuple(jnp.where(hits.found, c, 0.0) for c in lit), opacity

    def apart(self, medium: Medium, rays: Rays, hits: Hits) -> SurfaceLayers:
        diffuse, shader, value = self._colour(hits), surface_shader(medium.shader), self.values[hits.surface]
        if shader is None:
            specular, sample = (jnp.zeros_like(hits.u),) * 3, _sampled(medium.shader, medium, rays, hits, value)[1]
        else:
            factor, specular, sample = _reflected(shader, medium, rays, hits, diffuse, value)
            diffuse = tuple(map(jnp.multiply, diffuse, factor))
        normal, steepness = direction_and_length(tuple(-g for g in sample.gradient))
        return SurfaceLayers(normal, sample.s, steepness, diffuse, specular, sample.light.ambient)

    def shadowed(self, prepared: Search, scene: Scene, visible: AbstractVisibility | None) -> AbstractVisibility | None:
        if visible is None or scene.shadows is None or not self.casts_shadows:
            return visible
        return SurfaceShadows(visible, prepared, scene.clipping, scene.shadow_casters, self.opacity, self.most)

    def _colour(self, hits: Hits) -> Triple:
        return tuple(_own(self.rgb[:, c], hits) for c in range(3))


def _own(column: Float[Array, "n"], hits: Hits) -> Float[Array, "rays"]:
    """A number of each surface, of the one that rays hit; 0 where they hit none."""
    return jnp.where(hits.found, column[hits.surface], 0.0)


def hit_points(rays: Rays, hits: Hits) -> Point:
    """Where rays hit; one that does not has a point at rest, for what is computed there to be finite."""
    there = lambda x: jnp.where(hits.found, x, 0.0)
    still = Rays(tuple(map(there, rays.entry)), tuple(map(there, rays.direction)), rays.length)
    zero = jnp.zeros_like(hits.surface)
    return points_at(still, jnp.arange(zero.size, dtype=jnp.int32), zero, hits.u)


def _sampled(shader: Any, medium: Medium, rays: Rays, hits: Hits, value: Float[Array, "rays"]) -> tuple[Point, Sample]:
    """Where rays hit surfaces of isovalues, and what is known there in the world, with the light that reaches it."""
    point = hit_points(rays, hits)
    sample = jax.vmap(medium.field.resample)(point)
    sample = jax.vmap(shader.in_world, in_axes=(None, 0, 0))(medium.transfer, sample, point)
    if medium.visibility is not None:
        where = point._replace(surface=OnSurface(value, sample.gradient)) if sample.gradient else point
        sample = sample._replace(light=medium.visibility.transmittances(where, hits.found, reverse=True))
    return point, sample


def _reflected(
    shader: LitShader, medium: Medium, rays: Rays, hits: Hits, colour: Triple, value: Float[Array, "rays"]
) -> tuple[Triple, Triple, Sample]:
    """What surfaces of a colour and an isovalue reflect of it, what they add in the colour of the light, and what is known where they
    are."""
    point, sample = _sampled(shader, medium, rays, hits, value)
    return *reflected(shader, sample, point, colour), sample
