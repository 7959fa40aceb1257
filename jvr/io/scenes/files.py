"""Saving a scene and loading it again."""

import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jvr.atomic import replacing_together
from jvr.execution.devices import is_traced
from jvr.io.config.errors import ConfigError, shown
from jvr.io.config.text import read_toml, toml_of
from jvr.io.scenes.arrays import checksum, number_type, opened, write_arrays
from jvr.io.scenes.read import Reader
from jvr.io.scenes.written import Writer, precision_of
from jvr.io.volumes.errors import first_bytes
from jvr.model.scene import Scene

# Of the file; grows whenever an older jvr would misread what is written.
FORMAT = 1
HEADER = "# A scene of jvr, for jvr.load_scene. Numbers may be edited; long arrays are in {name}, which belongs to this file.\n"


def save_scene(scene: Scene, path: str | os.PathLike) -> None:
    """Writes a scene as TOML, and its long arrays beside it under the same name with the ending `.npz`.

    `jvr.load_scene` gives the same scene again, bit for bit: every array with its type, every static choice, a radiance transfer that was
    computed beforehand. What a volume keeps of its voxels (`bricked`, `packed`, `graded`) is computed anew. Names are those of Python:
    classes by `kind`, fields as they are called, so that a colour or a position can be edited in the text.

    Both files are replaced together, or none is.

    **Arguments:** `path`: ends in `.toml`.
    **Raises** `TypeError` for a part whose class is neither jvr's own nor registered by `jvr.register`, and for arrays that are being
    traced; `ValueError` for another ending, and for a scene that its constructors would refuse, as `equinox.tree_at` can make one;
    `OSError` where a file cannot be written.
    """
    path = _named(path)
    if type(scene) is not Scene:
        raise TypeError(f"save_scene writes a jvr.Scene, not a {type(scene).__name__}")
    if is_traced(scene):
        raise TypeError("save_scene needs concrete arrays: call it outside of jax.jit and jax.grad")
    scene = jax.tree.map(jnp.asarray, scene)
    # What is kept of voxels that have been replaced since is of no use.
    scene = eqx.tree_at(lambda s: s.volume, scene, scene.volume.current())
    writer = Writer(str(path), precision_of(scene))
    tables = writer.part(scene, Scene)
    beside = path.with_suffix(".npz")
    with replacing_together(beside, path) as (held, text):
        with held.open("w+b") as file:
            write_arrays(file, writer.arrays)
            start = {"format": FORMAT, "precision": writer.precision.name, "checksum": checksum(file)}
        text.write_text(HEADER.format(name=beside.name) + toml_of(start | tables), encoding="utf-8")


def load_scene(path: str | os.PathLike) -> Scene:
    """The scene that `jvr.save_scene` wrote, from the text at `path` and the `.npz` beside it.

    Constructors check what was edited. A file can name nothing but jvr's own classes and those that you have registered, and
    run nothing: those of strangers can be read.

    **Raises** `ValueError` (`jvr.io.config.ConfigError`), one line with file and key, for whatever is not right: another format or
    version, arrays that are missing or another scene's, unknown kinds and keys, values that are refused, double precision without
    `jax_enable_x64`; `OSError` where a file cannot be read.
    """
    path = _named(path)
    first_bytes(path)
    where, (_, tables) = str(path), read_toml(path)
    start = {name: tables.pop(name, None) for name in ("format", "precision", "checksum")}
    _check_format(where, start["format"])
    precision = number_type(start["precision"], where, "precision")
    if precision not in (np.float32, np.float64):
        raise ConfigError(where, "precision", f'must be "float32" or "float64", not {shown(start["precision"])}')
    with opened(where, path.with_suffix(".npz"), start["checksum"]) as arrays:
        try:
            return Reader(where, precision, arrays).part(tables, Scene)
        # Tables in tables in tables, without an end.
        except RecursionError:
            raise ConfigError(where, "", "its tables are nested too deeply") from None


def _named(path: str | os.PathLike) -> Path:
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise ValueError(f"{path}: the name of a scene file ends in .toml")
    return path


def _check_format(where: str, found: Any) -> None:
    if found is None:
        raise ConfigError(
            where, "format", "missing: this is no scene that jvr.save_scene wrote; `jvr render` reads configurations"
        )
    if found != FORMAT or isinstance(found, bool):
        raise ConfigError(
            where, "format", f"is {shown(found)}, and this jvr reads {FORMAT}: a newer one may have written the file"
        )
