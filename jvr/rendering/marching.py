"""Ray marching as an integrator: the default of `Settings(sampling=...)`."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.march.march import Marched, MarchOptions
from jvr.march.steps import Rays
from jvr.model.scene import Scene
from jvr.rendering.integrator import AbstractRayIntegrator, Radiance
from jvr.rendering.medium import Prepared, medium
from jvr.rendering.trace import composite


class Uniform(AbstractRayIntegrator):
    """Uniform sampling: every pixel's ray, and every sample of a ray that can be seen. The default."""

    marches: ClassVar[bool] = True

    @property
    def explanation(self) -> str:
        return "every ray, evenly spaced samples"

    def radiance(self, prepared: Prepared, rays: Rays) -> Radiance:
        settings = prepared.settings
        gathered = settings.adjoint.march(MarchOptions(settings.termination, True), medium(prepared), rays, prepared.dt)
        return radiance_of(prepared.scene, gathered, rays.length)


def radiance_of(scene: Scene, gathered: Marched, length: Float[Array, "rays"]) -> Radiance:
    """What rays of some length bring that were marched with their distance."""
    rgb, alpha = composite(scene, gathered, length)
    distance = sum(gathered.distance, jnp.zeros_like(alpha)) / max(len(gathered.distance), 1)
    assert gathered.steps is not None
    return Radiance(jnp.stack(rgb, axis=-1), alpha, distance, gathered.steps)
