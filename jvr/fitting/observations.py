"""Observations: target images as one long list of rays with their colours, and samples cached along them."""

import functools
import warnings
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt16

from jvr.execution.devices import everywhere, on_devices, over_rays, shares, sharing_memory
from jvr.fitting.targets import check_weights
from jvr.fitting.views import Pixels, Shift, Views, limits_of, with_planes
from jvr.march.fields import MISSING, CachedSamples, VoxelField
from jvr.march.medium import AbstractVisibility, Medium
from jvr.march.quadrature import Midpoint
from jvr.march.steps import Rays, points_at, segment_count, segment_span
from jvr.model.camera import AbstractCamera, Limits
from jvr.model.exact import Exact
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable
from jvr.numerics import two_sum
from jvr.rendering.integrator import AbstractRayIntegrator
from jvr.rendering.medium import Prepared, medium, occupancy, prepare
from jvr.rendering.settings import Settings
from jvr.rendering.trace import ahead, enter, near_volume, step_length
from jvr.types import Scalar, Triple

# Rays whose rows are held at a time; larger batches fall out of the cache, and a subset of the rays does not fill them.
CHUNK = 16_384
# Blocks of neighbouring pixels, by which misfit is told from noise: rows of as many sums as there are unknowns are held for all of them.
LEAST_SIDE, MOST_BLOCKS = 8, 4096


class WorldRays(NamedTuple):
    """Rays wherever in the world: one starts at `origin + low`, the eye is `behind` that by so much (see `AbstractCamera.rays_ahead`).
    `pixel`: which of its view each is, `None` where that plays no part; `limits`: as of `AbstractCamera`."""

    origin: Triple
    low: Triple
    direction: Triple
    behind: Float[Array, "..."]
    pixel: Int[Array, "..."] | None = None
    limits: Limits = (None, None)


class Observations(eqx.Module):
    """World rays, or pixels of cameras that are unknown, with the colour that each should have, `(tiles, rays)`: as many tiles for each
    device, its share; in each share, rays that cross more of the volume come first. A fit holds them once, and takes its tiles out of
    them within its programs.

    `weight` is 0 for the rays that fill up a share. `block` numbers the squares of neighbouring pixels. `start` is where a ray's kept
    samples begin in what its device holds, all 0 without any.
    """

    rays: WorldRays | Pixels
    target: Float[Array, "*tiles rays 3"]
    weight: Float[Array, "*tiles rays"]
    block: Int[Array, "*tiles rays"]
    start: Int[Array, "*tiles rays"]

    @property
    def size(self) -> int:
        return self.weight.size

    @property
    def chunk(self) -> int:
        """Rays of a tile."""
        return self.weight.shape[-1]

    def tile_count(self, every: int = 1) -> int:
        """How many tiles of each share every `every`-th of its rays fill."""
        each = self.size // shares()
        return -(-each // (every * self.chunk))

    def tile(self, index: Int[Array, ""] | int, every: Int[Array, ""] | int = 1) -> "Observations":
        """One of these tiles, of what one device holds: `(rays,)`."""
        rank = (index * self.chunk + jnp.arange(self.chunk)) * every
        inside = rank < self.size
        one = jax.tree.map(lambda x: x.reshape(self.size, *x.shape[2:])[jnp.where(inside, rank, 0)], self)
        return eqx.tree_at(lambda o: o.weight, one, jnp.where(inside, one.weight, 0))


class Samples(eqx.Module):
    """Scalars along every ray, 16 bits each, in blocks of `stride` rays: sample `k` of a ray is at `start + k * stride` in what is `stored`
    for its share. `gaps`: whether some are missing."""

    stored: Any
    low: Float[Array, ""]
    scale: Float[Array, ""]
    stride: int = eqx.field(static=True)
    gaps: bool = eqx.field(static=True)

    def along(self, start: Int[Array, "rays"]) -> CachedSamples:
        """The samples of rays as a field."""
        return CachedSamples(self.stored, start, self.low, self.scale, self.stride, self.gaps)

    @property
    def bytes(self) -> int:
        return self.stored.size * self.stored.dtype.itemsize


def check_settings(settings: Settings) -> None:
    """**Raises** `ValueError` for settings that fits do not support."""
    integrator, remedy = settings.sampling, "leave Settings(sampling=...) at jvr.Uniform()"
    if not isinstance(integrator, AbstractRayIntegrator):
        raise ValueError(f"a fit takes every sample of every ray: {remedy}")
    if not integrator.is_differentiable:
        raise ValueError(f"a fit goes by derivatives, and {type(integrator).__name__} has none: {remedy}")
    if integrator.marches and not isinstance(settings.quadrature, Midpoint):
        raise ValueError("a fit resamples the midpoints of segments: leave Settings(quadrature=...) at jvr.Midpoint()")


def check_views(scene: Scene, cameras: Sequence[AbstractCamera]) -> None:
    """**Raises** `ValueError` for geometry that is not known from all cameras."""
    if scene.geometry is None:
        return
    if scene.geometry.of_one_view and len(cameras) > 1:
        name = type(scene.geometry).__name__
        raise ValueError(f"a jvr.{name} is that of one view, and there are {len(cameras)}: fit one, or give a jvr.Mesh")
    for camera in cameras:
        scene.geometry.check_view(camera)


def observe(
    scene: Scene,
    cameras: Sequence[AbstractCamera],
    images: Sequence[np.ndarray],
    weights: Sequence[Any] | None,
    settings: Settings,
    chunk: int | None = None,
    *,
    unknown: Collection[int] = (),
    among: Sequence[np.ndarray] | None = None,
) -> Observations:
    """All pixels of all images as observations, in tiles of at most `chunk` rays, `CHUNK` without it, of all cores of a
    processor together. Sorted by how much of the volume they cross, rays are dealt out in turn to the devices.

    `unknown`: the cameras that a fit finds; where there are any, rays are pixels. `among`: which pixels are taken, one mask for each image.

    **Raises** `ValueError` for settings that fits do not support, where no ray meets the volume, or none of an unknown camera.
    """
    check_settings(settings)
    check_views(scene, cameras)
    weights = check_weights(cameras, weights, images[0].dtype)
    # Compiled for all cameras of one size and kind.
    planes = with_planes(cameras)
    rays: list[Any] = [_rays(scene, camera, planes) for camera in cameras]
    lengths = [np.asarray(inside(scene, one).length) for one in rays]
    _check_views(lengths, scene, unknown)
    length = np.concatenate(lengths)
    order = np.argsort(-length, kind="stable").astype(np.int32)
    if among is not None:
        order = order[np.concatenate([np.ravel(mask) for mask in among])[order]]
    if unknown:
        rays = [_pixels(i, camera) for i, camera in enumerate(cameras)]
    most = -(-(chunk or CHUNK) // sharing_memory())
    chunk = min(most, -(-order.size // shares()))
    together = chunk * shares()
    rank = np.arange(-(-order.size // together) * together, dtype=np.int32).reshape(-1, shares()).T.reshape(-1, chunk)
    pixel = order[np.minimum(rank, order.size - 1)]
    structure = jax.tree.structure(rays[0])
    columns = [list(parts) for parts in zip(*map(jax.tree.leaves, rays), strict=True)]
    del rays
    # One number of all rays after the other, so that they are not all held twice.
    placed = [on_devices(np.concatenate(columns.pop(0))[pixel]) for _ in range(len(columns))]
    target = on_devices(np.concatenate([image.reshape(-1, 3) for image in images])[pixel])
    weight = np.where(rank < order.size, np.concatenate([w.ravel() for w in weights])[pixel], 0)
    block = on_devices(_blocks(cameras)[pixel])
    start = on_devices(np.zeros(rank.shape, np.int32))
    return Observations(jax.tree.unflatten(structure, placed), target, on_devices(weight), block, start)


def _blocks(cameras: Sequence[AbstractCamera]) -> Int[np.ndarray, "pixels"]:
    """For each pixel of all images the number of its block: squares of `LEAST_SIDE` pixels a side, or of twice that and so on, so that
    there are at most `MOST_BLOCKS`."""
    side = LEAST_SIDE
    while sum(-(-c.height // side) * -(-c.width // side) for c in cameras) > MOST_BLOCKS:
        side *= 2
    blocks, first = [], 0
    for camera in cameras:
        row, column = np.divmod(np.arange(camera.height * camera.width, dtype=np.int32), camera.width)
        across = -(-camera.width // side)
        blocks.append(first + row // side * across + column // side)
        first += -(-camera.height // side) * across
    return np.concatenate(blocks).astype(np.int32)


@functools.partial(jax.jit, static_argnums=2)
def _rays(scene: Scene, camera: AbstractCamera, planes: tuple[bool, bool]) -> WorldRays:
    """The rays of a camera from near the volume on: starts in the world as two floats, directions, and the distances from the eye."""
    zero = scene.volume.origin
    scene, camera = near_volume(scene, camera)
    pixels = jnp.arange(camera.width * camera.height, dtype=jnp.int32)
    start = ahead(scene, camera)
    origin, direction, behind = camera.rays_ahead(pixels, start)
    starts = [two_sum(zero.high[i], zero.low[i], x) for i, x in enumerate(origin)]
    own = None if scene.geometry is None else pixels
    return WorldRays(
        tuple(high for high, _ in starts),
        tuple(low for _, low in starts),
        direction,
        behind,
        own,
        limits_of(camera, direction, start, planes),
    )


def _pixels(view: int, camera: AbstractCamera) -> Pixels:
    count = camera.width * camera.height
    return Pixels(np.full(count, view, np.int32), np.arange(count, dtype=np.int32))  # pyright: ignore[reportArgumentType]


def rays_inside(scene: Scene, views: Views | None, rays: WorldRays | Pixels, shift: Shift | None = None) -> Rays:
    """The rays of a tile inside of the volume; of cameras that are unknown as they are now, and with a `shift` of their values."""
    if isinstance(rays, WorldRays):
        return inside(scene, rays)
    assert views is not None
    return views.rays(scene, rays, shift)


@jax.jit
def inside(scene: Scene, rays: WorldRays) -> Rays:
    """The rays inside of the volume, wherever that is in the world."""
    zero = jax.lax.stop_gradient(scene.volume.origin)
    (scene,) = near_volume(scene)
    origin = tuple(
        Exact(high, low).minus(Exact(zero.high[i], zero.low[i])).rounded()
        for i, (high, low) in enumerate(zip(rays.origin, rays.low, strict=True))
    )
    return enter(scene, origin, rays.direction, rays.behind, rays.pixel, rays.limits)[0]


def keep_samples(
    scene: Scene, observations: Observations, settings: Settings, limit: int, *, clamped: bool
) -> tuple[Samples, Observations] | None:
    """Resamples the volume along every ray once, 16 bits a sample, or returns `None` where that would take more than `limit` bytes.

    The error of a kept sample is at most 2^-17 of the range of the volume's values, of those between the ends of a table where these stay
    (`clamped`).
    """
    chunk, dt = observations.chunk, step_length(scene, settings)
    counts = np.max(np.asarray(_segments(scene, observations, dt)).reshape(shares(), -1), axis=0)
    ends = chunk * np.cumsum(counts, dtype=np.int64)
    total = int(ends[-1])
    if 2 * total * shares() > limit or total >= 2**31:
        return None
    low, high = _kept_range(scene, clamped)
    scale = jnp.where(high > low, (high - low) / (MISSING - 1), 1.0)
    stored = on_devices(np.zeros(shares() * total, np.uint16))
    begins = (ends - chunk * counts).astype(np.int32)
    for i, (begin, count) in enumerate(zip(begins, counts, strict=True)):
        stored = _resample(stored, scene, observations, (jnp.int32(i), jnp.int32(begin), jnp.int32(count)), dt, low, scale)
    start = np.tile(begins[:, None] + np.arange(chunk, dtype=np.int32), (shares(), 1))
    kept = eqx.tree_at(lambda o: o.start, observations, on_devices(start))
    return Samples(stored, low, scale, chunk, scene.volume.gaps is not None), kept


def _kept_range(scene: Scene, clamped: bool) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Smallest and largest scalar to be told apart. Beyond the ends of a table, where scalars are `clamped` to them, all look alike: a hot
    voxel takes no levels from the others."""
    volume = scene.volume
    ends = [volume.slope * v + volume.intercept for v in (jnp.min(volume.values), jnp.max(volume.values))]
    low, high = jnp.minimum(*ends), jnp.maximum(*ends)
    if clamped and isinstance(scene.transfer, AbstractTable):
        low, high = (jnp.clip(end, *scene.transfer.ends) for end in (low, high))
    return low, high


def prepare_in_fit(scene: Scene, settings: Settings, skips: bool, visible: AbstractVisibility | None = None) -> Prepared:
    """What is computed once for all rays; `skips`: whether rays skip empty bricks although nothing else is negligible; `visible`: how
    much light reaches a point, where that is known."""
    (scene,) = near_volume(scene)
    return prepare(scene, settings, step_length(scene, settings), skips=bool(settings.negligible) or skips, visible=visible)


def is_mostly_empty(scene: Scene, settings: Settings) -> bool:
    """Whether rays through a scene are better off with a look at its bricks before each sample: half of them are empty."""
    occupied = jax.jit(occupancy, static_argnums=1)(scene, settings)
    return occupied is not None and float(jnp.mean(occupied.empty_radius > 0)) >= 0.5


def observed_medium(tile: Observations, samples: Samples | None, prepared: Prepared) -> Medium:
    """What the rays of a tile march through, resampled anew or from kept samples."""
    through = medium(prepared)
    return through if samples is None else through._replace(field=samples.along(tile.start))


def _check_views(lengths: Sequence[np.ndarray], scene: Scene, unknown: Collection[int]) -> None:
    """**Raises** `ValueError` where no ray of any camera meets the volume, or none of an unknown one; a camera whose rays all miss it is
    named."""
    blind = [i for i, length in enumerate(lengths) if not np.any(length > 0)]
    center = ", ".join(f"{c:.4g}" for c in np.asarray(scene.volume.center))
    where = f"the volume is around ({center}), with a radius of {float(scene.volume.radius):.4g}: check their poses, and clipping"
    if len(blind) == len(lengths):
        raise ValueError(f"no camera sees the volume; {where}")
    if lost := [i for i in blind if i in unknown]:
        raise ValueError(
            f"camera {lost[0]} is unknown and sees nothing of the volume, so that nothing pulls it there: start it where its picture shows "
            f"the volume, such as by look_at its centre, or leave it out; {where}"
        )
    if blind:
        named = ", ".join(map(str, blind))
        warnings.warn(
            f"cameras that see nothing of the volume, so that their images say nothing of it: {named}; {where}", stacklevel=5
        )


@jax.jit
def _segments(scene: Scene, observations: Observations, dt: Scalar) -> Int[Array, "tiles"]:
    """Of the longest ray of each tile."""

    def share(shared: tuple[Scene, Scalar], observations: Observations) -> Int[Array, "tiles"]:
        scene, dt = shared
        return jax.vmap(lambda rays: jnp.max(segment_count(rays_inside(scene, None, rays).length, dt)))(observations.rays)

    return everywhere(over_rays(share, (scene, dt), observations))


@functools.partial(jax.jit, donate_argnums=0)
def _resample(
    stored: UInt16[Array, "samples"],
    scene: Scene,
    observations: Observations,
    place: tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]],
    dt: Scalar,
    low: Array,
    scale: Array,
) -> UInt16[Array, "samples"]:
    """What is `stored`, with the samples of one tile of each share: its index, where they begin, and how many there are of each ray."""

    def share(shared: Any, own: tuple[Array, Observations]) -> Array:
        scene, (index, begin, count), dt, low, scale = shared
        stored, observations = own
        rays = rays_inside(scene, None, observations.tile(index).rays)

        def one(k: Int[Array, ""], stored: Array) -> Array:
            _, u = segment_span(k, segment_count(rays.length, dt), rays.length, dt)
            found = jax.vmap(VoxelField(scene.volume).resample)(points_at(rays, jnp.arange(u.size, dtype=jnp.int32), k, u))
            level = jnp.clip(jnp.round((found.s - low) / scale), 0, MISSING - 1)
            for known in found.known:
                level = jnp.where(known > 0.5, level, MISSING)
            return jax.lax.dynamic_update_slice(stored, level.astype(jnp.uint16), (begin + k * u.size,))

        return jax.lax.fori_loop(0, count, one, stored)

    return over_rays(share, (scene, place, dt, low, scale), (stored, observations))
