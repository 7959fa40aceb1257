"""The scene: a volume and everything that says how it looks."""

from collections.abc import Sequence

import equinox as eqx

from jvr.model.checks import float_array
from jvr.model.effects import AbstractScattering, AbstractShading, AbstractShadows
from jvr.model.light import AbstractLight, AmbientLight
from jvr.model.normals import AbstractNormals, AnalyticGradient
from jvr.model.optical import AbstractOpticalModel, EmissionAbsorption
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import ClippingBox, Volume
from jvr.types import ArrayLike, Vector


class Scene(eqx.Module):
    """What is rendered. A part that is `None` leaves no trace in the compiled program.

    **Arguments:**

    - `volume`: `jvr.Volume`.
    - `transfer`: a transfer function, `jvr.LinearTransfer`, `jvr.LutTransfer` or `jvr.GaussianTransfer`.
    - `background`: `(3,)` linear RGB that shows through what is transparent, or `None`.
    - `optical`: `jvr.EmissionAbsorption()` (default), `jvr.EmissionOnly()` or `jvr.AbsorptionOnly()`.
    - `clipping`: `jvr.ClippingBox` or `None`.
    - `lights`: any number of `jvr.DirectionalLight`, `jvr.PointLight`, `jvr.SpotLight`, `jvr.HeadLight` and `jvr.AmbientLight`.
    - `shading`: what surfaces make of light: `jvr.Lambert`, `jvr.Phong`, `jvr.BlinnPhong`, or `None`: the medium glows as it is.
    - `shadows`: how much of each light reaches a point: `jvr.ShadowRays`, `jvr.ShadowVolume`, `jvr.ShadowMap`, `jvr.OpacityShadowMap`,
      `jvr.DeepShadowMap`, or `None`: all of it.
    - `scattering`: what the medium makes of light: `jvr.SingleScattering` or `None`.
    - `normals`: how gradients are estimated, where something asks for them: `jvr.AnalyticGradient()` (default),
      `jvr.ForwardDifferences()`, `jvr.CentralDifferences()`, `jvr.SobelDifferences()`, `jvr.PrecomputedGradient()`.

    **Raises** `ValueError` for shadows without a light, or with nothing that shows light.
    """

    volume: Volume
    transfer: AbstractTransfer
    background: Vector | None
    optical: AbstractOpticalModel
    clipping: ClippingBox | None
    lights: tuple[AbstractLight | AmbientLight, ...]
    shading: AbstractShading | None
    shadows: AbstractShadows | None
    scattering: AbstractScattering | None
    normals: AbstractNormals

    def __init__(
        self,
        volume: Volume,
        transfer: AbstractTransfer,
        *,
        background: ArrayLike | None = None,
        optical: AbstractOpticalModel = EmissionAbsorption(),
        clipping: ClippingBox | None = None,
        lights: Sequence[AbstractLight | AmbientLight] = (),
        shading: AbstractShading | None = None,
        shadows: AbstractShadows | None = None,
        scattering: AbstractScattering | None = None,
        normals: AbstractNormals = AnalyticGradient(),
    ):
        self.volume = volume
        self.transfer = transfer
        self.background = None if background is None else float_array(background, "background", (3,))
        self.optical = optical
        self.clipping = clipping
        self.lights = tuple(lights)
        self.shading = shading
        self.shadows = shadows
        self.scattering = scattering
        self.normals = normals
        _check_light(self)


def _check_light(scene: Scene) -> None:
    """Parts of the light that go together, each of its kind."""
    kinds = {"shading": AbstractShading, "shadows": AbstractShadows, "scattering": AbstractScattering, "normals": AbstractNormals}
    for name, kind in kinds.items():
        part = getattr(scene, name)
        if part is not None and not isinstance(part, kind):
            raise TypeError(f"{name} must be one of jvr's, not {type(part).__name__}")
    for light in scene.lights:
        if not isinstance(light, AbstractLight | AmbientLight):
            raise TypeError(f"lights must be a sequence of jvr's lights, not of {type(light).__name__}")
    if scene.shadows is not None and not any(isinstance(light, AbstractLight) and light.casts_shadows for light in scene.lights):
        raise ValueError(
            "there are shadows and no light that casts them: add a jvr.DirectionalLight to lights=, or leave shadows out"
        )
    if scene.shadows is not None and scene.shading is None and scene.scattering is None:
        raise ValueError("nothing shows these shadows: set shading=jvr.Lambert() or scattering=jvr.SingleScattering()")
