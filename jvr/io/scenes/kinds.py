"""What a file may name, and what the fields of a class take: all of it is what the classes declare."""

import inspect
import types
import typing
from typing import Any

import equinox as eqx

from jvr.io.kinds import PARTS as PARTS
from jvr.io.kinds import class_named as class_named
from jvr.model.parameters import alternatives

# How a file says that something is absent which would be there if nothing was said.
NONE = "None"


def kinds_of(annotation: Any) -> list[str]:
    """The public classes that a field takes, such as all transfer functions; all where it takes anything."""
    wanted = classes_of(annotation) or (eqx.Module,)
    return [name for name in PARTS if issubclass(class_named(name), wanted)]


def classes_of(annotation: Any) -> tuple[type, ...]:
    """The classes of parts that an annotation names."""
    if isinstance(annotation, type) and issubclass(annotation, eqx.Module):
        return (annotation,)
    return tuple(dict.fromkeys(found for inner in typing.get_args(annotation) for found in classes_of(inner)))


def implied(annotation: Any) -> type | None:
    """The class of a part whose kind goes without saying: its field takes no other, or names it beside the family that it belongs to."""
    found = classes_of(annotation)
    first = bool(found) and all(issubclass(found[0], other) for other in found)
    return found[0] if first and not inspect.isabstract(found[0]) else None


def entry_of(annotation: Any) -> Any:
    """What each entry of a tuple takes, or `None` for fields that take no tuples."""
    return next((typing.get_args(kind)[0] for kind in alternatives(annotation) if typing.get_origin(kind) is tuple), None)


def takes_one(annotation: Any) -> bool:
    """Whether a field takes a part that is in no tuple."""
    return any(classes_of(kind) and typing.get_origin(kind) is not tuple for kind in alternatives(annotation))


def fits(value: Any, annotation: Any) -> bool:
    """Whether a value is what an annotation says; arrays by their shape and kind of number."""
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation is Any:
        return True
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, one) for one in inner)
    if origin is typing.Literal:
        return value in inner
    if origin is tuple:
        every = inner[:1] * len(value) if isinstance(value, tuple) and inner[-1] is Ellipsis else inner
        return isinstance(value, tuple) and len(value) == len(every) and all(map(fits, value, every))
    if annotation in (int, float):
        return isinstance(value, (int, annotation)) and not isinstance(value, bool)
    return isinstance(value, annotation)


def wanted(annotation: Any) -> str:
    """An annotation in words."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType, typing.Literal):
        return " or ".join(map(wanted, typing.get_args(annotation)))
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): f'"{NONE}"'}
    return words.get(annotation) or getattr(annotation, "__name__", None) or f'"{annotation}"'
