"""The parameters of public classes, as data and as Markdown, from what the classes declare."""

import dataclasses
import functools
import importlib
import inspect
from typing import Any

import equinox as eqx

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
    """The parameters of every public class that has some, by the name of the class."""
    return {name: parameters_of(cls) for name, cls in _public_classes().items() if parameters_of(cls)}


def _is_public(part: type) -> bool:
    """Whether some public class is a part of this kind."""
    return any(issubclass(cls, part) for cls in _public_classes().values())


@functools.cache
def _public_classes() -> dict[str, type]:
    things = {name: getattr(importlib.import_module(module), name) for module, names in NAMES.items() for name in names}
    return {name: cls for name, cls in sorted(things.items()) if inspect.isclass(cls) and issubclass(cls, eqx.Module)}


def markdown(entries: tuple[Entry, ...]) -> str:
    """A table of parameters."""
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
    shape = " or ".join([*shapes, *(["jvr.ByValue"] if about.by_scalar else [])])
    said = "" if default is inspect.Parameter.empty else f"{default:g}" if isinstance(default, float) else repr(default)
    return Entry(field.name, shape, values, about.unit, said, about.doc, about.hint)
