"""What of a scene is in the compiled program, decided from its structure alone."""

import dataclasses

import jax

from jvr.execution.devices import cores, shares
from jvr.march.quadrature import PreIntegrated
from jvr.model.effects import spelling
from jvr.model.light import AmbientLight
from jvr.model.optical import EmissionOnly
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.rendering.medium import delta_lights, scatters_by_gradient
from jvr.rendering.sampling import Uniform
from jvr.rendering.settings import Settings


def _skipping(volume: Volume, settings: Settings) -> str:
    if not settings.skipping:
        return "every sample is taken"
    bound = f", and those of optical depth below {settings.negligible:g} a ray" if settings.negligible else ""
    if volume.bricks is None:
        return f"empty bricks{bound}; they are bounded anew for each picture: jvr.Volume.bricked() does it once"
    return (
        f"empty bricks of {volume.bricks.size}^3 voxels{bound}; bounded anew inside of a jit that takes the voxels as an argument"
    )


def _devices() -> str:
    if shares() > 1:
        return f"rays are spread over {shares()}"
    idle = jax.default_backend() == "cpu" and cores() > 1
    return f"one, of {cores()} cores: call jvr.use_all_cores() before anything is computed" if idle else "one"


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of the compiled program: its name, whether it is in, why or why not, and what it needs of the others."""

    name: str
    included: bool
    reason: str
    needs: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Plan:
    """The plan of a rendering: what it compiles to. Equal plans compile to the same program; `print` explains it."""

    parts: tuple[Part, ...]
    key: str

    def __str__(self) -> str:
        width = max(len(part.name) for part in self.parts)
        needs = lambda part: f"; needs {', '.join(part.needs)}" if part.needs else ""
        return "\n".join(
            f"{'+' if part.included else '-'} {part.name:<{width}}  {part.reason}{needs(part)}" for part in self.parts
        )


def plan(scene: Scene, settings: Settings = Settings()) -> Plan:
    """What `render(scene, camera, settings)` puts into the compiled program, and why.

    A pure function of the scene's structure (which parts there are, shapes, types, static choices) and of the settings, never of the
    values of arrays: a scene with other numbers has the same plan and is not compiled again. Hashable.
    """
    volume, transfer = scene.volume, scene.transfer
    voxels = f"{'x'.join(map(str, volume.shape))} {volume.values.dtype}"
    arguments = (volume.slope,) * (2 if transfer.takes_gradient else 1)
    coloured = len(jax.eval_shape(transfer.evaluate, *arguments).sigma_t) == 3
    transparent = isinstance(scene.optical, EmissionOnly)
    termination = f"rays end at transmittance {settings.termination:g}" if settings.termination > 0 else "rays run to their end"
    quadrature = settings.quadrature
    parts = (
        Part("volume", True, f"{voxels}, {type(volume.interpolation).__name__.lower()}, a sample every {settings.step:g} voxels"),
        Part("adaptive sampling", not isinstance(settings.sampling, Uniform), settings.sampling.explanation),
        Part("transfer", True, f"{type(transfer).__name__}, {'coloured' if coloured else 'grey'} extinction"),
        Part("pre-integration", isinstance(quadrature, PreIntegrated), quadrature.explanation),
        Part("optical model", True, type(scene.optical).__name__),
        *_light_parts(scene),
        Part("empty-space skipping", settings.skipping, _skipping(volume, settings)),
        Part(
            "early termination", settings.termination > 0 and not transparent, "nothing absorbs" if transparent else termination
        ),
        Part(
            "background",
            scene.background is not None,
            "shows through" if scene.background is not None else "the scene names none",
        ),
        Part("clipping", scene.clipping is not None, "rays are cut" if scene.clipping is not None else "the scene names none"),
        Part("derivatives", True, f"{type(settings.adjoint).__name__}, if any are asked for"),
        Part("devices", shares() > 1, _devices()),
    )
    return Plan(
        parts,
        f"{jax.tree.structure((scene, settings))} {jax.tree.map(lambda x: (x.shape, str(x.dtype)), jax.tree.leaves(scene))}",
    )


def _light_parts(scene: Scene) -> tuple[Part, ...]:
    """Everything about light: each part is in because the scene holds it, or, as gradients, because another part asks."""
    shading, shadows, scattering, none = scene.shading, scene.shadows, scene.scattering, "the scene names none"
    lights = sorted(scene.lights, key=lambda light: isinstance(light, AmbientLight))
    shows = shading is not None or scattering is not None
    shown = ", ".join(type(light).__name__ for light in lights) + ("" if shows else ": nothing reflects or scatters them")
    asks = {
        "shading": shading is not None,
        "scattering": scatters_by_gradient(scene),
        "material": scene.material is not None and scene.material.needs_gradient,
        "transfer": scene.transfer.takes_gradient,
    }
    asking = " and ".join(name for name, there in asks.items() if there)
    gradient = f"{spelling(scene.normals)}, asked for by {asking}" if asking else "nothing asks for a gradient"
    casting = sum(light.casts_shadows for light in delta_lights(scene))
    shaded = none if shadows is None else f"{spelling(shadows)} for {casting} light{'s' * (casting != 1)}"
    by_gradient = ("lights", "gradient")
    return (
        Part("lights", shows and bool(lights), shown if lights else none),
        Part("shading", shading is not None, spelling(shading) or none, by_gradient if shading is not None else ()),
        Part("shadows", shadows is not None, shaded, ("light march",) if shadows is not None else ()),
        Part(
            "scattering",
            scattering is not None,
            spelling(scattering) or none,
            by_gradient[: 1 + asks["scattering"]] if scattering else (),
        ),
        *_environment_parts(scene),
        Part("gradient", bool(asking), gradient),
    )


def _environment_parts(scene: Scene) -> tuple[Part, ...]:
    """Environment lighting, the material that shows it, and what is in its way."""
    environment, material, radiance_transfer, none = (
        scene.environment,
        scene.material,
        scene.radiance_transfer,
        "the scene names none",
    )
    around = none if environment is None else f"environment lighting, {len(environment.coefficients)} coefficients"
    needs = ("environment", "gradient") if material is not None and material.needs_gradient else ("environment",)
    shown = none if material is None else spelling(material)
    made = (
        ""
        if radiance_transfer is None
        else "computed beforehand"
        if radiance_transfer.is_frozen
        else "computed in each picture: jvr.precompute"
    )
    return (
        Part("environment", environment is not None, around),
        Part("material", material is not None, shown, needs if material is not None else ()),
        Part(
            "radiance transfer",
            radiance_transfer is not None,
            f"{spelling(radiance_transfer)}, {made}" if radiance_transfer is not None else none,
            ("environment", "light march") if radiance_transfer is not None else (),
        ),
    )
