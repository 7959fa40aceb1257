"""Checks of numbers with their units, whose errors say what would be right."""

import math
from typing import Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from jvr.io.config.errors import shown


def problem(text: str, key: str | None = None) -> PydanticCustomError:
    """An error whose sentence is our own; `key` is where in the table it lies."""
    return PydanticCustomError("problem", "{text}", {"text": text} | ({"key": key} if key else {}))


def number(what: str, low: float = -math.inf, high: float = math.inf, *, inner: bool = False) -> BeforeValidator:
    """A real number from `low` to `high` (between them with `inner`); `what` says what it is and in which unit."""
    return BeforeValidator(lambda value: _number(value, what, low, high, inner))


def numbers(
    count: int | None, what: str, low: float = -math.inf, high: float = math.inf, *, inner: bool = False
) -> BeforeValidator:
    """A list of real numbers."""

    def check(value: Any) -> list[float]:
        if not isinstance(value, list) or (count is not None and len(value) != count):
            wanted = "a list of" if count is None else f"{count}"
            raise problem(f"must be {wanted} numbers in brackets ({what}), not {shown(value)}")
        return [_number(v, what, low, high, inner, f"entry {i} ") for i, v in enumerate(value)]

    return BeforeValidator(check)


def whole(what: str, low: int, high: int | None = None) -> BeforeValidator:
    """A whole number of at least `low` and at most `high`."""

    def check(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or value < low or (high is not None and value > high):
            wanted = f"of at least {low}" if high is None else f"from {low} to {high}"
            raise problem(f"must be a whole number {wanted} ({what}), not {shown(value)}")
        return value

    return BeforeValidator(check)


def _number(value: Any, what: str, low: float, high: float, inner: bool, entry: str = "") -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise problem(f"{entry}must be a plain number ({what}), not {shown(value)}")
    try:
        value = float(value)
    # A whole number beyond all that float64 holds.
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise problem(f"{entry}must be a finite number ({what}), not {value}")
    if value < low or (inner and value == low):
        raise problem(f"{entry}must be {'above' if inner else 'at least'} {low:g} ({what}), not {value:g}")
    if value > high or (inner and value == high):
        raise problem(f"{entry}must be {'below' if inner else 'at most'} {high:g} ({what}), not {value:g}")
    return value


def increasing(value: list[float]) -> list[float]:
    """Numbers each greater than the one before."""
    for i in range(1, len(value)):
        if not value[i - 1] < value[i]:
            raise problem(
                f"must be strictly increasing, but entry {i} ({value[i]:g}) is not above entry {i - 1} ({value[i - 1]:g})"
            )
    return value


def number_or_triple(what: str, low: float = -math.inf, high: float = math.inf, *, inner: bool = False) -> BeforeValidator:
    """One number, or three for red, green and blue."""

    def check(value: Any) -> float | list[float]:
        if not isinstance(value, list):
            return _number(value, what, low, high, inner)
        if len(value) != 3:
            raise problem(f"must be one number ({what}) or three for red, green, blue, not {shown(value)}")
        return [_number(v, what, low, high, inner, f"entry {i} ") for i, v in enumerate(value)]

    return BeforeValidator(check)


def numbers_or_triples(what: str, low: float = -math.inf, high: float = math.inf) -> BeforeValidator:
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
                _number(channel, what, low, high, False, f"entry {i} ")
        return value

    return BeforeValidator(check)
