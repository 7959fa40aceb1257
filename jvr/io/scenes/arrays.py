"""Long arrays of a scene, in a NumPy archive beside its text."""

import contextlib
import hashlib
import io
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import jax
import jax.numpy as jnp
import numpy as np

from jvr.io.config.errors import ConfigError, did_you_mean, shown
from jvr.io.volumes.arrays import npy_header
from jvr.io.volumes.errors import check_size, one_line

# A bit of what an archive says of a file.
ENCRYPTED = 1


def write_arrays(file: BinaryIO, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes arrays by name; types that NumPy's format has no name for, such as bfloat16, as their bits."""
    stored: dict[str, Any] = {name: np.asarray(array, order="C").view(_stored(array.dtype)) for name, array in arrays.items()}
    np.savez(file, **stored)


def checksum(file: io.BufferedReader | io.BufferedRandom) -> str:
    """Of a whole file; reading goes on at its beginning."""
    file.seek(0)
    found = hashlib.file_digest(file, "sha256").hexdigest()
    file.seek(0)
    return found


def number_type(name: Any, where: str, key: str) -> np.dtype:
    """The type of an array by its name. **Raises** `ConfigError` for other names, and for what JAX would round."""
    try:
        found = np.dtype(name) if isinstance(name, str) and re.fullmatch(r"[a-z0-9_]+", name) else None
        kept = None if found is None else jax.dtypes.canonicalize_dtype(found)
    except TypeError:
        found = kept = None
    if found is None or found.name != name or not (found.kind == "b" or jnp.issubdtype(found, jnp.number)):
        raise ConfigError(where, key, f"{shown(name)} is no type of numbers; float32 is one")
    if kept != found:
        raise ConfigError(where, key, f'{name} needs double precision: call jax.config.update("jax_enable_x64", True) first')
    return found


class Arrays:
    """The arrays of an archive that belongs to the text `where`, each read once and when it is asked for."""

    def __init__(self, where: str, path: Path, archive: zipfile.ZipFile):
        self._where, self._path, self._archive = where, path, archive
        self._read: dict[tuple[str, np.dtype], jax.Array] = {}

    def read(self, name: Any, dtype: np.dtype, key: str) -> jax.Array:
        """An array by name and type. **Raises** `ConfigError` where there is none."""
        if (name, dtype) not in self._read:
            self._read[name, dtype] = jnp.asarray(self._array(name, dtype, key))
        return self._read[name, dtype]

    def _array(self, name: str, dtype: np.dtype, key: str) -> np.ndarray:
        names = self._archive.namelist()
        if f"{name}.npy" not in names:
            known = did_you_mean(name, [entry.removesuffix(".npy") for entry in names])
            raise ConfigError(self._where, key, f"there is no array {shown(name)} in {self._path}; {known}")
        info = self._archive.getinfo(f"{name}.npy")
        if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & ENCRYPTED:
            raise ConfigError(self._where, key, f"{self._path} is compressed, as jvr.save_scene never does")
        with _damaged(self._where, self._path), self._archive.open(info) as file:
            shape, stored = npy_header(file, self._path)
        if stored != _stored(dtype):
            raise ConfigError(self._where, key, f"its array in {self._path} holds {stored}, not {dtype}")
        check_size(self._path, shape, dtype.itemsize, info.file_size)
        with _damaged(self._where, self._path), self._archive.open(info) as file:
            return np.lib.format.read_array(file, allow_pickle=False).view(dtype)


@contextlib.contextmanager
def opened(where: str, path: Path, wanted: Any) -> Iterator[Arrays]:
    """The archive at `path` that has the checksum `wanted`.

    **Raises** `ConfigError` where it is missing, another one, or damaged.
    """
    if not path.is_file():
        raise ConfigError(where, "", f"its arrays are in {path}, which is not there: copy or rename both together")
    with path.open("rb") as file:
        if checksum(file) != wanted:
            raise ConfigError(where, "checksum", f"{path} belongs to another scene, or is damaged: copy or rename both together")
        with _damaged(where, path):
            archive = zipfile.ZipFile(file)
        with archive:
            yield Arrays(where, path, archive)


@contextlib.contextmanager
def _damaged(where: str, path: Path) -> Iterator[None]:
    """Errors in this block are those of a damaged archive: its parsers raise errors of many kinds."""
    try:
        yield
    except Exception as error:
        raise ConfigError(where, "", f"{path} is damaged: {one_line(error)}; save the scene again") from None


def _stored(dtype: np.dtype) -> np.dtype:
    """The type that an archive holds an array in."""
    return dtype if dtype.kind in "biuf" else np.dtype(f"u{dtype.itemsize}")
