"""Saving an unfinished fit so that it can go on to the same answer."""

import dataclasses
import functools
import hashlib
import inspect
import json
import re
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jvr.atomic import replacing
from jvr.fitting.problem import Problem

# Of what is digested: with another number no digest is the same, which is what `load` says.
FORMAT = 2
# Digests by name.
Fingerprint = dict[str, str]


class CheckpointError(ValueError):
    """A checkpoint that does not belong to this fit, or cannot be read."""


def fingerprint(problem: Problem, given: tuple[Any, Any, Any, Any], solver: Any, coarse_levels: int = 0) -> Fingerprint:
    """A digest of each thing that a fit depends on, by its name: a checkpoint is not taken up by another fit. `given`: cameras, images,
    weights and the lights of each view."""
    scene = {field.name: getattr(problem.model.scene, field.name) for field in dataclasses.fields(problem.model.scene)}
    parts = scene | dict(zip(("cameras", "images", "weights", "lights of views"), given, strict=True))
    parts |= {
        "unknowns": problem.unknowns.names,
        "transforms": problem.unknowns.bijectors,
        "exposure": problem.model.exposure,
        "settings": problem.settings,
        "loss": problem.loss,
        "priors": problem.priors,
        "kept samples": problem.samples is None,
        "solver": solver,
    }
    parts |= {"coarse levels": coarse_levels} if coarse_levels else {}
    return {name: hashlib.sha256(f"{FORMAT}{_canonical(part)}".encode()).hexdigest()[:16] for name, part in parts.items()}


def _canonical(value: Any, around: tuple[int, ...] = ()) -> str:
    """A value in words that are the same in every process: a function is its name, its instructions and what it closes over (the
    optimisers of Optax are nothing else), where `repr` would name a place in memory."""
    if id(value) in around:
        return "itself"
    inner = functools.partial(_canonical, around=(*around, id(value)))
    if eqx.is_array(value) or isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        return f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"
    if isinstance(value, functools.partial):
        return f"partial({inner((value.func, value.args, value.keywords))})"
    if inspect.isfunction(value):
        held = inspect.getclosurevars(value).nonlocals
        return f"{value.__module__}.{value.__qualname__}{value.__code__.co_code.hex()}{inner(held)}{inner(value.__defaults__)}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return f"{type(value).__qualname__}{inner({f.name: getattr(value, f.name, None) for f in dataclasses.fields(value)})}"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key!r}: {inner(held)}' for key, held in value.items())}}}"
    if isinstance(value, tuple | list):
        return f"{type(value).__qualname__}({', '.join(map(inner, value))})"
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))


def save(path: Path, state: Any, history: list[dict[str, Any]], fingerprint: Fingerprint) -> None:
    """Writes the state of a solver and the history so far; the file is replaced at once or not at all."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(state, _is_data))]
    meta = json.dumps({"history": history, "fingerprint": fingerprint})
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {f"leaf{i}": leaf for i, leaf in enumerate(leaves)}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, meta=np.array(meta), **arrays)


def load(path: Path, like: Any, fingerprint: Fingerprint) -> tuple[Any, list[dict[str, Any]]]:
    """The state and the history that `save` wrote, in the structure of `like`.

    **Raises** `CheckpointError` where the file cannot be read or was written by another fit.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            meta = json.loads(str(file["meta"]))
            leaves = [file[f"leaf{i}"] for i in range(len(file.files) - 1)]
    except Exception as error:
        raise CheckpointError(f"{path}: not a checkpoint of a fit, or damaged: delete it to start anew") from error
    written = meta["fingerprint"]
    if changed := [name for name in fingerprint if not isinstance(written, dict) or written.get(name) != fingerprint[name]]:
        named = f"{', '.join(changed)} changed since" if len(changed) < len(fingerprint) else "another version of jvr wrote it"
        raise CheckpointError(f"{path}: is of another fit ({named}): undo the change, or delete it to start anew")
    data, rest = eqx.partition(like, _is_data)
    old, structure = jax.tree.flatten(data)
    if [np.shape(leaf) for leaf in leaves] != [np.shape(leaf) for leaf in old]:
        raise CheckpointError(f"{path}: written by another version of the solver: delete it to start anew")
    new = [jnp.asarray(leaf) if isinstance(before, jax.Array) else leaf for leaf, before in zip(leaves, old, strict=True)]
    return eqx.combine(jax.tree.unflatten(structure, new), rest), meta["history"]


def _is_data(leaf: Any) -> bool:
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.generic)
