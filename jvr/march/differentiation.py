"""Which way a march is differentiated: the choices that `Settings(adjoint=...)` takes."""

import abc
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from jvr.march.adjoint import Inputs, replay_march
from jvr.march.jacobian import TableJacobian, table_jacobian
from jvr.march.march import Marched, MarchOptions, march
from jvr.march.medium import Medium, taking_all
from jvr.march.rules import FORWARDS, forwards_only, is_there, perturbed, skipping
from jvr.march.steps import Rays
from jvr.model.parts import AbstractPart, PlanEntry
from jvr.model.transfer import ENTRIES, AbstractTable, AbstractTransfer
from jvr.types import Scalar


class AbstractAdjoint(AbstractPart):
    """An adjoint: a way to differentiate a march."""

    def explain(self, name: str, scene: Any, settings: Any) -> tuple[PlanEntry, ...]:
        return (PlanEntry("derivatives", True, f"{type(self).__name__}, if any are asked for"),)

    @abc.abstractmethod
    def march(self, options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> Marched:
        """The march, with this way's derivatives."""


class Replay(AbstractAdjoint):
    """Reverse mode by replay, for any number of unknowns, and forward mode: memory does not grow with the number of steps. The default.

    A tangent costs a march more than under `Forward()`. Second derivatives are taken forwards, `jax.jvp(jax.grad(loss), (x,), (v,))`; a
    gradient of `jax.grad(loss)`, or of a `jvp`, raises `ValueError`.
    """

    def march(self, options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> Marched:
        return replay_march(options, medium, rays, dt)


class Forward(AbstractAdjoint):
    """Forward mode (`jvp`, `jacfwd`, any number of times), for one or few directions, at less cost than `Replay()`; takes every sample
    that is not negligible. Reverse mode through it raises `ValueError`: use `Replay()`."""

    def march(self, options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> Marched:
        remedy = "jvr.Forward() has no reverse mode: use Settings(adjoint=jvr.Replay()), or jvr.Rows() for few unknowns"
        return forwards_only(march(options, taking_all(medium), rays, dt), remedy)


class Rows(AbstractAdjoint):
    """The per-ray Jacobian: forward and reverse mode and any nesting with `vmap`, for few unknowns.

    The derivative of each ray with respect to every perturbed array is computed once and held, `rays x unknowns` numbers; a
    tangent is that matrix times a direction. Entries of a table come out of one replay, with hat functions, at about the cost of a
    gradient; other arrays by one reverse pass for each ray and output. Second derivatives as of `Replay()`.
    """

    def march(self, options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> Marched:
        return _jacobian_march(options, medium, rays, dt)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _jacobian_march(options: MarchOptions, medium: Medium, rays: Rays, dt: Scalar) -> Any:
    return march(options, medium, rays, dt)


def _jacobian_rule(options: MarchOptions, primals: Inputs, tangents: Any) -> tuple[Marched, Marched]:
    tangents = perturbed(primals, tangents)
    medium, rays, dt = primals
    if jax.tree.leaves(tangents[0].visibility):
        raise ValueError(
            "jvr.Rows() does not know shadows or occlusion that change, nor a radiance transfer or its light: set "
            "Settings(adjoint=jvr.Replay()), or jvr.Forward() for forward mode; for a transfer function alone, jvr.precompute(scene) "
            "keeps occlusion and radiance transfer as they are"
        )
    rest_of_transfer, entries = _split_entries(tangents[0].transfer)
    if options.distance or not jax.tree.leaves(entries):
        primal, tangent = _march(options, *primals), None
    else:
        beside = tuple(name for name in entries.entries if name != "rgb")
        primal, rows = _table_jacobian((options, beside), medium, rays, dt)
        tangents = (tangents[0]._replace(transfer=rest_of_transfer), *tangents[1:])
        tangent = _times_entries(primal, rows, entries)
    if jax.tree.leaves(tangents):
        rest = _times_rays(options, primals, tangents)
        tangent = rest if tangent is None else jax.tree.map(jnp.add, tangent, rest)
    elif tangent is None:
        tangent = jax.tree.map(jnp.zeros_like, primal._replace(steps=None))
    steps: Any = jax.custom_derivatives.zero_from_primal(primal.steps, symbolic_zeros=True)
    return primal, tangent._replace(steps=steps)


_jacobian_march.defjvp(_jacobian_rule, symbolic_zeros=True)
_march = skipping(march, FORWARDS)
_table_jacobian = skipping(lambda options, *inputs: table_jacobian(options[0], *inputs, of=options[1]), FORWARDS)


def _split_entries(tree: AbstractTransfer) -> tuple[Any, Any]:
    """The same tree twice: without the entries of a table (its colours, extinctions and emissions), and with nothing but them."""
    nothing = jax.tree.map(lambda _: None, tree)
    if not isinstance(tree, AbstractTable) or not tree.entries:
        return tree, nothing
    found = tree.entries
    pick = lambda t: [getattr(t, name) for name in found]
    rest = eqx.tree_at(pick, tree, [None] * len(found))
    return rest, eqx.tree_at(pick, nothing, list(found.values()), is_leaf=lambda x: x is None)


def _times_entries(primal: Marched, rows: TableJacobian, tangent: Any) -> Marched:
    """Rows of a table times a direction in its entries; optical depths depend on extinctions alone, and have no rows without them."""
    rgb, sigma_t, emission = (tangent.entries.get(name) for name in ENTRIES)
    sigma_column = lambda c: sigma_t if sigma_t.ndim == 1 else sigma_t[:, c]
    radiance, tau = [[jnp.zeros_like(x) for x in channels] for channels in (primal.radiance, primal.tau)]
    for c in range(len(radiance)):
        if rgb is not None:
            radiance[c] += rows.radiance_rgb[c] @ rgb[:, c]
        if sigma_t is not None:
            radiance[c] += rows.radiance_sigma[c] @ sigma_column(c)
        if emission is not None:
            radiance[c] += rows.radiance_emission[c] @ emission[:, c]
    for c, of_entries in enumerate(rows.tau_sigma):
        tau[c] += of_entries @ sigma_column(c)
    return Marched(tuple(radiance), tuple(tau), (), None)


def _times_rays(options: MarchOptions, primals: Inputs, tangents: Any) -> Marched:
    """The Jacobian of each ray with respect to the leaves of `tangents` that are not `None`, times `tangents`."""
    medium, rays, dt = primals
    shared, fixed = eqx.partition((medium, dt), is_there((tangents[0], tangents[2])))
    own, fixed_own = eqx.partition(rays, is_there(tangents[1]))

    def one(shared: Any, own: Any, fixed_own: Any):
        medium, dt = eqx.combine(shared, fixed)
        ray = jax.tree.map(lambda x: x[None], eqx.combine(own, fixed_own))
        gathered: Marched = replay_march(options, medium, ray, dt)
        return jax.tree.map(lambda x: x[0], gathered._replace(steps=None))

    jacobian = jax.vmap(jax.jacrev(one, argnums=(0, 1)), in_axes=(None, 0, 0))(shared, own, fixed_own)

    def times(of_output: Any):
        by_shared, by_own = of_output
        moved = (tangents[0], tangents[2])
        terms = [
            jnp.tensordot(j, t, axes=t.ndim) for j, t in zip(jax.tree.leaves(by_shared), jax.tree.leaves(moved), strict=True)
        ]
        terms += [j * t for j, t in zip(jax.tree.leaves(by_own), jax.tree.leaves(tangents[1]), strict=True)]
        return sum(terms)

    return jax.tree.map(times, jacobian, is_leaf=lambda x: isinstance(x, tuple) and len(x) == 2 and isinstance(x[1], Rays))
