"""From tables to the parts of a scene."""

from typing import Any

from jvr.io.config.errors import blame
from jvr.io.config.load import Config
from jvr.io.config.schema.parts import PartTable


def made(config: Config, key: str, table: PartTable, *without: str) -> Any:
    """The part that a table describes, with those of the tables in it; keys `without` say something else.

    **Raises** `ConfigError` for what a constructor refuses, which names the key.
    """
    given = {name: value for name, value in table.given().items() if name not in without}
    keywords = {name: _value(config, f"{key}.{name}", value) for name, value in given.items()}
    with blame(config.where(key), key):
        return table.part(**keywords)


def _value(config: Config, key: str, value: Any) -> Any:
    if isinstance(value, PartTable):
        return made(config, key, value)
    if isinstance(value, list):
        return [_value(config, f"{key}[{i}]", entry) for i, entry in enumerate(value)]
    return value
