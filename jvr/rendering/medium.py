"""From a scene to the medium that rays march through: what the scene does not name is not in it.

Modules of effects are imported here and only for scenes that hold them; everything else about them is behind the interfaces of
`jvr.model.effects`.
"""

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from jvr.march.fields import VoxelField
from jvr.march.medium import DENSEST, AbstractShader, AbstractVisibility, Medium, Visibilities
from jvr.march.occupancy import Occupancy, occupancy_of
from jvr.march.quadrature import PreIntegrated
from jvr.march.shaders import GradientFrame, LightPathShader, OpticalShader, PreIntegratedShader
from jvr.model.bricks import bricks_of
from jvr.model.normals import AbstractNormals
from jvr.model.optical import AbsorptionOnly
from jvr.model.preintegration import PreIntegratedTable
from jvr.model.scene import Scene
from jvr.types import Scalar

if TYPE_CHECKING:
    # Settings hold an integrator, which reads what is prepared.
    from jvr.rendering.settings import Settings


class Prepared(NamedTuple):
    """What all rays through a scene share, computed once.

    - `scene`: near its volume (`jvr.rendering.trace.near_volume`);
    - `settings`: how it is rendered, all but the step, which is 1 here;
    - `dt`: the world length of a segment;
    - `occupancy`, `shadows`, `environment`: visible bricks, what is in the way of light, and the material under environment lighting,
      each `None` where the scene asks for none.
    """

    scene: Scene
    settings: "Settings"
    dt: Scalar
    occupancy: Occupancy | None = None
    shadows: AbstractVisibility | None = None
    environment: Any = None

    @property
    def shadow_stats(self) -> Any:
        return None if self.shadows is None else self.shadows.stats


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
    shadows = visibility(scene, occupied) if visible is None else visible
    return Prepared(scene, dataclasses.replace(settings, step=1.0), dt, occupied, shadows, environment(scene))


def medium(prepared: Prepared) -> Medium:
    """What of a scene rays march through: what the scene does not name is not in it."""
    scene, settings = prepared.scene, prepared.settings
    frame, normals = _gradients(scene)
    field = VoxelField(scene.volume, normals)
    quadrature = settings.quadrature
    pre_integrated = quadrature.pre_integrates
    if scene.shows_light:
        shader = _lit_shader(scene, frame, pre_integrated, prepared.environment)
    else:
        shader = (PreIntegratedShader if pre_integrated else OpticalShader)(scene.optical, frame)
    if not isinstance(quadrature, PreIntegrated):
        return Medium(field, scene.transfer, shader, prepared.occupancy, prepared.shadows)
    # Checks the transfer function's type itself.
    table = PreIntegratedTable(cast(Any, scene.transfer), quadrature.parts)
    return Medium(field, table, shader, prepared.occupancy, prepared.shadows)


def _lit_shader(scene: Scene, frame: GradientFrame | None, pre_integrated: bool, environment: Any) -> AbstractShader:
    from jvr.effects.cut import CutFaces
    from jvr.effects.lighting import LitPreIntegratedShader, LitShader

    kind = LitPreIntegratedShader if pre_integrated else LitShader
    cut, volume = None, scene.volume
    if scene.clipping is not None and frame is not None:
        cut = CutFaces(scene.clipping, jnp.min(volume.spacing))
    return kind(scene.optical, frame, volume.world_from_grid, scene.lights, scene.shading, scene.scattering, cut, environment)


def _gradients(scene: Scene) -> tuple[GradientFrame | None, AbstractNormals | None]:
    """How gradients come about, where something asks for them."""
    if not scene.needs_gradient:
        return None, None
    if scene.normals.of_opacity and scene.transfer.takes_gradient:
        raise ValueError("a transfer function of the gradient needs that of the scalar: set normals=...(of_opacity=False)")
    normals = scene.normals.with_gradients(scene.volume, scene.transfer)
    volume = scene.volume
    # The gradients that were computed stay with the field.
    return GradientFrame(eqx.filter(normals, False), volume.axes_inverse, volume.intercept, volume.shape), normals


def visibility(scene: Scene, occupancy: Occupancy | None) -> AbstractVisibility | None:
    """What says how much light reaches a point, or `None` where nothing is in its way. Made once for a picture."""
    if scene.shadows is None and scene.radiance_transfer is None:
        return None
    found = []
    if scene.shadows is not None:
        medium = absorbing(scene, occupancy, scene.transfer.takes_gradient)
        found.append(scene.shadows.visibility(scene, medium, jnp.min(scene.volume.spacing)))
    if scene.radiance_transfer is not None:
        from jvr.effects.radiance_transfer_grid import radiance_transfer_visibility

        medium = absorbing(scene, occupancy, scene.transfer.takes_gradient or scene.radiance_transfer.rays_need_gradient)
        found.append(radiance_transfer_visibility(scene, medium))
    return Visibilities(tuple(found)) if len(found) > 1 else found[0]


def absorbing(scene: Scene, occupancy: Occupancy | None, graded: bool) -> Medium:
    """What light passes on its way to a point, with gradients where it is `graded`."""
    frame, normals = _gradients(scene) if graded else (None, None)
    shader = LightPathShader(AbsorptionOnly(), frame, DENSEST / jnp.min(scene.volume.spacing))
    return Medium(VoxelField(scene.volume, normals), scene.transfer, shader, occupancy)


def environment(scene: Scene) -> Any:
    """The material under environment lighting, or `None` without one. Made once for a picture."""
    if scene.material is None:
        return None
    from jvr.effects.environment_lighting import environment_lighting_of

    return environment_lighting_of(scene)


def occupancy(scene: Scene, settings: "Settings") -> Occupancy | None:
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
