"""The replay adjoint: reverse mode through a march, by replaying it back to front.

The segments of every ray are walked a second time, back to front, so that nothing is stored for a step. With `B` the radiance from
behind a segment as it leaves the next one, `B <- e + exp(-dtau) B`, and `T` the transmittance in front of the segment,

    dL/de = T,    dL/d(dtau) = -T exp(-dtau) B,    d(tau)/d(dtau) = 1.

Nothing is divided by a transparency that may be zero, and nothing is found as the difference of two large numbers: `B` is a sum of
what was emitted, so entries deep behind a bright front keep their digits. (Walking front to back and subtracting each contribution
from the final radiance loses them: the compiler need not round both walks alike.) The optical depth in front of a segment is that in
front of the next one less its own. A segment may be arbitrarily opaque, which would leave no digit of such a difference: the forward
march records, for each channel, the depth in front of the last segment that can be seen through, and differences start there.

What a segment's `e` and `dtau` depend on is left to automatic differentiation of that one segment.

Second derivatives are those of both walks in forward mode (`jax.jvp` of `jax.grad`), in which nothing is stored either.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.march.march import Marched, MarchOptions, ReplayRecord, integrate, march
from jvr.march.medium import Medium, for_derivatives
from jvr.march.rules import is_zero, skipping, wanted_and_fixed, with_zeros
from jvr.march.segments import ActiveRays, SegmentBatch, active_rays, node_points, occupied_count, resample, with_lighting
from jvr.march.steps import Rays, Sample, points_at, segment_span
from jvr.march.sums import opacity, through, transmittance
from jvr.march.wavefront import wavefront_while
from jvr.numerics import materialise, one_minus_exp, two_sum
from jvr.types import Channels, Scalar

# What a derivative of a gradient is taken by.
FORWARDS = (
    "second derivatives are taken forwards: use jax.jvp(jax.grad(loss), (x,), (v,)) in place of a gradient of jax.grad(loss)"
)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def replay_march(options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> Marched:
    return march(options, medium, rays, dt)


def _replay_forward(options: MarchOptions, *arguments: Any):
    wanted, fixed = wanted_and_fixed(arguments)
    gathered, record = _integrate(options, *eqx.combine(wanted, fixed))
    return gathered, (wanted, fixed, record)


def _replay_backward(options: MarchOptions, residuals: Any, cotangent: Marched):
    if all(map(is_zero, cotangent.distance)):
        # Nobody asks for the derivative of the distance: it is then not replayed either.
        cotangent = cotangent._replace(distance=())
    wanted, fixed, record = residuals
    return _replay(None, wanted, fixed, record, with_zeros(cotangent)._replace(steps=None))


_integrate = skipping(functools.partial(integrate, for_replay=True), FORWARDS)
_replay = skipping(lambda _, *arguments: replay(*arguments), FORWARDS)
replay_march.defvjp(_replay_forward, _replay_backward, symbolic_zeros=True)


Inputs = tuple[Medium, Rays, Scalar]


class SuffixRadiance(NamedTuple):
    """The suffix of a ray behind a segment: radiance and opacity-weighted distance as they leave the next segment, and the optical depth
    from the entry to there as a sum of two floats."""

    radiance: Channels
    distance: Channels
    tau: Channels
    tau_low: Channels


class BackwardRays(NamedTuple):
    """Rays of a wavefront that are walked backwards, from segment `steps - 1` on; `front` and `last` are those of the forward march's
    `ReplayRecord`."""

    active: ActiveRays
    steps: Int[Array, "rays"]
    front: Channels
    last: tuple[Int[Array, "rays"], ...]

    def at(self, j: Int[Array, "rays"]) -> tuple[Int[Array, "rays"], Int[Array, "rays"]]:
        """The index of the `j`-th segment from the back, and the number of segments, 0 for rays that are done."""
        return jnp.maximum(self.steps - 1 - j, 0), jnp.where(j < self.steps, self.active.segments, 0)

    def skip(self, medium: Medium, dt: Scalar, j: Int[Array, "rays"]) -> Int[Array, "rays"]:
        """The next segment from the back, from the `j`-th on, whose midpoint may lie in a visible brick, or the number of them."""
        if medium.occupancy is None:
            return j
        rays = self.active.rays
        extent, u = segment_span(jnp.maximum(self.steps - 1 - j, 0), self.active.segments, rays.length, dt)
        within = len(medium.shader.quadrature_nodes) > 1
        first = u + extent / 2 if within else u
        return jnp.minimum(j + medium.occupancy.skip(rays, first, dt, backwards=True, within=within), self.steps)

    def empty_suffix(self, emits: int, *, distance: bool) -> SuffixRadiance:
        """The suffix behind the last segment."""
        zero = jnp.zeros_like(self.active.rays.length)
        blank = (zero,) * len(self.front)
        return SuffixRadiance((zero,) * emits, blank * distance, self.front, blank)

    def depth(self, j: Int[Array, "rays"], suffix: SuffixRadiance, dtau: Channels) -> tuple[Channels, Channels]:
        """Optical depth in front of the `j`-th segment from the back, whose own is `dtau`: infinite where nothing behind can be seen,
        given where the forward march has recorded it, else that in front of the next segment less its own."""
        k, channels = self.steps - 1 - j, []
        for front, last, high, low, d in zip(self.front, self.last, suffix.tau, suffix.tau_low, dtau, strict=True):
            # What was recorded holds in front of segment `last` and, where that was skipped, behind the first one that is reached.
            first = jnp.isinf(high)
            high, low = jnp.where(first, front, high), jnp.where(first, 0.0, low)
            high, low = two_sum(high, low, jnp.where(k < last, -d, 0.0))
            channels.append((jnp.where(k > last, jnp.inf, high), jnp.where(k > last, 0.0, low)))
        return tuple(high for high, _ in channels), tuple(low for _, low in channels)


def step_back(
    suffix: SuffixRadiance, front: tuple[Channels, Channels], emitted: Channels, dtau: Channels, u: Float[Array, "rays"]
) -> SuffixRadiance:
    """The suffix behind the segment in front."""
    clear = tuple(jnp.exp(-d) for d in dtau)
    radiance = tuple(e + b for e, b in zip(emitted, through(clear, suffix.radiance), strict=True))
    distance = tuple(one_minus_exp(d) * u + c * b for d, c, b in zip(dtau, clear, suffix.distance, strict=False))
    return SuffixRadiance(radiance, distance, *front)


def segment_cotangents(cotangent: Marched, suffix: SuffixRadiance, before: Channels, dtau: Channels, u: Float[Array, "rays"]):
    """Cotangents of one segment's emission, optical depth and distance (the equations at the top of this file)."""
    after = tuple(T * jnp.exp(-d) for T, d in zip(before, dtau, strict=True))
    pulled = [-g * b for g, b in zip(cotangent.radiance, through(after, suffix.radiance), strict=True)]
    n = len(dtau)
    to_dtau = [sum(pulled[c::n], cotangent.tau[c]) for c in range(n)]
    to_u = jnp.zeros_like(u)
    for c, (g, b) in enumerate(zip(cotangent.distance, suffix.distance, strict=True)):
        to_dtau[c] += g * after[c] * (u - b)
        to_u += g * opacity(before, dtau)[c]
    return through(before, cotangent.radiance), tuple(to_dtau), to_u


class _ReplayState(NamedTuple):
    """The suffix of a ray, how many segments were replayed, and the gradient with respect to the ray."""

    suffix: SuffixRadiance
    j: Int[Array, "rays"]
    gradient: Any


class _Gradients(NamedTuple):
    """Gradients shared by all rays."""

    medium: Any
    dt: Any


def replay(wanted: Any, fixed: Any, record: ReplayRecord, cotangent: Marched) -> Any:
    """The gradient of `<cotangent, march>` with respect to the leaves of `wanted` that are not `None`.

    **Arguments:** `wanted`, `fixed`: the march's inputs, each leaf in one of them; `record`: by the forward march.
    """
    medium, rays, dt = eqx.combine(wanted, fixed)
    medium = for_derivatives(medium, wanted[0], wanted[1:])
    rays_mask = is_there(wanted[1])
    zeros = functools.partial(jax.tree.map, jnp.zeros_like)

    def start(inputs: tuple[BackwardRays, Marched]) -> _ReplayState:
        back, cotangent = inputs
        suffix = back.empty_suffix(len(cotangent.radiance), distance=bool(cotangent.distance))
        return _ReplayState(suffix, jnp.zeros_like(back.steps), zeros(eqx.filter(back.active.rays, rays_mask)))

    def alive(inputs: tuple[BackwardRays, Marched], state: _ReplayState):
        return state.j < inputs[0].steps

    def advance(inputs: tuple[BackwardRays, Marched], state: _ReplayState, total: _Gradients):
        return _replay_segment(medium, dt, *inputs, state, total)

    inputs = (BackwardRays(active_rays(rays, dt), *record), cotangent)
    total = _Gradients(zeros(wanted[0]), zeros(wanted[2]))
    gradient, total = wavefront_while(alive, advance, start, lambda state: state.gradient, inputs, total, record.following)
    return total.medium, gradient, total.dt


def _replay_segment(medium: Medium, dt: Scalar, back: BackwardRays, cotangent: Marched, state: _ReplayState, total: _Gradients):
    state = state._replace(j=back.skip(medium, dt, state.j))
    active, (k, count) = back.active, back.at(state.j)
    count = occupied_count(medium, active, dt, k, count)
    # The field is not among `small`: it deposits its derivative itself, in place, through the tap.
    small_mask = is_there((total.medium.transfer, total.medium.shader, total.medium.visibility, state.gradient, total.dt))
    small, rest = eqx.partition((medium.transfer, medium.shader, medium.visibility, active.rays, dt), small_mask)

    def local(small: Any, taps: tuple[Sample, ...]):
        """The segment as a function of what its derivative is wanted for; the taps stand for the field."""
        transfer, shader, visibility, rays, dt = eqx.combine(small, rest)
        extent, u = segment_span(k, count, rays.length, dt)
        sampled = node_points(medium, rays, active.ray, k, u, extent)
        samples = jax.tree.map(jnp.add, resample(medium, sampled, k < count), taps)
        batch = SegmentBatch(rays, active.ray, k, u, extent, k < count)
        # Light moves with the extinction, of which it knows as the shader does.
        moved = medium._replace(transfer=transfer, shader=shader, visibility=visibility)
        samples = with_lighting(moved, batch, samples, reverse=True)
        point = points_at(rays, active.ray, k, u)
        found = jax.vmap(shader.evaluate_segment, in_axes=(None, 0, 0, 0))(transfer, samples, point, extent)
        return (*materialise(k < count, found), u), sampled

    (emitted, dtau, u), pull, sampled = jax.vjp(local, small, _no_taps(medium, active.rays), has_aux=True)

    front = back.depth(state.j, state.suffix, dtau)
    before = transmittance(*front)
    small_gradient, cotangents = pull(segment_cotangents(cotangent, state.suffix, before, dtau, u))

    # A ray that is done has no derivative, whatever the voxel that it reads.
    on = state.j < back.steps
    small_gradient = (*small_gradient[:3], jax.tree.map(lambda x: jnp.where(on, x, 0.0), small_gradient[3]), small_gradient[4])
    transfer, shader, visibility, ray_gradient, dt_gradient = jax.tree.map(
        jnp.add, (total.medium.transfer, total.medium.shader, total.medium.visibility, state.gradient, total.dt), small_gradient
    )
    # Else the whole computation of the cotangent is repeated in each of the scattered additions, which then take three times as long.
    cotangents = materialise(on, cotangents)
    field = total.medium.field
    for points, of_sample in zip(sampled, cotangents, strict=True):
        field = medium.field.deposit(field, points, of_sample)
    suffix = step_back(state.suffix, front, emitted, dtau, u)
    state = _ReplayState(suffix, state.j + on, ray_gradient)
    return state, _Gradients(Medium(field, transfer, shader, total.medium.occupancy, visibility), dt_gradient)


def _no_taps(medium: Medium, rays: Rays) -> tuple[Sample, ...]:
    """Zero for everything that is resampled at the quadrature nodes of a segment."""
    points = points_at(rays, jnp.zeros_like(rays.length, jnp.int32), jnp.int32(0), rays.length)
    one = jax.eval_shape(lambda: jax.vmap(medium.field.resample)(points))
    return (jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), one),) * len(medium.shader.quadrature_nodes)


def is_there(tree: Any) -> Any:
    """Which leaves of a tree are not `None`."""
    return jax.tree.map(lambda leaf: leaf is not None, tree, is_leaf=lambda leaf: leaf is None)
