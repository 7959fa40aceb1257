"""Reverse mode through adaptive sampling on slices (`jvr.integrators.slices.march`), by replaying it.

Blocks of slices are walked a second time, front to back. With `T` the transmittance in front of a block, `E` and `dtau` its emission and
optical depth, and `R` the radiance that reaches the eye from behind it, which is the whole radiance less what was gathered so far,

    dL/dE = T,    dL/d(dtau) = -R.

What `E` and `dtau` depend on is left to automatic differentiation of that one block, with the samples taken as they are; the cotangents
that arrive at samples are then deposited in the voxels. Sums are those of two floats; still, entries deep behind a bright front are
right to rounding of the radiance as a whole only (`jvr.march.adjoint` keeps more digits).

Memory: what one block of `2^levels` slices keeps, about 100 bytes for each pixel and slice of it; nothing grows with their number.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any
from jaxtyping import Array, Bool, Float, Int

from jvr.integrators.slices.march import (
    End,
    Gathered,
    Sliced,
    SliceOptions,
    Taps,
    add_block,
    blank_pyramid,
    blank_sums,
    march_slices,
    no_taps,
    position,
    slice_level,
    take_block,
    take_slice,
)
from jvr.march.adjoint import is_there
from jvr.march.compact import accumulate, for_each
from jvr.march.fields import VoxelField
from jvr.march.march import Marched
from jvr.march.rules import values, wanted_and_fixed, with_zeros
from jvr.march.steps import Point, Sample
from jvr.march.sums import Sums, join, through, transmittance
from jvr.types import Channels


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def replay_slices(options: SliceOptions, slices: Sliced) -> tuple[Marched, Int[Array, "pixels"], Int[Array, "levels"]]:
    """What the pixels gather from all slices, the last slice that each is in use on, and the samples taken on each level.

    Differentiable in reverse mode in volume, shading, `lattice.rays` and `dt`. Detached: which samples are taken, and where pixels end.
    """
    return _marched(march_slices(options, slices))


def _marched(end: End) -> tuple[Marched, Int[Array, "pixels"], Int[Array, "levels"]]:
    radiance, tau = join(end.sums.radiance, end.sums.radiance_low), join(end.sums.tau, end.sums.tau_low)
    emits = len(radiance) - len(tau)
    return Marched(radiance[:emits], tau, radiance[emits:], end.steps), end.ended, end.samples


def _replay_forward(options: SliceOptions, slices: Any):
    inputs, (wanted, fixed) = values(slices), wanted_and_fixed(slices)
    end = march_slices(options, inputs)
    return _marched(end), (wanted._replace(distances=None), fixed, inputs.distances, end)


def _replay_backward(options: SliceOptions, residuals: Any, cotangents: Any):
    wanted, fixed, distances, end = residuals
    slices = eqx.combine(wanted._replace(distances=distances), fixed)
    return (replay(options, slices, wanted, end, with_zeros(cotangents[0])),)


replay_slices.defvjp(_replay_forward, _replay_backward, symbolic_zeros=True)


def replay(options: SliceOptions, slices: Sliced, wanted: Any, end: End, cotangent: Marched) -> Any:
    """The gradient of `<cotangent, march>` with respect to the leaves of `wanted` that are not `None`."""
    to_sums = (*cotangent.radiance, *cotangent.distance)

    def block(carry: tuple[Array, Sums, Any]) -> tuple[Array, Sums, Any]:
        base, before, gradient = carry
        gathered, pull = _block(options, slices, wanted, end.ended, base)
        after = add_block(before, gathered)
        behind = [
            g * ((total - now) + (low - now_low))
            for g, total, low, now, now_low in zip(
                to_sums, end.sums.radiance, end.sums.radiance_low, after.radiance, after.radiance_low, strict=True
            )
        ]
        n = len(gathered.dtau)
        to_dtau = tuple(cotangent.tau[c] - sum(behind[c::n], jnp.zeros_like(end.sums.tau[c])) for c in range(n))
        (shading, rays, dt), taps = pull((through(transmittance(before.tau, before.tau_low), to_sums), to_dtau))
        plus = functools.partial(jax.tree.map, jnp.add)
        lattice = gradient.lattice._replace(rays=(plus(gradient.lattice.rays[0], rays), *gradient.lattice.rays[1:]))
        gradient = gradient._replace(shading=plus(gradient.shading, shading), lattice=lattice, dt=plus(gradient.dt, dt))
        return base + options.period, after, _deposit(options, slices, base, taps, gradient)

    start = (jnp.int32(0), blank_sums(options, slices), jax.tree.map(jnp.zeros_like, wanted))
    return jax.lax.while_loop(lambda carry: unvmap_any(end.ended > carry[0]), block, start)[2]


def _block(
    options: SliceOptions, slices: Sliced, wanted: Any, ended: Int[Array, "pixels"], base: Int[Array, ""]
) -> tuple[Gathered, Any]:
    """What a block gathers, and the function that pulls cotangents of its emission and optical depth back to shading, rays of the finest
    level and `dt`, as far as they are wanted, and to the samples of slices `base ... base + 2^levels`."""
    small_of = lambda s: (s.shading, s.lattice.rays[0], s.dt)
    small, rest = eqx.partition(small_of(slices), is_there(small_of(wanted)))

    def local(small: Any, taps: Taps) -> tuple[tuple[Channels, Channels], Gathered]:
        shading, rays, dt = eqx.combine(small, rest)
        lattice = slices.lattice._replace(rays=(rays, *slices.lattice.rays[1:]))
        here = slices._replace(shading=shading, lattice=lattice, dt=dt)
        first, others = (tuple(part(tap) for tap in taps) for part in (lambda tap: tap[0], lambda tap: tap[1:]))
        pyramid, _, _ = take_slice(options, here, ended, base, blank_pyramid(options, dt), first)
        _, gathered, _ = take_block(options, here, ended, base, pyramid, others)
        return (gathered.emitted, gathered.dtau), gathered

    _, pull, gathered = jax.vjp(local, small, no_taps(options, slices.dt, options.period + 1), has_aux=True)
    return gathered, pull


def _deposit(options: SliceOptions, slices: Sliced, base: Int[Array, ""], cotangents: Taps, gradient: Any) -> Any:
    """Adds the derivative of the samples of a block to the gradient."""
    if not jax.tree.leaves((gradient.volume, gradient.lattice.rays, gradient.dt)):
        return gradient

    def one(r: Int[Array, ""], gradient: Any) -> Any:
        top = slice_level(options, r)
        for level, cotangent in enumerate(cotangents):
            add_level = functools.partial(_deposit_level, slices, level, base + r)
            gradient = jax.lax.cond(level <= top, add_level, lambda _, total: total, cotangent[r], gradient)
        return gradient

    return jax.lax.fori_loop(jnp.int32(0), jnp.int32(options.period + 1), one, gradient)


def _deposit_level(slices: Sliced, level: int, k: Int[Array, ""], cotangent: Float[Array, "pixels"], gradient: Any) -> Any:
    """Adds the derivative of the samples of one level of a slice. Where the cotangent is zero, as where none was taken, nothing is done."""
    volume, rays = slices.volume, slices.lattice.rays[level]

    def body(index: Int[Array, "block"], valid: Bool[Array, "block"], read: tuple[Array, Array], gradient: Any) -> Any:
        rows, cotangent = read[0], jnp.where(valid, read[1], 0.0)
        point = Point(position(rows, k, slices.dt, volume.shape), (), index, jnp.broadcast_to(k, index.shape))
        field: Any = VoxelField(volume).deposit(VoxelField(gradient.volume), point, Sample(cotangent))
        gradient = gradient._replace(volume=field.volume)
        if gradient.lattice.rays[level] is not None:
            at = lambda rows, dt: jax.vmap(volume.sample)(position(rows, k, dt, volume.shape))
            to_rows, to_dt = jax.vjp(at, rows, slices.dt)[1](cotangent)
            totals = [*gradient.lattice.rays]
            totals[level] = accumulate(totals[level], index, valid, to_rows)
            gradient = gradient._replace(lattice=gradient.lattice._replace(rays=tuple(totals)))
            if gradient.dt is not None:
                gradient = gradient._replace(dt=gradient.dt + to_dt)
        return gradient

    return for_each(cotangent != 0, lambda index: (rays[index], cotangent[index]), body, gradient)
