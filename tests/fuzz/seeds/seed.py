"""What a seed is: a small whole file, or a folder of some, and what reads it."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jvr.io.volumes import VolumeError, read_volume

# Larger ones show what a byte of voxels takes in memory, apart from all else.
SHAPE: tuple[int, ...] = tuple(map(int, os.environ.get("JVR_FUZZ_SHAPE", "7,5,3").split(",")))
# How many times fewer files are damaged of what is decoded in a process of its own.
SLOW = 200


@dataclasses.dataclass
class Seed:
    """Files by their paths in a folder, the most telling first; `main` is the one that is read, or "" for the folder as a whole.

    `read` raises `errors` (or `OSError`) where it cannot, as for what is whole and `refused` all the same. Where it starts a process,
    `share` times fewer files are damaged.
    """

    files: dict[str, bytes]
    main: str
    read: Callable[[Path], Any]
    errors: tuple[type[Exception], ...]
    share: int = 1
    refused: bool = False


def voxels(dtype: str = "<i2") -> np.ndarray:
    return (np.arange(np.prod(SHAPE)) * 3 % 251).reshape(SHAPE).astype(dtype)


def volume(files: dict[str, bytes], main: str | None = None, share: int = 1, **keywords: Any) -> Seed:
    """A seed of `read_volume`, which reads the first of `files` unless `main` is another name."""
    read = lambda path: read_volume(path, **keywords)
    return Seed(files, next(iter(files)) if main is None else main, read, (VolumeError,), share)


def files_in(folder: Path, first: str = "") -> dict[str, bytes]:
    """The files of a folder by their paths beside it; those called `first` come first."""
    paths = sorted((path for path in folder.rglob("*") if path.is_file()), key=lambda path: (path.name != first, path))
    return {str(path.relative_to(folder.parent)): path.read_bytes() for path in paths}
