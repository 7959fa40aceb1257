"""Mirrors and glass: how isosurfaces send rays on (course notes on GPU-based volume ray-casting, Eurographics 2009, section 3.3).

With the normal `n` turned to the eye and `w_o` the direction to it, a ray goes on to the mirrored direction `2 (n . w_o) n - w_o`, and
behind the surface straight on, or by Snell's law as in `jvr.model.dielectric`. With `w` the fraction that is mirrored, `c` and `a` the
colour and the opacity of the surface, and `L` what either ray brings,

    L_k = L_medium + T (w L_{k-1}(mirrored) + (1 - w) (a c + (1 - a) L_{k-1}(behind))),

where `L_0` is what a ray brings in a scene that is not specular.
"""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.effects.isosurfaces import Isosurfaces, hit_points
from jvr.march.first_hit import Hits
from jvr.march.medium import Medium
from jvr.march.steps import Rays
from jvr.model.dielectric import fresnel, mirrored, refracted
from jvr.model.effects import AbstractSpecular, AbstractSurfaces
from jvr.model.light import HeadLight
from jvr.model.parameters import assign, choice, parameter
from jvr.model.parts import Knob, PlanEntry, is_zero
from jvr.model.ranges import POSITIVE, UNIT_INTERVAL, Interval
from jvr.model.volume import Volume
from jvr.numerics import direction_and_length, dot, turned
from jvr.types import ArrayLike, Triple

ONE_OR_EACH = ((), ("n",))


class Specular(AbstractSpecular):
    """Isosurfaces that mirror rays, and let them through as glass does: `L_k` of this file's first lines with `k = order`.

    **Arguments:**

    - `reflectance`: the fraction `w` that is mirrored at every angle, 0 ... 1, one number or one for each surface. `None`: that of a smooth
      interface of the given `index`, by Fresnel's equations, the mean over polarisations.
    - `index`: refractive index of what has the larger values over that of what has the smaller ones, positive, one number or one for each
      surface. Rays that pass are bent; beyond the angle of total reflection all is mirrored, whatever the reflectance. `None`: straight on.
    - `order`: how often in a row a ray is sent on. Then it is followed as in a scene without this part.

    What passes is what the surfaces' `opacity` leaves: clear glass has 0. Surfaces without an opacity are opaque, with a glaze over their
    colour. Where surfaces are not opaque both ways on are followed, all of them, so that time grows as `2^order`; else there is one, and it
    grows as `order`. What is left out is what is sent on more often, so that between mirrors it falls as `w^order`.

    Radiance is that over the square of the index, which an interface leaves as it is. Mirrored and bent rays see the scene beyond the
    camera's near and far planes, and a `jvr.HeadLight` shines along them as along those of the eye. The normal is the gradient by
    `Scene(normals=)`: where that of differences leans away from the surface itself, a ray under a grazing angle may meet it again.

    Differentiable in reflectance, index, and through places and normals of hits in isovalues, voxels and pose. Detached: which rays
    hit, where all is reflected, and how often. Towards the angle of total reflection derivatives grow without bound. **Raises**
    `ValueError` where neither reflectance nor index is given, and for numbers out of range.
    """

    reflectance: Float[Array, "..."] | None = parameter(UNIT_INTERVAL, shapes=ONE_OR_EACH, doc="fraction that is mirrored")
    index: Float[Array, "..."] | None = parameter(
        POSITIVE, shapes=ONE_OR_EACH, doc="refractive index of the larger values, relative to the smaller", hint="1.5 is glass"
    )
    order: int = choice(Interval(0.0, 16.0), doc="how often a ray is mirrored or bent", hint="2 shows both sides of a glass")

    def __init__(self, reflectance: ArrayLike | None = None, index: ArrayLike | None = None, order: int = 2):
        assign(self, reflectance=reflectance)
        assign(self, index=index, order=order)
        if reflectance is None and index is None:
            raise ValueError("nothing is mirrored or bent: give a reflectance for mirrors, or an index such as 1.5 for glass")

    @property
    def needs_gradient(self) -> bool:
        return self.order > 0

    @property
    def bends(self) -> bool:
        return self.index is not None

    def check(self, surfaces: AbstractSurfaces) -> None:
        if not isinstance(surfaces, Isosurfaces):
            raise ValueError(
                f"specular surfaces are isosurfaces, not {type(surfaces).__name__}: set surfaces=jvr.Isosurfaces(...)"
            )
        n = surfaces.values.shape[0]
        for name in ("reflectance", "index"):
            value = getattr(self, name)
            if value is not None and value.ndim and value.shape[0] != n:
                raise ValueError(
                    f"specular.{name} has {value.shape[0]} entries for {n} isovalues: give one number, or one for each"
                )

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        if scene.surfaces.is_opaque:
            return (PlanEntry(name, True, f"rays are mirrored, up to {self.order} times"),)
        ways, paths = "bent" if self.bends else "straight on", 2**self.order
        return (PlanEntry(name, True, f"rays are mirrored and {ways}, up to {self.order} times: at most {paths} paths a ray"),)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        if self.order == 0:
            yield f"{name}.order is 0: nothing is mirrored or bent"
        elif is_zero(self.reflectance) and (scene.surfaces.is_opaque or not self.bends):
            yield f"{name}.reflectance is zero: rays are followed that bring nothing"
        if any(isinstance(light, HeadLight) for light in scene.lights):
            yield "a jvr.HeadLight shines along mirrored rays, too; a jvr.PointLight at the eye stays there"

    def knobs(self, scene: Any) -> tuple[Knob, ...]:
        return (Knob("order", tuple(range(self.order + 1)), self.order + 1),)

    def deflected(self, volume: Volume, medium: Medium, rays: Rays, hits: Hits) -> tuple[Float[Array, "rays"], Triple, Triple]:
        point = hit_points(rays, hits)
        sample = jax.vmap(medium.field.resample)(point)
        sample = jax.vmap(medium.shader.in_world, in_axes=(None, 0, 0))(medium.transfer, sample, point)
        w_o, _ = direction_and_length(turned(-volume.world_from_grid[:3, :3], rays.direction))
        normal, steepness = direction_and_length(sample.gradient)
        away = dot(normal, w_o) < 0
        normal = tuple(jnp.where(away, -n, n) for n in normal)
        # Where the scalar does not change there is no normal, and a ray goes straight on.
        there = hits.found & (steepness > 0)
        mirror, straight = mirrored(normal, w_o), tuple(-o for o in w_o)
        own = lambda numbers: numbers[hits.surface] if numbers.ndim else numbers
        if self.index is None:
            assert self.reflectance is not None
            return jnp.where(there, own(self.reflectance), 0.0), mirror, straight
        # The side that a ray comes to is that of the larger values where it is one more than the surface before it.
        rises, index = hits.reached.side > hits.surface, own(self.index)
        eta = jnp.where(rises, 1 / index, index)
        behind = refracted(normal, w_o, eta)
        fraction = fresnel(dot(normal, w_o), behind, eta) if self.reflectance is None else own(self.reflectance)
        fraction = jnp.where(there, jnp.where(behind.total, 1.0, fraction), 0.0)
        onward = tuple(jnp.where(there, b, s) for b, s in zip(behind.direction, straight, strict=True))
        return fraction, mirror, onward
