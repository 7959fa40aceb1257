"""From a TOML file and `--set` to checked tables, and from a name in them to a file."""

import copy
import dataclasses
import os
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from jvr.io.config.errors import ConfigError, did_you_mean, first_complaint
from jvr.io.config.schema.whole import ConfigTable
from jvr.io.config.text import read_toml

Override = tuple[str, Any]
# Tables whose values may be others where a fit starts.
INITIAL = (
    "camera",
    "lights",
    "shading",
    "scattering",
    "background",
    "environment",
    "material",
    "radiance_transfer",
    "occlusion",
    "surfaces",
    "specular",
)
# Keys of one table that exclude each other.
ALTERNATIVES = {"path": "builtin", "fov_y": "half_angle_tangent", "opacity": "sigma_t"}
ALTERNATIVES |= {b: a for a, b in ALTERNATIVES.items()}


@dataclasses.dataclass(frozen=True)
class Config:
    """Checked tables, and where they come from: `name` is what errors call them, `folder` what their paths are relative to,
    `text` the file, `overrides` what the command line has set (`overridden` are the keys alone), `data` the tables as they were given."""

    tables: ConfigTable
    name: str
    folder: Path
    overridden: tuple[str, ...] = ()
    text: str = ""
    overrides: tuple[str, ...] = ()
    data: dict[str, Any] = dataclasses.field(default_factory=dict)

    def where(self, key: str) -> str:
        """Whose fault a key is: the command line's, or the file's."""
        return _where(self.name, self.overridden, key)

    def find(self, path: str, key: str, what: str | None = None) -> Path:
        """The file that a path means: as it is where absolute, else below the folder of the configuration, else below
        `$JVR_DATA` (default `./data`). What the command line has set is first looked for in the working folder.

        **Raises** `ConfigError` where there is no such file; `what` says which data set it is.
        """
        # Unlike the method of Path, this leaves "~name" as it is where there is no such user.
        given = Path(os.path.expanduser(path))
        data = Path(os.environ.get("JVR_DATA", "data"))
        here = [Path()] if self.where(key) == "--set" else []
        folders = [Path()] if given.is_absolute() else [*here, self.folder, data]
        for folder in folders:
            if (folder / given).exists():
                return folder / given
        problem = f"'{path}' does not exist"
        if not given.is_absolute():
            known = f"{data}" if "JVR_DATA" in os.environ else f"{data}, as it is not set"
            problem = f"'{path}' is not in {self.folder}, nor in $JVR_DATA ({known})"
        raise ConfigError(self.where(key), key, problem + (f"; it is {what}" if what else ""))


def read_config(path: str | os.PathLike, overrides: Sequence[str] = ()) -> Config:
    """Reads and checks a configuration; `overrides` are `key=value` with the value in TOML, or else text.

    **Raises** `ConfigError` for anything that is not a valid configuration, `OSError` where the file cannot be read.
    """
    path = Path(path)
    if not path.exists():
        near = did_you_mean(path.name, [p.name for p in path.parent.glob("*.toml")]) if path.parent.is_dir() else ""
        raise ConfigError(str(path), "", "no such file" + (f"; {near}" if near.startswith("did") else ""))
    text, data = read_toml(path)
    if {"format", "checksum"} <= set(data):
        raise ConfigError(str(path), "", "this is a scene, which jvr.load_scene reads in Python, and no configuration")
    return dataclasses.replace(config_from(data, str(path), path.parent, overrides), text=text)


def config_from(data: dict[str, Any], name: str, folder: Path = Path(), overrides: Sequence[str] = ()) -> Config:
    """A configuration from tables that are already in memory; `name` is what errors call it."""
    keys = []
    for text in overrides:
        key, value = _parse(text)
        _put(data, key, value)
        keys.append(key)
    data = _with_cameras(data, name, folder, tuple(keys))
    try:
        return Config(ConfigTable.model_validate(data), name, folder, tuple(keys), overrides=tuple(overrides), data=data)
    except ValidationError as error:
        key, problem = first_complaint(error, data)
        # A misspelt table is named by the whole key that was set in it.
        misspelt = problem.startswith("unknown key") and any(k.startswith(f"{key}.") for k in keys)
        raise ConfigError("--set" if misspelt else _where(name, tuple(keys), key), key, problem) from None


def _with_cameras(data: dict[str, Any], name: str, folder: Path, keys: tuple[str, ...]) -> dict[str, Any]:
    """Tables with those of the file that `camera` names in its place, as a fit writes one; other words are kinds of cameras."""
    given = data.get("camera")
    if not isinstance(given, str) or not given.endswith(".toml"):
        return data
    where = _where(name, keys, "camera")
    folders = [Path(), folder] if where == "--set" else [folder]
    found = next((place / given for place in folders if (place / given).is_file()), None)
    if found is None:
        raise ConfigError(where, "camera", f"'{given}' does not exist; a file of tables [[camera]] is meant, as a fit writes one")
    _, tables = read_toml(found)
    if set(tables) != {"camera"}:
        raise ConfigError(str(found), "", "a file of cameras has tables [[camera]] and nothing else")
    return {**data, "camera": tables["camera"]}


def started(config: Config) -> Config:
    """The configuration with the values of `fit.initial` in place of its own.

    **Raises** `ConfigError` for keys that say nothing about cameras, light and surfaces, and for values that are refused there.
    """
    fit = config.tables.fit
    if fit is None or not fit.initial:
        return config
    data, place = copy.deepcopy(config.data), config.where("fit.initial")
    for key, value in _leaves(fit.initial):
        first = key.split(".")[0]
        if first not in INITIAL:
            raise ConfigError(place, f"fit.initial.{key}", f"unknown key; {did_you_mean(first, INITIAL)}")
        _put(data, key, value, f"{place}: fit.initial")
    return config_from(data, f"{place}: fit.initial", config.folder)


def _leaves(table: dict[str, Any], prefix: str = "") -> Iterator[Override]:
    for key, value in table.items():
        path = prefix + key.replace("[", ".").replace("]", "")
        # A table that names its kind takes the place of the whole table that was there.
        if isinstance(value, dict) and "kind" not in value:
            yield from _leaves(value, f"{path}.")
        else:
            yield path, value


def _where(name: str, overridden: tuple[str, ...], key: str) -> str:
    key = key.replace("[", ".").replace("]", "")
    return "--set" if any(key == k or key.startswith(f"{k}.") for k in overridden) else name


def _parse(text: str) -> Override:
    key, equals, value = text.partition("=")
    key = key.strip().replace("[", ".").replace("]", "")
    if not equals or not all(key.split(".")):
        raise ConfigError("--set", "", f"'{text}' must be key=value, such as settings.step=0.5")
    try:
        parsed = tomllib.loads(f"value = {value}")
    except (ValueError, RecursionError):
        return key, value
    return key, parsed["value"] if list(parsed) == ["value"] else value


def _put(data: dict[str, Any], key: str, value: Any, where: str = "--set") -> None:
    """Sets a dotted key; whole numbers are indices of lists."""
    *parents, last = key.split(".")
    place: Any = data
    for part in parents:
        place = _enter(place, part, key, where)
    if isinstance(place, list):
        place[_index(place, last, key, where)] = value
    elif isinstance(place, dict):
        # What is set takes the place of its alternative in the file.
        place.pop(ALTERNATIVES.get(last, ""), None)
        place[last] = value
    else:
        raise ConfigError(where, key, f"'{'.'.join(parents)}' is a value, not a table")


def _enter(place: Any, part: str, key: str, where: str) -> Any:
    if isinstance(place, list):
        return place[_index(place, part, key, where)]
    if not isinstance(place, dict):
        raise ConfigError(where, key, f"'{part}' lies in a value, not in a table")
    return place.setdefault(part, {})


def _index(place: list, part: str, key: str, where: str) -> int:
    if not part.isdigit() or int(part) >= len(place):
        raise ConfigError(where, key, f"'{part}' must be an index from 0 to {len(place) - 1}")
    return int(part)
