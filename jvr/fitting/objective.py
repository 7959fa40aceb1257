"""The objective of a fit: its value for solvers that use gradients, and its normal equations for those that use the Jacobian.

Both go through the rays in chunks, so that a matrix of all rays is never held.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jvr.execution.devices import everywhere, over_rays, shares
from jvr.execution.tiles import dealt_blocks, picture_of, pixels_of
from jvr.fitting.losses import AbstractPrior, SquaredError
from jvr.fitting.observations import Observations, Samples, observed_medium, prepare_in_fit
from jvr.fitting.unknowns import ExposedModel, Unknowns
from jvr.march.differentiation import AbstractAdjoint, Forward, Replay, Rows
from jvr.march.jacobian import TableJacobian, table_jacobian
from jvr.march.march import Marched, MarchOptions
from jvr.march.medium import Medium
from jvr.march.steps import Rays
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTable
from jvr.rendering.settings import Settings
from jvr.rendering.trace import Prepared, composite, step_length, trace
from jvr.types import Image, Scalar, Triple


class Problem(eqx.Module):
    """A fit without its observations: what is unknown, how it is rendered, what is made small."""

    model: ExposedModel
    unknowns: Unknowns
    settings: Settings
    loss: Any  # AbstractLoss, or DSSIM for solvers that use gradients alone
    priors: tuple[AbstractPrior, ...]
    samples: Samples | None
    skips: bool = eqx.field(static=True, default=False)  # empty bricks, in what has no derivative there

    def with_samples(self, samples: Samples) -> "Problem":
        return Problem(self.model, self.unknowns, self.settings, self.loss, self.priors, samples, self.skips)

    def apart(self) -> "tuple[Problem, Array | None]":
        """What all devices share of it, and the kept samples, of which each has those of its own rays."""
        if self.samples is None:
            return self, None
        stored = lambda problem: problem.samples.stored
        return eqx.tree_at(stored, self, None), self.samples.stored

    def reassembled(self, stored: Array | None) -> "Problem":
        """What `apart` undoes on one device."""
        if stored is None:
            return self
        return eqx.tree_at(lambda problem: problem.samples.stored, self, stored, is_leaf=lambda x: x is None)

    def least_squares(self) -> "Problem":
        """The same unknowns and data, the squared error alone."""
        return Problem(self.model, self.unknowns, self.settings, SquaredError(), (), self.samples, self.skips)


class _Channel(eqx.Module):
    """One colour channel of a tile: for each ray `r`, `w` and `w rho(r)` of `Normal`, and its row for the unknowns in `columns`."""

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


def predict(problem: Problem, model: ExposedModel, gathered: Marched, length: Float[Array, "rays"]) -> Triple:
    """Colours as the target images have them."""
    rgb, _ = composite(model.scene, gathered, length)
    return rgb if model.exposure is None else tuple(model.exposure * c for c in rgb)


@eqx.filter_jit
def value(problem: Problem, unconstrained: Float[Array, "unknowns"], tiles: Observations, total: Scalar) -> Scalar:
    """Mean loss over all pixels plus priors, in unconstrained space. `tiles` has a leading axis of chunks."""
    model = problem.unknowns.model_from_unconstrained(problem.model, unconstrained)
    prepared = prepare_in_fit(model.scene, problem.settings, problem.skips)
    shared, stored = problem.apart()

    def share(shared: tuple[Problem, ExposedModel, Prepared], rays: tuple[Array | None, Observations]) -> Array:
        problem, model, prepared = shared
        stored, tiles = rays

        def add_tile(sum_: Scalar, tile: Observations) -> tuple[Scalar, None]:
            r = residual(problem.reassembled(stored), model, tile, prepared)
            return sum_ + sum(jnp.sum(tile.weight * problem.loss.value(c)) for c in r), None

        return jax.lax.scan(add_tile, jnp.zeros((), unconstrained.dtype), tiles)[0][None]

    loss = jnp.sum(over_rays(share, (shared, model, prepared), (stored, tiles)))
    return loss / total + prior(problem, model)


@eqx.filter_jit
def residuals(problem: Problem, unconstrained: Float[Array, "unknowns"], tiles: Observations, total: Scalar) -> Array:
    """The whole residual vector, scaled to a squared length of the mean squared error; priors have no residuals."""
    model = problem.unknowns.model_from_unconstrained(problem.model, unconstrained)
    adjoint, prepared = adjoint_of(problem), prepare_in_fit(model.scene, problem.settings, problem.skips)
    shared, stored = problem.apart()

    def share(shared: tuple[Problem, ExposedModel, Prepared, Scalar], rays: tuple[Array | None, Observations]) -> Array:
        problem, model, prepared, total = shared
        stored, tiles = rays

        def of_tile(tile: Observations) -> Array:
            scale = jnp.sqrt(tile.weight / total)
            return jnp.stack([scale * c for c in residual(problem.reassembled(stored), model, tile, prepared, adjoint)])

        return jax.lax.map(of_tile, tiles)

    return jnp.ravel(everywhere(over_rays(share, (shared, model, prepared, total), (stored, tiles))))


def residual(
    problem: Problem, model: ExposedModel, tile: Observations, prepared: Prepared, adjoint: AbstractAdjoint = Replay()
) -> Triple:
    """Rendered minus target in each channel, differentiable in the mode of `adjoint`."""
    medium, rays = observed_medium(model.scene, tile, problem.samples, problem.settings, prepared)
    options = MarchOptions(problem.settings.termination, distance=False)
    gathered = adjoint.march(options, medium, rays, step_length(model.scene, problem.settings))
    colours = predict(problem, model, gathered, rays.length)
    return tuple(c - tile.target[:, i] for i, c in enumerate(colours))


@eqx.filter_jit
def image_value(
    problem: Problem, unconstrained: Float[Array, "unknowns"], cameras: Sequence[AbstractCamera], images: Sequence[Array]
) -> Scalar:
    """`value` for a loss over whole images: the mean over images plus priors."""
    model = problem.unknowns.model_from_unconstrained(problem.model, unconstrained)
    settings = eqx.tree_at(lambda s: s.adjoint, problem.settings, Replay())
    losses, prepared = [], prepare_in_fit(model.scene, settings, problem.skips)
    for camera, target in zip(cameras, images, strict=True):
        rendered = _rendered(problem, model, camera, settings, prepared)
        losses.append(problem.loss.image(rendered, target))
    return jnp.mean(jnp.stack(losses)) + prior(problem, model)


def _rendered(problem: Problem, model: ExposedModel, camera: AbstractCamera, settings: Settings, prepared: Prepared) -> Image:
    """A whole image, colours as the targets have them."""
    height, width = camera.height, camera.width

    def share(
        shared: tuple[Problem, ExposedModel, AbstractCamera, Prepared], blocks: Int[Array, "blocks"]
    ) -> Float[Array, "rays 3"]:
        problem, model, camera, prepared = shared
        gathered, rays, _ = trace(model.scene, camera, settings, pixels_of(blocks, height, width), prepared=prepared)
        return jnp.stack(predict(problem, model, gathered, rays.length), axis=-1)

    shared = (problem.apart()[0], model, camera, prepared)
    rays = everywhere(over_rays(share, shared, dealt_blocks(height, width, shares())))
    return picture_of(rays, height, width, shares())


def prior(problem: Problem, model: ExposedModel) -> Scalar | float:
    """The sum of all priors."""
    return sum((p.value(model.scene) for p in problem.priors), 0.0)


@eqx.filter_jit
def prior_expansion(problem: Problem, values: Float[Array, "unknowns"]) -> tuple[Any, Any, Any]:
    """Value, gradient and Hessian of the priors in the unknowns' own values."""
    unknowns, model = problem.unknowns, problem.model

    def of_values(values: Array) -> Array:
        return jnp.asarray(prior(problem, unknowns.insert(model, unknowns.split(values, model))), values.dtype)

    return of_values(values), jax.grad(of_values)(values), jax.hessian(of_values)(values)


class LightTangents(NamedTuple):
    """How much light reaches each point, where that takes long and is therefore made once for all chunks: its floating-point arrays, the
    others, and the derivatives of the first in each of the `directions` of `_Kinds` (a leading axis)."""

    arrays: Any
    rest: Any
    tangents: Any


def light_tangents(problem: Problem, values: Float[Array, "unknowns"]) -> LightTangents | None:
    """What `normal_equations` of all chunks need at one point, or `None` where that is nothing worth keeping."""
    transfer = problem.model.scene.radiance_transfer
    return None if transfer is None or transfer.is_final else _light_tangents(problem, values)


@eqx.filter_jit
def _light_tangents(problem: Problem, values: Float[Array, "unknowns"]) -> LightTangents:
    kinds = _Kinds.of(problem)

    def around(part: Array) -> tuple[Any, Any]:
        prepared = prepare_in_fit(kinds.changed(part, values).scene, problem.settings, problem.skips)
        return eqx.partition(prepared.shadows, eqx.is_inexact_array)

    part = values[kinds.inner]
    if not part.size:
        return LightTangents(*around(part), None)
    along = jax.vmap(lambda direction: jax.jvp(around, (part,), (direction,), has_aux=True), out_axes=(None, 0, None))
    arrays, tangents, rest = along(kinds.basis(values.dtype))
    return LightTangents(arrays, rest, tangents)


def normal_equations(
    problem: Problem, values: Float[Array, "unknowns"], tile: Observations, around: LightTangents | None = None
) -> Normal:
    """The sums of `Normal` over one tile of rays, in float64; `around`: what `light_tangents` returns, else made for this tile alone.

    The rows have the precision of `values`, their products are summed in float64. A matrix summed in float32 is uncertain by 1e-7, and
    already an eigenvalue of 1e-7 is a combination of unknowns that changes the images by 3e-4 of what a single one does.
    """
    channels = _channels(problem, values, tile, around)
    with jax.enable_x64(True):
        return _sums(channels, values.size)


@eqx.filter_jit
def _channels(
    problem: Problem, values: Float[Array, "unknowns"], tile: Observations, around: LightTangents | None
) -> list[_Channel]:
    shared, stored = problem.apart()

    def share(shared: tuple[Problem, Array, LightTangents | None], rays: tuple[Array | None, Observations]) -> list[_Channel]:
        return _share_of_channels(shared[0].reassembled(rays[0]), shared[1], rays[1], shared[2])

    return over_rays(share, (shared, values, around), (stored, tile))


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
        channels.append(_Channel(r, tile.weight * problem.loss.weight(r), losses, rows, columns))
    return channels


@eqx.filter_jit
def _sums(channels: list[_Channel], n: int) -> Normal:
    total = Normal(jnp.zeros(()), jnp.zeros(()), jnp.zeros((n, n)), jnp.zeros(n))
    for channel in channels:
        r, weight, losses, rows = (x.astype(float) for x in jax.tree.leaves(channel))
        weighted, columns = rows * weight[:, None], np.asarray(channel.columns, np.int32)
        total = Normal(
            total.loss + jnp.sum(losses),
            total.squares + jnp.sum(weight * jnp.square(r)),
            total.matrix.at[columns[:, None], columns].add(weighted.T @ rows),
            total.vector.at[columns].add(weighted.T @ r),
        )
    return everywhere(total)


def _jacobian(
    problem: Problem, values: Float[Array, "unknowns"], tile: Observations, around: LightTangents | None
) -> tuple[Triple, list[Blocks]]:
    """Predicted colours of a chunk, and for each channel blocks of its Jacobian with the unknowns that they belong to."""
    kinds = _Kinds.of(problem)
    model = kinds.changed(values[kinds.inner], values)
    options = MarchOptions(problem.settings.termination, distance=False)
    blocks: list[Blocks] = [[], [], []]
    arrays, rest, tangents = around or LightTangents(None, None, None)

    def observed(scene: Scene, arrays: Any) -> tuple[Medium, Rays]:
        visible = None if around is None else eqx.combine(arrays, rest)
        prepared = prepare_in_fit(scene, problem.settings, problem.skips, visible)
        return observed_medium(scene, tile, problem.samples, problem.settings, prepared)

    def of_inner(part: Array, arrays: Any) -> tuple[Triple, Marched]:
        changed = kinds.changed(part, values)
        medium, rays = observed(changed.scene, arrays)
        gathered = Forward().march(options, medium, rays, step_length(changed.scene, problem.settings))
        return predict(problem, changed, gathered, rays.length), gathered

    medium, rays = observed(model.scene, arrays)
    gathered = None
    if kinds.entries:
        dt, of_extinctions = step_length(model.scene, problem.settings), "scene.transfer.sigma_t" in kinds.entries
        gathered, rows = table_jacobian(options, medium, rays, dt, of_extinctions=of_extinctions)
        _add_entries(problem, model, gathered, rows, rays.length, kinds.entries, blocks)
    if kinds.inner.size:
        point = (values[kinds.inner], arrays)
        along = jax.vmap(lambda *t: jax.jvp(of_inner, point, t, has_aux=True), out_axes=(None, 0, None))
        _, jacobian, gathered = along(kinds.basis(values.dtype), tangents)
        for c in range(3):
            blocks[c].append((jacobian[c].T, kinds.inner[kinds.directions[:, c]]))
    if gathered is None:
        gathered = Forward().march(options, medium, rays, step_length(model.scene, problem.settings))
    if kinds.outer.size:
        after = lambda part: predict(problem, kinds.changed(part, values, kinds.outer), gathered, rays.length)
        of_outer = jax.jacfwd(after)(values[kinds.outer])
        for c in range(3):
            blocks[c].append((of_outer[c], kinds.outer))
    return predict(problem, model, gathered, rays.length), blocks


def march_unknowns(problem: Problem) -> int:
    """How many derivatives are taken by forward mode, at the cost of a march each."""
    return len(_Kinds.of(problem).directions)


def adjoint_of(problem: Problem) -> AbstractAdjoint:
    """How the whole residual vector is differentiated."""
    moves_light = any(name.startswith("scene.environment") for name in problem.unknowns.names)
    known = problem.model.scene.radiance_transfer is None or not moves_light
    return Rows() if known and has_table_jacobian(problem.model.scene) else Forward()


class _Kinds(NamedTuple):
    """Indices of the unknowns in the vector of all by how they act: as `entries` of a table (rows), after the march (`outer`), or inside
    it (`inner`). `directions`: indices in `inner` that are moved together, one for each channel of the picture."""

    problem: Problem
    entries: dict[str, np.ndarray]
    outer: np.ndarray
    inner: np.ndarray
    directions: np.ndarray

    @classmethod
    def of(cls, problem: Problem) -> "_Kinds":
        entries: dict[str, np.ndarray] = {}
        outer, inner, directions = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros((0, 3), int)]
        begin, taken = 0, 0
        with_rows = has_table_jacobian(problem.model.scene)
        for name, array in zip(problem.unknowns.names, problem.unknowns.values(problem.model), strict=True):
            indices = np.arange(begin, begin + array.size)
            begin += array.size
            if with_rows and name in ("scene.transfer.rgb", "scene.transfer.sigma_t"):
                entries[name] = indices.reshape(array.shape)
            elif name in ("scene.background", "exposure"):
                outer.append(indices)
            else:
                inner.append(indices)
                own = taken + np.arange(array.size)
                taken += array.size
                # A colour of environment lighting is seen in that colour alone: one march for all three.
                apart = name == "scene.environment.coefficients"
                directions.append(own.reshape(-1, 3) if apart else np.repeat(own[:, None], 3, axis=1))
        return cls(problem, entries, np.concatenate(outer), np.concatenate(inner), np.concatenate(directions))

    def basis(self, dtype: Any) -> Float[Array, "directions inner"]:
        """`directions` as vectors."""
        vectors = np.zeros((len(self.directions), self.inner.size))
        np.put_along_axis(vectors, self.directions, 1.0, axis=1)
        return jnp.asarray(vectors, dtype)

    def changed(self, part: Array, values: Float[Array, "unknowns"], indices: np.ndarray | None = None) -> ExposedModel:
        """The model of `values` with `part` at some indices, by default those of `inner`. Arrays that hold none of them do not depend on
        `part`."""
        unknowns, model = self.problem.unknowns, self.problem.model
        where = {int(k): i for i, k in enumerate(self.inner if indices is None else indices)}
        arrays, begin = [], 0
        for array in unknowns.split(values, model):
            first = where.get(begin)
            begin += array.size
            arrays.append(array if first is None else part[first : first + array.size].reshape(array.shape))
        return unknowns.insert(model, arrays)


def has_table_jacobian(scene: Scene) -> bool:
    """Whether entries of the transfer function act through what a sample is classified as, and nothing else."""
    by_gradient = scene.needs_gradient and scene.normals.follows_transfer(scene.volume)
    shade = scene.shadows is not None or (scene.radiance_transfer is not None and not scene.radiance_transfer.is_frozen)
    return isinstance(scene.transfer, AbstractTable) and not shade and not by_gradient


def _add_entries(
    problem: Problem,
    model: ExposedModel,
    gathered: Marched,
    rows: TableJacobian,
    length: Float[Array, "rays"],
    entries: dict[str, np.ndarray],
    blocks: list[Blocks],
) -> None:
    """Chains the rows of the march with what happens to radiance and optical depth after it, channel by channel."""
    ones = jax.tree.map(jnp.ones_like, (gathered.radiance, gathered.tau))
    zeros = jax.tree.map(jnp.zeros_like, ones)
    final = lambda radiance, tau: predict(problem, model, gathered._replace(radiance=radiance, tau=tau), length)
    _, by_radiance = jax.jvp(final, (gathered.radiance, gathered.tau), (ones[0], zeros[1]))
    _, by_tau = jax.jvp(final, (gathered.radiance, gathered.tau), (zeros[0], ones[1]))
    rgb, sigma_t = entries.get("scene.transfer.rgb"), entries.get("scene.transfer.sigma_t")
    for c in range(3):
        if rgb is not None and rows.radiance_rgb:
            blocks[c].append((rows.radiance_rgb[c] * by_radiance[c][:, None], rgb[:, c]))
        if sigma_t is not None:
            block = jnp.zeros((length.shape[0], sigma_t.shape[0]), length.dtype)
            if rows.radiance_sigma:
                block += rows.radiance_sigma[c] * by_radiance[c][:, None]
            if rows.tau_sigma:
                block += rows.tau_sigma[c % len(rows.tau_sigma)] * by_tau[c][:, None]
            blocks[c].append((block, sigma_t if sigma_t.ndim == 1 else sigma_t[:, c]))
