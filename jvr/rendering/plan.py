"""What of a scene is in the compiled program, decided from its structure alone."""

import dataclasses
from typing import Any, ClassVar, cast

import jax
from jax.core import Tracer

from jvr.march.fields import VoxelField
from jvr.march.march import AbstractShader, Medium
from jvr.march.occupancy import Occupancy, occupancy_of
from jvr.march.quadrature import PreIntegrated
from jvr.march.steps import Point
from jvr.model.bricks import bricks_of
from jvr.model.optical import AbstractOpticalModel, EmissionOnly
from jvr.model.preintegration import PreIntegratedTable
from jvr.model.scene import Scene
from jvr.model.transfer import Classified
from jvr.model.volume import Volume
from jvr.rendering.sampling import Uniform
from jvr.rendering.settings import Settings
from jvr.types import Channels, Scalar


class OpticalShader(AbstractShader):
    """The optical model alone: an unlit medium."""

    optical: AbstractOpticalModel

    def segment(self, medium: Classified, point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        return self.optical.segment(medium, dt)


class PreIntegratedShader(OpticalShader):
    """The optical model alone, the scalar linear along a segment."""

    places: ClassVar[tuple[float, ...]] = (-0.5, 0.5)

    def look(self, transfer: Any, scalars: tuple[Scalar, ...], point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        return transfer.segment(self.optical, *scalars, dt)


def medium(scene: Scene, settings: Settings, occupancy: Occupancy | None = None) -> Medium:
    """What of a scene rays march through."""
    field = VoxelField(scene.volume)
    if isinstance(settings.quadrature, PreIntegrated):
        # Checks the transfer function's type itself.
        table = PreIntegratedTable(cast(Any, scene.transfer), settings.quadrature.parts)
        return Medium(field, table, PreIntegratedShader(scene.optical), occupancy)
    return Medium(field, scene.transfer, OpticalShader(scene.optical), occupancy)


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
    coloured = any(getattr(transfer, name, transfer.rgb).ndim == 2 for name in ("sigma_t", "height") if hasattr(transfer, name))
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
