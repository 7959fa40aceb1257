"""The scene: a volume and everything that says how it looks."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx

from jvr.model.by_value import is_by_gradient
from jvr.model.clipping import AbstractClipping, ClippingBox
from jvr.model.effects import (
    AbstractMaterial,
    AbstractOcclusion,
    AbstractPrecomputable,
    AbstractRadianceTransfer,
    AbstractScattering,
    AbstractShading,
    AbstractShadows,
    AbstractSpecular,
    AbstractSurfaces,
)
from jvr.model.environment import EnvironmentLight
from jvr.model.environment_map import EnvironmentMap
from jvr.model.geometry import AbstractGeometry
from jvr.model.interpolation import Nearest
from jvr.model.light import AbstractDeltaLight, AbstractLight, AmbientLight
from jvr.model.normals import AbstractNormals, AnalyticGradient
from jvr.model.optical import AbstractOpticalModel, EmissionAbsorption
from jvr.model.parameters import assign, parameter
from jvr.model.parts import AbstractPart, PlanEntry, asks_gradient, parts_of
from jvr.model.ranges import COLOUR
from jvr.model.transfer import AbstractTransfer, ClearTransfer
from jvr.model.volume import Volume
from jvr.types import ArrayLike, Vector


class Scene(AbstractPart):
    """A volume with transfer function, optical model and lighting. A part that is `None` leaves no trace in the compiled program.

    **Arguments:**

    - `volume`: `jvr.Volume`.
    - `transfer`: a transfer function, `jvr.LinearTransfer`, `jvr.LutTransfer`, `jvr.GaussianTransfer`, `jvr.GradientTransfer`, or `None`:
      the medium shows nothing (`jvr.ClearTransfer`), and surfaces or geometry are all there is.
    - `background`: what shows through what is transparent: `(3,)` linear RGB, `jvr.EnvironmentMap`, or `None`.
    - `optical`: `jvr.EmissionAbsorption()` (default), `jvr.EmissionOnly()` or `jvr.AbsorptionOnly()`.
    - `clipping`: what is left of the volume: `jvr.ClippingBox`, `jvr.ClippingPlane`, several of them in a row, or `None`: all of it.
    - `lights`: any number of `jvr.DirectionalLight`, `jvr.PointLight`, `jvr.SpotLight`, `jvr.HeadLight`, `jvr.AmbientLight` and
      `jvr.EnvironmentLight`.
    - `shading`: what surfaces make of light: `jvr.Lambert`, `jvr.Phong`, `jvr.BlinnPhong`, `jvr.AnisotropicGGX`,
      `jvr.PhenomenologicalBSDF`, or `None`: the medium glows as it is.
    - `shadows`: how much of each light reaches a point: `jvr.ShadowRays`, `jvr.ShadowVolume`, `jvr.ShadowMap`, `jvr.OpacityShadowMap`,
      `jvr.DeepShadowMap`, `jvr.PiecewiseShadows`, `jvr.InScattering` around any of them, or `None`: all of it.
    - `scattering`: what the medium makes of light: `jvr.SingleScattering` or `None`.
    - `environment`: light from far away in all directions: `jvr.EnvironmentLight`, `jvr.EnvironmentMap` or `None`; adds to those among
      `lights`.
    - `material`: what a point makes of the environment's light: a BRDF such as `jvr.MicrofacetBRDF(...)`, `jvr.HarmonicMaterial`,
      `jvr.MaterialByValue`, or `None`.
    - `radiance_transfer`: how much of the environment reaches a point: `jvr.RadianceTransfer(...)`, or `None`: all of it.
    - `occlusion`: how much of the ambient light the medium near a point takes away: `jvr.LocalOcclusion(...)`,
      `jvr.HistogramOcclusion(...)`, or, of isosurfaces, `jvr.SurfaceOcclusion(...)`, or `None`: nothing.
    - `geometry`: opaque geometry that rays end at, `jvr.DepthImage`, `jvr.Mesh`, or `None`.
    - `normals`: how gradients are estimated, where something asks for them: `jvr.AnalyticGradient()` (default),
      `jvr.ForwardDifferences()`, `jvr.CentralDifferences()`, `jvr.SobelDifferences()`, `jvr.PrecomputedGradient()`.
    - `surfaces`: `jvr.Isosurfaces(...)`, shaded as the medium is, or `None`.
    - `specular`: how surfaces mirror and bend rays, `jvr.Specular(...)`, or `None`: not at all.

    **Raises** `ValueError` for a scene that shows nothing; for shadows without a light, or with nothing that shows light; for occlusion
    without ambient light, or with nothing that shows it, and that of surfaces without these; for one of environment and material without
    the other, and for radiance transfer without both; for surfaces between nearest voxels, or whose normals are those of the opacity; for
    a specular part without surfaces, or with a depth image.
    """

    volume: Volume = parameter(doc="a jvr.Volume, as jvr.read_volume gives it")
    transfer: AbstractTransfer = parameter(doc="one of jvr's")
    background: Vector | EnvironmentMap | None = parameter(COLOUR, doc="red, green, blue, linear, or a jvr.EnvironmentMap")
    optical: AbstractOpticalModel = parameter(doc="one of jvr's")
    # The first class is that of a file that names none.
    clipping: ClippingBox | AbstractClipping | tuple[ClippingBox | AbstractClipping, ...] | None = parameter(
        doc="a jvr.ClippingBox, a jvr.ClippingPlane or a sequence of them"
    )
    lights: tuple[AbstractLight, ...] = parameter(doc="a sequence of jvr's lights")
    shading: AbstractShading | None = parameter(doc="one of jvr's")
    shadows: AbstractShadows | None = parameter(doc="one of jvr's")
    scattering: AbstractScattering | None = parameter(doc="one of jvr's")
    normals: AbstractNormals = parameter(doc="one of jvr's")
    environment: EnvironmentLight | EnvironmentMap | None = parameter(doc="a jvr.EnvironmentLight or a jvr.EnvironmentMap")
    material: AbstractMaterial | None = parameter(doc="one of jvr's")
    radiance_transfer: AbstractRadianceTransfer | None = parameter(doc="a jvr.RadianceTransfer")
    occlusion: AbstractOcclusion | None = parameter(doc="one of jvr's")
    geometry: AbstractGeometry | None = parameter(doc="a jvr.DepthImage or a jvr.Mesh")
    surfaces: AbstractSurfaces | None = parameter(doc="jvr.Isosurfaces(...)")
    specular: AbstractSpecular | None = parameter(doc="jvr.Specular(...)")

    def __init__(
        self,
        volume: Volume,
        transfer: AbstractTransfer | None = None,
        *,
        background: ArrayLike | EnvironmentMap | None = None,
        optical: AbstractOpticalModel = EmissionAbsorption(),
        clipping: AbstractClipping | Sequence[AbstractClipping] | None = None,
        lights: Sequence[AbstractLight] = (),
        shading: AbstractShading | None = None,
        shadows: AbstractShadows | None = None,
        scattering: AbstractScattering | None = None,
        normals: AbstractNormals = AnalyticGradient(),
        environment: EnvironmentLight | EnvironmentMap | None = None,
        material: AbstractMaterial | None = None,
        radiance_transfer: AbstractRadianceTransfer | None = None,
        geometry: AbstractGeometry | None = None,
        occlusion: AbstractOcclusion | None = None,
        surfaces: AbstractSurfaces | None = None,
        specular: AbstractSpecular | None = None,
    ):
        # None of several is no clipping.
        clipping = clipping if isinstance(clipping, AbstractClipping) or clipping else None
        if transfer is None:
            if surfaces is None and geometry is None:
                raise ValueError(
                    "this scene shows nothing: give it a transfer function, surfaces=jvr.Isosurfaces(...) or geometry="
                )
            transfer = ClearTransfer()
        assign(self, volume=volume, transfer=transfer, background=background, optical=optical, clipping=clipping)
        assign(self, lights=lights, shading=shading, shadows=shadows, scattering=scattering, normals=normals)
        assign(self, environment=environment, material=material, radiance_transfer=radiance_transfer, geometry=geometry)
        assign(self, surfaces=surfaces, specular=specular, occlusion=occlusion)
        _check_light(self)
        _check_environment(self)
        _check_surfaces(self)
        _check_specular(self)
        if geometry is not None:
            geometry.check_light(shading, material)

    def current(self) -> "Scene":
        """The same scene with nothing in it that was computed for another: `Volume.current()`, and each precomputed part `checked`. What
        draws a scene begins here."""
        volume = self.volume.current()
        scene = self if volume is self.volume else eqx.tree_at(lambda s: s.volume, self, volume)
        for name in self.precomputable:
            part = lambda s, name=name: getattr(s, name)
            scene = eqx.tree_at(part, scene, part(self).checked(self))
        return scene

    @property
    def is_precomputable(self) -> bool:
        """Whether `jvr.precompute` has anything to do: projecting a material, or `precomputable` parts."""
        return self.environment_light is not None or bool(self.precomputable)

    @property
    def precomputable(self) -> tuple[str, ...]:
        """Fields of parts that `jvr.precompute` computes beforehand."""
        return tuple(f.name for f in dataclasses.fields(self) if isinstance(getattr(self, f.name), AbstractPrecomputable))

    @property
    def shows_lights(self) -> bool:
        return any(part.shows_lights for _, part in parts_of(self))

    @property
    def shows_light(self) -> bool:
        """Whether anything in it shows light, of lights or of the environment."""
        return self.shows_lights or any(part.shows_environment for _, part in parts_of(self))

    @property
    def shades_surfaces(self) -> bool:
        """Whether the light that falls on a surface is what it shows."""
        return self.shading is not None or self.material is not None

    @property
    def ends_rays(self) -> bool:
        return isinstance(self.background, EnvironmentMap) or any(part.ends_rays for _, part in parts_of(self))

    @property
    def background_colour(self) -> Vector | None:
        """The background where it is one colour for all rays, else `None`."""
        return None if isinstance(self.background, EnvironmentMap) else self.background

    @property
    def environment_lights(self) -> tuple[EnvironmentLight, ...]:
        """Its environment, as harmonics, and those among its lights."""
        return _environments(self.lights, self.environment)

    @property
    def environment_light(self) -> EnvironmentLight | None:
        """The light of all of them as one, or `None` where there is none."""
        return functools.reduce(EnvironmentLight.__add__, self.environment_lights) if self.environment_lights else None

    @property
    def light_blocker(self) -> AbstractGeometry | None:
        """The geometry that light does not get through: `None`, too, where it is known from the eye alone."""
        return None if self.geometry is None or self.geometry.of_one_view else self.geometry

    @property
    def shadow_casters(self) -> tuple[AbstractDeltaLight | None, ...]:
        """Its lights, `None` in the place of each that nothing shades."""
        return _casters(self.lights)

    @property
    def needs_gradient(self) -> bool:
        return any(asks_gradient(part) for _, part in parts_of(self))

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return () if self.background_colour is None else (PlanEntry("background", True, "shows through"),)

    def remarks(self, name: str, scene: Any, stats: Any) -> Iterator[str]:
        if not self.lights and self.shows_lights:
            yield "there is no light: shading shows black, and nothing is scattered"

    def replaced(self, **parts: Any) -> "Scene":
        """The scene with other parts, and without what these cannot carry: shadows go with the last light that casts them and the last part
        that shows them, occlusion with the last ambient light, that part or its surfaces, material and radiance transfer with the
        environment, what is specular with the surfaces."""
        light, shading, scattering = (parts.get(name, getattr(self, name)) for name in ("lights", "shading", "scattering"))
        if not any(_casters(light)) or (shading is None and scattering is None):
            parts["shadows"] = None
        if not any(isinstance(one, AmbientLight) for one in light) or (shading is None and scattering is None):
            parts["occlusion"] = None
        held = parts.get("occlusion", self.occlusion)
        if held is not None and held.of_surfaces and (shading is None or parts.get("surfaces", self.surfaces) is None):
            parts["occlusion"] = None
        if not _environments(light, parts.get("environment", self.environment)):
            parts |= {"material": None, "radiance_transfer": None}
        if parts.get("surfaces", self.surfaces) is None:
            parts["specular"] = None
        return dataclasses.replace(self, **parts)

    @property
    def material_order(self) -> int:
        """`material_order` of its environment and radiance transfer; 0 without an environment."""
        around = self.environment_light
        return 0 if around is None else material_order(around, self.radiance_transfer)


def material_order(environment: EnvironmentLight, transfer: AbstractRadianceTransfer | None) -> int:
    """Order of the harmonics that a material is projected on: that of the environment; with an exact product the transfer's where that is
    higher, since shadows are sharper than the light that casts them."""
    if transfer is None or not transfer.exact:
        return environment.order
    return max(environment.order, transfer.order)


def _casters(lights: Sequence[AbstractLight]) -> tuple[AbstractDeltaLight | None, ...]:
    return tuple(light if isinstance(light, AbstractDeltaLight) and light.casts_shadows else None for light in lights)


def _environments(
    lights: Sequence[AbstractLight], environment: EnvironmentLight | EnvironmentMap | None
) -> tuple[EnvironmentLight, ...]:
    if isinstance(environment, EnvironmentMap):
        environment = environment.to_harmonics(environment.order)
    return tuple(light for light in (environment, *lights) if isinstance(light, EnvironmentLight))


def _check_light(scene: Scene) -> None:
    """Parts of the light that go together."""
    for light in scene.lights:
        if not isinstance(light, AbstractDeltaLight | AmbientLight | EnvironmentLight):
            raise TypeError(f"nothing shows a {type(light).__name__}: derive it from jvr.model.light.AbstractDeltaLight")
    if scene.shadows is not None and not any(scene.shadow_casters):
        raise ValueError(
            "there are shadows and no light that casts them: add a jvr.DirectionalLight to lights=, or leave shadows out"
        )
    if scene.shadows is not None and scene.shading is None and scene.scattering is None:
        raise ValueError("nothing shows these shadows: set shading=jvr.Lambert() or scattering=jvr.SingleScattering()")
    ambient = any(isinstance(light, AmbientLight) for light in scene.lights)
    if scene.occlusion is not None and not ambient:
        raise ValueError("occlusion is that of ambient light: add a jvr.AmbientLight to lights=, or leave occlusion out")
    if scene.occlusion is not None and scene.shading is None and scene.scattering is None:
        raise ValueError("nothing shows this occlusion: set shading=jvr.Lambert() or scattering=jvr.SingleScattering()")
    if scene.occlusion is not None and scene.occlusion.of_surfaces and scene.surfaces is None:
        raise ValueError(
            "jvr.SurfaceOcclusion is that of isosurfaces: set surfaces=jvr.Isosurfaces(...), or occlusion=jvr.LocalOcclusion()"
        )
    if scene.occlusion is not None and scene.occlusion.of_surfaces and scene.shading is None:
        raise ValueError("surfaces show no ambient light without a shading: set shading=jvr.Lambert()")
    if scene.normals.of_opacity and is_by_gradient((scene.shading, scene.scattering)):
        raise ValueError("jvr.ByGradient goes by the gradient of the scalar: set normals=...(of_opacity=False)")


def _check_environment(scene: Scene) -> None:
    """Environment lighting, and what shows it."""
    if scene.environment_lights and scene.material is None:
        raise ValueError("nothing shows the environment: set material=jvr.LambertBRDF() or another material")
    if scene.material is not None and not scene.environment_lights:
        raise ValueError("a material shows environment lighting: set environment=jvr.EnvironmentLight.from_image(...)")
    if scene.radiance_transfer is not None and not scene.environment_lights:
        raise ValueError("radiance transfer is that of an environment: set environment= and material=, or leave it out")


def _check_surfaces(scene: Scene) -> None:
    """What isosurfaces, and their normals, are of."""
    if scene.surfaces is None:
        return
    if isinstance(scene.volume.interpolation, Nearest):
        raise ValueError("nearest voxels have no isosurfaces between them: set jvr.Volume(interpolation=jvr.Trilinear())")
    if scene.normals.of_opacity and scene.needs_gradient:
        raise ValueError("isosurfaces are lit by the gradient of the scalar: set normals=...(of_opacity=False)")


def _check_specular(scene: Scene) -> None:
    """What mirrors and bends rays, and what these may meet."""
    if scene.specular is None:
        return
    if scene.surfaces is None:
        raise ValueError("there is no surface to be specular: set surfaces=jvr.Isosurfaces(...), or leave specular out")
    if scene.geometry is not None and scene.geometry.of_one_view:
        raise ValueError("mirrored rays do not know a depth image, which is of the eye's alone: give geometry=jvr.Mesh(...)")
    scene.specular.check(scene.surfaces)
