"""What is wrong with a configuration, in one line: file, key, what is wrong, what would be right."""

import contextlib
import difflib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from pydantic import ValidationError

# Pydantic's own sentences for wrong types, as a person who writes TOML would say them.
SENTENCES = {
    "string_type": 'must be text in quotes, such as "text"',
    "list_type": "must be a list, such as [1, 2, 3]",
    "dict_type": "must be a table of keys",
    "model_type": "must be a table of keys",
    "model_attributes_type": "must be a table of keys",
    "bool_type": "must be true or false",
}


class ConfigError(ValueError):
    """A configuration that cannot be used: one line that names file and key, what is wrong and what would be right."""

    def __init__(self, where: str, key: str, problem: str):
        place = f"{where}: {key}" if key else where
        super().__init__(" ".join(f"{place}: {problem}".split()))


@contextlib.contextmanager
def blame(where: str, key: str) -> Iterator[None]:
    """Errors of constructors in this block are the fault of one key."""
    try:
        yield
    except ConfigError:
        raise
    # A whole number of more than 32 or 64 bits is an OverflowError of NumPy.
    except (ValueError, TypeError, OverflowError) as error:
        raise ConfigError(where, key, str(error)) from error


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A hint for a misspelt word: the nearest known one, or all of them."""
    known = list(known)
    near = difflib.get_close_matches(word, known, 1, 0.6)
    return f"did you mean '{near[0]}'?" if near else f"known: {', '.join(known)}"


def first_complaint(error: ValidationError, data: Any) -> tuple[str, str]:
    """Key and problem of the most telling complaint of pydantic about `data`."""
    complaints = error.errors(include_url=False)
    # A misspelt key often shows as a missing one too: the misspelling says more.
    first = min(complaints, key=lambda e: e["type"] == "missing")
    context = first.get("ctx", {})
    key = key_of(first["loc"], data, context.get("key"))
    if first["type"] == "missing":
        return key, "missing; this key is needed here"
    if first["type"] == "literal_error":
        return key, unknown_choice(first["input"], _words(context["expected"]))
    if first["type"] == "union_tag_not_found":
        return f"{key}.kind", "missing; it says what this table describes"
    if first["type"] == "union_tag_invalid":
        return f"{key}.kind", unknown_choice(context["tag"], _words(context["expected_tags"]))
    if first["type"] == "too_short":
        least = context["min_length"]
        return key, f"must have at least {least} {'entry' if least == 1 else 'entries'}, not {shown(first['input'])}"
    if first["type"] in SENTENCES:
        return key, f"{SENTENCES[first['type']]}, not {shown(first['input'])}"
    return key, first["msg"].removeprefix("Value error, ")


def key_of(loc: Sequence[int | str], data: Any, last: str | None = None) -> str:
    """The key of a place in the data as one would write it, such as `camera[1].eye`."""
    key, skipped = "", False
    for part in loc:
        if isinstance(part, int):
            # A single table is read as a list of one.
            if isinstance(data, list):
                key, data = f"{key}[{part}]", data[part]
            continue
        # A kind may have the name of a key, but comes before the keys.
        if not skipped and _is_alternative(part, data):
            # An alternative in parentheses may hold a kind of table.
            skipped = not part.startswith("(")
            continue
        skipped = False
        key, data = f"{key}.{part}", data[part] if isinstance(data, dict) and part in data else None
    return (key + (f".{last}" if last else "")).lstrip(".")


def _is_alternative(part: str, data: Any) -> bool:
    """Whether a part of a place is no key, but the alternative that pydantic tried: a kind of table, or in parentheses."""
    kind = data.get("kind") if isinstance(data, dict) else data
    return part == kind or part.startswith("(")


def shown(value: Any) -> str:
    """A value as its writer would recognise it."""
    if isinstance(value, str):
        return f'the text "{value[:60]}"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "a table"
    try:
        text = str(value)
    # Python refuses to write numbers of thousands of digits.
    except ValueError:
        return "a number of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."


def unknown_choice(given: Any, known: Iterable[str]) -> str:
    """A word that is none of those known."""
    return f"unknown choice {shown(given).removeprefix('the text ')}; {did_you_mean(str(given), known)}"


def _words(expected: str) -> list[str]:
    """The choices in a sentence of pydantic."""
    return [word.strip(" '") for word in expected.replace(" or ", ",").split(",")]
