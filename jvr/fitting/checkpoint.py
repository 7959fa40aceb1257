"""Saving an unfinished fit so that it can go on to the same answer."""

import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jvr.atomic import replacing


class CheckpointError(ValueError):
    """A checkpoint that does not belong to this fit, or cannot be read."""


def save(path: Path, state: Any, history: list[dict[str, Any]], fingerprint: str) -> None:
    """Writes the state of a solver and the history so far; the file is replaced at once or not at all."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(state, _is_data))]
    meta = json.dumps({"history": history, "fingerprint": fingerprint})
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {f"leaf{i}": leaf for i, leaf in enumerate(leaves)}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, meta=np.array(meta), **arrays)


def load(path: Path, like: Any, fingerprint: str) -> tuple[Any, list[dict[str, Any]]]:
    """The state and the history that `save` wrote, in the structure of `like`.

    **Raises** `CheckpointError` where the file cannot be read or was written by another fit.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            meta = json.loads(str(file["meta"]))
            leaves = [file[f"leaf{i}"] for i in range(len(file.files) - 1)]
    except Exception as error:
        raise CheckpointError(f"{path}: not a checkpoint of a fit, or damaged: delete it to start anew") from error
    if meta["fingerprint"] != fingerprint:
        raise CheckpointError(f"{path}: written by a fit of another scene, images or settings: delete it to start anew")
    data, rest = eqx.partition(like, _is_data)
    old, structure = jax.tree.flatten(data)
    new = [jnp.asarray(leaf) if isinstance(before, jax.Array) else leaf for leaf, before in zip(leaves, old, strict=True)]
    return eqx.combine(jax.tree.unflatten(structure, new), rest), meta["history"]


def _is_data(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic)
