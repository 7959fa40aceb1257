"""Sample positions along a ray.

Segments of length `dt` tile the part of a ray that lies inside the medium, from its entry to its exit; the last one is
shortened. Each is sampled at its own midpoint. Positions come from the segment's index, never by accumulation, and are measured
from the entry point, so that a camera far away costs no digits inside the volume.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.model.geometry import Face
from jvr.numerics import larger
from jvr.types import Channels, Scalar, Triple


class End(NamedTuple):
    """What rays see where they end, behind the medium that they cross, each component an array of shape `(rays,)`.

    - `rgb`: radiance that arrives from there, without that of a background of one colour;
    - `opaque`: 1 where a ray ends at something opaque, 0 where it goes on to what is far away;
    - `distance`: world length from the ray's entry to what is opaque, 0 where nothing is;
    - `face`: where it ends at geometry of which `rgb` is the colour, until the light there is known; else `None`.
    """

    rgb: Triple
    opaque: Float[Array, "rays"]
    distance: Float[Array, "rays"]
    face: Face | None = None


class Rays(NamedTuple):
    """A batch of rays inside a medium, each component an array of shape `(rays,)`.

    `entry` and `direction` are in grid coordinates, `direction` per world length; `length` is the world length from entry to exit,
    0 where the ray misses. `end`: what is behind the medium, where that differs from ray to ray; a march does not need it
    (`without_end`).
    """

    entry: Triple
    direction: Triple
    length: Float[Array, "rays"]
    end: End | None = None

    @property
    def without_end(self) -> "Rays":
        """The rays as a march takes them: what is behind is not carried through its wavefronts."""
        return self._replace(end=None)


class OnSurface(NamedTuple):
    """Where a point lies on an isosurface: its isovalue, and the gradient of the scalar in the world."""

    value: Float[Array, ""]
    gradient: Triple


class Point(NamedTuple):
    """One sample on one ray: its grid position, the ray's direction (grid coordinates per world length), the ray's index in the batch
    and `k`, the index of its segment; `surface`: where it is one of an isosurface."""

    p: Triple
    direction: Triple
    ray: Int[Array, ""]
    k: Int[Array, ""]
    surface: OnSurface | None = None


class Transmittances(NamedTuple):
    """How much of the light reaches a point: one channel, three, or none where nothing is in its way.

    `lights`: of each light of the scene, or of none where nothing is in the way of any; `environment`: of the environment, as what shows
    it reads that; `ambient`: of all ambient light.
    """

    lights: tuple[Channels, ...] = ()
    environment: Channels = ()
    ambient: Channels = ()

    def of_light(self, index: int) -> Channels:
        """That of one of the scene's lights."""
        return self.lights[index] if self.lights else ()

    def beside(self, other: "Transmittances") -> "Transmittances":
        """What either says of light of which the other says nothing."""
        lights, around, ambient = self
        return Transmittances(lights or other.lights, around or other.environment, ambient or other.ambient)


class Sample(NamedTuple):
    """What is resampled at a point; fields that nobody asks for are empty.

    `s`: the scalar; `gradient`: its derivatives along the grid axes, or those of the extinction; `neighbours`: what else a gradient is made
    of, such as scalars around the point before the transfer function; `light`: how much of it reaches the point; `known`: 1, or 0 where
    voxels that it would be made of are missing, in volumes with gaps.
    """

    s: Float[Array, "..."]
    gradient: Triple = ()
    neighbours: Channels = ()
    light: Transmittances = Transmittances()
    known: Channels = ()


def segment_count(length: Float[Array, "rays"], dt: Scalar) -> Int[Array, "rays"]:
    """Number of segments of each ray, `ceil(length / dt)`."""
    return jnp.ceil(jax.lax.stop_gradient(length / dt)).astype(jnp.int32)


def segment_span(k: Int[Array, "..."], count: Int[Array, "rays"], length: Float[Array, "rays"], dt: Scalar):
    """Length of segment `k` of each ray, and the distance of its midpoint from the entry.

    Only the last segment's length depends on where the ray leaves. Past it the length is zero and the point stays at the exit,
    so that a finished ray never reads outside of the medium.
    """
    start = k * dt
    last = larger(length - start, 0.0)
    extent = jnp.where(k < count - 1, dt, jnp.where(k < count, last, 0.0))
    return extent, jnp.where(k < count, start + extent / 2, length)


def points_at(rays: Rays, ray: Int[Array, "rays"], k: Int[Array, "..."], u: Float[Array, "rays"]) -> Point:
    """The batch of points at distance `u` from the entry."""
    p = tuple(e + u * d for e, d in zip(rays.entry, rays.direction, strict=True))
    return Point(p, rays.direction, ray, jnp.broadcast_to(k, u.shape))
