"""Derivatives of every ray with respect to every entry of a tabulated transfer function, out of one replay.

Entry `p` has weight `hat_p(s) = max(0, 1 - |coordinate(s) - p|)` in a sample, so

    dL_c / d rgb_p,c = sum_k hat_p(s_k) T_k de_k / d rgb,        dL_c / d sigma_p = sum_k hat_p(s_k) (T_k de_k - R_k ddtau_k) / d sigma,

with `R_k` the radiance still to come after segment `k`. Channel `c` of the radiance must depend on channel `c` of the colour alone.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jvr.march.adjoint import segment_cotangents, subtract_segment
from jvr.march.batch import shrinking_while
from jvr.march.march import (
    Lanes,
    Marched,
    MarchOptions,
    Medium,
    add_segment,
    integrate,
    marched,
    opacity,
    through,
    transmittance,
)
from jvr.march.steps import Rays, points_at, segment, segment_count
from jvr.types import Scalar

# Segments whose contributions are added to the rows in one pass over memory: the rows are long, the segments short.
BLOCK = 8


class TableRows(NamedTuple):
    """Rows of the Jacobian of a march. Each is `(rays, entries)`, for one channel of radiance or optical depth.

    `radiance_rgb[c]`, `radiance_sigma[c]`: of radiance channel `c` with respect to column `c` of the colours, and to the extinctions
    (column `c` of them where they are coloured); `tau_sigma[c]`: of optical depth `c` with respect to the extinctions.
    """

    radiance_rgb: tuple[Float[Array, "rays n"], ...]
    radiance_sigma: tuple[Float[Array, "rays n"], ...]
    tau_sigma: tuple[Float[Array, "rays n"], ...]


class _RowLanes(NamedTuple):
    lanes: Lanes
    remaining: Any
    rows: TableRows


def table_rows(options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> tuple[Marched, TableRows]:
    """The march of `jvr.march.march.march` and its rows with respect to the entries of `medium.transfer`, an `AbstractTable`.

    Distances have no rows. Memory: `rays x entries` numbers for each row that `TableRows` lists. Detached as in `march`.
    """
    sums, steps = integrate(options, medium, rays, dt)
    n = medium.transfer.rgb.shape[0]
    zero = jnp.zeros((steps.size, n), rays.length.dtype)
    blank = TableRows((zero,) * len(sums.radiance), (zero,) * len(sums.radiance), (zero,) * len(sums.tau))
    lanes = Lanes(
        rays,
        jnp.arange(steps.size, dtype=jnp.int32),
        segment_count(rays.length, dt),
        jax.tree.map(jnp.zeros_like, sums)._replace(distance=(), distance_low=()),
        steps,
    )
    remaining = sums._replace(tau=(), tau_low=(), distance=(), distance_low=())

    def alive(state: _RowLanes, k: Int[Array, ""]):
        return k < state.lanes.steps

    def advance(state: _RowLanes, k: Int[Array, ""]):
        def one(carry: tuple[Lanes, Any], i: Int[Array, ""]):
            lanes, remaining, *sample = _row_segment(medium, dt, *carry, k + i)
            return (lanes, remaining), sample

        (lanes, remaining), (u, weights) = jax.lax.scan(one, (state.lanes, state.remaining), jnp.arange(BLOCK))
        entry = jnp.arange(n, dtype=u.dtype)
        hats = [jnp.maximum(0.0, 1.0 - jnp.abs(u[i][:, None] - entry)) for i in range(BLOCK)]
        rows = jax.tree.map(lambda row, w: row + sum(hats[i] * w[i][:, None] for i in range(BLOCK)), state.rows, weights)
        return _RowLanes(lanes, remaining, rows), k + BLOCK

    final, _ = shrinking_while(alive, advance, _RowLanes(lanes, remaining, blank), jnp.int32(0))
    return marched(sums, steps), final.rows


def _row_segment(medium: Medium, dt: Scalar, lanes: Lanes, remaining: Any, k: Int[Array, ""]):
    """One segment of every ray: the state after it, where its samples fall in the table, and the weights of their hats."""
    count = jnp.where(k < lanes.steps, lanes.count, 0)
    extent, distance = segment(k, count, lanes.rays.length, dt)
    points = points_at(lanes.rays, lanes.ray, k, distance)
    s = jax.vmap(medium.field.resample)(points)
    classified = jax.vmap(medium.transfer.evaluate)(s)
    (emitted, dtau), pull = jax.vjp(lambda c: jax.vmap(medium.shader.segment)(c, points, extent), classified)
    before = transmittance(lanes.sums)
    remaining = subtract_segment(remaining, through(before, emitted), opacity(before, dtau), distance)

    radiance_rgb, radiance_sigma, tau_sigma = [], [], []
    zero = jnp.zeros_like(distance)
    nothing = Marched((zero,) * len(emitted), (zero,) * len(dtau), (), None)
    for c in range(len(emitted)):
        one = nothing._replace(radiance=_only(nothing.radiance, c))
        (of_entry,) = pull(segment_cotangents(one, remaining, before, dtau, distance)[:2])
        radiance_rgb.append(of_entry.rgb[c])
        radiance_sigma.append(of_entry.sigma_t[c % len(of_entry.sigma_t)])
    for c in range(len(dtau)):
        (of_entry,) = pull(((zero,) * len(emitted), _only(nothing.tau, c)))
        tau_sigma.append(of_entry.sigma_t[c])
    weights = TableRows(tuple(radiance_rgb), tuple(radiance_sigma), tuple(tau_sigma))
    u = jax.vmap(medium.transfer.coordinate)(s)
    return lanes._replace(sums=add_segment(lanes.sums, emitted, dtau, distance)), remaining, u, weights


def _only(channels: tuple[Array, ...], c: int) -> tuple[Array, ...]:
    """One in channel `c`, zero in the others."""
    return tuple(jnp.ones_like(x) if i == c else x for i, x in enumerate(channels))
