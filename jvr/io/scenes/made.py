"""A part of a scene from its fields: by its constructor, which checks them, and then exact to the last bit."""

import dataclasses
import inspect
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jvr.io.config.errors import ConfigError, blame, shown
from jvr.io.scenes.kinds import fits, wanted


def is_static(field: dataclasses.Field) -> bool:
    """Whether a field is a choice, and no array."""
    return bool(field.metadata.get("static"))


def is_derived(field: dataclasses.Field) -> bool:
    """Whether a field is made of the others (`jvr.model.kept.made_by`)."""
    return "made_by" in field.metadata


def made(cls: type, values: Mapping[str, Any], where: str, key: str) -> Any:
    """The object of a class whose fields have these values; of those that are left out the constructor decides.

    What a constructor makes of its arguments, such as voxels that it fills in, may differ from what a scene held; then that has its place.

    **Raises** `ConfigError` for what the constructor refuses, and for values that are not what the fields are declared as.
    """
    fields, arguments = {f.name: f for f in dataclasses.fields(cls)}, {}
    for name, parameter in inspect.signature(cls.__init__).parameters.items():
        if name in values:
            arguments[name] = values[name]
        elif parameter.default is parameter.empty and name != "self":
            if name not in fields or not fits(None, fields[name].type):
                raise ConfigError(where, _inside(key, name), "missing; this key is needed here")
            arguments[name] = None
    with blame(where, key):
        part = cls(**arguments)
    arrays = [name for name in values if not is_static(fields[name])]
    changed = [name for name in arrays if not same(getattr(part, name), values[name])]
    if changed:
        pick = lambda p: tuple(getattr(p, name) for name in changed)
        part = eqx.tree_at(pick, part, tuple(values[name] for name in changed), is_leaf=lambda x: x is None)
    for f in fields.values():
        value = getattr(part, f.name)
        if not is_derived(f) and not fits(value, f.type):
            raise ConfigError(where, _inside(key, f.name), f"is {_described(value)}; it must be {wanted(f.type)}")
    return part


def same(one: Any, other: Any) -> bool:
    """Whether two values are the same in structure, static choices, types and every bit."""
    (a, structure), (b, structure_b) = jax.tree.flatten(one), jax.tree.flatten(other)
    return structure == structure_b and all(map(_same_bits, a, b))


def _same_bits(a: Any, b: Any) -> bool:
    if a is b:
        return True
    a, b = np.asarray(a), np.asarray(b)
    bits = lambda x: np.ascontiguousarray(x).reshape(-1).view(np.uint8)
    return a.dtype == b.dtype and a.shape == b.shape and np.array_equal(bits(a), bits(b))


def _inside(key: str, name: str) -> str:
    return f"{key}.{name}".lstrip(".")


def _described(value: Any) -> str:
    if eqx.is_array(value):
        return f"an array of {value.dtype} with shape {value.shape}"
    return f"a {type(value).__name__}" if isinstance(value, eqx.Module) else shown(value)
