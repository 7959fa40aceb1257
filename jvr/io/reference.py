"""The parameters of public classes and functions, as data and as Markdown, from what they declare."""

import dataclasses
import functools
import importlib
import inspect
from typing import Any

import equinox as eqx

from jvr.io.kinds import KINDS, maker_of
from jvr.model.parameters import Parameter, alternatives, declared, parts_of, shapes_of
from jvr.model.ranges import ANY
from jvr.names import NAMES


@dataclasses.dataclass(frozen=True)
class Entry:
    """A parameter of a class: `shape`, `range` and `default` in words, the last empty where a constructor needs a value, and what
    `jvr.model.parameters.Parameter` says of it."""

    name: str
    shape: str
    range: str
    unit: str
    default: str
    doc: str
    hint: str


def parameters_of(thing: Any) -> tuple[Entry, ...]:
    """The declared parameters of a class that its constructor takes, or those of a function, in its order."""
    arguments, fields = inspect.signature(thing.__init__ if isinstance(thing, type) else thing).parameters, declared(thing)
    taken = [(fields[name], argument.default) for name, argument in arguments.items() if name in fields]
    # What only jvr itself passes on, such as digits of a position, has no public class.
    hidden = lambda field: any(not _is_public(part) for part in parts_of(field.type))
    return tuple(_entry(field, default) for field, default in taken if not hidden(field))


def public_parameters() -> dict[str, tuple[Entry, ...]]:
    """The parameters of every public class and function that declares some, by its name."""
    found = {name: parameters_of(thing) for name, thing in sorted(public().items()) if _declares(thing)}
    return {name: entries for name, entries in found.items() if entries}


def _declares(thing: Any) -> bool:
    return issubclass(thing, eqx.Module) if inspect.isclass(thing) else bool(declared(thing))


def _is_public(part: type) -> bool:
    """Whether some public class is a part of this kind."""
    return any(issubclass(thing, part) for thing in public().values() if inspect.isclass(thing))


@functools.cache
def public() -> dict[str, Any]:
    """Every public name of `jvr` but modules, and what it names."""
    return {name: getattr(importlib.import_module(module), name) for module, names in NAMES.items() for name in names}


def kinds_of(thing: Any) -> tuple[str, ...]:
    """What configurations call a class or function."""
    named = ((kind, maker_of(family, kind)) for family, kinds in KINDS.items() for kind in kinds)
    return tuple(kind for kind, maker in named if maker == thing)


def markdown(entries: tuple[Entry, ...]) -> str:
    """A table of parameters; nothing where there are none."""
    if not entries:
        return ""
    lines = ["| parameter | what | shape | values | default |", "|---|---|---|---|---|"]
    for e in entries:
        about = Parameter(ANY, e.doc, e.unit, e.hint).about
        lines.append(f"| `{e.name}` | {about} | {e.shape} | {e.range} | {f'`{e.default}`' if e.default else 'needed'} |")
    return "\n".join(lines)


def _entry(field: dataclasses.Field, default: Any) -> Entry:
    about, kinds, is_array = field.metadata["parameter"], alternatives(field.type), False
    if parts_of(field.type):
        values = "part of a scene"
    elif field.metadata.get("static"):
        is_whole = int in kinds and float not in kinds
        values = "true or false" if bool in kinds else f"whole, {about.within.whole_words}" if is_whole else about.within.words
    else:
        values, is_array = about.within.words, True
    shapes = [str(shape).replace("'", "") for shape in shapes_of(field)] if is_array else []
    shape = " or ".join([*shapes, *(["jvr.ByValue", "jvr.ByGradient"] if about.by_scalar else [])])
    said = "" if default is inspect.Parameter.empty else f"{default:g}" if isinstance(default, float) else repr(default)
    return Entry(field.name, shape, values, about.unit, said, about.doc, about.hint)
