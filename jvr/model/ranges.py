"""What a parameter may be and how it acts, declared once beside its field: constructors check its values, and a fit keeps to them."""

import dataclasses
import math
from typing import Any, TypeAlias

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Interval:
    """Numbers from `low` to `high`, the ends included unless `is_open`; `per_length`: in units of 1 / world length."""

    low: float = -math.inf
    high: float = math.inf
    is_open: bool = False
    per_length: bool = False

    @property
    def closed(self) -> "Interval":
        """The same with its ends."""
        return dataclasses.replace(self, is_open=False)

    def holds(self, values: Any) -> Any:
        """Which values are finite and in the interval."""
        inside = (self.low < values) & (values < self.high) if self.is_open else (self.low <= values) & (values <= self.high)
        return np.isfinite(values) & inside

    def __str__(self) -> str:
        ends = f"{self.low:g} ... {self.high:g}"
        return f"{ends}, without either end" if self.is_open else ends


@dataclasses.dataclass(frozen=True)
class UnitVector:
    """Directions: their length says nothing."""


@dataclasses.dataclass(frozen=True)
class Increasing:
    """Strictly increasing numbers."""

    def holds(self, values: Any) -> Any:
        """Whether the numbers are finite and each is larger than the one before."""
        return np.all(np.isfinite(values)) & np.all(np.diff(values) > 0)


@dataclasses.dataclass(frozen=True)
class Entries:
    """Vectors, each entry of which has an interval of its own."""

    intervals: tuple[Interval, ...]

    @property
    def closed(self) -> "Entries":
        """The same with the ends of all intervals."""
        return Entries(tuple(interval.closed for interval in self.intervals))

    def holds(self, values: Any) -> Any:
        """Which entries are finite and in their interval."""
        return np.stack([interval.holds(value) for interval, value in zip(self.intervals, values, strict=True)])

    def __str__(self) -> str:
        return ", ".join(map(str, self.intervals))


Range: TypeAlias = Interval | UnitVector | Increasing | Entries

ANY = Interval()
NOT_NEGATIVE = Interval(low=0.0)
POSITIVE = Interval(low=0.0, is_open=True)
UNIT_INTERVAL = Interval(0.0, 1.0)
ASYMMETRY = Interval(-1.0, 1.0, is_open=True)
EXTINCTION = Interval(low=0.0, per_length=True)
DEGREES = Interval(0.0, 180.0)
INCREASING = Increasing()


def within(declared: Range, *, by_channel: bool = False) -> dict[str, Any]:
    """The metadata of a field whose array takes values in a range: `eqx.field(metadata=within(UNIT_INTERVAL))`.

    `by_channel`: where the last axis of the array is colour, each of its channels acts on that channel of a picture alone, as those of
    light do. A fit then takes one forward derivative for all three.
    """
    return {"range": declared, "by_channel": by_channel}


def range_at(tree: Any, path: tuple[Any, ...]) -> Range:
    """The range of the leaf of `tree` at a path of `jax.tree_util`: the innermost that is declared along it, such as that of an
    asymmetry for the values of a `jvr.ByValue` in its place, and any number where none is."""
    return _declared_at(tree, path).get("range", ANY)


def is_by_channel(tree: Any, path: tuple[Any, ...]) -> bool:
    """Whether each colour channel of the leaf of `tree` at a path acts on that channel of a picture alone."""
    return _declared_at(tree, path).get("by_channel", False)


def _declared_at(tree: Any, path: tuple[Any, ...]) -> dict[str, Any]:
    """The metadata of the innermost field along a path that declares a range."""
    found: dict[str, Any] = {}
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            declared = {f.name: dict(f.metadata) for f in dataclasses.fields(tree) if "range" in f.metadata}
            found, tree = declared.get(key.name, found), getattr(tree, key.name)
        else:
            tree = tree[key.key if isinstance(key, jax.tree_util.DictKey) else key.idx]
    return found
