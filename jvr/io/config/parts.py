"""From tables to the parts of a scene."""

from collections.abc import Callable
from typing import Any

from jvr.io.config.errors import blame
from jvr.io.config.schema.parts import PartTable


def made(where: Callable[[str], str], key: str, table: PartTable, *without: str) -> Any:
    """The part that a table describes, with those of the tables in it; keys `without` say something else. `where`: whose fault a key is.

    **Raises** `ConfigError` for what a constructor refuses, which names the key.
    """
    given = {name: value for name, value in table.given().items() if name not in without}
    keywords = {name: _value(where, f"{key}.{name}", value) for name, value in given.items()}
    with blame(where(key), key):
        return table.part(**keywords)


def _value(where: Callable[[str], str], key: str, value: Any) -> Any:
    if isinstance(value, PartTable):
        return made(where, key, value)
    if isinstance(value, list):
        return [_value(where, f"{key}[{i}]", entry) for i, entry in enumerate(value)]
    return value
