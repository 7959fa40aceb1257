"""First hits: where rays cross the isosurfaces of a volume (course notes on GPU-based volume ray-casting, Eurographics 2009, section 2.4).

A ray is sampled at `u_k = k dt`. Between two samples of which one lies below an isovalue and the other not, it crosses that surface. Bricks
that hold none of the isovalues between their bounds are skipped. Far from all isovalues steps may be larger:

- two rates: where the scalar is at least `band` away from every isovalue, `coarse` samples are one step. A crossing in such a step is
  looked for again at the finer rate;
- guaranteed: no crossing is nearer than `|s - rho| / L` along a ray on which the scalar changes by at most `L` per length, which is bounded
  in each brick.

The crossing is then enclosed ever closer, by interpolation, truncation and projection (Oliveira and Takahashi, "An enhancement of the
bisection method average performance preserving minmax optimality", ACM TOMS 47:1, 2020): about as many samples as the secant method takes,
and never more than two more than bisection.

Its derivative is that of the implicit function `s(x(u)) = rho`: `du = (d rho - ds at fixed u) / (grad s . d)`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jvr.march.occupancy import Occupancy
from jvr.march.rules import is_there, perturbed
from jvr.march.segments import FIRST_SKIPS
from jvr.march.steepest import Steepest
from jvr.march.steps import Rays, segment_count
from jvr.march.wavefront import wavefront_while
from jvr.model.volume import Volume
from jvr.numerics import divide_or_zero, dot, materialise, turned
from jvr.types import Scalar

# Samples of the lattice for each of the base rate, where steps are as long as bounds on the gradient allow.
FINER = 32
# A ray that crosses a surface under a smaller angle than this (its sine) has the derivative of this angle.
LEAST_SINE = 1e-3
# The fraction of rays that may idle while others are searched, and while crossings are enclosed: both take few steps.
IDLE_SEARCH, IDLE_ENCLOSED = 0.5, 0.8
# How many tolerances from a surface that it leaves a ray looks for the next one.
SETS_OFF = 4.0
# The side of a point where there are no data.
MISSING = -1


class Search(eqx.Module):
    """What rays need to know to find the isosurfaces of a volume.

    - `values`: isovalues, ascending; `dt`: world length between two samples; `tolerance`: how closely a crossing is enclosed;
    - `occupancy`: bricks that may hold an isovalue, or `None` where none are skipped;
    - `band`: the scalar's distance from the isovalues from which `coarse` samples are one step; `None`: every sample is taken;
    - `steepest`: bounds on how the scalar changes along each axis of the grid, within a brick and its neighbours; `None`: not known.
    """

    volume: Volume
    values: Float[Array, "n"]
    dt: Scalar
    tolerance: Scalar
    occupancy: Occupancy | None
    band: Scalar | None = None
    steepest: Steepest | None = None
    coarse: int = eqx.field(static=True, default=1)

    @property
    def leaps(self) -> bool:
        """Whether steps may be larger than one sample."""
        return self.steepest is not None or self.band is not None

    def side(self, s: Float[Array, "rays"]) -> Int[Array, "rays"]:
        """How many isovalues a scalar has reached."""
        return sum((s >= value).astype(jnp.int32) for value in self.values)  # pyright: ignore[reportReturnType]

    def sample(self, rays: Rays, u: Float[Array, "rays"]) -> tuple[Float[Array, "rays"], Int[Array, "rays"]]:
        """The scalar at distances `u`, and the side of the isovalues that it is on."""
        p = tuple(e + u * d for e, d in zip(rays.entry, rays.direction, strict=True))
        s = jax.vmap(self.volume.sample)(p)
        # Else it is sampled anew in each kernel that reads it.
        s = materialise(rays.length > 0, s)
        side = self.side(s)
        return s, side if self.volume.gaps is None else jnp.where(jax.vmap(self.volume.is_known)(p), side, MISSING)

    def skip(self, rays: Rays, k: Int[Array, "rays"]) -> Int[Array, "rays"]:
        """How many steps from sample `k` on cross no surface."""
        if self.occupancy is None:
            return jnp.zeros_like(k)
        return self.occupancy.skip(rays, jnp.minimum(k * self.dt, rays.length), self.dt, within=True)

    def stride(self, rays: Rays, k: Int[Array, "rays"], s: Float[Array, "rays"]) -> Int[Array, "rays"]:
        """How many samples are one step from sample `k` on, where the scalar is `s`."""
        distance = jnp.min(jnp.stack([jnp.abs(s - value) for value in self.values]), axis=0)
        if self.steepest is None:
            assert self.band is not None
            return jnp.where(distance >= self.band, self.coarse, 1)
        return self.steepest.stride(rays, jnp.minimum(k * self.dt, rays.length), distance, self.dt)


class Reached(NamedTuple):
    """Where rays have come to: at distance `u`, between samples `k` and `k + 1`, on a `side` of the isovalues; `on`: whether they go on;
    `s`: the scalar there, no number where it was not sampled."""

    u: Float[Array, "rays"]
    k: Int[Array, "rays"]
    side: Int[Array, "rays"]
    on: Bool[Array, "rays"]
    s: Float[Array, "rays"]


class Hits(NamedTuple):
    """Where rays cross a surface next.

    `u`: distance from the entry, 0 where nothing is `found`; `surface`: the index of its isovalue; `reached`: where to go on from; `steps`:
    samples that were taken.
    """

    u: Float[Array, "rays"]
    surface: Int[Array, "rays"]
    found: Bool[Array, "rays"]
    reached: Reached
    steps: Int[Array, "rays"]


def start(search: Search, rays: Rays) -> Reached:
    """The beginning of rays: a few skips on from their entry. Most of those that see nothing end here."""
    segments = segment_count(rays.length, search.dt)
    k = jnp.zeros_like(segments)
    if search.occupancy is not None:
        k = jax.lax.fori_loop(0, FIRST_SKIPS, lambda _, k: jnp.minimum(k + search.skip(rays, k), segments), k)
    u = jnp.minimum(k * search.dt, rays.length)
    s, side = search.sample(rays, u)
    return jax.lax.stop_gradient(Reached(u, k, side, k < segments, s))


def leaving(search: Search, rays: Rays, hits: Hits, crosses: Bool[Array, "rays"]) -> Reached:
    """The beginning of rays that start where others have hit a surface, on the side behind it where they cross it. Sides are known, so that
    a ray does not meet the surface that it leaves; one that it meets at once is met no nearer than a few tolerances."""
    before = 2 * hits.surface + 1 - hits.reached.side
    near = jnp.minimum(SETS_OFF * search.tolerance, rays.length)
    side = jnp.where(crosses, hits.reached.side, before)
    return jax.lax.stop_gradient(Reached(near, jnp.zeros_like(side), side, hits.found, _not_sampled(near)))


@jax.custom_jvp
def next_hit(search: Search, rays: Rays, reached: Reached) -> Hits:
    """The next crossing of an isosurface on each ray, from where it has come to.

    Differentiable in voxels, isovalues and rays, in both modes and any number of times. A ray that meets a surface at an angle below 0.06
    degrees has the derivative of that angle: at a silhouette it would be infinite. Where the scalar does not change at all it is 0.
    Detached: which surface is crossed, and whether one is.
    """
    found = _brackets(search, rays, reached)
    u, samples = _enclosed(search, rays, found)
    there = found.there
    steps = found.steps + jnp.where(there, samples, 0)
    return Hits(jnp.where(there, u, 0.0), jnp.where(there, found.surface, 0), there, found.beyond(u), steps)


def _rule(primals: tuple[Search, Rays, Reached], tangents: tuple[Search, Rays, Reached]) -> tuple[Hits, Hits]:
    hits = next_hit(*primals)
    search, rays, _ = primals
    of_search, of_rays, _ = perturbed(primals, tangents)
    zero = lambda x: jax.custom_derivatives.zero_from_primal(x, symbolic_zeros=True)
    blank = jax.tree.map(zero, hits)
    moved = (of_search.volume, of_search.values, of_rays.entry, of_rays.direction)
    if not jax.tree.leaves(moved):
        return hits, blank
    arrays = (search.volume, search.values, rays.entry, rays.direction)
    moving, still = eqx.partition(arrays, is_there(moved))

    def excess(moving):
        """By how much the scalar where a ray has crossed a surface exceeds its isovalue."""
        volume, values, entry, direction = eqx.combine(moving, still)
        p = tuple(jnp.where(hits.found, e + hits.u * d, 0.0) for e, d in zip(entry, direction, strict=True))
        # Each run that is read is one addition to all voxels in reverse mode.
        return jax.vmap(lambda p: volume.sample(p, in_runs=True))(p) - values[hits.surface]

    change = jax.jvp(excess, (moving,), (moved,))[1]
    return hits, blank._replace(u=jnp.where(hits.found, -change * _inverse_slope(search.volume, rays, hits), 0.0))


next_hit.defjvp(_rule, symbolic_zeros=True)


def _inverse_slope(volume: Volume, rays: Rays, hits: Hits) -> Float[Array, "rays"]:
    """World length along a ray per change of the scalar where it crosses a surface."""
    p = tuple(jnp.where(hits.found, e + hits.u * d, 0.0) for e, d in zip(rays.entry, rays.direction, strict=True))
    gradient = jax.vmap(jax.grad(lambda p: volume.sample(p, in_runs=True)))(p)
    slope, world = dot(gradient, rays.direction), turned(volume.axes_inverse.T, gradient)
    least = jax.lax.stop_gradient(LEAST_SINE * jnp.sqrt(dot(world, world)))
    return divide_or_zero(jnp.ones_like(slope), jnp.copysign(jnp.maximum(jnp.abs(slope), least), slope))


def passed(search: Search, rays: Rays, opacity: Float[Array, "n"] | None, most: int) -> Float[Array, "rays"]:
    """How much light gets through the surfaces on each ray: the product of `1 - opacity` of those that it crosses, `most` at most; without
    an `opacity` nothing through any. Differentiable in that alone."""
    search, rays = jax.lax.stop_gradient((search, rays))
    reached, clear = start(search, rays), jnp.ones_like(rays.length)
    if opacity is None:
        return jnp.where(_brackets(search, rays, reached).there, 0.0, clear)

    def cross(carry: tuple[Reached, Float[Array, "rays"]], _: None) -> tuple[tuple[Reached, Float[Array, "rays"]], None]:
        reached, clear = carry
        found = _brackets(search, rays, reached)
        return (found.beyond(found.front), jnp.where(found.there, clear * (1 - opacity[found.surface]), clear)), None

    return jax.lax.scan(cross, (reached, clear), length=most)[0][1]


class _Brackets(NamedTuple):
    """Between which distances rays cross a surface, if they do; `side`: in front of it; `s`, `ahead`: the scalar at either end, `s` no
    number where it was not sampled."""

    front: Float[Array, "rays"]
    back: Float[Array, "rays"]
    side: Int[Array, "rays"]
    rises: Bool[Array, "rays"]
    there: Bool[Array, "rays"]
    k: Int[Array, "rays"]
    steps: Int[Array, "rays"]
    s: Float[Array, "rays"]
    ahead: Float[Array, "rays"]

    @property
    def surface(self) -> Int[Array, "rays"]:
        """The index of the isovalue that is crossed."""
        return jnp.where(self.rises, self.side, self.side - 1)

    def beyond(self, u: Float[Array, "rays"]) -> Reached:
        """Where rays go on that cross it at distance `u`."""
        return Reached(u, self.k, jnp.where(self.rises, self.side + 1, self.side - 1), self.there, _not_sampled(u))


def _not_sampled(u: Float[Array, "rays"]) -> Float[Array, "rays"]:
    return jnp.full_like(u, jnp.nan)


class _Progress(NamedTuple):
    """The state of a ray that is searched: the sample that it has come to, the side of it and, unless it was skipped to, its scalar `s`;
    `crossed`: one more than the side of the next, where that is another, else 0; `ahead`: the scalar there; `fine_until`: up to which
    sample steps are small, where others may be larger."""

    k: Int[Array, "rays"]
    side: Int[Array, "rays"]
    crossed: Int[Array, "rays"]
    steps: Int[Array, "rays"]
    s: Float[Array, "rays"]
    ahead: Float[Array, "rays"]
    fine_until: Int[Array, "rays"] | None


class _Way(NamedTuple):
    """A ray, the number of its steps, and where it begins."""

    rays: Rays
    segments: Int[Array, "rays"]
    reached: Reached


def _brackets(search: Search, rays: Rays, reached: Reached) -> _Brackets:
    """The pair of samples of each ray that the next surface is between."""
    segments = jnp.where(reached.on, segment_count(rays.length, search.dt), 0)

    def begin(way: _Way) -> _Progress:
        reached, zero = way.reached, jnp.zeros_like(way.reached.k)
        return _Progress(reached.k, reached.side, zero, zero, reached.s, reached.s, zero if search.leaps else None)

    def alive(way: _Way, progress: _Progress) -> Bool[Array, "rays"]:
        return (progress.crossed == 0) & (progress.k < way.segments)

    def advance(way: _Way, progress: _Progress, _: None) -> tuple[_Progress, None]:
        on = alive(way, progress)
        skipped = search.skip(way.rays, progress.k)
        k = jnp.minimum(progress.k + skipped, way.segments)
        s = jnp.where(skipped > 0, jnp.nan, progress.s)
        stride, fine_until = jnp.ones_like(k), progress.fine_until
        if fine_until is not None:
            may = ~jnp.isnan(s) & (k >= fine_until)
            stride = jnp.where(may, search.stride(way.rays, k, s), 1)
        following = jnp.minimum(k + stride, way.segments)
        ahead, side = search.sample(way.rays, jnp.minimum(following * search.dt, way.rays.length))
        sampled = on & (k < way.segments)
        crosses = sampled & (side != progress.side) & (side != MISSING) & (progress.side != MISSING)
        passed = sampled & ~crosses
        if fine_until is not None:
            # What a larger step has passed is looked at again.
            again = crosses & (following > k + 1)
            crosses = crosses & ~again
            fine_until = jnp.where(again, following, fine_until)
        reached = lambda new, kept, before: jnp.where(passed, new, jnp.where(on, kept, before))
        return _Progress(
            reached(following, k, progress.k),
            jnp.where(passed, side, progress.side),
            jnp.where(crosses, side + 1, progress.crossed),
            progress.steps + sampled,
            reached(ahead, s, progress.s),
            jnp.where(crosses, ahead, progress.ahead),
            fine_until,
        ), None

    work = jnp.where(reached.on, jnp.maximum(segments - reached.k, 0), 0)
    finish = lambda progress: progress._replace(fine_until=None)
    found, _ = wavefront_while(alive, advance, begin, finish, _Way(rays, segments, reached), None, work, IDLE_SEARCH)
    there, rises = found.crossed > 0, found.crossed - 1 > found.side
    # The lattice goes on behind a surface; what is in front of it is known.
    front = jnp.maximum(jnp.minimum(found.k * search.dt, rays.length), jnp.where(reached.on, reached.u, 0.0))
    back = jnp.maximum(front, jnp.minimum((found.k + 1) * search.dt, rays.length))
    return _Brackets(front, back, found.side, rises, there, found.k, found.steps, found.s, found.ahead)


class _Enclosed(NamedTuple):
    """A bracket that is made smaller: its ends, by how much the scalar is below the isovalue at the front, negative, and above it at the
    back, positive (both with the sign of the crossing; `below` no number until it is sampled); how much of the length that bisection would
    leave is not used up (`room`)."""

    front: Float[Array, "rays"]
    back: Float[Array, "rays"]
    below: Float[Array, "rays"]
    above: Float[Array, "rays"]
    room: Float[Array, "rays"]
    steps: Int[Array, "rays"]


class _Crossing(NamedTuple):
    """What a bracket is made smaller by: the ray, the isovalue, and the sign of the crossing."""

    rays: Rays
    value: Float[Array, "rays"]
    sign: Float[Array, "rays"]
    bracket: _Brackets


def _enclosed(search: Search, rays: Rays, found: _Brackets) -> tuple[Float[Array, "rays"], Int[Array, "rays"]]:
    """The distance of each crossing, and how many samples that took."""
    least = search.tolerance
    halvings = jnp.maximum(jnp.ceil(jnp.log2(search.dt / (2 * least))), 0.0)
    tiny = jnp.finfo(rays.length.dtype).tiny
    sign = jnp.where(found.rises, 1.0, -1.0).astype(rays.length.dtype)
    crossing = _Crossing(rays, search.values[jnp.clip(found.surface, 0, search.values.size - 1)], sign, found)
    excess = lambda crossing, s: crossing.sign * (s - crossing.value)

    def begin(crossing: _Crossing) -> _Enclosed:
        bracket = crossing.bracket
        # Which side either end is on is known; rounding has no say in it.
        below = jnp.minimum(excess(crossing, bracket.s), -tiny)
        above = jnp.maximum(excess(crossing, bracket.ahead), tiny)
        # The step that samples the front takes its part of the room as well.
        room = 2.0 ** (halvings + 2) * least * jnp.where(jnp.isnan(below), 2.0, 1.0)
        return _Enclosed(bracket.front, bracket.back, below, above, room, jnp.zeros_like(bracket.k))

    def alive(_: _Crossing, state: _Enclosed) -> Bool[Array, "rays"]:
        return (jnp.isnan(state.below) | (state.back - state.front > 2 * least)) & (state.room > least / 4)

    def advance(crossing: _Crossing, state: _Enclosed, _: None) -> tuple[_Enclosed, None]:
        on, width = alive(crossing, state), state.back - state.front
        starts = jnp.isnan(state.below)
        u = jnp.where(starts, state.front, _between(state, width, search.dt))
        found = excess(crossing, search.sample(crossing.rays, u)[0])
        low = starts | (found < 0)
        move = lambda where, new, old: jnp.where(on & where, new, old)
        front, below = move(low, u, state.front), move(low, jnp.minimum(found, -tiny), state.below)
        back, above = move(~low, u, state.back), move(~low, jnp.maximum(found, tiny), state.above)
        return _Enclosed(front, back, below, above, jnp.where(on, state.room / 2, state.room), state.steps + on), None

    def finish(state: _Enclosed) -> tuple[Float[Array, "rays"], Int[Array, "rays"]]:
        return _secant(state), state.steps

    (u, steps), _ = wavefront_while(alive, advance, begin, finish, crossing, None, found.there.astype(jnp.int32), IDLE_ENCLOSED)
    return u, steps


def _secant(state: _Enclosed) -> Float[Array, "rays"]:
    """Where a straight line between the ends of a bracket crosses."""
    fraction = state.below / (state.below - state.above)
    return state.front + jnp.clip(fraction, 0.0, 1.0) * (state.back - state.front)


def _between(state: _Enclosed, width: Float[Array, "rays"], dt: Scalar) -> Float[Array, "rays"]:
    """Where to look next: at the secant's crossing, moved towards the middle by a little, and by as much as bisection's pace asks for."""
    middle, secant = state.front + width / 2, _secant(state)
    towards, distance = jnp.sign(middle - secant), jnp.abs(middle - secant)
    truncation = 0.05 * jnp.square(width) / dt
    truncated = jnp.where(truncation <= distance, secant + towards * truncation, middle)
    radius = jnp.maximum(state.room - width / 2, 0.0)
    return jnp.where(jnp.abs(truncated - middle) <= radius, truncated, middle - towards * radius)
