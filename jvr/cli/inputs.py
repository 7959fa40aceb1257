"""What a person gives to a command: files, folders and flags, refused in one line before any work starts."""

import contextlib
import os
import re
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jvr.io.config import Config

IMAGES = (".exr", ".png")


class BadInput(Exception):
    """Input that cannot be used; the message is the line that the person sees."""


class Interrupted(Exception):
    """Ctrl-C or SIGTERM; the message says what was kept."""

    def __init__(self, message: str, status: int):
        super().__init__(message)
        self.status = status


@contextlib.contextmanager
def reading() -> Iterator[None]:
    """A stage that only reads and checks input: what it raises is the input's fault. Warnings become lines on stderr."""
    with warnings_as_lines():
        try:
            yield
        except OSError as error:
            raise BadInput(system_problem(error)) from error
        except (ValueError, TypeError) as error:
            raise BadInput(str(error)) from error


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Warnings are one line each on stderr, without the place in the program that they come from."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *rest, **more: explain(f"warning: {message}", 0)
        yield


def refused_by_jvr(error: Exception) -> bool:
    """Whether the error was raised in jvr's own code on purpose, rather than somewhere below it."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return Path(last.filename).is_relative_to(Path(__file__).parents[1]) and (last.line or "").lstrip().startswith("raise")


def explain(message: str, status: int) -> int:
    """Prints one line on stderr and returns the exit status that goes with it."""
    line = " ".join(message.split())
    print(f"jvr: {line}", file=sys.stderr)
    return status


def usage_problem(error: Any) -> str:
    """A wrong command line as one line, with the help that would put it right."""
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "jvr"
    return f"{error.format_message().rstrip('.')}; see {command} --help"


def load(given: Path, sets: Sequence[str], volume: dict[str, Any] | None = None) -> "Config":
    """The configuration of a TOML file, or one made up for a volume file that is named directly."""
    from jvr.io.config import config_from, read_config

    if given.suffix.lower() == ".toml":
        if refused := [f"--{key.replace('_', '-')}" for key in (volume or {})]:
            raise BadInput(f"{refused[0]} is for a volume file; for a configuration use --set")
        return read_config(given, sets)
    if not given.exists():
        raise BadInput(f"{given}: no such file; give a configuration (.toml) or a volume")
    data = {"volume": {"path": str(given.absolute()), **(volume or {})}, "transfer": {"kind": "window"}}
    data["background"] = [0.0, 0.0, 0.0]
    return config_from(data, str(given), given.parent, sets)


def name_of(given: Path) -> str:
    """A volume's or configuration's name without its ending; dots of its own stay: `scan.v2.nii.gz` is `scan.v2`."""
    from jvr.io.volumes import READERS

    # Not what a link leads to: stores of data call that by its checksum.
    name = Path(os.path.abspath(given)).name or "volume"
    if given.is_dir() and not name.lower().endswith(".zarr"):
        return name
    endings = [ending for ending in (*READERS, ".toml") if name.lower().endswith(ending)]
    return name[: -len(max(endings, key=len))] or name if endings else name


def inputs_of(config: "Config") -> list[Path]:
    """The files and folders that a configuration reads, itself among them, as far as they exist."""
    named: list[tuple[str, str]] = []

    def walk(value: Any, key: str) -> None:
        if isinstance(value, dict):
            for name, part in value.items():
                walk(part, f"{key}.{name}".lstrip("."))
        elif isinstance(value, list):
            for i, part in enumerate(value):
                walk(part, f"{key}.{i}")
        elif isinstance(value, str) and re.search(r"(^|\.)path$|^fit\.(images|weights)\.", key):
            named.append((value, key))

    walk(config.data, "")
    found = [Path(config.name)] if Path(config.name).exists() else []
    for path, key in named:
        with contextlib.suppress(ValueError):
            found.append(config.find(path, key))
    return found


def check_inputs_stay(output: Path, inputs: Sequence[Path]) -> None:
    """Refuses an output that would take the place of an input, or join the files of a folder that is read."""
    for path in inputs:
        if path.is_dir():
            siblings = output.parent.exists() and path.samefile(output.parent)
            taken = siblings and any(p.suffix.lower() == output.suffix.lower() for p in path.iterdir())
        else:
            taken = output.exists() and path.samefile(output)
        if taken:
            raise BadInput(f"-o {output}: would change {path}, which is read; choose another name or folder")


def check_image_output(path: Path) -> None:
    """Refuses a picture that could not be written."""
    if path.suffix.lower() not in IMAGES:
        raise BadInput(f"-o {path}: pictures are written as .exr (linear) or .png (sRGB)")
    check_file_output(path, "out.png")


def check_file_output(path: Path, example: str) -> None:
    """Refuses a file that could not be written."""
    if path.is_dir():
        raise BadInput(f"-o {path}: this is a folder; name a file in it, such as {path / example}")
    if path.exists() and not os.access(path, os.W_OK):
        raise BadInput(f"-o {path}: the file is write-protected; choose another name")
    _try_to_write(path.parent, f"-o {path}")


def check_folder_output(path: Path) -> None:
    """Refuses a folder that could not be created or written to; it is created once there is something to write."""
    exists = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not exists.is_dir():
        raise BadInput(f"-o {path}: {'this' if exists == path else exists} is a file; name a folder")
    _try_to_write(exists, f"-o {path}")


def _try_to_write(folder: Path, flag: str) -> None:
    if not folder.is_dir():
        raise BadInput(f"{flag}: the folder {folder} does not exist; create it first")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise BadInput(f"{flag}: cannot write to {folder}: {error.strerror}; choose another folder") from error


def system_problem(error: OSError) -> str:
    """Jvr's own messages name the file already; the system's have it in an attribute."""
    if error.strerror is None:
        return str(error)
    return f"{error.filename}: {error.strerror}" if error.filename else f"{error.strerror}: output is cut short"
