"""Local lighting: the light at a sample, and what it adds to the medium's own, `j = sigma_t (rgb a + b)`.

`a` is what shading makes of the light (1 without shading), `b` what is reflected in the light's own colour and what is scattered:

    a = k_ambient L_ambient + sum_lights E T_light reflect + integral M_tinted L T,
    b = sum_lights E T_light (specular + albedo p(cos theta)) + integral M_plain L T.

Lights, shading, shadows, scattering, and material and environment of the scene come together here; each says for itself what it does.
"""

from typing import Any

import jax
import jax.numpy as jnp

from jvr.effects.cut import CutFaces
from jvr.effects.environment_lighting import EnvironmentLighting, environment_lighting_of
from jvr.effects.self_shadow import ShadedSegment
from jvr.effects.shading import surface_weight
from jvr.march.medium import LightPath, Medium
from jvr.march.shaders import GradientFrame, OpticalShader, PreIntegratedShader, where_known
from jvr.march.steps import End, Point, Sample
from jvr.model.by_value import at_sample
from jvr.model.clipping import parts_of_clipping
from jvr.model.effects import AbstractScattering, AbstractShading
from jvr.model.light import AbstractDeltaLight, AbstractLight, AmbientLight
from jvr.model.optical import with_own
from jvr.model.scene import Scene
from jvr.model.transfer import Classified
from jvr.numerics import direction_and_length, transformed, turned
from jvr.types import Affine, Channels, Scalar, Triple


def prepare(scene: Scene) -> EnvironmentLighting | None:
    """What is computed once for all rays through a scene that shows light: its material under environment lighting."""
    return None if scene.material is None else environment_lighting_of(scene)


def lit_shader(
    scene: Scene, frame: GradientFrame | None, prepared: EnvironmentLighting | None, *, pre_integrated: bool
) -> "LitShader":
    """The shader of a scene that shows light; `frame`: how gradients come about, where something asks for them."""
    kind = LitPreIntegratedShader if pre_integrated else LitShader
    cut, volume = None, scene.volume
    if scene.clipping is not None and frame is not None:
        cut = CutFaces(parts_of_clipping(scene.clipping), jnp.min(volume.spacing))
    return kind(scene.optical, frame, volume.world_from_grid, scene.lights, scene.shading, scene.scattering, cut, prepared)


class LitShader(OpticalShader):
    """The optical model of a medium that shows light."""

    world_from_grid: Affine
    lights: tuple[AbstractLight, ...]
    shading: AbstractShading | None
    scattering: AbstractScattering | None
    cut: CutFaces | None = None  # where surfaces are clipped
    environment: EnvironmentLighting | None = None

    def shade(self, classified: Classified, sample: Sample, point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        factor, added = self.light_at(sample, point, classified, dt)
        rgb = tuple(c * a + b for c, a, b in zip(classified.rgb, factor, added, strict=True))
        # What glows by itself needs no light.
        return self.optical.evaluate_segment(classified._replace(rgb=rgb), dt)

    def light_at(
        self, sample: Sample, point: Point, classified: Classified, dt: Scalar, *, is_surface: bool = False
    ) -> tuple[Triple, Triple]:
        """`a` and `b` of a sample that stands for a segment of length `dt` of a medium, or of a point that `is_surface` whatever the length
        of its gradient."""
        zero = jnp.zeros_like(sample.s)
        x = transformed(self.world_from_grid, point.p)
        w_o, _ = direction_and_length(turned(-self.world_from_grid[:3, :3], point.direction))
        normal, magnitude = direction_and_length(tuple(-g for g in sample.gradient)) if sample.gradient else ((zero,) * 3, zero)
        shading, scattering = at_sample((self.shading, self.scattering), sample.s, magnitude)
        surface = zero if shading is None else shading.surface_weight(magnitude)
        cut = zero
        if is_surface:
            surface = cut = surface_weight(magnitude, zero)
        if self.cut is not None:
            # What is hardly a surface has hardly a say in the normal.
            weight = (
                surface
                if self.environment is None or shading is not None
                else surface_weight(magnitude, self.environment.threshold)
            )
            normal, cut = self.cut.normal(x, tuple(weight * n for n in normal))
            surface = surface + cut * (1 - surface)
        scatters = zero + 1 if scattering is None or not scattering.needs_gradient else scattering.medium_weight(magnitude)
        # Where there is a switch, what is not a surface scatters and does not reflect.
        reflects = 1 - scatters if scattering is not None and scattering.needs_gradient else zero + 1
        # A medium that nothing reflects from glows as it is.
        glows = shading is None and self.environment is None
        factor, added = [zero + 1 if glows else zero] * 3, [zero] * 3
        for i, light in enumerate(self.lights):
            if isinstance(light, AbstractDeltaLight):
                w_i, _, irradiance = light.sample(x, w_o)
                incident = _times(irradiance, sample.light.of_light(i))
                reflected = None if shading is None else shading.reflect(surface, normal, w_o, w_i)
                scattered = None if scattering is None else scattering.scatter(w_o, w_i)
            elif isinstance(light, AmbientLight):
                incident = _times(light.rgb, sample.light.ambient)
                reflected = None if shading is None else (shading.ambient_reflectance(), None)
                scattered = None if scattering is None else scattering.scatter_ambient()
            else:
                # Light of the environment is shown by the material, all of it together.
                continue
            if reflected is not None:
                diffuse, specular = reflected
                factor = [f + reflects * diffuse * e for f, e in zip(factor, incident, strict=True)]
                if specular is not None:
                    added = [b + reflects * specular * e for b, e in zip(added, incident, strict=True)]
            if scattered is not None:
                added = [b + scatters * e for b, e in zip(added, _times(incident, scattered), strict=True)]
        if self.environment is not None:
            here = ShadedSegment(classified, sample.gradient, dt)
            tinted, unmodulated = self.environment.reflect(sample.s, magnitude, normal, w_o, sample.light.environment, cut, here)
            factor = [f + reflects * c for f, c in zip(factor, tinted, strict=True)]
            added = [b + reflects * c for b, c in zip(added, unmodulated, strict=True)]
        return tuple(factor), tuple(added)


def surface_shader(shader: Any) -> LitShader | None:
    """The shader of surfaces in what a shader shades, or `None` where that shades none. A surface does not scatter as a medium does, and
    where it is cut there is none of it."""
    if not isinstance(shader, LitShader) or (shader.shading is None and shader.environment is None):
        return None
    return LitShader(
        shader.optical, shader.frame, shader.world_from_grid, shader.lights, shader.shading, None, None, shader.environment
    )


def reflected(shader: LitShader, sample: Sample, points: Point, colour: Triple) -> tuple[Triple, Triple]:
    """What points of surfaces of a colour reflect of it, and what they add in the colour of the light; `shader`: a `surface_shader`."""
    zero = jnp.zeros_like(colour[0])
    none = jnp.zeros((), zero.dtype)
    light_at = lambda sample, point, classified: shader.light_at(sample, point, classified, none, is_surface=True)
    return jax.vmap(light_at)(sample, points, Classified(colour, (zero,)))


def radiance_of_geometry(scene: Scene, path: LightPath, search: Any, medium: Medium, end: End) -> Triple:
    """What rays see where they end, of geometry in the light that `medium` shows. `path`: of light through the scene; `search`: what its
    surfaces are found by."""
    # Scenes without any do without its modules.
    from jvr.effects.lit_geometry import light_on_geometry

    shader = surface_shader(medium.shader)
    assert shader is not None
    at, sample = light_on_geometry(scene, path, search, medium.visibility, end)
    factor, added = reflected(shader, sample, at, end.rgb)
    lit = (c * a + b for c, a, b in zip(end.rgb, factor, added, strict=True))
    return tuple(jnp.where(end.opaque > 0, c, far) for c, far in zip(lit, end.rgb, strict=True))


class LitPreIntegratedShader(LitShader, PreIntegratedShader):
    """Pre-integration in a lit medium: the scalar linear along a segment, the light that of the mean of its ends."""

    def evaluate_segment(self, transfer: Any, samples: tuple[Sample, ...], point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        front, back = samples
        emitted, own, dtau = transfer.evaluate_apart(self.optical, front.s, back.s, dt)
        middle = self.in_world(transfer.table, _mean(front, back), point)
        factor, added = self.light_at(middle, point, transfer.evaluate(middle.s), dt)
        # A constant colour of the given optical depth.
        extra, _ = self.optical.evaluate_segment(Classified(added, dtau), jnp.ones_like(dt))
        radiance = with_own(tuple(e * a + b for e, a, b in zip(emitted, factor, extra, strict=False)), own)
        return where_known(samples, radiance), where_known(samples, dtau)


def _mean(front: Sample, back: Sample) -> Sample:
    return jax.tree.map(lambda a, b: 0.5 * (a + b), front, back)


def _times(rgb: Triple, channels: Channels) -> Triple:
    """Three channels times one, three or none."""
    if not channels:
        return rgb
    return tuple(c * f for c, f in zip(rgb, channels * (3 // len(channels)), strict=True))
