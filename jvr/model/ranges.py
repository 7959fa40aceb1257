"""The values that a parameter may take: what `jvr.model.parameters` declares, constructors check and a fit keeps to."""

import dataclasses
import math
from typing import Any, TypeAlias

import numpy as np


@dataclasses.dataclass(frozen=True)
class Interval:
    """Numbers from `low` to `high`.

    - `ends`: which of the two belong to it, in the notation of intervals: "[]", "()", "[)" or "(]".
    - `per_length`: in units of 1 / world length.
    - `light`: "colour" or "radiance": constructors take brighter ones than fits make, and no codes (`jvr.model.checks`).
    - `takes_infinity`: whether values may be infinite.
    """

    low: float | int = -math.inf
    high: float | int = math.inf
    ends: str = "[]"
    per_length: bool = False
    light: str = ""
    takes_infinity: bool = False

    @property
    def is_open(self) -> bool:
        """Whether an end does not belong to it."""
        return self.ends != "[]"

    @property
    def closed(self) -> "Interval":
        """The same with its ends."""
        return dataclasses.replace(self, ends="[]")

    def holds(self, values: Any) -> Any:
        """Which values are finite (unless it takes infinity) and in the interval."""
        sound = ~np.isnan(values) if self.takes_infinity else np.isfinite(values)
        above = self.low < values if self.ends[0] == "(" else self.low <= values
        below = values < self.high if self.ends[1] == ")" else values <= self.high
        return sound & above & below

    @property
    def problem(self) -> str:
        """What its values must be, as a sentence about others goes on."""
        return f"must be {self.words}"

    @property
    def words(self) -> str:
        bounded = math.isfinite(self.low), math.isfinite(self.high)
        if all(bounded):
            low, high = f"{self.low:g}", f"{self.high:g}"
            forms = {"()": f"between {low} and {high}, without either", "(]": f"above {low} and at most {high}"}
            return forms.get(self.ends, f"in {self.ends[0]}{low}, {high}{self.ends[1]}")
        if self.low == 0:
            if self.takes_infinity:
                return "positive" if self.ends[0] == "(" else "not negative"
            return "positive and finite" if self.ends[0] == "(" else "finite and not negative"
        if any(bounded):
            return f"finite and {'above' if self.ends[0] == '(' else 'at least'} {self.low:g}"
        return "a number" if self.takes_infinity else "finite"

    @property
    def whole_words(self) -> str:
        """The same of whole numbers."""
        return f"of at least {self.low:g}" if math.isinf(self.high) else f"from {self.low:g} to {self.high:g}"

    def __str__(self) -> str:
        ends = f"{self.low:g} ... {self.high:g}"
        return f"{ends}, without either end" if self.ends == "()" else ends


@dataclasses.dataclass(frozen=True)
class UnitVector:
    """Directions: their length says nothing."""

    words = "a direction of any length but zero"
    problem = "must have a direction"

    def holds(self, values: Any) -> Any:
        """Whether the numbers are finite and one is not zero."""
        return np.all(np.isfinite(values)) & np.any(values != 0)


@dataclasses.dataclass(frozen=True)
class Increasing:
    """Strictly increasing numbers."""

    words = "strictly increasing"
    problem = "must be strictly increasing, finite numbers: sort them and remove duplicates"

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

    @property
    def words(self) -> str:
        return "; ".join(interval.words for interval in self.intervals)

    @property
    def problem(self) -> str:
        return f"must be {self.words}"

    def __str__(self) -> str:
        return ", ".join(map(str, self.intervals))


Range: TypeAlias = Interval | UnitVector | Increasing | Entries

ANY = Interval()
# Also where nothing ends.
UNLIMITED = Interval(takes_infinity=True)
NOT_NEGATIVE = Interval(low=0.0)
POSITIVE = Interval(low=0.0, ends="()")
AT_LEAST_ONE = Interval(low=1.0)
UNIT_INTERVAL = Interval(0.0, 1.0)
FRACTION = Interval(0.0, 1.0, "()")
ASYMMETRY = Interval(-1.0, 1.0, "()")
EXTINCTION = Interval(low=0.0, per_length=True)
# Of a medium by itself: radiance per world length.
EMISSION = Interval(low=0.0, per_length=True, light="radiance")
DEGREES = Interval(0.0, 180.0)
ANGLE_OF_VIEW = Interval(0.0, 180.0, "()")
INCREASING = Increasing()
DIRECTION = UnitVector()
# A ray or a sum may end below such a transmittance; at 1 it would end before it began.
TRANSMITTANCE = Interval(0.0, 1.0, "[)")
# Linear RGB of which 1 is white, and the strength of a light. Constructors take brighter ones than fits make.
COLOUR = Interval(0.0, 1.0, light="colour")
RADIANCE = Interval(low=0.0, light="radiance")
