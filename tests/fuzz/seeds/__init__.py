"""A small whole file of every format, or a small folder, and what reads it."""

from pathlib import Path

from seeds.faulty import faulty
from seeds.headers import headers
from seeds.pictures import pictures
from seeds.scans import scans
from seeds.seed import Seed
from seeds.stacks import stacks
from seeds.tables import tables

__all__ = ["Seed", "all_seeds", "faulty"]


def all_seeds(folder: Path) -> dict[str, Seed]:
    """All seeds by the names of their formats; those that a library writes are written in `folder`."""
    return headers() | scans() | stacks(folder) | pictures(folder) | tables(folder)
