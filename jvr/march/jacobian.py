"""The per-ray Jacobian with respect to the entries of a tabulated transfer function, out of one replay.

Entry `p` has weight `hat_p(s) = max(0, 1 - |coordinate(s) - p|)` in a sample, so

    dL_c / d rgb_p,c = sum_k hat_p(s_k) T_k de_k / d rgb,
    dL_c / d sigma_p = sum_k hat_p(s_k) (T_k de_k - T_k+1 B_k+1 ddtau_k) / d sigma,
    dL_c / d q_p,c = sum_k hat_p(s_k) T_k de_k / dq,

with `q` the emission of its own, `T_k` the transmittance in front of segment `k` and `B_k+1` the radiance from behind it (see
`jvr.march.adjoint`). Channel `c` of the radiance must depend on channel `c` of the colour alone, and how much light reaches a point not on
the table.
"""

from collections.abc import Collection
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.march.adjoint import BackwardRays, SuffixRadiance, segment_cotangents, step_back
from jvr.march.march import Marched, MarchOptions, integrate
from jvr.march.medium import Medium, for_derivatives
from jvr.march.segments import SegmentBatch, active_rays, light_at, occupied_count
from jvr.march.shaders import where_known
from jvr.march.steps import Rays, points_at, segment_span
from jvr.march.sums import transmittance
from jvr.march.wavefront import wavefront_while
from jvr.model.transfer import AbstractTable, Classified
from jvr.types import Channels, Scalar

# Segments whose contributions are added to the rows in one pass over memory: the rows are long, the segments short.
BLOCK = 8


class TableJacobian(NamedTuple):
    """The per-ray Jacobian of a march, by rows. Each is `(rays, entries)`, for one channel of radiance or optical depth.

    `radiance_rgb[c]`, `radiance_sigma[c]`: of radiance channel `c` with respect to column `c` of the colours, and to the extinctions
    (column `c` of them where they are coloured); `tau_sigma[c]`: of optical depth `c` with respect to the extinctions;
    `radiance_emission[c]`: of radiance channel `c` with respect to column `c` of the emissions. Those of extinctions and of emissions are
    empty where nobody asks for them.
    """

    radiance_rgb: tuple[Float[Array, "rays n"], ...]
    radiance_sigma: tuple[Float[Array, "rays n"], ...]
    tau_sigma: tuple[Float[Array, "rays n"], ...]
    radiance_emission: tuple[Float[Array, "rays n"], ...] = ()


class _JacobianState(NamedTuple):
    suffix: SuffixRadiance
    j: Int[Array, "rays"]
    rows: TableJacobian


def table_jacobian(
    options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar, *, of: Collection[str] = ("sigma_t",)
) -> tuple[Marched, TableJacobian]:
    """The march of `jvr.march.march.march` and its rows with respect to the entries of `medium.transfer`, an `AbstractTable`: colours and
    the fields that are named by `of`, extinctions (`sigma_t`) and its own `emission`.

    Distances have no rows. Memory: `rays x entries` numbers for each row that `TableJacobian` lists. Detached as in `march`.
    """
    gathered, record = integrate(options, medium, rays, dt, for_replay=True)
    assert isinstance(medium.transfer, AbstractTable)
    assert record is not None
    wanted = jax.tree.map(lambda _: None, medium)
    of_entries = lambda m: [getattr(m.transfer, name) for name in ("rgb", *of)]
    medium = for_derivatives(medium, eqx.tree_at(of_entries, wanted, of_entries(medium), is_leaf=lambda x: x is None))
    n = medium.transfer.rgb.shape[0]
    emits, absorbs = len(gathered.radiance), len(record.front)

    def start(back: BackwardRays) -> _JacobianState:
        zero = jnp.zeros((back.steps.size, n), rays.length.dtype)
        of_extinctions = "sigma_t" in of
        rows = TableJacobian((zero,) * emits, (zero,) * emits * of_extinctions, (zero,) * absorbs * of_extinctions)
        rows = rows._replace(radiance_emission=(zero,) * emits * ("emission" in of))
        return _JacobianState(back.empty_suffix(emits, distance=False), jnp.zeros_like(back.steps), rows)

    def alive(back: BackwardRays, state: _JacobianState):
        return state.j < back.steps

    def advance(back: BackwardRays, state: _JacobianState, _: None) -> tuple[_JacobianState, None]:
        one = lambda carry, _: _jacobian_segment(medium, dt, back, of, *carry)
        (suffix, j), (u, weights) = jax.lax.scan(one, (state.suffix, state.j), length=BLOCK)
        entry = jnp.arange(n, dtype=u.dtype)
        hats = [jnp.maximum(0.0, 1.0 - jnp.abs(u[i][:, None] - entry)) for i in range(BLOCK)]
        rows = jax.tree.map(lambda row, w: row + sum(hats[i] * w[i][:, None] for i in range(BLOCK)), state.rows, weights)
        return _JacobianState(suffix, j, rows), None

    back = BackwardRays(active_rays(rays, dt), *record)
    rows, _ = wavefront_while(alive, advance, start, lambda state: state.rows, back, None, record.following)
    return gathered, rows


def _jacobian_segment(
    medium: Medium, dt: Scalar, back: BackwardRays, of: Collection[str], suffix: SuffixRadiance, j: Int[Array, "rays"]
):
    """One segment of every ray: the state before it, where its samples fall in the table, and the weights of their hats."""
    j = back.skip(medium, dt, j)
    active, (k, count) = back.active, back.at(j)
    count = occupied_count(medium, active, dt, k, count)
    extent, distance = segment_span(k, count, active.rays.length, dt)
    points = points_at(active.rays, active.ray, k, distance)
    samples = jax.vmap(medium.field.resample)(points)
    samples = jax.vmap(medium.shader.in_world, in_axes=(None, 0, 0))(medium.transfer, samples, points)
    classified = jax.vmap(medium.shader.classify, in_axes=(None, 0))(medium.transfer, samples)
    batch = SegmentBatch(active.rays, active.ray, k, distance, extent, k < count)

    def radiance_and_depth(classified: Classified) -> tuple[Channels, Channels]:
        # Where in the segment the light is looked up depends on its extinction; the light itself does not.
        light = {} if medium.visibility is None else {"light": light_at(medium, batch, classified.sigma_t, reverse=True)}
        return jax.vmap(medium.shader.shade)(classified, samples._replace(**light), points, extent)

    (emitted, dtau), pull = jax.vjp(radiance_and_depth, classified)
    front = back.depth(j, suffix, dtau)
    before = transmittance(*front)

    radiance_rgb, radiance_sigma, tau_sigma, radiance_emission = [], [], [], []
    zero = jnp.zeros_like(distance)
    nothing = Marched((zero,) * len(emitted), (zero,) * len(dtau), (), None)
    for c in range(len(emitted)):
        one = nothing._replace(radiance=_only(nothing.radiance, c))
        (of_entry,) = pull(segment_cotangents(one, suffix, before, dtau, distance)[:2])
        radiance_rgb.append(of_entry.rgb[c])
        radiance_sigma.append(of_entry.sigma_t[c % len(of_entry.sigma_t)])
        if "emission" in of:
            radiance_emission.append(of_entry.emission[c])
    of_extinctions = "sigma_t" in of
    for c in range(len(dtau) * of_extinctions):
        (of_entry,) = pull(((zero,) * len(emitted), _only(nothing.tau, c)))
        tau_sigma.append(of_entry.sigma_t[c])
    weights = TableJacobian(
        tuple(radiance_rgb), tuple(radiance_sigma) * of_extinctions, tuple(tau_sigma), tuple(radiance_emission)
    )
    weights = jax.tree.map(lambda w: where_known((samples,), (w,))[0], weights)
    assert isinstance(medium.transfer, AbstractTable)
    u = jax.vmap(medium.transfer.coordinate)(samples.s)
    return (step_back(suffix, front, emitted, dtau, distance), j + (j < back.steps)), (u, weights)


def _only(channels: tuple[Array, ...], c: int) -> tuple[Array, ...]:
    """One in channel `c`, zero in the others."""
    return tuple(jnp.ones_like(x) if i == c else x for i, x in enumerate(channels))
