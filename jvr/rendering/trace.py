"""Rays in the world: from a camera into the volume, and what they have gathered there as colours."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.march.march import Marched
from jvr.march.steps import End, Rays
from jvr.model.camera import AbstractCamera, Limits
from jvr.model.clipping import Line, interval_inside, moved_clipping
from jvr.model.environment_map import EnvironmentMap
from jvr.model.geometry import Met
from jvr.model.scene import Scene
from jvr.numerics import larger, one_minus_exp, smaller
from jvr.types import Scalar, Triple

if TYPE_CHECKING:
    # Settings hold an integrator, which traces rays.
    from jvr.rendering.settings import Settings

# How many radii of the volume a camera is away from its middle for its rays to start there.
FAR = 2.0


def promote_dtypes(scene: Scene, *others: Any) -> Any:
    """A scene and whatever else with every floating-point array in the widest precision among them, as the state of the loop needs; with
    x64 on, parts of a scene may differ. Voxels stay as they are in memory."""
    voxels = lambda tree: tree[0].volume.values
    floats, rest = eqx.partition(eqx.tree_at(voxels, (scene, *others), None), eqx.is_inexact_array)
    widest = jnp.result_type(*jax.tree.leaves(floats))
    promoted = eqx.combine(jax.tree.map(lambda x: x.astype(widest), floats), rest)
    return eqx.tree_at(voxels, promoted, scene.volume.values, is_leaf=lambda x: x is None)


def near_volume(scene: Scene, *others: Any) -> Any:
    """A scene and cameras in one precision and in a world whose origin is voxel (0, 0, 0), wherever that lies in theirs: differences of
    positions are taken before they are rounded. Derivatives are those in the world of the scene."""
    scene, *cameras = promote_dtypes(scene, *others)
    origin = jax.lax.stop_gradient(scene.volume.origin)
    placed = lambda s: (s.volume, s.clipping, s.lights, s.geometry)
    lights = tuple(light.moved(origin) for light in scene.lights)
    geometry = None if scene.geometry is None else scene.geometry.moved(origin)
    parts = (scene.volume.moved(origin), moved_clipping(scene.clipping, origin), lights, geometry)
    scene = eqx.tree_at(placed, scene, parts, is_leaf=lambda x: x is None)
    return scene, *(camera.moved(origin) for camera in cameras)


def ahead(scene: Scene, camera: AbstractCamera) -> Scalar:
    """Where in front of a camera its rays start: at the middle of the volume if that is far away, else at the eye. Detached: a ray is the
    same wherever on it one starts."""
    back = camera.world_from_camera[:3, 2]
    depth = jnp.dot(back, camera.world_from_camera[:3, 3] - scene.volume.center)
    return jax.lax.stop_gradient(jnp.where(depth > FAR * scene.volume.radius, depth, 0.0))


def step_length(scene: Scene, settings: "Settings") -> Scalar:
    """World length of a segment."""
    return settings.step * jnp.min(scene.volume.spacing)


def enter(
    scene: Scene,
    origin: Triple,
    direction: Triple,
    behind: Float[Array, "rays"] | float = 0.0,
    pixels: Int[Array, "rays"] | None = None,
    limits: Limits = (None, None),
) -> tuple[Rays, Float[Array, "rays"]]:
    """World rays inside the volume (and its clipping), and the distance from the eye, which is `behind` their origin by so much, to
    where they enter.

    They end at opaque geometry, and where what is behind differs from ray to ray, they know what they see there, or of geometry that is
    lit its colour (`jvr.rendering.geometry.lit_where_rays_end`). `pixels`: of each, `None` where they are of none
    (`jvr.model.geometry.AbstractGeometry.hit`); `limits`: distances from their origins between which anything is seen. A ray with
    non-finite numbers gets the length NaN, which `composite` turns into a NaN pixel.
    """
    start = scene.volume.grid_from_world(origin)
    along = scene.volume.grid_from_world(direction, direction=True)
    t_in, t_out = interval_inside(scene.volume, scene.clipping, (origin, direction), (start, along))
    near, far = limits
    nearest = -behind if near is None else larger(near, -behind)
    t_in, t_out = larger(t_in, nearest), t_out if far is None else smaller(t_out, far)
    met = None if scene.geometry is None else _met(scene, (origin, direction), (behind, nearest, far), pixels)
    t_out = t_out if met is None else smaller(t_out, met.distance)
    hit = t_out > t_in
    # Those that miss are counted from the eye.
    end = _end(scene, direction, met, jnp.where(hit, t_in, -behind))
    # A ray that misses gets harmless numbers before any arithmetic, so that its derivative is zero and not 0 * inf.
    t_in, t_out = jnp.where(hit, t_in, 0.0), jnp.where(hit, t_out, 0.0)
    keep = lambda v: tuple(jnp.where(hit, x, 0.0) for x in v)
    poison = jnp.where(jnp.isfinite(sum(start) + sum(along)), 0.0, jnp.nan)
    start, along = keep(start), keep(along)
    entry = tuple(s + t_in * d for s, d in zip(start, along, strict=True))
    return Rays(entry, along, t_out - t_in + poison, end), jnp.where(hit, behind + t_in, 0.0)


def _met(
    scene: Scene,
    rays: Line,
    distances: tuple[Float[Array, "rays"] | float, Float[Array, "rays"] | float, Float[Array, "rays"] | None],
    pixels: Int[Array, "rays"] | None,
) -> Met:
    """Where rays meet geometry, no nearer and no farther than the `distances` say; with its faces where the scene shades them."""
    behind, nearest, far = distances
    assert scene.geometry is not None
    met = scene.geometry.hit(rays, behind, nearest, pixels)
    met = met if scene.shades_surfaces else met._replace(face=None)
    return met if far is None else met._replace(distance=jnp.where(met.distance > far, jnp.inf, met.distance))


def _end(scene: Scene, direction: Triple, met: Met | None, t_in: Float[Array, "rays"]) -> End | None:
    """What rays end at that enter at `t_in`, `None` where that is a background of one colour or nothing at all. `met`: where they meet
    geometry."""
    nothing = jnp.zeros_like(direction[0])
    far, end = (nothing,) * 3, None
    if isinstance(scene.background, EnvironmentMap):
        seen = scene.background.radiance(jnp.stack(direction, axis=1))
        far = (seen[:, 0], seen[:, 1], seen[:, 2])
        end = End(far, nothing, nothing)
    if met is None:
        return end
    t, rgb, face = met
    there = t < jnp.inf
    colours = tuple(jnp.where(there, near, behind) for near, behind in zip(rgb, far, strict=True))
    return End(colours, there.astype(t.dtype), jnp.where(there, jnp.where(there, t, 0.0) - t_in, 0.0), face)


def camera_rays(scene: Scene, camera: AbstractCamera, pixels: Int[Array, "rays"]) -> tuple[Rays, Float[Array, "rays"]]:
    """The rays of some pixels inside the volume, and the distance from the eye to where they enter; scene and camera near the volume."""
    if scene.geometry is not None:
        scene.geometry.check_view(camera)
    start = ahead(scene, camera)
    origin, direction, behind = camera.rays_ahead(pixels, start)
    return enter(scene, origin, direction, behind, pixels, camera.limits(direction, start))


def composite(scene: Scene, gathered: Marched, rays: Rays) -> tuple[Triple, Float[Array, "rays"]]:
    """Colour of each ray with what is behind the medium, and the opacity of the medium and of what is opaque behind it."""
    transmittances = tuple(jnp.exp(-tau) for tau in gathered.tau)
    zero = jnp.where(jnp.isnan(rays.length), jnp.nan, 0.0)
    rgb = tuple(zero + L for L in gathered.radiance or (0.0, 0.0, 0.0))
    far = behind(scene, rays)
    if far is not None:
        clear = transmittances * (3 // len(transmittances)) if transmittances else (1.0, 1.0, 1.0)
        rgb = tuple(c + T * b for c, T, b in zip(rgb, clear, far, strict=True))
    # Not 1 - T: thin media keep their digits.
    alpha = sum((one_minus_exp(tau) for tau in gathered.tau), zero) / max(len(gathered.tau), 1)
    return rgb, alpha if rays.end is None else alpha + seen_end(gathered, rays.end)


def seen_end(gathered: Marched, end: End) -> Float[Array, "rays"]:
    """How much is seen of what is opaque behind the medium, the mean over channels."""
    transmittances = [jnp.exp(-tau) for tau in gathered.tau]
    return end.opaque * (sum(transmittances, jnp.zeros_like(end.opaque)) / len(transmittances) if transmittances else 1.0)


def behind(scene: Scene, rays: Rays) -> Any:
    """Radiance behind the medium in three channels, or `None` where there is none."""
    colour, end = scene.background_colour, rays.end
    if end is None:
        return colour
    return end.rgb if colour is None else tuple(c + (1 - end.opaque) * b for c, b in zip(end.rgb, colour, strict=True))
