"""THE loop: a batch of rays, front to back, one segment of every ray at a time.

The loop knows no effect by name. It is handed a `Medium`: a field that is resampled at a point and a shader that turns what was
resampled into emitted radiance and optical depth.
"""

import abc
import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.march.batch import pooled_while
from jvr.march.occupancy import Occupancy
from jvr.march.steps import Point, Rays, Sample, points_at, segment, segment_count
from jvr.model.transfer import Classified
from jvr.numerics import computed_once, mean_depth, one_minus_exp, two_sum
from jvr.types import Channels, Scalar

# Leaps before a ray is started.
FIRST_LEAPS = 4
# Optical depth of a segment, and of a voxel on the way of light, beyond which denser media are lit alike: light gets about as deep into
# them as the eye sees. Without it the two would be compared at distances that a position in single precision cannot tell apart.
DENSEST = 64.0


class AbstractField(eqx.Module):
    """What is resampled along rays; its arrays may be large."""

    @abc.abstractmethod
    def resample(self, point: Point) -> Sample:
        """What is known at one point, but for the light there."""

    @abc.abstractmethod
    def deposit(self, gradient: "AbstractField", points: Point, cotangent: Sample) -> "AbstractField":
        """Adds the derivative of `sum(cotangent * resample(points))` to `gradient`, in place where the compiler can; leaves of
        `gradient` that are `None` are not asked for."""


class AbstractVisibility(eqx.Module):
    """How much of each light reaches a point, and of that from all around where the scene asks for it."""

    @property
    def is_sharp(self) -> bool:
        """Whether it may change within a segment, so that it matters where in the segment it is looked up."""
        return True

    @abc.abstractmethod
    def transmittances(self, points: Point, wanted: Bool[Array, "rays"], *, reverse: bool) -> tuple[Channels, ...]:
        """For each light, the transmittance between it and each of a batch of points, one or three channels, or none where nothing can
        shade it. What is not `wanted` may be anything finite.

        Differentiable in reverse mode where `reverse` says so, else in forward mode.
        """

    @property
    @abc.abstractmethod
    def stats(self) -> Any:
        """What is to be reported about it, or `None`."""


class AbstractShader(eqx.Module):
    """What a segment looks like: everything between the scalar and the eye. Its arrays are small."""

    # Where in a segment the field is resampled, from -1/2 at its front to 1/2 at its back.
    places: ClassVar[tuple[float, ...]] = (0.0,)

    @abc.abstractmethod
    def segment(self, medium: Classified, sample: Sample, point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        """Emitted radiance (three components or none) and optical depth (one, three or none) of one segment of length `dt` whose
        properties are constant."""

    def look(self, transfer: Any, samples: tuple[Sample, ...], point: Point, dt: Scalar) -> tuple[Channels, Channels]:
        """The same for a segment around `point`, from what is known at `places`."""
        sample = self.prepare(transfer, samples[0], point)
        return self.segment(self.classify(transfer, sample), sample, point, dt)

    def prepare(self, transfer: Any, sample: Sample, point: Point) -> Sample:
        """The sample with its gradient in the world."""
        return sample

    def classify(self, transfer: Any, sample: Sample) -> Classified:
        """Colour and extinction of a prepared sample."""
        return transfer.evaluate(sample.s)


class Medium(NamedTuple):
    """What rays march through: resampled, classified, shaded; where `occupancy` is not `None`, only in visible bricks; where `shadows`
    is not `None`, each sample knows how much light reaches it."""

    field: AbstractField
    transfer: Any  # what `shader.look` reads: an AbstractTransfer, or one prepared for the shader
    shader: AbstractShader
    occupancy: Occupancy | None = None
    shadows: AbstractVisibility | None = None


def for_derivatives(medium: Medium) -> Medium:
    """What a march goes through whose derivative with respect to the transfer function is taken: an empty brick may have one, since
    that of extinction at zero is not zero."""
    leaps = medium.occupancy is not None and medium.occupancy.in_derivatives
    return medium if leaps else medium._replace(occupancy=None)


@dataclasses.dataclass(frozen=True)
class MarchOptions:
    """Static choices of a march. A ray ends once its transmittance, in every channel, is at most `termination`."""

    termination: float
    distance: bool


class Marched(NamedTuple):
    """What the loop returns for each ray.

    `radiance`: three components, or none where nothing is emitted; `tau`: optical depth, one or three components, or none;
    `distance`: opacity-weighted distance from the entry, not yet divided by the opacity, a component for each of `tau`, or none;
    `steps`: segments that were sampled, `None` in a derivative.
    """

    radiance: Channels
    tau: Channels
    distance: Channels
    steps: Int[Array, "rays"] | None


class Sums(NamedTuple):
    """The running state of a ray: radiance and optical depth as unevaluated sums of two floats (see `two_sum`), and the
    opacity-weighted distance."""

    radiance: Channels
    radiance_low: Channels
    tau: Channels
    tau_low: Channels
    distance: Channels


class Lanes(NamedTuple):
    """A batch of rays: their indices in the whole batch and their numbers of segments."""

    rays: Rays
    ray: Int[Array, "rays"]
    segments: Int[Array, "rays"]


class Stretch(NamedTuple):
    """One segment of every ray: its index, the distance of its middle from the entry, its length, and whether it is there."""

    rays: Rays
    ray: Int[Array, "rays"]
    k: Int[Array, "..."]
    u: Float[Array, "rays"]
    extent: Float[Array, "rays"]
    inside: Bool[Array, "rays"]


class Progress(NamedTuple):
    """How far a ray has come: its sums, the segment that comes next, how many it sampled and, for each channel of optical depth, the
    last segment that light from behind could still reach the eye through (`last`), with the optical depth in front of it (`front`)."""

    sums: Sums
    following: Int[Array, "rays"]
    steps: Int[Array, "rays"]
    front: Channels
    last: tuple[Int[Array, "rays"], ...]


class Noted(NamedTuple):
    """What a replay needs of a ray's `Progress` at its end."""

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
) -> tuple[Marched, Noted | None]:
    """What every ray gathered, and where a replay will need it, what that starts from."""
    emits, absorbs = channel_counts(medium, rays, dt)

    def start(inputs: tuple[Lanes, Int[Array, "rays"]]) -> Progress:
        lanes, following = inputs
        zero = jnp.zeros_like(lanes.rays.length)
        blank = (zero,) * absorbs
        sums = Sums((zero,) * emits, (zero,) * emits, blank, blank, blank * options.distance)
        none = jnp.zeros_like(lanes.segments)
        return Progress(sums, following, none, blank * for_replay, (none,) * absorbs * for_replay)

    def alive(inputs: tuple[Lanes, Int[Array, "rays"]], progress: Progress) -> Bool[Array, "rays"]:
        return is_alive(options, inputs[0], progress)

    def advance(inputs: tuple[Lanes, Int[Array, "rays"]], progress: Progress, _: None) -> tuple[Progress, None]:
        lanes = inputs[0]
        k = jnp.where(is_alive(options, lanes, progress), leap(medium, lanes, dt, progress.following), progress.following)
        leapt, progress = k > progress.following, progress._replace(following=k)
        alive = is_alive(options, lanes, progress)
        emitted, dtau, u = take_segment(medium, lanes, dt, k, shown(medium, lanes, dt, k, jnp.where(alive, lanes.segments, 0)))
        # Where a ray ends with a leap, the last segment that it leapt over is the one to be noted.
        front, last = note_front(progress, alive | leapt, k - ~alive) if for_replay else ((), ())
        sums = add_segment(progress.sums, emitted, dtau, u)
        return Progress(sums, k + alive, progress.steps + alive, front, last), None

    def finish(progress: Progress) -> tuple[Marched, Noted | None]:
        noted = Noted(progress.following, progress.front, progress.last) if for_replay else None
        return marched(progress), noted

    lanes = lanes_of(rays, dt)
    first = first_visible(medium, lanes, dt)
    work = lanes.segments - first
    gathered, noted = pooled_while(alive, advance, start, finish, (lanes, first), None, work)[0]
    if noted is not None:
        # Rays without work were not started; a replay that skips nothing still has all of their segments to look at.
        blank = work == 0
        last = tuple(jnp.where(blank, lanes.segments - 1, x) for x in noted.last)
        noted = noted._replace(following=jnp.where(blank, lanes.segments, noted.following), last=last)
    return gathered, noted


def note_front(progress: Progress, moved: Bool[Array, "rays"], k: Int[Array, "rays"]):
    """`front` and `last` as the rays that have `moved` are in front of segment `k`."""
    depth = join(progress.sums.tau, progress.sums.tau_low)
    clear = [moved & (now < opaque_depth(now.dtype)) for now in depth]
    front = tuple(jnp.where(c, now, old) for c, now, old in zip(clear, depth, progress.front, strict=True))
    last = tuple(jnp.where(c, k, old) for c, old in zip(clear, progress.last, strict=True))
    return front, last


def lanes_of(rays: Rays, dt: Scalar) -> Lanes:
    """All rays, numbered."""
    count = segment_count(rays.length, dt)
    return Lanes(rays, jnp.arange(count.size, dtype=jnp.int32), count)


def marched(progress: Progress) -> Marched:
    """The sums of every ray, rounded to one float each."""
    sums = progress.sums
    return Marched(join(sums.radiance, sums.radiance_low), join(sums.tau, sums.tau_low), sums.distance, progress.steps)


def leap(medium: Medium, lanes: Lanes, dt: Scalar, k: Int[Array, "rays"]) -> Int[Array, "rays"]:
    """The next segment, from `k` on, that may have a sample in a visible brick, or the number of segments."""
    if medium.occupancy is None:
        return k
    extent, u = segment(k, lanes.segments, lanes.rays.length, dt)
    within = len(medium.shader.places) > 1
    first = u - extent / 2 if within else u
    return jnp.minimum(k + medium.occupancy.leap(lanes.rays, first, dt, within=within), lanes.segments)


def first_visible(medium: Medium, lanes: Lanes, dt: Scalar) -> Int[Array, "rays"]:
    """The segment that each ray starts with: a few leaps on from its entry. Most of the rays that see nothing end here, and what is
    left of the others says better how long they will take."""
    first = jnp.zeros_like(lanes.segments)
    if medium.occupancy is None:
        return first
    return jax.lax.fori_loop(0, FIRST_LEAPS, lambda _, k: leap(medium, lanes, dt, k), first)


def shown(medium: Medium, lanes: Lanes, dt: Scalar, k: Int[Array, "rays"], count: Int[Array, "rays"]) -> Int[Array, "rays"]:
    """`count`, the number of segments, and 0 for rays whose segment `k` is not to be seen. A leap may end in another empty brick; where
    empty means negligible, both directions have to take the same segments."""
    if medium.occupancy is None or not medium.occupancy.in_derivatives:
        return count
    _, u = segment(k, count, lanes.rays.length, dt)
    return jnp.where(medium.occupancy.shows(lanes.rays, u), count, 0)


def take_segment(medium: Medium, lanes: Lanes, dt: Scalar, k: Int[Array, "rays"], count: Int[Array, "rays"]):
    """Emission and optical depth of segment `k` of every ray, and the distance of its midpoint; zero beyond `count`."""
    extent, u = segment(k, count, lanes.rays.length, dt)
    sampled = places(medium, lanes.rays, lanes.ray, k, u, extent)
    where = Stretch(lanes.rays, lanes.ray, k, u, extent, k < count)
    samples = lit(medium, where, resample(medium, sampled, k < count), reverse=False)
    point = points_at(lanes.rays, lanes.ray, k, u)
    emitted, dtau = jax.vmap(medium.shader.look, in_axes=(None, 0, 0, 0))(medium.transfer, samples, point, extent)
    return emitted, dtau, u


def resample(medium: Medium, sampled: list[Point], proof: Bool[Array, "rays"]) -> tuple[Sample, ...]:
    """The field at each of the places, once for all channels of the shader; `proof` as in `computed_once`."""
    return computed_once(proof, tuple(jax.vmap(medium.field.resample)(points) for points in sampled))


def classify_at(medium: Medium, points: Point, proof: Bool[Array, "points"]) -> tuple[Classified, Sample]:
    """Colour and extinction at a batch of points, and what the shader knows of them; `proof` as in `computed_once`."""
    samples = computed_once(proof, jax.vmap(medium.field.resample)(points))
    prepared = jax.vmap(medium.shader.prepare, in_axes=(None, 0, 0))(medium.transfer, samples, points)
    return jax.vmap(medium.shader.classify, in_axes=(None, 0))(medium.transfer, prepared), prepared


def lit(medium: Medium, where: Stretch, samples: tuple[Sample, ...], *, reverse: bool) -> tuple[Sample, ...]:
    """The samples of a segment with the light that reaches it, where that is asked for."""
    if medium.shadows is None:
        return samples
    shader, middle = medium.shader, points_at(where.rays, where.ray, where.k, where.u)
    classify = lambda sample, point: shader.classify(medium.transfer, shader.prepare(medium.transfer, sample, point)).sigma_t
    sigma_t = [sigma for sample in samples for sigma in jax.vmap(classify)(sample, middle)]
    light = light_at(medium, where, sigma_t, reverse=reverse)
    return tuple(sample._replace(light=light) for sample in samples)


def light_at(medium: Medium, where: Stretch, sigma_t: Sequence[Array], *, reverse: bool) -> tuple[Channels, ...]:
    """How much light reaches a segment with these extinctions.

    It is looked up where the segment's own emission comes from on average, in front of its middle: in the middle of an opaque one it
    is dark, though its front is not.
    """
    assert medium.shadows is not None
    dtau = jnp.minimum(sum(sigma_t[1:], sigma_t[0]) / len(sigma_t) * where.extent, DENSEST)
    points = points_at(where.rays, where.ray, where.k, where.u + where.extent * (mean_depth(dtau) - 0.5))
    # Without extinction there is nothing to see; but where nothing is left out it has a derivative, and between the ends of a segment
    # there may be what is at neither.
    everywhere = medium.occupancy is None or len(medium.shader.places) > 1
    wanted = where.inside if everywhere else where.inside & functools.reduce(jnp.logical_or, [sigma != 0 for sigma in sigma_t])
    return computed_once(where.inside, medium.shadows.transmittances(points, wanted, reverse=reverse))


def places(
    medium: Medium,
    rays: Rays,
    ray: Int[Array, "rays"],
    k: Int[Array, "..."],
    u: Float[Array, "rays"],
    extent: Float[Array, "rays"],
) -> list[Point]:
    """Where a segment around `u` is resampled."""
    return [points_at(rays, ray, k, u + at * extent if at else u) for at in medium.shader.places]


def add_segment(sums: Sums, emitted: Channels, dtau: Channels, u: Float[Array, "rays"]) -> Sums:
    """One step of front-to-back compositing."""
    before = transmittance(sums.tau, sums.tau_low)
    radiance = add(sums.radiance, sums.radiance_low, through(before, emitted))
    tau = add(sums.tau, sums.tau_low, dtau)
    # Where the distance is not asked for, `sums.distance` is empty and nothing is computed.
    distance = tuple(total + a * u for total, a in zip(sums.distance, opacity(before, dtau), strict=False))
    return Sums(*radiance, *tau, distance)


def transmittance(tau: Channels, tau_low: Channels) -> Channels:
    """Transmittance from the optical depth, and not as a running product, whose rounding errors would add up."""
    return tuple(jnp.exp(-depth) for depth in join(tau, tau_low))


def through(transmittances: Channels, emitted: Channels) -> Channels:
    """What remains of each channel of `emitted`; a single transmittance serves all channels, none attenuates nothing."""
    if not transmittances:
        return emitted
    return tuple(T * e for T, e in zip(spread(transmittances, len(emitted)), emitted, strict=True))


def spread(channels: Channels, n: int) -> Channels:
    """One component repeated for `n` channels, or the `n` components themselves."""
    return channels * (n // len(channels)) if channels else channels


def opacity(before: Channels, dtau: Channels) -> Channels:
    """What one segment adds to the opacity of its ray, in each channel of `dtau`."""
    return tuple(T * one_minus_exp(d) for T, d in zip(before, dtau, strict=True))


def is_alive(options: MarchOptions, lanes: Lanes, progress: Progress) -> Bool[Array, "rays"]:
    """Whether the next segment of each ray is to be taken: it lies inside, and something of it can still reach the eye."""
    alive = progress.following < lanes.segments
    if progress.sums.tau:
        thinnest = functools.reduce(jnp.minimum, progress.sums.tau)
        # Even without a bound: behind so much nothing can be seen.
        bound = -math.log(options.termination) if options.termination > 0 else math.inf
        alive &= thinnest < min(bound, opaque_depth(thinnest.dtype))
    return alive


def opaque_depth(dtype: Any) -> float:
    """The optical depth at which the transmittance underflows."""
    return -math.log(float(jnp.finfo(dtype).tiny))


def channel_counts(medium: Medium, rays: Rays, dt: Scalar) -> tuple[int, int]:
    """How many channels the medium emits and absorbs in, by shape alone."""
    one = lanes_of(jax.tree.map(lambda x: x[:1], rays), dt)
    emitted, dtau, _ = jax.eval_shape(lambda: take_segment(medium, one, dt, jnp.zeros_like(one.segments), one.segments))
    return len(emitted), len(dtau)


def add(high: Channels, low: Channels, terms: Channels) -> tuple[Channels, Channels]:
    """`two_sum` in every channel."""
    sums = [two_sum(h, low_, t) for h, low_, t in zip(high, low, terms, strict=True)]
    return tuple(s[0] for s in sums), tuple(s[1] for s in sums)


def join(high: Channels, low: Channels) -> Channels:
    """Two-float sums rounded to one float."""
    return tuple(h + low_ for h, low_ in zip(high, low, strict=True))
