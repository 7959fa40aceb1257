"""The per-ray Jacobian with respect to where the rays run, out of one replay: what cameras that move need.

A camera acts through the seven numbers of a ray, its entry `e`, direction `d` and length, so that one replay (`jvr.march.adjoint`) serves
any number of directions that it may move in. Where a segment depends on its sample alone, all channels share the gradient of the field:

    dL_c / de = sum_k g_ck grad s(e + u_k d),   dL_c / dd = sum_k u_k g_ck grad s(e + u_k d),

with `g_ck = dL_c / ds_k` as in `jvr.march.adjoint`. The last segment, whose length and middle depend on where the ray leaves, adds the
derivative in the length.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jvr.march.adjoint import BackwardRays, SuffixRadiance, replay, segment_cotangents, step_back
from jvr.march.fields import VoxelField
from jvr.march.march import Marched, MarchOptions, ReplayRecord, integrate
from jvr.march.medium import Medium, for_derivatives
from jvr.march.segments import active_rays, occupied_count
from jvr.march.shaders import OpticalShader, where_known
from jvr.march.steps import Rays, points_at, segment_span
from jvr.march.sums import transmittance
from jvr.march.wavefront import wavefront_while
from jvr.model.normals import AnalyticGradient
from jvr.numerics import materialise
from jvr.types import Scalar, Triple


def ray_jacobian(
    options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar, colours: Callable[[Marched], Triple]
) -> tuple[Marched, tuple[Rays, ...]]:
    """The march of `jvr.march.march.march`, and the derivatives of the three `colours` that are made of it, each with respect to the
    numbers of its ray. Detached as in `march`."""
    gathered, record = integrate(options, medium, rays, dt, for_replay=True)
    assert record is not None
    final = lambda radiance, tau: colours(gathered._replace(radiance=radiance, tau=tau))
    found, pull = jax.vjp(final, gathered.radiance, gathered.tau)
    ones, zeros = jnp.ones_like(rays.length), jnp.zeros_like(rays.length)
    pulled = [pull(tuple(ones if i == c else zeros for i in range(3))) for c in range(len(found))]
    if gathered.radiance:
        return gathered, _replayed(medium, rays, dt, record, [Marched(L, tau, (), None) for L, tau in pulled])
    # Where nothing glows, channels are alike but for a factor.
    n = len(gathered.tau)
    alone = [Marched((), tuple(ones if i == c else zeros for i in range(n)), (), None) for c in range(n)]
    depths = _replayed(medium, rays, dt, record, alone)
    scaled = lambda c: jax.tree.map(lambda x: pulled[c][1][c % n] * x, depths[c % n])
    return gathered, tuple(scaled(c) for c in range(3))


def _replayed(medium: Medium, rays: Rays, dt: Scalar, record: ReplayRecord, cotangents: list[Marched]) -> tuple[Rays, ...]:
    """For each of the cotangents the gradient in the numbers of the rays."""
    nothing, still = (jax.tree.map(lambda _: None, tree) for tree in (medium, rays))
    field = medium.field
    if (
        isinstance(field, VoxelField)
        and field.normals is None
        and type(medium.shader) is OpticalShader
        and medium.visibility is None
    ):
        # A segment depends on the scalar in its middle alone, and not on where that is or how light comes there.
        graded = medium._replace(field=VoxelField(field.volume, AnalyticGradient()))
        return _walk(for_derivatives(graded, jax.tree.map(lambda _: None, graded), rays), rays, dt, record, tuple(cotangents))
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *cotangents)
    found = jax.vmap(lambda cotangent: replay((nothing, rays, None), (medium, still, dt), record, cotangent)[1])(stacked)
    return tuple(jax.tree.map(lambda x, c=c: x[c], found) for c in range(len(cotangents)))


class _State(NamedTuple):
    suffix: SuffixRadiance
    j: Int[Array, "rays"]
    gradients: tuple[Rays, ...]


def _walk(medium: Medium, rays: Rays, dt: Scalar, record: ReplayRecord, cotangents: tuple[Marched, ...]) -> tuple[Rays, ...]:
    """`replay` for all cotangents at once."""

    def start(inputs: tuple[BackwardRays, tuple[Marched, ...]]) -> _State:
        back, cotangents = inputs
        zeros = jax.tree.map(jnp.zeros_like, back.active.rays)
        suffix = back.empty_suffix(len(cotangents[0].radiance), distance=False)
        return _State(suffix, jnp.zeros_like(back.steps), (zeros,) * len(cotangents))

    def alive(inputs: tuple[BackwardRays, tuple[Marched, ...]], state: _State):
        return state.j < inputs[0].steps

    def advance(inputs: tuple[BackwardRays, tuple[Marched, ...]], state: _State, _: None) -> tuple[_State, None]:
        return _segment(medium, dt, *inputs, state), None

    inputs = (BackwardRays(active_rays(rays, dt), *record), cotangents)
    return wavefront_while(alive, advance, start, lambda state: state.gradients, inputs, None, record.following)[0]


def _segment(medium: Medium, dt: Scalar, back: BackwardRays, cotangents: tuple[Marched, ...], state: _State) -> _State:
    state = state._replace(j=back.skip(medium, dt, state.j))
    active, (k, count) = back.active, back.at(state.j)
    count = occupied_count(medium, active, dt, k, count)
    extent, u = segment_span(k, count, active.rays.length, dt)
    points, inside = points_at(active.rays, active.ray, k, u), k < count

    sample = materialise(inside, jax.vmap(medium.field.resample)(points))
    slope, sample = sample.gradient, sample._replace(gradient=())
    evaluate = jax.vmap(medium.shader.evaluate_segment, in_axes=(None, 0, 0, 0))
    segment = lambda s, extent: evaluate(medium.transfer, (sample._replace(s=s),), points, extent)
    ones = jnp.ones_like(extent)
    found, by_s = jax.jvp(lambda s: segment(s, extent), (sample.s,), (ones,))
    by_extent = jax.jvp(lambda extent: segment(sample.s, extent), (extent,), (ones,))[1]
    # What a ray that is done reads is nothing, in value and in derivative.
    at_rest = lambda x: jnp.where(inside, x, 0.0)
    (emitted, dtau), by_s, by_extent = jax.tree.map(at_rest, materialise(inside, (found, by_s, by_extent)))
    slope = tuple(map(at_rest, slope))
    front = back.depth(state.j, state.suffix, dtau)
    before, is_last = transmittance(*front), k == count - 1
    along = sum(g * d for g, d in zip(slope, active.rays.direction, strict=True))

    def added(cotangent: Marched, total: Rays) -> Rays:
        of_emitted, of_dtau, _ = segment_cotangents(cotangent, state.suffix, before, dtau, u)
        products = lambda by: [g * x for g, x in zip((*of_emitted, *of_dtau), (*by[0], *by[1]), strict=True)]
        chain = lambda by: sum(products(by), jnp.zeros_like(u))
        of_s, of_extent = where_known((sample,), (chain(by_s), chain(by_extent)))
        entry = tuple(t + of_s * g for t, g in zip(total.entry, slope, strict=True))
        direction = tuple(t + u * of_s * g for t, g in zip(total.direction, slope, strict=True))
        return Rays(entry, direction, total.length + jnp.where(is_last, of_extent + 0.5 * of_s * along, 0.0))

    gradients = tuple(added(*pair) for pair in zip(cotangents, state.gradients, strict=True))
    return _State(step_back(state.suffix, front, emitted, dtau, u), state.j + (state.j < back.steps), gradients)
