"""What files of presets share: how they are opened, and what is said of those that are none."""

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes.errors import one_line

# ParaView's own list of all its colour maps takes 2 MB.
LARGEST = 20_000_000


class PresetError(ValueError):
    """A preset that cannot be read or written: one line that names the file, what is wrong and what would be right."""

    def __init__(self, path: str | os.PathLike, problem: str):
        super().__init__(" ".join(f"{path}: {problem}".split()))


def text_of(path: Path, what: str, remedy: str) -> str:
    """The text of a file; `what`: it should be."""
    # A pipe or a device may never end.
    if path.exists() and not path.is_file():
        raise PresetError(path, f"no file, but {what} is one; {remedy}")
    with path.open("rb") as file:
        content = file.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise PresetError(path, f"larger than {LARGEST:,} bytes, which no preset is; {remedy}")
    try:
        return content.decode()
    except UnicodeDecodeError:
        raise PresetError(path, f"not {what}: it is not text; {remedy}") from None


def json_of(path: Path, what: str, remedy: str) -> Any:
    """What a JSON file says."""
    text = text_of(path, what, remedy)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise PresetError(path, f"not {what} ({one_line(error)}); {remedy}") from None


@contextmanager
def refusing(path: Path, what: str, remedy: str) -> Iterator[None]:
    """What goes wrong in this block is the fault of the file."""
    try:
        yield
    except PresetError:
        raise
    except KeyError as error:
        raise PresetError(path, f"not {what}: it has no {error}; {remedy}") from None
    except (ValueError, TypeError, AttributeError, ArithmeticError) as error:
        raise PresetError(path, f"not {what}: {one_line(error)}; {remedy}") from None


def rows_of(numbers: Any, columns: int, name: str) -> np.ndarray:
    """A flat list of numbers as rows."""
    flat = np.array([float(number) for number in numbers])
    if not len(flat) or len(flat) % columns:
        raise ValueError(f"{name} has {len(flat)} numbers, which are not points of {columns}")
    return flat.reshape(-1, columns)
