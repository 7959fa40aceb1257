"""Checks of numbers with their units, whose errors say what would be right."""

import math
from typing import Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from jvr.io.config.errors import shown
from jvr.model.ranges import ANY, DIRECTION, Entries, Increasing, Interval, Range


def problem(text: str, key: str | None = None) -> PydanticCustomError:
    """An error whose sentence is our own; `key` is where in the table it lies."""
    return PydanticCustomError("problem", "{text}", {"text": text} | ({"key": key} if key else {}))


def number(what: str, within: Interval = ANY) -> BeforeValidator:
    """A real number in an interval; `what` says what it is and in which unit."""
    return BeforeValidator(lambda value: _number(value, what, within))


def numbers(count: int | None, what: str, within: Range = ANY) -> BeforeValidator:
    """A list of real numbers."""

    def check(value: Any) -> list[float]:
        if not isinstance(value, list) or (count is not None and len(value) != count):
            wanted = "a list of" if count is None else f"{count}"
            raise problem(f"must be {wanted} numbers in brackets ({what}), not {shown(value)}")
        each = within.intervals if isinstance(within, Entries) else [within if isinstance(within, Interval) else ANY] * len(value)
        found = [_number(v, what, each[i], f"entry {i} ") for i, v in enumerate(value)]
        if within == DIRECTION and not any(found):
            raise problem(f"{DIRECTION.problem} ({what}), not {shown(value)}")
        return increasing(found) if isinstance(within, Increasing) else found

    return BeforeValidator(check)


def whole(what: str, within: Interval) -> BeforeValidator:
    """A whole number in an interval."""

    def check(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not within.low <= value <= within.high:
            raise problem(f"must be a whole number {within.whole_words} ({what}), not {shown(value)}")
        return value

    return BeforeValidator(check)


def _number(value: Any, what: str, within: Interval, entry: str = "") -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise problem(f"{entry}must be a plain number ({what}), not {shown(value)}")
    try:
        value = float(value)
    # A whole number beyond all that float64 holds.
    except OverflowError:
        value = math.inf
    if not (math.isfinite(value) or within.takes_infinity):
        raise problem(f"{entry}must be a finite number ({what}), not {value}")
    if not within.holds(value):
        raise problem(f"{entry}{within.problem} ({what}), not {value:g}")
    return value


def increasing(value: list[float]) -> list[float]:
    """Numbers each greater than the one before."""
    for i in range(1, len(value)):
        if not value[i - 1] < value[i]:
            raise problem(
                f"must be strictly increasing, but entry {i} ({value[i]:g}) is not above entry {i - 1} ({value[i - 1]:g})"
            )
    return value


def number_or_each(what: str, within: Interval = ANY) -> BeforeValidator:
    """One number, or a list of them."""

    def check(value: Any) -> float | list[float]:
        if not isinstance(value, list):
            return _number(value, what, within)
        return [_number(v, what, within, f"entry {i} ") for i, v in enumerate(value)]

    return BeforeValidator(check)


def number_or_triple(what: str, within: Interval = ANY) -> BeforeValidator:
    """One number, or three for red, green and blue."""

    def check(value: Any) -> float | list[float]:
        if not isinstance(value, list):
            return _number(value, what, within)
        if len(value) != 3:
            raise problem(f"must be one number ({what}) or three for red, green, blue, not {shown(value)}")
        return [_number(v, what, within, f"entry {i} ") for i, v in enumerate(value)]

    return BeforeValidator(check)


def numbers_or_triples(what: str, within: Interval = ANY) -> BeforeValidator:
    """A list with one number for each entry, or three; pydantic's union would complain about both at once."""

    def check(value: Any) -> list[Any]:
        if not isinstance(value, list):
            raise problem(f"must be a list of numbers in brackets ({what}), not {shown(value)}")
        for i, entry in enumerate(value):
            if isinstance(entry, list) != isinstance(value[0], list):
                raise problem("must be one number for each entry, or three for each entry, not a mixture")
            channels = entry if isinstance(entry, list) else [entry]
            if isinstance(entry, list) and len(entry) != 3:
                raise problem(f"entry {i} must be 3 numbers ({what} for red, green, blue), not {shown(entry)}")
            for channel in channels:
                _number(channel, what, within, f"entry {i} ")
        return value

    return BeforeValidator(check)
