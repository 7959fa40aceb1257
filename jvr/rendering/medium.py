"""From a scene to the medium that rays march through: what the scene does not name is not in it.

Effects are behind the interfaces of `jvr.model.parts` and `jvr.model.effects`. What shows light in a scene comes together in one module,
which is imported for scenes alone that show any.
"""

import dataclasses
import importlib
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from jvr.march.fields import VoxelField
from jvr.march.march import Marched, MarchOptions
from jvr.march.medium import DENSEST, AbstractVisibility, Medium, Visibilities
from jvr.march.occupancy import Occupancy, occupancy_of
from jvr.march.quadrature import PreIntegrated
from jvr.march.shaders import GradientFrame, LightPathShader, OpticalShader, PreIntegratedShader
from jvr.march.steepest import steepest_gradients
from jvr.march.steps import Rays
from jvr.model.bricks import Bricks, bricks_of, widened
from jvr.model.normals import AbstractNormals
from jvr.model.optical import AbsorptionOnly
from jvr.model.parts import parts_of
from jvr.model.preintegration import PreIntegratedTable
from jvr.model.scene import Scene
from jvr.model.volume import Volume
from jvr.types import Scalar

if TYPE_CHECKING:
    # Settings hold an integrator, which reads what is prepared.
    from jvr.rendering.settings import Settings

LIGHTING = "jvr.effects.lighting"


class Prepared(NamedTuple):
    """What all rays through a scene share, computed once.

    - `scene`: near its volume (`jvr.rendering.trace.near_volume`);
    - `settings`: how it is rendered, all but the step, which is 1 here;
    - `dt`: the world length of a segment;
    - `occupancy`, `visibility`, `lighting`, `search`: visible bricks, what is in the way of light, what the shader of light computes for
      all rays, and what these need to find surfaces, each `None` where the scene asks for none.
    """

    scene: Scene
    settings: "Settings"
    dt: Scalar
    occupancy: Occupancy | None = None
    visibility: AbstractVisibility | None = None
    lighting: Any = None
    search: Any = None

    @property
    def shadow_stats(self) -> Any:
        return None if self.visibility is None else self.visibility.stats


def prepare(
    scene: Scene,
    settings: "Settings",
    dt: Scalar,
    *,
    skips: bool = True,
    visible: AbstractVisibility | None = None,
) -> Prepared:
    """What rays through a scene near its volume need to know beforehand. `skips`: whether they skip empty bricks; `visible`: how much light
    reaches a point, where that is known."""
    occupied = occupancy(scene, settings) if skips else None
    search = None
    if scene.surfaces is not None:
        search = scene.surfaces.prepare(scene, bricks(scene.volume) if settings.skipping else None)
    if visible is None:
        visible = visibility(scene, occupied)
        if scene.surfaces is not None:
            visible = scene.surfaces.shadowed(search, scene, visible)
    lighting = lighting_module().prepare(scene) if scene.shows_light else None
    return Prepared(scene, dataclasses.replace(settings, step=1.0), dt, occupied, visible, lighting, search)


def medium(prepared: Prepared, *, graded: bool = False) -> Medium:
    """What of a scene rays march through: what the scene does not name is not in it. `graded`: with gradients, asked for or not."""
    scene, settings = prepared.scene, prepared.settings
    frame, normals = _gradients(scene, graded=graded)
    field = VoxelField(scene.volume, normals)
    quadrature = settings.quadrature
    pre_integrated = quadrature.pre_integrates and not scene.transfer.is_clear
    if scene.shows_light:
        shader = lighting_module().lit_shader(scene, frame, prepared.lighting, pre_integrated=pre_integrated)
    else:
        shader = (PreIntegratedShader if pre_integrated else OpticalShader)(scene.optical, frame)
    if scene.transfer.is_clear or not isinstance(quadrature, PreIntegrated):
        return Medium(field, scene.transfer, shader, prepared.occupancy, prepared.visibility)
    # Checks the transfer function's type itself.
    table = PreIntegratedTable(cast(Any, scene.transfer), quadrature.parts)
    return Medium(field, table, shader, prepared.occupancy, prepared.visibility)


def marched(prepared: Prepared, through: Medium, rays: Rays) -> Marched:
    """What rays gather in the medium; nothing, and no march, where it is clear."""
    settings = prepared.settings
    if prepared.scene.transfer.is_clear:
        return Marched((), (), (), jnp.zeros_like(rays.length, jnp.int32))
    return settings.adjoint.march(MarchOptions(settings.termination, distance=True), through, rays, prepared.dt)


def lighting_module() -> Any:
    """What shows light, imported for scenes alone that do."""
    return importlib.import_module(LIGHTING)


def _gradients(scene: Scene, *, graded: bool = False) -> tuple[GradientFrame | None, AbstractNormals | None]:
    """How gradients come about, where something asks for them, or whoever calls."""
    if not (scene.needs_gradient or graded):
        return None, None
    if scene.normals.of_opacity and scene.transfer.takes_gradient:
        raise ValueError("a transfer function of the gradient needs that of the scalar: set normals=...(of_opacity=False)")
    normals = scene.normals.with_gradients(scene.volume, scene.transfer)
    volume = scene.volume
    # The gradients that were computed stay with the field.
    return GradientFrame(eqx.filter(normals, False), volume.axes_inverse, volume.intercept, volume.shape), normals


def visibility(scene: Scene, occupancy: Occupancy | None) -> AbstractVisibility | None:
    """What says how much light reaches a point, or `None` where nothing is in its way. Made once for a picture."""
    path = lambda graded: absorbing(scene, occupancy, graded)
    found = [each for _, part in parts_of(scene) if (each := part.visibility(scene, path)) is not None]
    return Visibilities(tuple(found)) if len(found) > 1 else next(iter(found), None)


def absorbing(scene: Scene, occupancy: Occupancy | None, graded: bool) -> Medium:
    """What light passes on its way to a point, with gradients where it is `graded`."""
    frame, normals = _gradients(scene) if graded else (None, None)
    shader = LightPathShader(AbsorptionOnly(), frame, DENSEST / jnp.min(scene.volume.spacing))
    return Medium(VoxelField(scene.volume, normals), scene.transfer, shader, occupancy)


def occupancy(scene: Scene, settings: "Settings") -> Occupancy | None:
    """Which bricks of a scene are visible, or `None` where nothing is to be skipped."""
    if not settings.skipping:
        return None
    volume = scene.volume
    # No ray is longer than the volume's diameter, so that the optical depth of all that is skipped stays below the bound.
    least = jax.lax.stop_gradient(settings.negligible / (2 * volume.radius)) if settings.negligible else None
    found = bricks(volume)
    steepest = steepest_gradients(volume, scene.normals, found.size) if scene.transfer.takes_gradient else None
    return occupancy_of(found, volume.slope, volume.intercept, scene.transfer, least, steepest)


def bricks(volume: Volume) -> Bricks:
    """Bounds of what interpolation may return in the bricks of a volume: of those that it keeps, or made anew."""
    found = volume.bricks
    if found is None and isinstance(volume.values, Tracer):
        found = bricks_of(jax.lax.stop_gradient(volume.values))
    elif found is None:
        # Voxels that a traced function closes over are constants; the compiler would fold all of this, and takes seconds for it.
        with jax.ensure_compile_time_eval():
            found = volume.bricked().bricks
    assert found is not None
    return widened(found) if volume.interpolation.reach else found
