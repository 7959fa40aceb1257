"""Derivatives of a march with respect to the entries of a tabulated transfer function."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jvr.model.transfer import AbstractTable, AbstractTransfer, Classified
from jvr.numerics import add_runs


def split_entries(tree: AbstractTransfer) -> tuple[Any, Any]:
    """The same tree twice: without the entries of a table (its colours and extinctions), and with nothing but them."""
    if not isinstance(tree, AbstractTable):
        return tree, jax.tree.map(lambda _: None, tree)
    rest = eqx.tree_at(lambda t: (t.rgb, t.sigma_t), tree, (None, None), is_leaf=lambda x: x is None)
    nothing = jax.tree.map(lambda _: None, tree)
    entries = eqx.tree_at(lambda t: (t.rgb, t.sigma_t), nothing, (tree.rgb, tree.sigma_t), is_leaf=lambda x: x is None)
    return rest, entries


def deposit_entries(gradient: Any, table: AbstractTransfer, s: Float[Array, "rays"], cotangent: Classified) -> Any:
    """Adds the derivative of `sum(cotangent * table.evaluate(s))` to the entries of `gradient` that are not `None`.

    Each sample touches the two entries around it. All channels go into one row: one scattered pair of rows for each sample, and not two
    scattered numbers for each channel.
    """
    if not isinstance(table, AbstractTable):
        return gradient
    wanted = [gradient.rgb, gradient.sigma_t]
    columns = [c for entries, c in zip(wanted, cotangent, strict=False) if entries is not None]
    wanted = [entries for entries in wanted if entries is not None]
    if not wanted:
        return gradient
    packed = jnp.concatenate([entries.reshape(entries.shape[0], -1) for entries in wanted], axis=1)
    rows = jnp.stack(sum(columns, ()), axis=1)
    u = jax.vmap(table.coordinate)(s)
    low = jnp.clip(jnp.floor(u), 0, packed.shape[0] - 2)
    fraction = (u - low)[:, None]
    packed = add_runs(packed, low.astype(jnp.int32), jnp.stack([(1 - fraction) * rows, fraction * rows], axis=1))
    split = jnp.split(packed, [len(columns[0])], axis=1)[: len(wanted)]
    deposited = [part.reshape(entries.shape) for part, entries in zip(split, wanted, strict=True)]
    return eqx.tree_at(lambda t: [e for e in (t.rgb, t.sigma_t) if e is not None], gradient, deposited)
