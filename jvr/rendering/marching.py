"""Ray marching as an integrator: the default of `Settings(sampling=...)`."""

from typing import ClassVar

import jax.numpy as jnp

from jvr.march.march import Marched
from jvr.march.steps import Rays
from jvr.model.scene import Scene
from jvr.rendering.geometry import lit_where_rays_end
from jvr.rendering.integrator import AbstractRayIntegrator, Radiance
from jvr.rendering.medium import Prepared, marched, medium
from jvr.rendering.specular import seen_in_mirrors
from jvr.rendering.surfaces import blended_with_surfaces, ended_at_surfaces
from jvr.rendering.trace import composite, seen_end


class Uniform(AbstractRayIntegrator):
    """Uniform sampling: every pixel's ray, and every sample of a ray that can be seen. The default."""

    marches: ClassVar[bool] = True

    @property
    def explanation(self) -> str:
        return "every ray, evenly spaced samples"

    def radiance(self, prepared: Prepared, rays: Rays) -> Radiance:
        through, surfaces = medium(prepared), prepared.scene.surfaces
        rays = lit_where_rays_end(prepared, through, rays)
        if surfaces is None:
            return radiance_of(prepared.scene, marched(prepared, through, rays.without_end), rays)
        if prepared.scene.specular is not None and prepared.scene.specular.order:
            return seen_in_mirrors(prepared, through, rays)
        if not surfaces.is_opaque:
            return blended_with_surfaces(prepared, through, rays)
        rays, steps = ended_at_surfaces(prepared, through, rays)
        found = radiance_of(prepared.scene, marched(prepared, through, rays.without_end), rays)
        return found._replace(steps=found.steps + steps)


def radiance_of(scene: Scene, gathered: Marched, rays: Rays) -> Radiance:
    """What rays bring that were marched with their distance."""
    rgb, alpha = composite(scene, gathered, rays)
    distance = sum(gathered.distance, jnp.zeros_like(alpha)) / max(len(gathered.distance), 1)
    if rays.end is not None:
        distance += seen_end(gathered, rays.end) * rays.end.distance
    assert gathered.steps is not None
    return Radiance(jnp.stack(rgb, axis=-1), alpha, distance, gathered.steps)
