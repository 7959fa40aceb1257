"""Ambient occlusion of isosurfaces: how much of the hemisphere above a point of a surface is free of it, by short rays (course notes on
GPU-based volume ray-casting, Eurographics 2009, chapter 5 and listing 9.5).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jvr.effects.short_rays import GOLDEN
from jvr.march.medium import AbstractVisibility, LightPath
from jvr.march.secondary import secondary_rays
from jvr.march.steps import OnSurface, Point, Transmittances
from jvr.model.clipping import Clipping
from jvr.model.effects import AbstractOcclusion
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import Knob, PlanEntry, multiples, spelling
from jvr.model.ranges import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.numerics import clamp, direction_and_length, dot, larger, rounded_into, turned
from jvr.types import ArrayLike, Scalar, Triple


class SurfaceOcclusion(AbstractOcclusion):
    """Ambient occlusion of isosurfaces: the fraction of the directions above a point of a surface in which, within a reach, nothing is.

        O(x) = 1 - 1 / K sum_k max_j b(s(x + j D w_k) - rho),    j = 1 ... steps

    along `K` rays on the side of the surface that is seen, in steps of length `D`, with `b(d)` 1 on the other side of the isovalue `rho` of
    the surface and 0 on this (listing 9.5, which forgets to divide by `K`). Ambient light on surfaces is multiplied with it, that in the
    medium is not: the medium takes none, and is none of what takes it. Where the volume or its clipping ends there is nothing more. Other
    isovalues of the scene do not count.

    **Arguments:**

    - `rays`: `K`, on a spiral of equal areas in the frame of the normal, the same at all points: no noise, and the same picture however it
      is tiled.
    - `steps`: samples of a ray; `factor`: `D` in voxels of the smallest spacing. Rays reach `steps` times as far; what is thinner than `D`
      may be missed.
    - `tilt`: what of the normal is added to each direction, which lifts rays off the surface: 0.1, as in the listing, has the lowest at
      5.7 degrees, and the mean cosine at 0.563 in place of 0.5. 0 is the whole hemisphere.
    - `cosine`: whether directions count by the cosine of their angle, as light on a matt surface does, and not alike.
    - `softness`: how far beyond the isovalue a scalar is that takes all, in data units: `b(d)` rises in a straight line, and `O` has a
      derivative. `None`: a step, which has none.

    Differentiable with a `softness`, in voxels, isovalues, `softness`, the position and the normal of a surface; without it a constant.
    Costs `rays x steps` samples for each pixel. **Raises** `ValueError` for numbers outside their ranges, and in a scene without surfaces
    or with nothing that shades them.
    """

    rays: int = choice(AT_LEAST_ONE, doc="rays for each point")
    steps: int = choice(AT_LEAST_ONE, doc="samples of each ray")
    factor: Scalar = parameter(POSITIVE, doc="length of a step", unit="voxels of the smallest spacing")
    tilt: Scalar = parameter(NOT_NEGATIVE, doc="what of the normal is added to each direction")
    cosine: bool = choice(doc="whether directions count by their cosine")
    softness: Scalar | None = parameter(POSITIVE, doc="how far beyond the isovalue a scalar takes all", unit="data units")

    def __init__(
        self,
        rays: int = 48,
        steps: int = 20,
        *,
        factor: ArrayLike = 1.5,
        tilt: ArrayLike = 0.0,
        cosine: bool = False,
        softness: ArrayLike | None = None,
    ):
        assign(self, rays=rays, steps=steps, factor=factor, tilt=tilt, cosine=cosine, softness=softness)

    @property
    def of_surfaces(self) -> bool:
        return True

    @property
    def needs_gradient(self) -> bool:
        return True

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry(name, True, f"{spelling(self)}, at each hit", ("ambient light", "surfaces", "gradient")),)

    def knobs(self, scene: Any) -> tuple[Knob, ...]:
        return (multiples("rays", self.rays, (1 / 4, 1 / 2, 1), 4, least=1),)

    def visibility(self, scene: Scene, path: LightPath) -> "SurfaceVisibility":
        length = self.factor * jnp.min(scene.volume.spacing)
        directions = jnp.asarray(hemisphere(self.rays, self.cosine), length.dtype)
        return SurfaceVisibility(scene.volume, scene.clipping, directions, length, self.tilt, self.softness, self.steps)


def hemisphere(rays: int, cosine: bool) -> Float[np.ndarray, "rays 3"]:
    """Unit directions with `z > 0` on a spiral, which count alike: each for as much solid angle, or for as much of it times its cosine."""
    index = np.arange(rays)
    height = 1 - (index + 0.5) / rays
    height = np.sqrt(height) if cosine else height
    radius = np.sqrt((1 - height) * (1 + height))
    return np.stack([radius * np.cos(GOLDEN * index), radius * np.sin(GOLDEN * index), height], axis=1)


class SurfaceVisibility(AbstractVisibility):
    """What arrives of ambient light at surfaces. `directions`: about an upward normal; `length`: of a step, in the world."""

    volume: Volume
    clipping: Clipping
    directions: Float[Array, "rays 3"]
    length: Scalar
    tilt: Scalar
    softness: Scalar | None
    steps: int = eqx.field(static=True)

    def transmittances(self, points: Point, wanted: Any, *, reverse: bool) -> Transmittances:
        surface = points.surface
        if surface is None:
            return Transmittances()
        one = self
        if self.softness is None:
            one, points, surface = jax.lax.stop_gradient((self, points, surface))
        return Transmittances(ambient=(one._free(points, surface),))

    @property
    def stats(self) -> None:
        return None

    def _free(self, points: Point, surface: OnSurface) -> Float[Array, "points"]:
        """The fraction of rays that meet nothing."""
        slope = dot(surface.gradient, turned(self.volume.world_from_grid[:3, :3], points.direction))
        # The scalar rises towards what is not seen.
        rise = jnp.where(slope < 0, -1.0, 1.0)
        normal, _ = direction_and_length(tuple(-rise * g for g in surface.gradient))
        tangent, other = _beside(normal)

        def of_ray(total: Float[Array, "points"], local: Float[Array, "3"]) -> tuple[Float[Array, "points"], None]:
            height = local[2] + self.tilt
            world = (local[0] * t + local[1] * o + height * n for t, o, n in zip(tangent, other, normal, strict=True))
            direction, _ = direction_and_length(tuple(world))
            return total + self._blocked(points, surface, rise, direction), None

        blocked, _ = jax.lax.scan(of_ray, jnp.zeros_like(surface.value), self.directions)
        return 1 - blocked / self.directions.shape[0]

    def _blocked(
        self, points: Point, surface: OnSurface, rise: Float[Array, "points"], direction: Triple
    ) -> Float[Array, "points"]:
        """How much of a ray is blocked, 0 ... 1: by the sample that blocks it most."""
        volume = self.volume
        along = volume.grid_from_world(direction, direction=True)
        rays = secondary_rays(volume, self.clipping, (volume.world_from_point(points.p), direction), (points.p, along))

        @jax.checkpoint
        def sample(most: Float[Array, "points"], j: Scalar) -> tuple[Float[Array, "points"], None]:
            t = j * self.length
            inside = (t >= rays.t_in) & (t <= rays.t_out)
            p = (c + t * d for c, d in zip(points.p, along, strict=True))
            p = tuple(rounded_into(c, low, high) for c, low, high in zip(p, *volume.domain, strict=True))
            beyond = rise * (jax.vmap(volume.sample)(p) - surface.value)
            if volume.gaps is not None:
                inside &= jax.vmap(volume.is_known)(p)
            by = (beyond > 0).astype(most.dtype) if self.softness is None else clamp(beyond / self.softness, 0.0, 1.0)
            return larger(most, jnp.where(inside, by, 0.0)), None

        steps = jnp.arange(1, self.steps + 1, dtype=surface.value.dtype)
        return jax.lax.scan(sample, jnp.zeros_like(surface.value), steps)[0]


def _beside(normal: Triple) -> tuple[Triple, Triple]:
    """Two unit vectors that are perpendicular to a unit vector and to each other (Duff et al., "Building an orthonormal basis, revisited",
    JCGT 6(1), 2017)."""
    x, y, z = normal
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)
