"""Observations: target images as one long list of rays with their colours, and samples cached along them."""

import warnings
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.execution.devices import everywhere, on_devices, over_rays, shares
from jvr.march.fields import MISSING, CachedSamples, VoxelField
from jvr.march.medium import AbstractVisibility, Medium
from jvr.march.quadrature import Midpoint
from jvr.march.steps import Rays, points_at, segment_count, segment_span
from jvr.model.camera import AbstractCamera
from jvr.model.exact import Exact
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable
from jvr.numerics import two_sum
from jvr.pictures import as_radiance
from jvr.rendering.medium import environment, medium, occupancy, visibility
from jvr.rendering.sampling import Uniform
from jvr.rendering.settings import Settings
from jvr.rendering.trace import Prepared, ahead, enter, near_volume, step_length
from jvr.types import Triple


class Observations(eqx.Module):
    """World rays with the colour that each should have, in shares of as many rays for each device; in each, rays that cross more of the
    volume come first.

    A ray starts at `origin + low`, the eye is `behind` that by so much (see `AbstractCamera.rays_ahead`).

    `weight` is 0 for the rays that fill up the last chunk of a share. `start` is where a ray's kept samples begin in what its device
    holds, all 0 without any.
    """

    origin: Triple
    low: Triple
    behind: Float[Array, "rays"]
    direction: Triple
    target: Float[Array, "rays 3"]
    weight: Float[Array, "rays"]
    start: Int[Array, "rays"]

    @property
    def size(self) -> int:
        return self.weight.shape[0]

    def dealt(self, chunk: int) -> "Observations":
        """Dealt out in turn to `shares()`, each filled up to whole chunks."""
        order = np.arange(self.size)
        order = np.pad(order, (0, -len(order) % (chunk * shares())), mode="edge")
        filled = jax.tree.map(lambda x: x[order], self)
        filled = eqx.tree_at(lambda o: o.weight, filled, filled.weight.at[self.size :].set(0))
        return jax.tree.map(lambda x: x[order.reshape(-1, shares()).T.ravel()], filled)

    def subsampled(self, every: int, chunk: int) -> "Observations":
        """Every `every`-th ray of each share, filled up to whole chunks."""
        each = self.size // shares()
        index = np.arange(0, each, every)
        kept = len(index)
        index = np.pad(index, (0, -kept % chunk))
        subsample = jax.tree.map(lambda x: x.reshape(shares(), each, *x.shape[1:])[:, index], self)
        subsample = eqx.tree_at(lambda o: o.weight, subsample, subsample.weight.at[:, kept:].set(0))
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), subsample)

    def tiles(self, chunk: int) -> list["Observations"]:
        """One chunk of every share at a time."""
        split = jax.tree.map(lambda x: x.reshape(shares(), -1, chunk, *x.shape[1:]), self)
        of_all = lambda i: jax.tree.map(lambda x: on_devices(x[:, i].reshape(-1, *x.shape[3:])), split)
        return [of_all(i) for i in range(self.size // (chunk * shares()))]


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


def check_images(cameras: Sequence[AbstractCamera], images: Any, name: str = "target image") -> list[np.ndarray]:
    """The images as float arrays, one for each camera and of its size.

    **Raises** `ValueError` where their number or a size differs, a pixel is not finite, or they hold codes in place of radiance.
    """
    if isinstance(cameras, AbstractCamera) or getattr(images, "ndim", 4) == 3:
        raise TypeError("cameras and images must be sequences of as many: put a single one in brackets, as [camera] and [image]")
    images = [as_radiance(image, f"{name} {i}").astype(jnp.result_type(float)) for i, image in enumerate(images)]
    if len(images) != len(cameras) or not images:
        raise ValueError(
            f"there are {len(images)} images for {len(cameras)} cameras: give one image for each camera, and at least one"
        )
    for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        if image.shape == (camera.height, camera.width, 4):
            raise ValueError(f"{name} {i} has four channels: give light over the scene's background, (height, width, 3)")
        if image.shape != (camera.height, camera.width, 3):
            raise ValueError(
                f"{name} {i} has shape {image.shape}, its camera sees {(camera.height, camera.width, 3)}: resize the image or the camera"
            )
        if not np.all(np.isfinite(image)):
            raise ValueError(
                f"{name} {i} has {np.sum(~np.isfinite(image))} values that are not finite: give them weight 0 and replace them"
            )
        # A photograph that was only converted to floating point.
        if image.max() >= 16 and np.array_equal(image, np.rint(image)):
            raise ValueError(
                f"{name} {i} holds whole numbers up to {image.max():g}, radiance has white at 1: "
                "convert codes by jvr.linear_from_srgb(codes / 255)"
            )
        if image.max() >= 16 and np.mean(image > 1) > 0.5:
            warnings.warn(
                f"{name} {i} goes up to {image.max():g} and is mostly brighter than white, 1: are these codes?", stacklevel=3
            )
        if count := np.count_nonzero(image < 0):
            warnings.warn(f"{name} {i} has {count:,} negative values, which no scene gives: is it a difference?", stacklevel=3)
    return images


def observe(
    scene: Scene,
    cameras: Sequence[AbstractCamera],
    images: Sequence[np.ndarray],
    weights: Sequence[Any] | None,
    settings: Settings,
) -> Observations:
    """All pixels of all images as observations, sorted by the length of their rays.

    **Raises** `ValueError` for settings that fits do not support.
    """
    if not isinstance(settings.quadrature, Midpoint):
        raise ValueError("a fit resamples the midpoints of segments: leave Settings(quadrature=...) at jvr.Midpoint()")
    if not isinstance(settings.sampling, Uniform):
        raise ValueError("a fit takes every sample of every ray: leave Settings(sampling=...) at jvr.Uniform()")
    # Compiled for all cameras of one size and kind.
    rays = [_rays(scene, camera) for camera in cameras]
    (origin, low), direction, behind = jax.tree.map(lambda *parts: np.concatenate(parts), *rays)
    target = np.concatenate([image.reshape(-1, 3) for image in images])
    weight = np.concatenate([w.ravel() for w in _check_weights(cameras, weights, target.dtype)])
    shared = lambda tree: jax.tree.map(jnp.asarray, tree)
    start = jnp.zeros(len(behind), jnp.int32)
    placed = (shared(origin), shared(low), shared(behind), shared(direction))
    whole = Observations(*placed, jnp.asarray(target), jnp.asarray(weight), start)
    order = np.argsort(-np.asarray(_inside(scene, whole).length), kind="stable")
    return jax.tree.map(lambda x: x[order], whole)


@jax.jit
def _rays(scene: Scene, camera: AbstractCamera) -> tuple[tuple[Triple, Triple], Triple, Float[Array, "rays"]]:
    """The rays of a camera from near the volume on: starts in the world as two floats, directions, and the distances from the eye."""
    zero = scene.volume.origin
    scene, camera = near_volume(scene, camera)
    pixels = jnp.arange(camera.width * camera.height, dtype=jnp.int32)
    origin, direction, behind = camera.rays_ahead(pixels, ahead(scene, camera))
    starts = [two_sum(zero.high[i], zero.low[i], x) for i, x in enumerate(origin)]
    return (tuple(high for high, _ in starts), tuple(low for _, low in starts)), direction, behind


@jax.jit
def _inside(scene: Scene, tile: Observations) -> Rays:
    """The rays inside of the volume, wherever that is in the world."""
    zero = jax.lax.stop_gradient(scene.volume.origin)
    (scene,) = near_volume(scene)
    origin = tuple(
        Exact(high, low).minus(Exact(zero.high[i], zero.low[i])).rounded()
        for i, (high, low) in enumerate(zip(tile.origin, tile.low, strict=True))
    )
    return enter(scene, origin, tile.direction, tile.behind)[0]


def keep_samples(
    scene: Scene, observations: Observations, settings: Settings, chunk: int, limit: int, *, clamped: bool
) -> tuple[Samples, Observations] | None:
    """Resamples the volume along every ray once, 16 bits a sample, or returns `None` where that would take more than `limit` bytes.

    The error of a kept sample is at most 2^-17 of the range of the volume's values, of those between the ends of a table where these stay
    (`clamped`).
    """
    tiles = observations.tiles(chunk)
    counts = [int(_longest(scene, tile, settings)) for tile in tiles]
    total = chunk * sum(counts)
    if 2 * total * shares() > limit or total >= 2**31:
        return None
    low, high = _kept_range(scene, clamped)
    scale = jnp.where(high > low, (high - low) / (MISSING - 1), 1.0)
    stored = np.empty((shares(), total), np.uint16)
    starts, begin = [], 0
    for tile, count in zip(tiles, counts, strict=True):
        for k in range(count):
            found = _resample(scene, tile, settings, jnp.int32(k), low, scale)
            stored[:, begin + k * chunk : begin + (k + 1) * chunk] = found.reshape(shares(), chunk)
        starts.append(begin + np.arange(chunk, dtype=np.int32))
        begin += chunk * count
    start = np.tile(np.concatenate(starts), shares())
    kept = eqx.tree_at(lambda o: o.start, observations, jnp.asarray(start))
    return Samples(on_devices(stored.ravel()), low, scale, chunk, scene.volume.gaps is not None), kept


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
    occupied = occupancy(scene, settings) if settings.negligible or skips else None
    return Prepared(occupied, visibility(scene, occupied) if visible is None else visible, environment(scene))


def is_mostly_empty(scene: Scene, settings: Settings) -> bool:
    """Whether rays through a scene are better off with a look at its bricks before each sample: half of them are empty."""
    occupied = jax.jit(occupancy, static_argnums=1)(scene, settings)
    return occupied is not None and float(jnp.mean(occupied.empty_radius > 0)) >= 0.5


def observed_medium(
    scene: Scene, tile: Observations, samples: Samples | None, settings: Settings, prepared: Prepared
) -> tuple[Medium, Rays]:
    """What the rays of a tile march through, resampled anew or from kept samples, and the rays inside of it."""
    rays = _inside(scene, tile)
    through = medium(near_volume(scene)[0], settings, prepared)
    if samples is not None:
        through = through._replace(field=samples.along(tile.start))
    return through, rays


@eqx.filter_jit
def _longest(scene: Scene, tile: Observations, settings: Settings) -> Int[Array, ""]:
    rays = _inside(scene, tile)
    return everywhere(jnp.max(segment_count(rays.length, step_length(scene, settings))))


@eqx.filter_jit
def _resample(scene: Scene, tile: Observations, settings: Settings, k: Int[Array, ""], low: Array, scale: Array) -> Array:
    def share(shared: tuple[Scene, Array, Array, Array], tile: Observations) -> Array:
        scene, k, low, scale = shared
        rays, dt = _inside(scene, tile), step_length(scene, settings)
        _, u = segment_span(k, segment_count(rays.length, dt), rays.length, dt)
        found = jax.vmap(VoxelField(scene.volume).resample)(points_at(rays, jnp.arange(u.size, dtype=jnp.int32), k, u))
        level = jnp.clip(jnp.round((found.s - low) / scale), 0, MISSING - 1)
        for known in found.known:
            level = jnp.where(known > 0.5, level, MISSING)
        return level.astype(jnp.uint16)

    return everywhere(over_rays(share, (scene, k, low, scale), tile))


def _check_weights(cameras: Sequence[AbstractCamera], weights: Sequence[Any] | None, dtype: Any) -> list[np.ndarray]:
    if weights is None:
        return [np.ones((camera.height, camera.width), dtype) for camera in cameras]
    arrays = [np.asarray(weight, dtype) for weight in weights]
    if len(arrays) != len(cameras):
        raise ValueError(f"there are weights for {len(arrays)} images and {len(cameras)} cameras: give one array for each")
    for i, (camera, weight) in enumerate(zip(cameras, arrays, strict=True)):
        if weight.shape != (camera.height, camera.width) or not np.all(np.isfinite(weight) & (weight >= 0)):
            raise ValueError(
                f"weights {i} must be {(camera.height, camera.width)}, finite and not negative; they have shape {weight.shape}"
            )
    return arrays
