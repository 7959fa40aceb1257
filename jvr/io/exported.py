"""Scenes, cameras, settings and pictures as arguments and results of functions that `jax.export` writes down."""

import functools
import importlib
import json
import pkgutil
import sys
from typing import Any

import equinox as eqx
import jax
from jax import export

# Where the types are that such a function may take or return.
PACKAGES = ("jvr.model", "jvr.march", "jvr.effects", "jvr.rendering", "jvr.integrators")


class _Empty(eqx.Module):
    """A module without fields."""


# What Equinox has in the place of what is not there.
_NOTHING = jax.tree_util.default_registry.flatten_one_level(_Empty())[1][0]  # pyright: ignore[reportOptionalSubscript]


def use_export() -> None:
    """Makes the types of jvr known to `jax.export`, so that functions of them can be written to a file and read from it:

        jvr.use_export()
        exported = jax.export.export(jax.jit(lambda scene: jvr.render(scene, camera)))(scene)
        Path("picture.bin").write_bytes(exported.serialize())

    and in another process, on as many devices, with a scene of the same structure,

        jvr.use_export()
        picture = jax.export.deserialize(bytearray(Path("picture.bin").read_bytes())).call(scene)

    JAX writes it by the package `flatbuffers` (`pip install "jvr[export]"`). To be called in both, after the classes of one's own that
    derive from jvr's; any number of times. What is written is the structure of arguments and results, as JSON, nothing that is executed
    when it is read. **Raises** `TypeError`, while that is written, for static fields other than numbers, strings and tuples of them.
    """
    for package in PACKAGES:
        for found in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            importlib.import_module(found.name)
    for kind in _modules(eqx.Module):
        _register(kind)
    for name, module in list(sys.modules.items()):
        if name.startswith(PACKAGES):
            for kind in vars(module).values():
                if isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields"):
                    _register_tuple(kind)


def _modules(kind: type) -> set[type]:
    """All of jvr's modules, and those that are made of them, below a class. A class within a function has no name to be found by."""
    found = {kind} if any(base.__module__.startswith("jvr.") for base in kind.__mro__) and "<" not in kind.__qualname__ else set()
    return found.union(*map(_modules, kind.__subclasses__()))


@functools.cache
def _register(kind: type) -> None:
    export.register_pytree_node_serialization(
        kind,
        serialized_name=_name(kind),
        serialize_auxdata=lambda fields: json.dumps([_plain(value, kind) for value in fields]).encode(),
        deserialize_auxdata=lambda text: tuple(map(_restored, json.loads(text))),
    )


@functools.cache
def _register_tuple(kind: Any) -> None:
    export.register_namedtuple_serialization(kind, serialized_name=_name(kind))


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"


def _plain(value: Any, kind: type) -> Any:
    """A static field as JSON has it: objects stand for what that does not know."""
    if value is _NOTHING:
        return {}
    if isinstance(value, tuple):
        return {"tuple": [_plain(item, kind) for item in value]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"jax.export cannot keep a {type(value).__name__} that is a static field of {_name(kind)}")


def _restored(value: Any) -> Any:
    if isinstance(value, dict):
        return tuple(map(_restored, value["tuple"])) if value else _NOTHING
    return value
