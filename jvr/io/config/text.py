"""TOML as text: read with its errors in one line, written so that reading gives every number back exactly."""

import json
import os
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.config.errors import ConfigError


class Inline(dict):
    """A table that is written in one line."""


def read_toml(path: str | os.PathLike) -> tuple[str, dict[str, Any]]:
    """The text of a file and its tables. **Raises** `ConfigError` where it is not TOML, `OSError` where it cannot be read."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        return text, tomllib.loads(text)
    # Numbers of thousands of digits and thousands of nested brackets raise errors of their own.
    except (ValueError, RecursionError) as error:
        raise ConfigError(str(path), "", f"not valid TOML: {error}") from None


def toml_of(tables: dict[str, Any], header: str = "") -> str:
    """Tables as TOML: dictionaries, lists of them, arrays, numbers, truth values and strings."""
    inside = lambda value: (
        (isinstance(value, dict) and not isinstance(value, Inline)) or (isinstance(value, list) and value != [])
    )
    lines = [f"{key} = {value_text(value)}\n" for key, value in tables.items() if not inside(value)]
    for key, value in tables.items():
        name = f"{header}.{key}".lstrip(".")
        if inside(value) and isinstance(value, dict):
            lines.append(f"\n[{name}]\n{toml_of(value, name)}")
        elif inside(value):
            lines.extend(f"\n[[{name}]]\n{toml_of(entry, name)}" for entry in value)
    return "".join(lines)


def value_text(value: Any) -> str:
    """One value as TOML."""
    if isinstance(value, Inline):
        inner = ", ".join(f"{key} = {value_text(part)}" for key, part in value.items())
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, np.ndarray):
        return array_text(value)
    if isinstance(value, str):
        # JSON's strings are TOML's but for this one character.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return str(value).lower() if isinstance(value, bool) else str(value)


def array_text(array: np.ndarray) -> str:
    """An array as TOML, each row of a table on a line of its own; the digits are the fewest that give the same numbers."""
    if array.ndim == 0:
        return _digits(array[()])
    if array.ndim == 1:
        return f"[{', '.join(_digits(x) for x in array)}]"
    return "[\n" + "".join(f"  {array_text(row)},\n" for row in array) + "]"


def _digits(x: Any) -> str:
    """The shortest digits that give exactly this number again when read as float64 and converted."""
    text = str(x)
    return text if type(x)(float(text)) == x else repr(float(x))
