"""Adaptive sampling in three dimensions: one slice of the whole picture at a time, front to back (Kraus, Strengert, Klein and Ertl,
"Adaptive sampling in three dimensions for volume rendering on GPUs"; figures and tables below are that paper's).

Samples of all pixels lie on common slices `dt` apart. On slice `k` the levels `l <= l_slice(k)` of a pyramid are visited, from coarse to
fine, `l_slice` being the number of times that 2 divides `k`, at most `levels` (table 1). A pixel of level `l` is `2^l` pixels wide; its
scalar and its wanted distance `d` are synthesised from level `l + 1` and then, where the synthesised `d` is below `2^(l + 1)`, sampled.
A pixel is visited only where the `d` of its last visit is below `2^(l_slice + 1)`. The finest level is accumulated wherever it is
visited, from the last scalar to the new one (figures 3, 5 and 6).

A slice that `2^levels` divides visits every pixel in use, so that what follows depends on nothing in front of it. The `2^levels` slices
from one such slice to the next are a block: a function from samples to emission and optical depth of every pixel, which
`jvr.integrators.slices.adjoint` differentiates as `jvr.march.adjoint` does a segment.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Float, Int

from jvr.integrators.slices.oracle import DistanceField
from jvr.march.compact import for_each, map_selected, write
from jvr.march.sums import Sums, add, join, opacity, opaque_depth, through, transmittance
from jvr.model.volume import Volume
from jvr.numerics import larger, rounded_into, smaller
from jvr.types import Channels, Scalar, Triple

# The number of a slice that no picture has.
NEVER = 2**30


@dataclasses.dataclass(frozen=True)
class SliceOptions:
    """Static choices of adaptive sampling on slices.

    `levels`: of the pyramid above the finest, whose size `width` x `height` is divisible by `2^levels`; `termination`: a pixel ends
    with the first block behind which its transmittance, in every channel, is at most this; `evaluate_segment(shading, (front, back,
    length))`: radiance and optical depth of some segments from the scalars at their ends.
    """

    levels: int
    width: int
    height: int
    termination: float
    evaluate_segment: Callable[[Any, tuple[Array, Array, Array]], tuple[Channels, Channels]]

    @property
    def period(self) -> int:
        """Slices from one that visits every level to the next."""
        return 2**self.levels

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level, with the ring of pixels around the picture that synthesis reads."""
        return (self.height >> level) + 2, (self.width >> level) + 2


class Lattice(NamedTuple):
    """Where the slices cut the rays of every level, rings included.

    - `rays[l]`: a row for each pixel: grid position where `u = 0`, grid displacement per world length, `u` on slice 0, and the largest
      `u`. Rays that meet the volume have `u = 0` where they enter and end where they leave; samples are clamped to that.
    - `first`, `last`: for each pixel of the finest level the last slice in front of its entry and the first one behind its exit;
      `NEVER` and -1 where there is nothing to accumulate.
    - `unit`, `unit_slope`: `d` is measured in `max(dt, unit + k * unit_slope)`, the distance between slices or between neighbouring
      pixels on slice `k`, whichever is larger.
    """

    rays: tuple[Float[Array, "_ 8"], ...]
    first: Int[Array, "pixels"]
    last: Int[Array, "pixels"]
    unit: Scalar
    unit_slope: Scalar


class Sliced(NamedTuple):
    """What is marched through: `shading` is what `SliceOptions.evaluate_segment` needs to know. Detached: `distances`."""

    volume: Volume
    shading: Any
    lattice: Lattice
    dt: Scalar
    distances: DistanceField


class Level(NamedTuple):
    """Scalar of every pixel of a level, and the distance that it wants, in units of the lattice."""

    s: Float[Array, "pixels"]
    d: Float[Array, "pixels"]


Pyramid = tuple[Level, ...]
# For each level, a number for each of its pixels.
Taps = tuple[Float[Array, "*slices _"], ...]


class Gathered(NamedTuple):
    """What pixels gathered in a block: radiance and, behind it, opacity-weighted distance from the entry (a channel for each of
    `dtau`), both as they leave its front; optical depth; the number of segments."""

    emitted: Channels
    dtau: Channels
    steps: Int[Array, "pixels"]


class End(NamedTuple):
    """How far all pixels have come: sums with the distance among the radiance, segments, the last slice that each pixel is in use
    on, and the samples taken on each level."""

    sums: Sums
    steps: Int[Array, "pixels"]
    ended: Int[Array, "pixels"]
    samples: Int[Array, "levels"]


def march_slices(options: SliceOptions, slices: Sliced) -> End:
    """Accumulates all slices, front to back, until every pixel has left the volume or is opaque."""
    ended = -(-slices.lattice.last // options.period) * options.period
    pyramid, _, samples = take_slice(
        options, slices, ended, jnp.int32(0), blank_pyramid(options, slices.dt), no_taps(options, slices.dt)
    )

    def block(carry: tuple[Array, Pyramid, End]) -> tuple[Array, Pyramid, End]:
        base, pyramid, end = carry
        pyramid, gathered, samples = take_block(
            options, slices, end.ended, base, pyramid, no_taps(options, slices.dt, options.period)
        )
        sums = add_block(end.sums, gathered)
        ended = jnp.where(_is_opaque(options, sums), jnp.minimum(end.ended, base + options.period), end.ended)
        return base + options.period, pyramid, End(sums, end.steps + gathered.steps, ended, end.samples + samples)

    start = (jnp.int32(0), pyramid, End(blank_sums(options, slices), jnp.zeros_like(ended), ended, samples))
    return jax.lax.while_loop(lambda carry: unvmap_any(carry[2].ended > carry[0]), block, start)[2]


def take_block(
    options: SliceOptions, slices: Sliced, ended: Int[Array, "pixels"], base: Int[Array, ""], pyramid: Pyramid, taps: Taps
) -> tuple[Pyramid, Gathered, Int[Array, "levels"]]:
    """The slices `base + 1 ... base + 2^levels`, from the pyramid that slice `base` left, `base` a multiple of `2^levels`.

    `taps[l][r - 1]` is added to the samples of slice `base + r`. Differentiable in `pyramid`, `taps`, `slices.shading`, and in
    `slices.lattice.rays` and `slices.dt` as far as lengths of segments go; samples themselves are constants here.
    """
    lattice, blank = slices.lattice, jnp.zeros_like(pyramid[0].s)
    # Pixels that come into use with the last slice have no segment in this block.
    begun = start_of(options, lattice) <= base
    emits, absorbs = channel_counts(options, slices)

    def one(carry: Any, now: tuple[Array, Taps]) -> tuple[Any, Any]:
        pyramid, before, k_before, gathered = carry
        r, taps = now
        pyramid, visited, samples = take_slice(options, slices, ended, base + r, pyramid, taps)
        mask, s = visited & begun, pyramid[0].s
        u0, u1 = (distance(lattice.rays[0], k, slices.dt) for k in (k_before, (base + r).astype(blank.dtype)))
        added: Any = map_selected(options.evaluate_segment, mask, slices.shading, (before, s, u1 - u0))
        emitted, dtau = added
        weights = opacity((jnp.ones_like(blank),) * absorbs, dtau)
        emitted = (*emitted, *(a * (u0 + u1) / 2 for a in weights))
        clear = tuple(jnp.exp(-tau) for tau in gathered.dtau)
        gathered = Gathered(
            tuple(e + more for e, more in zip(gathered.emitted, through(clear, emitted), strict=True)),
            tuple(tau + more for tau, more in zip(gathered.dtau, dtau, strict=True)),
            gathered.steps + (mask & (u1 > u0)),
        )
        k_before = jnp.where(mask, (base + r).astype(blank.dtype), k_before)
        return (pyramid, jnp.where(mask, s, before), k_before, gathered), samples

    gathered = Gathered((blank,) * (emits + absorbs), (blank,) * absorbs, jnp.zeros(blank.shape, jnp.int32))
    carry = (pyramid, pyramid[0].s, jnp.full_like(blank, base), gathered)
    numbers = jnp.arange(1, options.period + 1, dtype=jnp.int32)
    (pyramid, _, _, gathered), samples = jax.lax.scan(one, carry, (numbers, taps))
    return pyramid, gathered, jnp.sum(samples, axis=0, dtype=jnp.int32)


def take_slice(
    options: SliceOptions, slices: Sliced, ended: Int[Array, "pixels"], k: Int[Array, ""], pyramid: Pyramid, taps: Taps
) -> tuple[Pyramid, Bool[Array, "pixels"], Int[Array, "levels"]]:
    """The pyramid as slice `k` leaves it (figure 3), the pixels of the finest level that it visits, and the number of samples that it
    takes on each level; `taps` are added to them."""
    lattice, top, whole = slices.lattice, slice_level(options, k), k % options.period == 0
    pixel = lattice.unit + k * lattice.unit_slope
    active = in_use(options, lattice, k - k % options.period, ended)
    # In front of the entry all samples are clamped to it; the first visit has taken that one.
    behind = jnp.where(whole, start_of(options, lattice) <= k, lattice.first < k)
    # Behind its exit a pixel is visited once more at most: its last visit in front may have wanted none before the block ends.
    active = (behind & (k <= jnp.where(whole, ended, jnp.minimum(ended, lattice.last))), *active[1:])

    def visit(level: int, coarser: Level | None, stored: Level) -> tuple[Level, Array, Array]:
        visited = active[level] & (whole | (stored.d < 2 ** (top + 1)))
        s, d = stored
        if coarser is None:
            sampled = visited
        else:
            is_synthesised = visited & (level < top)
            fine = lambda old, coarse: jnp.where(
                is_synthesised, synthesise(coarse.reshape(options.shape(level + 1))).ravel(), old
            )
            s, d = fine(s, coarser.s), fine(d, coarser.d)
            sampled = visited & (d < 2 ** (level + 1))
        found = _sample(slices, lattice.rays[level], k, pixel, sampled)
        s, d = jnp.where(sampled, found.s + taps[level], s), jnp.where(sampled, found.d, d)
        return Level(s, d), visited, jnp.sum(sampled, dtype=jnp.int32)

    levels, counts, visited = list(pyramid), [jnp.int32(0)] * len(pyramid), active[0]
    for level in range(options.levels, -1, -1):
        refresh = functools.partial(visit, level, levels[level + 1] if level < options.levels else None)
        keep = lambda stored, level=level: (stored, jnp.zeros_like(active[level]), jnp.int32(0))
        # The finest level is on every slice.
        result = refresh(levels[0]) if level == 0 else jax.lax.cond(level <= top, refresh, keep, levels[level])
        levels[level], visited, counts[level] = result
    return tuple(levels), visited, jnp.stack(counts)


def _sample(slices: Sliced, rays: Float[Array, "n 8"], k: Int[Array, ""], pixel: Scalar, mask: Bool[Array, "n"]) -> Level:
    """Scalar and wanted distance of the pixels of a level that are sampled."""
    volume, rays, dt, distances, pixel = jax.lax.stop_gradient((slices.volume, rays, slices.dt, slices.distances, pixel))
    unit = jnp.maximum(dt, pixel)

    def body(index: Array, valid: Array, rows: Array, values: Level) -> Level:
        p = position(rows, k, dt, volume.shape)
        s, d = jax.vmap(volume.sample)(p), distances.at(p, pixel) / unit
        return Level(write(values.s, index, valid, s), write(values.d, index, valid, d))

    blank = jnp.zeros(mask.size, dt.dtype)
    return for_each(mask, lambda index: rays[index], body, Level(blank, blank))


def slice_level(options: SliceOptions, k: Int[Array, ""]) -> Int[Array, ""]:
    """`l_slice` of slice `k` (table 1): how often 2 divides it, at most `levels`."""
    r = k % options.period
    return jnp.where(r == 0, options.levels, 31 - jax.lax.clz(r & -r))


def synthesise(coarse: Float[Array, "h w"]) -> Float[Array, "h2 w2"]:
    """A level of the pyramid from the next coarser one, both with their rings: `(h, w)` becomes `(2 h - 2, 2 w - 2)`.

    Figure 5: a pixel is 3/4 of the coarse pixel that it lies in plus 1/4 of the next nearest, in rows and in columns; the subdivision
    of biquadratic B-splines. Linear functions are reproduced, up to the border too, where the ring stands for what lies outside.
    """
    for axis in (0, 1):
        a, b = (jax.lax.slice_in_dim(coarse, i, coarse.shape[axis] - 1 + i, axis=axis) for i in (0, 1))
        fine = jnp.stack([0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b], axis=axis + 1)
        coarse = fine.reshape(-1, fine.shape[-1]) if axis == 0 else fine.reshape(fine.shape[0], -1)
    return coarse


def start_of(options: SliceOptions, lattice: Lattice) -> Int[Array, "pixels"]:
    """The first slice that each pixel of the finest level is in use on: the last one in front of its entry that visits all levels."""
    return lattice.first // options.period * options.period


def in_use(
    options: SliceOptions, lattice: Lattice, base: Int[Array, ""], ended: Int[Array, "pixels"]
) -> tuple[Bool[Array, "_"], ...]:
    """The pixels of each level that are in use from slice `base` on, a multiple of `2^levels`: on the finest level those that are
    to be accumulated, on coarser ones those that pixels in use are synthesised from."""
    levels = [((start_of(options, lattice) <= base) & (ended >= base)).reshape(options.shape(0))]
    for _ in range(options.levels):
        levels.append(_parents(levels[-1]))
    return tuple(level.ravel() for level in levels)


def _parents(fine: Bool[Array, "h w"]) -> Bool[Array, "h2 w2"]:
    """The pixels of the next coarser level that any selected pixel is synthesised from: column `X` serves `2 X - 1 ... 2 X + 2`."""
    padded = jnp.pad(fine, 2)
    for axis in (0, 1):
        padded = jnp.moveaxis(padded, axis, 0)
        pairs = padded[0::2] | padded[1::2]
        padded = jnp.moveaxis(pairs[:-1] | pairs[1:], 0, axis)
    return padded


def position(rows: Float[Array, "block 8"], k: Int[Array, ""], dt: Scalar, shape: tuple[int, int, int]) -> Triple:
    """Grid positions of samples on slice `k`, clamped to where each ray is inside."""
    u = distance(rows, k, dt)
    p = [rows[:, i] + u * rows[:, 3 + i] for i in range(3)]
    # Rays that miss are sampled for the sake of their neighbours, at the nearest point. Rays that hit are moved by a rounding, which
    # must not cost their derivative.
    bounds = [(0.0, n - 1.0) if n > 1 else (-0.5, 0.5) for n in shape]
    return tuple(rounded_into(x, low, high) for x, (low, high) in zip(p, bounds, strict=True))


def distance(rows: Float[Array, "block 8"], k: Array, dt: Scalar) -> Float[Array, "block"]:
    """`u` on slice `k`."""
    return smaller(larger(rows[:, 6] + k * dt, 0.0), rows[:, 7])


def add_block(sums: Sums, gathered: Gathered) -> Sums:
    """One step of front-to-back compositing."""
    before = transmittance(sums.tau, sums.tau_low)
    radiance = add(sums.radiance, sums.radiance_low, through(before, gathered.emitted))
    return Sums(*radiance, *add(sums.tau, sums.tau_low, gathered.dtau), ())


def blank_sums(options: SliceOptions, slices: Sliced) -> Sums:
    """Sums of pixels that have gathered nothing."""
    emits, absorbs = channel_counts(options, slices)
    blank = jnp.zeros(slices.lattice.first.shape, slices.dt.dtype)
    return Sums((blank,) * (emits + absorbs), (blank,) * (emits + absorbs), (blank,) * absorbs, (blank,) * absorbs, ())


def channel_counts(options: SliceOptions, slices: Sliced) -> tuple[int, int]:
    """How many channels the medium emits and absorbs in, by shape alone."""
    one = jax.ShapeDtypeStruct((1,), slices.dt.dtype)
    emitted, dtau = jax.eval_shape(options.evaluate_segment, slices.shading, (one, one, one))
    return len(emitted), len(dtau)


def blank_pyramid(options: SliceOptions, dt: Scalar) -> Pyramid:
    """Zeros: a slice that `2^levels` divides reads nothing of what was before."""
    return tuple(Level(zero, zero) for zero in no_taps(options, dt))


def no_taps(options: SliceOptions, dt: Scalar, *slices: int) -> Taps:
    """Zeros for every sample of a slice, or of some slices."""
    return tuple(jnp.zeros((*slices, math.prod(options.shape(level))), dt.dtype) for level in range(options.levels + 1))


def _is_opaque(options: SliceOptions, sums: Sums) -> Bool[Array, "pixels"] | bool:
    """Whether nothing behind can be seen."""
    if not sums.tau:
        return False
    thinnest = functools.reduce(jnp.minimum, join(sums.tau, sums.tau_low))
    bound = -math.log(options.termination) if options.termination > 0 else math.inf
    return thinnest >= min(bound, opaque_depth(thinnest.dtype))
