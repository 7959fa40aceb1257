"""From the parts of a scene to tables, by what their classes declare."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jvr.io.config.text import Inline
from jvr.io.scenes.kinds import NONE, PARTS, class_named, entry_of, implied
from jvr.io.scenes.made import is_derived, is_static, made, same

# Arrays of so many numbers and axes are written in the text, where they can be read and edited.
MOST, AXES = 128, 2


@dataclasses.dataclass
class Writer:
    """Makes tables and gathers the long arrays in `arrays`. `where`: the file that errors name; `precision`: of numbers in the text."""

    where: str
    precision: np.dtype
    arrays: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def part(self, part: Any, annotation: Any, key: str = "") -> dict[str, Any]:
        """The table of a part, in a place that takes what the annotation says.

        Left out are what the constructor makes by itself where it is absent or of no public class (such as a `Remainder`), and what is
        derived, of which only the arguments of its method are kept.

        **Raises** `TypeError` for a class that is not jvr's own, `ConfigError` for a part that could not be read.
        """
        cls, fields = type(part), dataclasses.fields(part)
        kind = {} if cls is implied(annotation) else {"kind": _kind(part, key or "scene")}
        annotations = {f.name: f.type for f in fields}
        values = {f.name: getattr(part, f.name) for f in fields if not is_derived(f)}
        shown = {name: value for name, value in values.items() if value is not None and not _is_hidden(value, annotations[name])}
        unsaid = made(cls, shown, self.where, key)
        table: dict[str, Any] = dict(kind)
        for f in fields:
            value, place = getattr(part, f.name), f"{key}.{f.name}".lstrip(".")
            if is_derived(f):
                if value is not None:
                    table[f.name] = Inline(_choices(value))
            elif f.name in shown or not same(getattr(unsaid, f.name), value):
                table[f.name] = value if is_static(f) and value is not None else self._value(value, f.type, place)
        return table

    def _value(self, value: Any, annotation: Any, key: str) -> Any:
        if value is None:
            return NONE
        if isinstance(value, tuple):
            return [self.part(one, entry_of(annotation), f"{key}[{i}]") for i, one in enumerate(value)]
        if not isinstance(value, eqx.Module):
            return self._array(value, key)
        table = self.part(value, annotation, key)
        return table["kind"] if list(table) == ["kind"] else table

    def _array(self, value: Any, key: str) -> Any:
        array = np.asarray(value)
        short = array.ndim <= AXES and 0 < array.size <= MOST
        if short and array.dtype == self.precision and not np.isnan(array).any():
            return array
        self.arrays[key] = array
        return Inline(array=key, dtype=array.dtype.name)


def precision_of(scene: Any) -> np.dtype:
    """The type that most of the short arrays of a scene have."""
    types = [np.dtype(x.dtype) for x in jax.tree.leaves(scene) if hasattr(x, "dtype") and np.size(x) <= MOST]
    return max((np.dtype(np.float32), np.dtype(np.float64)), key=types.count)


def _kind(part: Any, key: str) -> str:
    """The public name of a part's class."""
    name = type(part).__name__
    if name not in PARTS or class_named(name) is not type(part):
        raise TypeError(
            f"{key} is a {type(part).__module__}.{name}, none of jvr's own classes nor registered, which are all that a scene file can "
            "name: call jvr.register for it, or save the scene with one of jvr's in its place and put yours back after jvr.load_scene"
        )
    return name


def _is_hidden(value: Any, annotation: Any) -> bool:
    """Whether a value, or each entry of a tuple, is of the one class that its place takes, and that has no public name."""
    only, entries = implied(annotation), value if isinstance(value, tuple) else (value,)
    return only is not None and only.__name__ not in PARTS and all(type(x) is only for x in entries)


def _choices(derived: Any) -> dict[str, Any]:
    """The static fields of what was derived."""
    fields = dataclasses.fields(derived) if dataclasses.is_dataclass(derived) else ()
    return {f.name: getattr(derived, f.name) for f in fields if is_static(f)}
