"""From tables to the parts of a scene, by what their classes declare."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jvr.io.config.errors import ConfigError, blame, did_you_mean, shown
from jvr.io.scenes.arrays import Arrays, number_type
from jvr.io.scenes.kinds import NONE, PARTS, class_named, classes_of, entry_of, fits, implied, kinds_of, takes_one, wanted
from jvr.io.scenes.made import is_derived, is_static, made
from jvr.model.parameters import takes_array


@dataclasses.dataclass(frozen=True)
class Reader:
    """Makes parts of tables. `where`: the file that errors name; `precision`: of numbers in the text; `arrays`: what lies beside it."""

    where: str
    precision: np.dtype
    arrays: Arrays

    def part(self, table: Any, annotation: Any, key: str = "") -> Any:
        """The part that a table describes, in a place that takes what the annotation says: a table, or the name of a kind.

        **Raises** `ConfigError` for whatever is not right.
        """
        table = {"kind": table} if isinstance(table, str) else table
        if not isinstance(table, dict):
            raise ConfigError(self.where, key, f"must be a table of keys, not {shown(table)}")
        cls = self._class(table, annotation, key)
        fields = {f.name: f for f in dataclasses.fields(cls)}
        values, derived = {}, {}
        for name, raw in table.items():
            place = f"{key}.{name}".lstrip(".")
            if name == "kind":
                continue
            if name not in fields:
                raise ConfigError(self.where, place, f"unknown key; {did_you_mean(name, fields)}")
            if is_derived(fields[name]):
                derived[name] = self._choices(raw, place)
            else:
                values[name] = self._value(raw, fields[name], place)
        part = made(cls, values, self.where, key)
        for name, choices in derived.items():
            with blame(self.where, f"{key}.{name}".lstrip(".")):
                part = getattr(part, fields[name].metadata["made_by"])(**choices)
        return part

    def _class(self, table: dict[str, Any], annotation: Any, key: str) -> type:
        place, only = f"{key}.kind".lstrip("."), implied(annotation)
        if "kind" not in table:
            if only is None:
                raise ConfigError(
                    self.where, place, f"missing; it says what this table describes: {', '.join(kinds_of(annotation))}"
                )
            return only
        kind, classes = table["kind"], classes_of(annotation)
        found = class_named(kind) if isinstance(kind, str) and kind in PARTS else None
        if found is None or (classes and not issubclass(found, classes)):
            known = did_you_mean(str(kind), kinds_of(annotation))
            raise ConfigError(self.where, place, f"unknown choice {shown(kind).removeprefix('the text ')}; {known}")
        return found

    def _value(self, raw: Any, field: dataclasses.Field, key: str) -> Any:
        annotation, entry = field.type, entry_of(field.type)
        if raw == NONE and not (is_static(field) and fits(raw, annotation)):
            if not fits(None, annotation):
                raise ConfigError(self.where, key, f"cannot be absent; it must be {self._wanted(annotation)}")
            return None
        if is_static(field):
            if not fits(raw, annotation):
                raise ConfigError(self.where, key, f"is {shown(raw)}; it must be {wanted(annotation)}")
            return raw
        if entry is not None and (isinstance(raw, list) or not takes_one(annotation)):
            if not isinstance(raw, list):
                raise ConfigError(self.where, key, f"must be a list of tables, not {shown(raw)}")
            return tuple(self.part(one, entry, f"{key}[{i}]") for i, one in enumerate(raw))
        is_stored = isinstance(raw, dict) and "array" in raw
        is_part, takes_parts = isinstance(raw, dict | str) and not is_stored, bool(classes_of(annotation))
        if takes_parts and not is_part and not takes_array(annotation):
            raise ConfigError(self.where, key, f"is {shown(raw)}; it must be {self._wanted(annotation)}")
        if is_part and (takes_parts or annotation is Any):
            return self.part(raw, annotation, key)
        return self._stored(raw, key) if is_stored else self._numbers(raw, key)

    def _wanted(self, annotation: Any) -> str:
        """What a field takes, in words: the kinds of a part."""
        return f"one of {', '.join(kinds_of(annotation))}" if classes_of(annotation) else wanted(annotation)

    def _stored(self, raw: Any, key: str) -> jax.Array:
        if set(raw) != {"array", "dtype"} or not isinstance(raw["array"], str):
            raise ConfigError(self.where, key, "an array beside the text has two keys, array and dtype")
        return self.arrays.read(raw["array"], number_type(raw["dtype"], self.where, f"{key}.dtype"), key)

    def _numbers(self, raw: Any, key: str) -> jax.Array:
        if not _are_numbers(raw):
            raise ConfigError(self.where, key, f"must be a number or a list of numbers, not {shown(raw)}")
        with blame(self.where, key), np.errstate(over="ignore"):
            try:
                numbers = np.asarray(raw, np.float64)
            except ValueError:
                raise ConfigError(self.where, key, "its rows have different lengths") from None
            return jnp.asarray(numbers.astype(self.precision))

    def _choices(self, raw: Any, key: str) -> dict[str, Any]:
        """The arguments of the method that makes what is derived."""
        if not isinstance(raw, dict) or not all(isinstance(value, int | float | bool) for value in raw.values()):
            raise ConfigError(self.where, key, f"must be a table of numbers, not {shown(raw)}")
        return raw


def _are_numbers(raw: Any) -> bool:
    if isinstance(raw, list):
        return all(map(_are_numbers, raw))
    return isinstance(raw, int | float) and not isinstance(raw, bool)
