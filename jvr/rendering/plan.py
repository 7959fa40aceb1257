"""What of a scene is in the compiled program, decided from its structure alone."""

import dataclasses
from typing import Any, cast

import jax
import jax.numpy as jnp
from jax.core import Tracer

from jvr.march.fields import VoxelField
from jvr.march.march import AbstractShader, AbstractVisibility, Medium
from jvr.march.occupancy import Occupancy, occupancy_of
from jvr.march.quadrature import PreIntegrated
from jvr.march.shaders import GradientFrame, OpticalShader, PreIntegratedShader
from jvr.model.bricks import bricks_of
from jvr.model.light import AbstractLight, AmbientLight
from jvr.model.normals import AbstractNormals
from jvr.model.optical import AbsorptionOnly, EmissionOnly
from jvr.model.preintegration import PreIntegratedTable
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.rendering.sampling import Uniform
from jvr.rendering.settings import Settings


def medium(
    scene: Scene, settings: Settings, occupancy: Occupancy | None = None, shadows: AbstractVisibility | None = None
) -> Medium:
    """What of a scene rays march through: what the scene does not name is not in it."""
    frame, normals = _gradients(scene)
    field = VoxelField(scene.volume, normals)
    quadrature = settings.quadrature
    pre_integrated = isinstance(quadrature, PreIntegrated)
    if scene.shading is None and scene.scattering is None:
        shader = (PreIntegratedShader if pre_integrated else OpticalShader)(scene.optical, frame)
    else:
        shader = _lit_shader(scene, frame, pre_integrated)
    if not isinstance(quadrature, PreIntegrated):
        return Medium(field, scene.transfer, shader, occupancy, shadows)
    # Checks the transfer function's type itself.
    table = PreIntegratedTable(cast(Any, scene.transfer), quadrature.parts)
    return Medium(field, table, shader, occupancy, shadows)


def _lit_shader(scene: Scene, frame: GradientFrame | None, pre_integrated: bool) -> AbstractShader:
    from jvr.effects.lighting import LitPreIntegratedShader, LitShader

    kind = LitPreIntegratedShader if pre_integrated else LitShader
    ambient = tuple(light for light in scene.lights if isinstance(light, AmbientLight))
    lights, volume = arriving_lights(scene), scene.volume
    return kind(scene.optical, frame, volume.world_from_grid, lights, ambient, scene.shading, scene.scattering)


def _gradients(scene: Scene) -> tuple[GradientFrame | None, AbstractNormals | None]:
    """How gradients come about, where something asks for them."""
    if not needs_gradient(scene):
        return None, None
    if scene.normals.of_opacity and scene.transfer.takes_gradient:
        raise ValueError("a transfer function of the gradient needs that of the scalar: set normals=...(of_opacity=False)")
    normals = scene.normals.prepared(scene.volume, scene.transfer)
    return GradientFrame(scene.normals, scene.volume.axes_inverse, scene.volume.shape), normals


def needs_gradient(scene: Scene) -> bool:
    """Whether anything in a scene asks for gradients."""
    scatters = scene.scattering is not None and scene.scattering.needs_gradient
    return scene.shading is not None or scatters or scene.transfer.takes_gradient


def arriving_lights(scene: Scene) -> tuple[AbstractLight, ...]:
    """The lights that come from one direction at each point."""
    return tuple(light for light in scene.lights if isinstance(light, AbstractLight))


def visibility(scene: Scene, occupancy: Occupancy | None) -> AbstractVisibility | None:
    """What says how much light reaches a point, or `None` where nothing casts shadows. Made once for a picture."""
    if scene.shadows is None:
        return None
    frame, normals = _gradients(scene) if scene.transfer.takes_gradient else (None, None)
    absorbing = Medium(VoxelField(scene.volume, normals), scene.transfer, OpticalShader(AbsorptionOnly(), frame), occupancy)
    return scene.shadows.prepared(scene, arriving_lights(scene), absorbing, jnp.min(scene.volume.spacing))


def occupancy(scene: Scene, settings: Settings) -> Occupancy | None:
    """Which bricks of a scene are visible, or `None` where nothing is to be skipped."""
    if not settings.skipping:
        return None
    volume = scene.volume
    bricks = volume.bricks
    if bricks is None and isinstance(volume.values, Tracer):
        bricks = bricks_of(jax.lax.stop_gradient(volume.values))
    elif bricks is None:
        # Voxels that a traced function closes over are constants; the compiler would fold all of this, and takes seconds for it.
        with jax.ensure_compile_time_eval():
            bricks = volume.bricked().bricks
    assert bricks is not None
    # No ray is longer than the volume's diameter, so that the optical depth of all that is skipped stays below the bound.
    least = jax.lax.stop_gradient(settings.negligible / (2 * volume.radius)) if settings.negligible else None
    return occupancy_of(bricks, volume.slope, volume.intercept, scene.transfer, least)


def _skipping(volume: Volume, settings: Settings) -> str:
    if not settings.skipping:
        return "every sample is taken"
    bound = f", and those of optical depth below {settings.negligible:g} a ray" if settings.negligible else ""
    if volume.bricks is None:
        return f"empty bricks{bound}; they are bounded anew for each picture: jvr.Volume.bricked() does it once"
    return f"empty bricks of {volume.bricks.size}^3 voxels{bound}"


@dataclasses.dataclass(frozen=True)
class Part:
    """One part of the compiled program: its name, whether it is in, and why or why not."""

    name: str
    included: bool
    reason: str


@dataclasses.dataclass(frozen=True)
class Plan:
    """What a rendering compiles to. Equal plans compile to the same program; `print` explains it."""

    parts: tuple[Part, ...]
    key: str

    def __str__(self) -> str:
        width = max(len(part.name) for part in self.parts)
        return "\n".join(f"{'+' if part.included else '-'} {part.name:<{width}}  {part.reason}" for part in self.parts)


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
    )
    return Plan(
        parts,
        f"{jax.tree.structure((scene, settings))} {jax.tree.map(lambda x: (x.shape, str(x.dtype)), jax.tree.leaves(scene))}",
    )
