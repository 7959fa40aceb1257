"""From tables to the parts of a scene."""

from collections.abc import Callable
from typing import Any

from jvr.io.config.errors import blame
from jvr.io.config.schema.parts import PartTable
from jvr.io.kinds import kind_of
from jvr.model.parameters import declared


def made(where: Callable[[str], str], key: str, table: PartTable, *without: str) -> Any:
    """The part that a table describes, with those of the tables in it; keys `without` say something else. `where`: whose fault a key is.

    **Raises** `ConfigError` for what a constructor refuses, which names the key.
    """
    given = {name: value for name, value in table.given().items() if name not in without}
    keywords = {name: made_value(where, f"{key}.{name}", value) for name, value in given.items()}
    with blame(where(key), key):
        return table.part(**keywords)


def choices_of(part: Any) -> dict[str, Any]:
    """The static choices of an object by the keys of its table, and those of the parts in it, of which one without any is the name of its
    kind."""
    found: dict[str, Any] = {}
    for name, field in declared(type(part)).items():
        value = getattr(part, name)
        kind = kind_of(value)
        if kind is not None:
            inner = choices_of(value)
            found[name] = {"kind": kind} | inner if inner else kind
        elif field.metadata.get("static"):
            found[name] = value
    return found


def made_value(where: Callable[[str], str], key: str, value: Any) -> Any:
    """What the value of a key stands for: a table for a part, a list for what its entries stand for, anything else for itself."""
    if isinstance(value, PartTable):
        return made(where, key, value)
    if isinstance(value, list):
        return [made_value(where, f"{key}[{i}]", entry) for i, entry in enumerate(value)]
    return value
