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
from jvr.fitting.kinds import Kinds, OfViews, TableEntries
from jvr.fitting.objective import seen
from jvr.fitting.observations import Observations, observed_medium, prepare_in_fit, rays_inside
from jvr.fitting.problem import Problem, predict, prior
from jvr.fitting.unknowns import ExposedModel
from jvr.fitting.views import Pixels
from jvr.march.differentiation import Forward
from jvr.march.jacobian import TableJacobian, table_jacobian
from jvr.march.march import Marched, MarchOptions
from jvr.march.medium import Medium
from jvr.march.ray_jacobian import ray_jacobian
from jvr.march.steps import Rays
from jvr.model.scene import Scene
from jvr.rendering.medium import Prepared
from jvr.types import Triple


class _OfViews(eqx.Module):
    """Rows for unknown cameras: for each ray its view and its derivatives in the directions of that view, whose unknowns are in `columns`
    (`jvr.fitting.kinds.OfViews`)."""

    view: Int[Array, "rays"]
    rows: Float[Array, "rays directions"]
    columns: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def places(self) -> np.ndarray:
        return np.asarray(self.columns, np.int32)

    def by_view(self, of_rays: Float[Array, "rays *n"]) -> Float[Array, "views *n"]:
        """Sums over the rays of each view."""
        return jax.ops.segment_sum(of_rays, self.view, num_segments=len(self.columns))


class _Channel(eqx.Module):
    """One colour channel of a tile: for each ray its block of pixels, its colour, `r`, `w` and `w rho(r)` of `Normal`, and its row for the
    unknowns in `columns`, and for those of its own view where cameras are unknown."""

    block: Int[Array, "rays"]
    colour: Float[Array, "rays"]
    residual: Float[Array, "rays"]
    weight: Float[Array, "rays"]
    loss: Float[Array, "rays"]
    rows: Float[Array, "rays columns"]
    columns: tuple[int, ...] = eqx.field(static=True)
    of_views: _OfViews | None = None


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
    scene = problem.model.scene
    is_made = all(getattr(scene, field).is_final for field in scene.precomputable)
    return None if is_made else _light_tangents(problem, values)


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
    colours, blocks, of_views = _jacobian(problem, values, tile, around)
    channels = []
    for c, colour in enumerate(colours):
        r = colour - tile.target[:, c]
        nothing: Blocks = [] if blocks[c] else [(jnp.zeros((r.size, 0), r.dtype), np.zeros(0, int))]
        rows = jnp.concatenate([block for block, _ in (*blocks[c], *nothing)], axis=1)
        columns = tuple(np.concatenate([columns for _, columns in (*blocks[c], *nothing)]).tolist())
        losses = tile.weight * problem.loss.value(r)
        weight = tile.weight * problem.loss.weight(r)
        channels.append(_Channel(tile.block, colour, r, weight, losses, rows, columns, of_views[c]))
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
        if channel.of_views is not None:
            of_views = _in_double(channel.of_views)
            matrix, vector = _sums_of_views(of_views, rows, columns, weight, r, n)
            total = total._replace(matrix=total.matrix + matrix, vector=total.vector + vector)
    return everywhere(total)


def _in_double(of_views: _OfViews) -> _OfViews:
    return eqx.tree_at(lambda x: x.rows, of_views, of_views.rows.astype(float))


def _sums_of_views(
    of_views: _OfViews, rows: Array, columns: np.ndarray, weight: Array, r: Array, n: int
) -> tuple[Float[Array, "n n"], Float[Array, "n"]]:
    """The part of the normal equations that unknown cameras have: a block for each view, and one of each view with all other unknowns. A
    row of all views, zero but for one of them, is never held."""
    own, places = of_views.rows, of_views.places
    weighted = own * weight[:, None]
    blocks = of_views.by_view(own[:, :, None] * weighted[:, None, :])
    matrix = jnp.zeros((n, n)).at[places[:, :, None], places[:, None, :]].add(blocks, mode="drop")
    vector = jnp.zeros(n).at[places].add(of_views.by_view(weighted * r[:, None]), mode="drop")
    if columns.size:
        # One direction after the other: their products with the rows of all are as many times as large as these.
        across = jax.lax.map(lambda x: of_views.by_view(rows * x[:, None]), weighted.T)
        crossed = jnp.zeros((n, n)).at[places.T[:, :, None], columns].add(across, mode="drop")
        matrix += crossed + crossed.T
    return matrix, vector


@eqx.filter_jit
def _scores(channels: list[_Channel], n: int, blocks: int) -> Scores:
    score, by_channel = jnp.zeros((blocks, n)), []
    for channel in channels:
        fields = channel.colour, channel.residual, channel.weight, channel.rows
        colour, r, weight, rows = (x.astype(float) for x in fields)
        columns, by_block = np.asarray(channel.columns, np.int32), partial(jax.ops.segment_sum, num_segments=blocks)
        score = score.at[:, columns].add(by_block(rows * (weight * r)[:, None], channel.block))
        # What sees no unknown, as the empty background, says nothing of how well they explain the rest.
        seen = jnp.any(rows != 0, axis=1)
        moved = lambda by, rows=rows, columns=columns: jnp.zeros(n).at[columns].add(by @ rows)
        if channel.of_views is not None:
            of_views = _in_double(channel.of_views)
            seen |= jnp.any(of_views.rows != 0, axis=1)
            score = score.at[_places_of_blocks(of_views, channel.block, blocks)].add(
                by_block(of_views.rows * (weight * r)[:, None], channel.block), mode="drop"
            )
            moved = lambda by, moved=moved, of_views=of_views: (
                moved(by).at[of_views.places].add(of_views.by_view(of_views.rows * by[:, None]), mode="drop")
            )
        live = jnp.where(seen, weight, 0)
        sums = live, live * r**2, live * colour**2, (live * r) ** 2
        by_channel.append(
            (by_block(live * r, channel.block), moved(weight), moved(weight * colour), jnp.stack([jnp.sum(x) for x in sums]))
        )
    residual, offset, gain, sums = (jnp.stack(parts) for parts in zip(*by_channel, strict=True))
    return everywhere(Scores(score, residual, offset, gain, sums))


def _places_of_blocks(of_views: _OfViews, block: Int[Array, "rays"], blocks: int) -> tuple[Array, Array]:
    """Where in a table of blocks and unknowns the sums over blocks of a view's rows belong: the pixels of a block are of one view."""
    view = jnp.maximum(jax.ops.segment_max(of_views.view, block, num_segments=blocks), 0)
    return jnp.arange(blocks)[:, None], jnp.asarray(of_views.places)[view]


def _jacobian(
    problem: Problem, values: Float[Array, "unknowns"], tile: Observations, around: LightTangents | None
) -> tuple[Triple, list[Blocks], list[_OfViews | None]]:
    """Predicted colours of a chunk, and for each channel blocks of its Jacobian with the unknowns that they belong to, and the rows of
    unknown cameras."""
    kinds = Kinds.of(problem)
    model = kinds.changed(values[kinds.inner], values)
    options = MarchOptions(problem.settings.termination, distance=False)
    blocks: list[Blocks] = [[], [], []]
    arrays, rest, tangents = around or LightTangents(None, None, None)

    def observed(scene: Scene, arrays: Any) -> tuple[Prepared, Medium | None]:
        visible = None if around is None else eqx.combine(arrays, rest)
        prepared = prepare_in_fit(scene, problem.settings, problem.skips, visible)
        return prepared, observed_medium(tile, problem.samples, prepared) if problem.marches else None

    def look(part: Array, arrays: Any) -> tuple[Triple, Marched | None]:
        changed = kinds.changed(part, values)
        prepared, through = observed(changed.scene, arrays)
        rays = rays_inside(changed.scene, changed.views, tile.rays)
        return seen(problem, changed, rays, through, prepared, Forward())

    rays, gathered, colours = rays_inside(model.scene, model.views, tile.rays), None, ()
    of_views: list[_OfViews | None] = [None, None, None]
    if kinds.of_views is not None:
        prepared, through = observed(model.scene, arrays)
        gathered, of_views, colours = _rows_of_views(problem, model, kinds.of_views, tile, (prepared, through, rays))
    if any(indices is not None for indices in kinds.entries):
        prepared, through = observed(model.scene, arrays)
        assert through is not None
        beside = [name for name in ("sigma_t", "emission") if getattr(kinds.entries, name) is not None]
        gathered, rows = table_jacobian(options, through, rays, prepared.dt, of=beside)
        _add_entries(model, gathered, rows, rays, kinds.entries, blocks)
    if kinds.inner.size:
        point = (values[kinds.inner], arrays)
        along = jax.vmap(lambda *t: jax.jvp(look, point, t, has_aux=True), out_axes=(None, 0, None))
        colours, jacobian, gathered = along(kinds.basis(values.dtype), tangents)
        for c in range(3):
            blocks[c].append((jacobian[c].T, kinds.inner[kinds.directions[:, c]]))
    if gathered is None and not colours:
        colours, gathered = look(values[kinds.inner], arrays)
    if gathered is None:
        return colours, blocks, of_views
    if kinds.outer.size:
        after = lambda part: predict(kinds.changed(part, values, kinds.outer), gathered, rays)
        of_outer = jax.jacfwd(after)(values[kinds.outer])
        for c in range(3):
            blocks[c].append((of_outer[c], kinds.outer))
    return predict(model, gathered, rays), blocks, of_views


def _rows_of_views(
    problem: Problem,
    model: ExposedModel,
    of_views: OfViews,
    tile: Observations,
    marched: tuple[Prepared, Medium | None, Rays],
) -> tuple[Marched | None, list[_OfViews | None], Triple]:
    """What a march has gathered, the rows of unknown cameras in each channel, and where nothing marches, the colours.

    A camera acts through where its rays run alone, so a march is differentiated in these, once for all directions.
    """
    prepared, through, rays = marched
    assert isinstance(tile.rays, Pixels)
    basis = of_views.basis(rays.length.dtype)
    still, (view, _) = jax.tree.map(lambda x: jnp.zeros_like(x[0]), basis), tile.rays
    move = lambda shift: rays_inside(model.scene, model.views, tile.rays, shift)
    if through is None:
        look = lambda shift: seen(problem, model, move(shift), None, prepared, Forward())[0]
        colours, jacobian = jax.vmap(lambda t: jax.jvp(look, (still,), (t,)), out_axes=(None, 0))(basis)
        gathered, found = None, [channel.T for channel in jacobian]
    else:
        options = MarchOptions(problem.settings.termination, distance=False)
        final = lambda gathered: predict(model, gathered, rays)
        gathered, of_rays = ray_jacobian(options, through, rays, prepared.dt, final)
        along = jax.vmap(lambda t: jax.jvp(move, (still,), (t,))[1])(basis)
        colours = ()
        chained = lambda of: jax.tree.reduce(jnp.add, jax.tree.map(jnp.multiply, of, along))
        found = [chained(of).T for of in of_rays]
    columns = tuple(map(tuple, of_views.columns.tolist()))
    known = jnp.asarray(of_views.columns == sum(v.size for v in problem.unknowns.values(problem.model)))[view]
    return gathered, [_OfViews(view, jnp.where(known, 0, rows), columns) for rows in found], colours


def _add_entries(
    model: ExposedModel,
    gathered: Marched,
    rows: TableJacobian,
    rays: Rays,
    entries: TableEntries,
    blocks: list[Blocks],
) -> None:
    """Chains the rows of the march with what happens to radiance and optical depth after it, channel by channel."""
    ones = jax.tree.map(jnp.ones_like, (gathered.radiance, gathered.tau))
    zeros = jax.tree.map(jnp.zeros_like, ones)
    final = lambda radiance, tau: predict(model, gathered._replace(radiance=radiance, tau=tau), rays)
    _, by_radiance = jax.jvp(final, (gathered.radiance, gathered.tau), (ones[0], zeros[1]))
    _, by_tau = jax.jvp(final, (gathered.radiance, gathered.tau), (zeros[0], ones[1]))
    sigma_t = entries.sigma_t
    for c in range(3):
        if entries.rgb is not None and rows.radiance_rgb:
            blocks[c].append((rows.radiance_rgb[c] * by_radiance[c][:, None], entries.rgb[:, c]))
        if entries.emission is not None and rows.radiance_emission:
            blocks[c].append((rows.radiance_emission[c] * by_radiance[c][:, None], entries.emission[:, c]))
        if sigma_t is not None:
            block = jnp.zeros((rays.length.shape[0], sigma_t.shape[0]), rays.length.dtype)
            if rows.radiance_sigma:
                block += rows.radiance_sigma[c] * by_radiance[c][:, None]
            if rows.tau_sigma:
                block += rows.tau_sigma[c % len(rows.tau_sigma)] * by_tau[c][:, None]
            blocks[c].append((block, sigma_t if sigma_t.ndim == 1 else sigma_t[:, c]))
