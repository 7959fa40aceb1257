"""Integrators: how the light that rays bring is found, and how a picture is made of it. `Settings(sampling=...)` holds one.

Most find it for each ray by itself (`AbstractRayIntegrator`): they say what one batch of rays brings, and are spread over devices, tiled,
fitted, differentiated. Others choose among the rays of a picture, or share samples between them, and make the picture themselves
(`AbstractIntegrator`).
"""

import abc
import dataclasses
import math
import warnings
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.execution.devices import everywhere, over_rays, program, shares
from jvr.execution.tiles import block_shape, dealt_blocks, in_tiles, picture_of, pixels_of
from jvr.march.steps import Rays
from jvr.model.camera import AbstractCamera
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.scene import Scene
from jvr.numerics import divide_or_zero
from jvr.rendering.image import Rendering, RenderStats
from jvr.rendering.medium import Prepared, prepare
from jvr.rendering.supersampling import filtered, finer
from jvr.rendering.trace import camera_rays, near_volume
from jvr.types import Scalar

if TYPE_CHECKING:
    # Settings hold an integrator.
    from jvr.rendering.settings import Settings


class Radiance(NamedTuple):
    """What rays bring, multiplied by the opacity that it has, as associated colours are.

    - `rgb`: `(rays, 3)`, linear radiance, with what of the background is seen;
    - `alpha`: opacity;
    - `distance`: `alpha` times the mean distance from where the ray enters to what is seen on it;
    - `steps`: samples that were taken.
    """

    rgb: Float[Array, "rays 3"]
    alpha: Float[Array, "rays"]
    distance: Float[Array, "rays"]
    steps: Int[Array, "rays"]

    def depth(self, t_in: Float[Array, "rays"]) -> Float[Array, "rays"]:
        """The mean distance from an eye that is `t_in` away from where the rays enter; 0 where nothing is seen."""
        return jnp.where(self.alpha > 0, t_in + divide_or_zero(self.distance, self.alpha), 0.0)


class View(NamedTuple):
    """What a picture is made of: a scene and a camera near the volume (`jvr.rendering.trace.near_volume`), the settings, whose `step` is 1,
    and the world length of a segment in its place, so that one program serves all steps."""

    scene: Scene
    camera: AbstractCamera
    settings: "Settings"
    dt: Scalar


class AbstractIntegrator(AbstractPart):
    """An integrator: how a picture is made of light. Static, without arrays."""

    # Whether `Settings(tile=...)` bounds the memory that it takes.
    is_tiled: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def explanation(self) -> str:
        """What it does, for `jvr.plan`."""

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry("integrator", True, self.explanation),)

    @abc.abstractmethod
    def picture(self, view: View) -> Rendering:
        """The picture of a view; traceable. **Raises** `ValueError` for what this integrator does not support."""

    def render(self, scene: Scene, camera: AbstractCamera, settings: "Settings") -> Rendering:
        """`jvr.render` by this integrator, as it was called before; for one release, with a warning."""
        warnings.warn(
            f"{type(self).__name__}.render is jvr.render(scene, camera, settings) with Settings(sampling=...)",
            DeprecationWarning,
            stacklevel=2,
        )
        same = dataclasses.replace(settings, sampling=self, step=1.0)
        return compiled_picture(scene.current(), camera, same, settings.step)


class AbstractRayIntegrator(AbstractIntegrator):
    """An integrator that finds the light of each ray by itself."""

    is_tiled: ClassVar[bool] = True
    # Whether what rays bring is what `medium(prepared)` emits and absorbs in segments of `dt`, so that a fit may keep their samples and
    # take the Jacobian of a table out of one replay.
    marches: ClassVar[bool] = False
    # Whether `radiance` has derivatives.
    is_differentiable: ClassVar[bool] = True

    @abc.abstractmethod
    def radiance(self, prepared: Prepared, rays: Rays) -> Radiance:
        """What rays bring that enter the volume of `prepared.scene`; of those that miss it, which have no length, the background.

        Called within a program that is compiled, for some rays of a picture or of a fit at a time, in no particular order.
        **Raises** `ValueError` for scenes that this integrator does not support.
        """

    def picture(self, view: View) -> Rendering:
        """The rays of all pixels, spread over devices, at most `Settings(tile=...)` of them at a time on each."""
        height, width = view.camera.height, view.camera.width
        most = view.settings.tile // math.prod(block_shape(height, width))

        def share(shared: tuple[AbstractCamera, Prepared], blocks: Int[Array, "blocks"]) -> tuple[Array, ...]:
            camera, prepared = shared
            return in_tiles(lambda tile: self._pixels(prepared, camera, pixels_of(tile, height, width)), blocks, most)

        prepared, dealt = prepare(view.scene, view.settings, view.dt), dealt_blocks(height, width, shares())
        rays = everywhere(over_rays(share, (view.camera, prepared), dealt))
        rgb, alpha, depth, steps = picture_of(rays, height, width, shares())
        return Rendering(rgb, alpha, depth, RenderStats(steps, shadows=everywhere(prepared.shadow_stats)))

    def _pixels(self, prepared: Prepared, camera: AbstractCamera, pixels: Int[Array, "rays"]) -> tuple[Array, ...]:
        """Colour, opacity, depth and steps of some pixels."""
        rays, t_in = camera_rays(prepared.scene, camera, pixels)
        found = self.radiance(prepared, rays)
        return found.rgb, found.alpha, found.depth(t_in), found.steps


def make_picture(scene: Scene, camera: AbstractCamera, settings: "Settings", step: Scalar | float) -> Rendering:
    """The picture that the integrator of `settings` makes. Traceable. `settings`: with a step of 1, in place of which there is `step`."""
    scene, camera = near_volume(scene, camera)
    n = settings.pixel_samples
    view = View(scene, camera if n == 1 else finer(camera, n), settings, step * jnp.min(scene.volume.spacing))
    picture = settings.sampling.picture(view)
    return picture if n == 1 else filtered(picture, n, settings.pixel_filter)


compiled_picture = program(make_picture, static_argnums=2)
