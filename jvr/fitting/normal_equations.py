"""The normal equations of a fit, for solvers that use the Jacobian: its rows are made chunk by chunk of rays and summed up at once, so that
a matrix of all rays is never held."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.execution.devices import everywhere, over_rays
from jvr.fitting.identifiability import Scores
from jvr.fitting.kinds import Kinds, TableEntries
from jvr.fitting.objective import seen
from jvr.fitting.observations import Observations, inside, observed_medium, prepare_in_fit
from jvr.fitting.problem import Problem, predict, prior
from jvr.fitting.unknowns import ExposedModel
from jvr.march.differentiation import Forward
from jvr.march.jacobian import TableJacobian, table_jacobian
from jvr.march.march import Marched, MarchOptions
from jvr.march.medium import Medium
from jvr.model.scene import Scene
from jvr.rendering.medium import Prepared
from jvr.types import Triple


class _Channel(eqx.Module):
    """One colour channel of a tile: for each ray its block of pixels, its colour, `r`, `w` and `w rho(r)` of `Normal`, and its row for the
    unknowns in `columns`."""

    block: Int[Array, "rays"]
    colour: Float[Array, "rays"]
    residual: Float[Array, "rays"]
    weight: Float[Array, "rays"]
    loss: Float[Array, "rays"]
    rows: Float[Array, "rays columns"]
    columns: tuple[int, ...] = eqx.field(static=True)


class Normal(NamedTuple):
    """Sums over rays at one point, in the unknowns' own values `v`, with weights `w` (per pixel, times the loss's own).

    `loss = sum w rho(r)`, `squares = sum w r^2`, `matrix = sum w J^T J`, `vector = sum w J^T r`.
    """

    loss: Any
    squares: Any
    matrix: Any
    vector: Any


Blocks = list[tuple[Float[Array, "rays columns"], np.ndarray]]


@eqx.filter_jit
def prior_expansion(problem: Problem, values: Float[Array, "unknowns"]) -> tuple[Any, Any, Any]:
    """Value, gradient and Hessian of the priors in the unknowns' own values."""
    unknowns, model = problem.unknowns, problem.model

    def of_values(values: Array) -> Array:
        return jnp.asarray(prior(problem, unknowns.insert(model, unknowns.split(values, model))), values.dtype)

    return of_values(values), jax.grad(of_values)(values), jax.hessian(of_values)(values)


class LightTangents(NamedTuple):
    """How much light reaches each point, where that takes long and is therefore made once for all chunks: its floating-point arrays, the
    others, and the derivatives of the first in each of the `directions` of `Kinds` (a leading axis)."""

    arrays: Any
    rest: Any
    tangents: Any


def light_tangents(problem: Problem, values: Float[Array, "unknowns"]) -> LightTangents | None:
    """What `normal_equations` of all chunks need at one point, or `None` where that is nothing worth keeping."""
    transfer = problem.model.scene.radiance_transfer
    return None if transfer is None or transfer.is_final else _light_tangents(problem, values)


@eqx.filter_jit
def _light_tangents(problem: Problem, values: Float[Array, "unknowns"]) -> LightTangents:
    kinds = Kinds.of(problem)

    def around(part: Array) -> tuple[Any, Any]:
        prepared = prepare_in_fit(kinds.changed(part, values).scene, problem.settings, problem.skips)
        return eqx.partition(prepared.visibility, eqx.is_inexact_array)

    part = values[kinds.inner]
    if not part.size:
        return LightTangents(*around(part), None)
    along = jax.vmap(lambda direction: jax.jvp(around, (part,), (direction,), has_aux=True), out_axes=(None, 0, None))
    arrays, tangents, rest = along(kinds.basis(values.dtype))
    return LightTangents(arrays, rest, tangents)


def normal_equations(
    problem: Problem,
    values: Float[Array, "unknowns"],
    observations: Observations,
    index: int = 0,
    every: int = 1,
    around: LightTangents | None = None,
) -> Normal:
    """The sums of `Normal` over one tile of every share (`Observations.tile`), in float64; `around`: what `light_tangents` returns, else
    made for this tile alone.

    The rows have the precision of `values`, their products are summed in float64. A matrix summed in float32 is uncertain by 1e-7, and
    already an eigenvalue of 1e-7 is a combination of unknowns that changes the images by 3e-4 of what a single one does.
    """
    channels = _channels(problem, values, observations, (jnp.int32(index), jnp.int32(every)), around)
    with jax.enable_x64(True):
        return _sums(channels, values.size)


def scored(
    problem: Problem,
    values: Float[Array, "unknowns"],
    observations: Observations,
    index: int,
    blocks: int,
    around: LightTangents | None = None,
) -> tuple[Normal, Scores]:
    """`normal_equations` of one tile, with the sums over its `blocks` of pixels that tell misfit from noise."""
    channels = _channels(problem, values, observations, (jnp.int32(index), jnp.int32(1)), around)
    with jax.enable_x64(True):
        return _sums(channels, values.size), _scores(channels, values.size, blocks)


@eqx.filter_jit
def _channels(
    problem: Problem,
    values: Float[Array, "unknowns"],
    observations: Observations,
    place: tuple[Int[Array, ""], Int[Array, ""]],
    around: LightTangents | None,
) -> list[_Channel]:
    shared, stored = problem.apart()

    def share(
        shared: tuple[Problem, Array, Any, LightTangents | None], rays: tuple[Array | None, Observations]
    ) -> list[_Channel]:
        problem, values, place, around = shared
        stored, observations = rays
        return _share_of_channels(problem.reassembled(stored), values, observations.tile(*place), around)

    return over_rays(share, (shared, values, place, around), (stored, observations))


def _share_of_channels(
    problem: Problem, values: Float[Array, "unknowns"], tile: Observations, around: LightTangents | None
) -> list[_Channel]:
    colours, blocks = _jacobian(problem, values, tile, around)
    channels = []
    for c, colour in enumerate(colours):
        r = colour - tile.target[:, c]
        rows = jnp.concatenate([block for block, _ in blocks[c]], axis=1)
        columns = tuple(np.concatenate([columns for _, columns in blocks[c]]).tolist())
        losses = tile.weight * problem.loss.value(r)
        weight = tile.weight * problem.loss.weight(r)
        channels.append(_Channel(tile.block, colour, r, weight, losses, rows, columns))
    return channels


@eqx.filter_jit
def _sums(channels: list[_Channel], n: int) -> Normal:
    total = Normal(jnp.zeros(()), jnp.zeros(()), jnp.zeros((n, n)), jnp.zeros(n))
    for channel in channels:
        fields = channel.residual, channel.weight, channel.loss, channel.rows
        r, weight, losses, rows = (x.astype(float) for x in fields)
        weighted, columns = rows * weight[:, None], np.asarray(channel.columns, np.int32)
        total = Normal(
            total.loss + jnp.sum(losses),
            total.squares + jnp.sum(weight * jnp.square(r)),
            total.matrix.at[columns[:, None], columns].add(weighted.T @ rows),
            total.vector.at[columns].add(weighted.T @ r),
        )
    return everywhere(total)


@eqx.filter_jit
def _scores(channels: list[_Channel], n: int, blocks: int) -> Scores:
    score, by_channel = jnp.zeros((blocks, n)), []
    for channel in channels:
        fields = channel.colour, channel.residual, channel.weight, channel.rows
        colour, r, weight, rows = (x.astype(float) for x in fields)
        columns, by_block = np.asarray(channel.columns, np.int32), partial(jax.ops.segment_sum, num_segments=blocks)
        score = score.at[:, columns].add(by_block(rows * (weight * r)[:, None], channel.block))
        # What sees no unknown, as the empty background, says nothing of how well they explain the rest.
        live = jnp.where(jnp.any(rows != 0, axis=1), weight, 0)
        moved = lambda by, rows=rows, columns=columns: jnp.zeros(n).at[columns].add(by @ rows)
        sums = live, live * r**2, live * colour**2, (live * r) ** 2
        by_channel.append(
            (by_block(live * r, channel.block), moved(weight), moved(weight * colour), jnp.stack([jnp.sum(x) for x in sums]))
        )
    residual, offset, gain, sums = (jnp.stack(parts) for parts in zip(*by_channel, strict=True))
    return everywhere(Scores(score, residual, offset, gain, sums))


def _jacobian(
    problem: Problem, values: Float[Array, "unknowns"], tile: Observations, around: LightTangents | None
) -> tuple[Triple, list[Blocks]]:
    """Predicted colours of a chunk, and for each channel blocks of its Jacobian with the unknowns that they belong to."""
    kinds = Kinds.of(problem)
    model = kinds.changed(values[kinds.inner], values)
    options = MarchOptions(problem.settings.termination, distance=False)
    blocks: list[Blocks] = [[], [], []]
    arrays, rest, tangents = around or LightTangents(None, None, None)

    def observed(scene: Scene, arrays: Any) -> tuple[Prepared, Medium | None]:
        visible = None if around is None else eqx.combine(arrays, rest)
        prepared = prepare_in_fit(scene, problem.settings, problem.skips, visible)
        return prepared, observed_medium(tile, problem.samples, prepared) if problem.integrator.marches else None

    def look(part: Array, arrays: Any) -> tuple[Triple, Marched | None]:
        changed = kinds.changed(part, values)
        prepared, through = observed(changed.scene, arrays)
        return seen(problem, changed, inside(changed.scene, tile.rays), through, prepared, Forward())

    rays, gathered, colours = inside(model.scene, tile.rays), None, ()
    if any(indices is not None for indices in kinds.entries):
        prepared, through = observed(model.scene, arrays)
        assert through is not None
        of_extinctions = kinds.entries.sigma_t is not None
        gathered, rows = table_jacobian(options, through, rays, prepared.dt, of_extinctions=of_extinctions)
        _add_entries(model, gathered, rows, rays.length, kinds.entries, blocks)
    if kinds.inner.size:
        point = (values[kinds.inner], arrays)
        along = jax.vmap(lambda *t: jax.jvp(look, point, t, has_aux=True), out_axes=(None, 0, None))
        colours, jacobian, gathered = along(kinds.basis(values.dtype), tangents)
        for c in range(3):
            blocks[c].append((jacobian[c].T, kinds.inner[kinds.directions[:, c]]))
    if gathered is None and not colours:
        colours, gathered = look(values[kinds.inner], arrays)
    if gathered is None:
        return colours, blocks
    if kinds.outer.size:
        after = lambda part: predict(kinds.changed(part, values, kinds.outer), gathered, rays.length)
        of_outer = jax.jacfwd(after)(values[kinds.outer])
        for c in range(3):
            blocks[c].append((of_outer[c], kinds.outer))
    return predict(model, gathered, rays.length), blocks


def _add_entries(
    model: ExposedModel,
    gathered: Marched,
    rows: TableJacobian,
    length: Float[Array, "rays"],
    entries: TableEntries,
    blocks: list[Blocks],
) -> None:
    """Chains the rows of the march with what happens to radiance and optical depth after it, channel by channel."""
    ones = jax.tree.map(jnp.ones_like, (gathered.radiance, gathered.tau))
    zeros = jax.tree.map(jnp.zeros_like, ones)
    final = lambda radiance, tau: predict(model, gathered._replace(radiance=radiance, tau=tau), length)
    _, by_radiance = jax.jvp(final, (gathered.radiance, gathered.tau), (ones[0], zeros[1]))
    _, by_tau = jax.jvp(final, (gathered.radiance, gathered.tau), (zeros[0], ones[1]))
    sigma_t = entries.sigma_t
    for c in range(3):
        if entries.rgb is not None and rows.radiance_rgb:
            blocks[c].append((rows.radiance_rgb[c] * by_radiance[c][:, None], entries.rgb[:, c]))
        if sigma_t is not None:
            block = jnp.zeros((length.shape[0], sigma_t.shape[0]), length.dtype)
            if rows.radiance_sigma:
                block += rows.radiance_sigma[c] * by_radiance[c][:, None]
            if rows.tau_sigma:
                block += rows.tau_sigma[c % len(rows.tau_sigma)] * by_tau[c][:, None]
            blocks[c].append((block, sigma_t if sigma_t.ndim == 1 else sigma_t[:, c]))
