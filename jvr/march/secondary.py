"""Secondary rays: straight ways of light through a medium, along which nothing is emitted, and one step of a sweep along them.

What shadow volumes and radiance transfer know is swept: all rays of a batch take steps between the same distances. (Shadow rays, each of
which goes from a sample of its own, are marched: `jvr.march.march`.)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jvr.march.medium import Medium
from jvr.march.segments import classify_at
from jvr.march.steps import Point, Sample
from jvr.model.clipping import Clipping, Line, interval_inside
from jvr.model.transfer import Classified
from jvr.model.volume import Volume
from jvr.numerics import larger, rounded_into, smaller
from jvr.types import Channels, Triple


class SecondaryRays(NamedTuple):
    """A batch of rays: grid position of their start, direction in grid coordinates per world length, and the distances from their start
    between which there is a medium on their whole line, the same where there is none."""

    p: Triple
    along: Triple
    t_in: Float[Array, "..."]
    t_out: Float[Array, "..."]


def secondary_rays(volume: Volume, clipping: Clipping, world: Line, grid: Line) -> SecondaryRays:
    """Rays that begin somewhere, in world and grid coordinates, and go on without an end."""
    t_in, t_out = interval_inside(volume, clipping, world, grid)
    hit = t_out > t_in
    return SecondaryRays(*grid, jnp.where(hit, t_in, 0.0), jnp.where(hit, t_out, 0.0))


def take_midpoint(
    medium: Medium,
    volume: Volume,
    rays: SecondaryRays,
    begin: Float[Array, "..."],
    end: Float[Array, "..."],
    wanted: Bool[Array, "rays"] | bool,
) -> tuple[Channels, Classified, Sample]:
    """Optical depth of each ray between two distances from its start, none of them negative, and what is known in the middle; 0 where it is
    not `wanted`.

    By one sample in the middle of what of that is inside of the medium: exact where it is homogeneous, and continuous where a border moves.
    """
    low, high = (smaller(larger(t, rays.t_in), rays.t_out) for t in (begin, end))
    middle, inside = 0.5 * (low + high), (high > low) & wanted
    p = (c + middle * d for c, d in zip(rays.p, rays.along, strict=True))
    # Where nothing is inside, and by a rounding elsewhere, the middle may be outside, where nothing may be read.
    p = tuple(rounded_into(c, first, last) for c, first, last in zip(p, *volume.domain, strict=True))
    classified, sample = classify_at(medium, points(p, rays.along), inside)
    return tuple(jnp.where(inside, sigma * (high - low), 0.0) for sigma in classified.sigma_t), classified, sample


def channel_count(medium: Medium, volume: Volume, rays: SecondaryRays) -> int:
    """How many channels the medium absorbs in, by shape alone."""
    return len(jax.eval_shape(lambda: take_midpoint(medium, volume, rays, rays.t_in, rays.t_out, True)[0]))


def points(p: Triple, along: Triple) -> Point:
    """Grid positions that belong to no march."""
    zero = jnp.zeros_like(p[0], jnp.int32)
    return Point(p, along, zero, zero)
