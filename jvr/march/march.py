"""THE loop of ray marching: a batch of rays, front to back, one segment of every ray at a time."""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from jvr.march.medium import Medium
from jvr.march.segments import ActiveRays, active_rays, channel_counts, first_visible, occupied_count, skip, take_segment
from jvr.march.steps import Rays
from jvr.march.sums import Sums, add_segment, join, opaque_depth
from jvr.march.wavefront import wavefront_while
from jvr.types import Channels, Scalar


@dataclasses.dataclass(frozen=True)
class MarchOptions:
    """Static choices of a march. A ray ends once its transmittance, in every channel, is at most `termination`."""

    termination: float
    distance: bool


class Marched(NamedTuple):
    """What a march returns for each ray.

    `radiance`: three components, or none where nothing is emitted; `tau`: optical depth, one or three components, or none;
    `distance`: opacity-weighted distance from the entry, not yet divided by the opacity, a component for each of `tau`, or none;
    `steps`: segments that were sampled, `None` in a derivative.
    """

    radiance: Channels
    tau: Channels
    distance: Channels
    steps: Int[Array, "rays"] | None


class Progress(NamedTuple):
    """The state of a ray in a march: its sums, the segment that comes next, how many it sampled and, for each channel of optical depth, the
    last segment that light from behind could still reach the eye through (`last`), with the optical depth in front of it (`front`)."""

    sums: Sums
    following: Int[Array, "rays"]
    steps: Int[Array, "rays"]
    front: Channels
    last: tuple[Int[Array, "rays"], ...]


class ReplayRecord(NamedTuple):
    """The record that a replay starts from: what it needs of a ray's `Progress` at its end."""

    following: Int[Array, "rays"]
    front: Channels
    last: tuple[Int[Array, "rays"], ...]


def march(options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> Marched:
    """Integrates emission and absorption along every ray (course notes on GPU-based volume ray-casting, Eurographics 2009, eq. 1.8).

    Differentiable in forward mode as it stands; `jvr.march.adjoint` adds reverse mode. Detached: the number of segments and
    the decision to end a ray early.
    """
    return integrate(options, medium, rays, dt)[0]


def integrate(
    options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar, *, for_replay: bool = False
) -> tuple[Marched, ReplayRecord | None]:
    """What every ray gathered, and where a replay will need it, what that starts from."""
    emits, absorbs = channel_counts(medium, rays, dt)

    def start(inputs: tuple[ActiveRays, Int[Array, "rays"]]) -> Progress:
        active, following = inputs
        zero = jnp.zeros_like(active.rays.length)
        blank = (zero,) * absorbs
        sums = Sums((zero,) * emits, (zero,) * emits, blank, blank, blank * options.distance)
        none = jnp.zeros_like(active.segments)
        return Progress(sums, following, none, blank * for_replay, (none,) * absorbs * for_replay)

    def alive(inputs: tuple[ActiveRays, Int[Array, "rays"]], progress: Progress) -> Bool[Array, "rays"]:
        return is_alive(options, inputs[0], progress)

    def advance(inputs: tuple[ActiveRays, Int[Array, "rays"]], progress: Progress, _: None) -> tuple[Progress, None]:
        active = inputs[0]
        k = jnp.where(is_alive(options, active, progress), skip(medium, active, dt, progress.following), progress.following)
        skipped, progress = k > progress.following, progress._replace(following=k)
        alive = is_alive(options, active, progress)
        emitted, dtau, u = take_segment(
            medium, active, dt, k, occupied_count(medium, active, dt, k, jnp.where(alive, active.segments, 0))
        )
        # Where a ray ends with a skip, the last segment that it skipped is the one to be recorded.
        front, last = record_front(progress, alive | skipped, k - ~alive) if for_replay else ((), ())
        sums = add_segment(progress.sums, emitted, dtau, u)
        return Progress(sums, k + alive, progress.steps + alive, front, last), None

    def finish(progress: Progress) -> tuple[Marched, ReplayRecord | None]:
        record = ReplayRecord(progress.following, progress.front, progress.last) if for_replay else None
        return marched(progress), record

    active = active_rays(rays, dt)
    first = first_visible(medium, active, dt)
    work = active.segments - first
    gathered, record = wavefront_while(alive, advance, start, finish, (active, first), None, work)[0]
    if record is not None:
        # Rays without work were not started; a replay that skips nothing still has all of their segments to look at.
        blank = work == 0
        last = tuple(jnp.where(blank, active.segments - 1, x) for x in record.last)
        record = record._replace(following=jnp.where(blank, active.segments, record.following), last=last)
    return gathered, record


def record_front(progress: Progress, moved: Bool[Array, "rays"], k: Int[Array, "rays"]):
    """`front` and `last` as the rays that have `moved` are in front of segment `k`."""
    depth = join(progress.sums.tau, progress.sums.tau_low)
    clear = [moved & (now < opaque_depth(now.dtype)) for now in depth]
    front = tuple(jnp.where(c, now, old) for c, now, old in zip(clear, depth, progress.front, strict=True))
    last = tuple(jnp.where(c, k, old) for c, old in zip(clear, progress.last, strict=True))
    return front, last


def marched(progress: Progress) -> Marched:
    """The sums of every ray, rounded to one float each."""
    sums = progress.sums
    return Marched(join(sums.radiance, sums.radiance_low), join(sums.tau, sums.tau_low), sums.distance, progress.steps)


def is_alive(options: MarchOptions, active: ActiveRays, progress: Progress) -> Bool[Array, "rays"]:
    """Whether the next segment of each ray is to be taken: it lies inside, and something of it can still reach the eye."""
    alive = progress.following < active.segments
    if progress.sums.tau:
        thinnest = functools.reduce(jnp.minimum, progress.sums.tau)
        # Even without a bound: behind so much nothing can be seen.
        bound = -math.log(options.termination) if options.termination > 0 else math.inf
        alive &= thinnest < min(bound, opaque_depth(thinnest.dtype))
    return alive
