"""Reverse mode through a march, by replaying it.

The march is walked a second time, front to back. With `R` the radiance still to come, `R <- R - T e` at each segment, and

    dL/de = T,    dL/d(dtau) = -R  (after the segment),    d(tau)/d(dtau) = 1,

so that no state is stored for any step and nothing is divided by a transparency that may be zero. What a segment's `e` and `dtau`
depend on is left to automatic differentiation of that one segment. `R` starts from the unevaluated two-float sum of the forward
march: in plain floats, entries deep behind a bright front would be lost in its rounding.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.march.batch import shrinking_while
from jvr.march.march import (
    Lanes,
    Marched,
    MarchOptions,
    Medium,
    Sums,
    add_segment,
    add,
    integrate,
    join,
    march,
    marched,
    opacity,
    through,
    transmittance,
)
from jvr.march.steps import Rays, points_at, segment, segment_count
from jvr.march.table import deposit_entries, split_entries
from jvr.types import Channels, Scalar


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def replay_march(options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> Marched:
    return march(options, medium, rays, dt)


def _replay_forward(options: MarchOptions, *arguments: Any):
    is_primal = lambda x: isinstance(x, jax.custom_derivatives.CustomVJPPrimal)
    inputs = jax.tree.map(lambda x: x.value, arguments, is_leaf=is_primal)
    perturbed = jax.tree.map(lambda x: x.perturbed and eqx.is_inexact_array(x.value), arguments, is_leaf=is_primal)
    sums, steps = integrate(options, *inputs)
    # What is perturbed is known by which half of the inputs a leaf is in: a None in `wanted` asks for no derivative.
    wanted, fixed = eqx.partition(inputs, perturbed)
    return marched(sums, steps), (wanted, fixed, sums, steps)


def _replay_backward(options: MarchOptions, residuals: Any, cotangent: Marched):
    wanted, fixed, sums, steps = residuals
    is_zero = lambda x: isinstance(x, jax.custom_derivatives.SymbolicZero)
    if all(map(is_zero, cotangent.distance)):
        # Nobody asks for the derivative of the distance: it is then not replayed either.
        cotangent, sums = cotangent._replace(distance=()), sums._replace(distance=(), distance_low=())
    cotangent = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype) if is_zero(x) else x, cotangent, is_leaf=is_zero)
    return replay(wanted, fixed, sums, steps, cotangent._replace(steps=None))


replay_march.defvjp(_replay_forward, _replay_backward, symbolic_zeros=True)

Inputs = tuple[Medium, Rays, Scalar]


class _ReplayLanes(NamedTuple):
    """A ray while it is replayed: `lanes.sums` runs forward again, `remaining` is what is still to come (its radiance and distance;
    optical depth is not used), `gradient` is with respect to the ray."""

    lanes: Lanes
    remaining: Sums
    cotangent: Marched
    gradient: Any


class _Gradients(NamedTuple):
    """Gradients shared by all rays, and the index of the next segment."""

    medium: Any
    dt: Any
    k: Int[Array, ""]


def replay(wanted: Any, fixed: Any, sums: Sums, steps: Int[Array, "rays"], cotangent: Marched) -> Any:
    """The gradient of `<cotangent, march>` with respect to the leaves of `wanted` that are not `None`.

    **Arguments:** `wanted`, `fixed`: the march's inputs, each leaf in one of them; `sums`, `steps`: what the forward march ended with.
    """
    medium, rays, dt = eqx.combine(wanted, fixed)
    zeros = functools.partial(jax.tree.map, jnp.zeros_like)
    # Only the transmittance is needed on the way; radiance and distance are known from the forward march.
    depths = zeros(Sums((), (), sums.tau, sums.tau_low, (), ()))
    lanes = Lanes(rays, jnp.arange(steps.size, dtype=jnp.int32), segment_count(rays.length, dt), depths, steps)

    def alive(state: _ReplayLanes, total: _Gradients):
        return total.k < state.lanes.steps

    def advance(state: _ReplayLanes, total: _Gradients):
        return _replay_segment(medium, dt, state, total)

    start = _ReplayLanes(lanes, sums._replace(tau=(), tau_low=()), cotangent, zeros(wanted[1]))
    final, total = shrinking_while(alive, advance, start, _Gradients(zeros(wanted[0]), zeros(wanted[2]), jnp.int32(0)))
    return total.medium, final.gradient, total.dt


def _replay_segment(medium: Medium, dt: Scalar, state: _ReplayLanes, total: _Gradients):
    lanes, k = state.lanes, total.k
    count = jnp.where(k < lanes.steps, lanes.count, 0)
    # Entries of a table are not among `small`: automatic differentiation would scatter each column by itself.
    rest_of_transfer, entries = split_entries(total.medium.transfer)
    small_mask = is_there((rest_of_transfer, total.medium.shader, state.gradient, total.dt))
    small, rest = eqx.partition((medium.transfer, medium.shader, lanes.rays, dt), small_mask)

    def local(small: Any, tap: Array, classified_tap: Any):
        """The segment as a function of what its derivative is wanted for; taps stand for the field and the table's entries."""
        transfer, shader, rays, dt = eqx.combine(small, rest)
        extent, u = segment(k, count, rays.length, dt)
        points = points_at(rays, lanes.ray, k, u)
        s = jax.vmap(medium.field.resample)(points) + tap
        classified = jax.tree.map(jnp.add, jax.vmap(transfer.evaluate)(s), classified_tap)
        return (*jax.vmap(shader.segment)(classified, points, extent), u), (points, s)

    no_tap = jnp.zeros_like(lanes.rays.length)
    classified = jax.eval_shape(jax.vmap(medium.transfer.evaluate), no_tap)
    no_taps = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), classified)
    (emitted, dtau, u), pull, (points, s) = jax.vjp(local, small, no_tap, no_taps, has_aux=True)

    before = transmittance(lanes.sums)
    remaining = subtract_segment(state.remaining, through(before, emitted), opacity(before, dtau), u)
    cotangents = segment_cotangents(state.cotangent, remaining, before, dtau, u)
    small_gradient, s_cotangent, entry_cotangent = pull(cotangents)

    rest_of_transfer, shader, ray_gradient, dt_gradient = jax.tree.map(
        jnp.add, (rest_of_transfer, total.medium.shader, state.gradient, total.dt), small_gradient
    )
    entries = deposit_entries(entries, medium.transfer, s, entry_cotangent)
    field = medium.field.deposit(total.medium.field, points, s_cotangent)
    medium_gradient = Medium(field, eqx.combine(rest_of_transfer, entries), shader)
    lanes = lanes._replace(sums=add_segment(lanes.sums, (), dtau, u))
    return _ReplayLanes(lanes, remaining, state.cotangent, ray_gradient), _Gradients(medium_gradient, dt_gradient, k + 1)


def is_there(tree: Any) -> Any:
    """Which leaves of a tree are not `None`."""
    return jax.tree.map(lambda leaf: leaf is not None, tree, is_leaf=lambda leaf: leaf is None)


def subtract_segment(remaining: Sums, emitted: Channels, opacities: Channels, u: Float[Array, "rays"]) -> Sums:
    """What is still to come after a segment."""
    radiance = add(remaining.radiance, remaining.radiance_low, tuple(-e for e in emitted))
    nearer = tuple(-a * u for a in opacities) if remaining.distance else ()
    return Sums(*radiance, (), (), *add(remaining.distance, remaining.distance_low, nearer))


def segment_cotangents(cotangent: Marched, remaining: Sums, before: Channels, dtau: Channels, u: Float[Array, "rays"]):
    """Cotangents of one segment's emission, optical depth and distance (the equations at the top of this file)."""
    to_come = [-g * r for g, r in zip(cotangent.radiance, join(remaining.radiance, remaining.radiance_low), strict=True)]
    n = len(dtau)
    to_dtau = [sum(to_come[c::n], cotangent.tau[c]) for c in range(n)]
    to_u = jnp.zeros_like(u)
    for c, (g, r) in enumerate(zip(cotangent.distance, join(remaining.distance, remaining.distance_low), strict=True)):
        to_dtau[c] += g * (u * before[c] * jnp.exp(-dtau[c]) - r)
        to_u += g * opacity(before, dtau)[c]
    return through(before, cotangent.radiance), tuple(to_dtau), to_u
