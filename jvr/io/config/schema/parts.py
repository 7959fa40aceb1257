"""Tables of classes: a key for each parameter that a class declares, checked as it is declared; what is left out has the default of the
constructor.

A place that takes a part of a scene, such as a phase function, takes a table with a `kind`, or the name of a kind alone. Its table is made
when a file names it, so that no class is imported that no file names.
"""

import functools
import inspect
import typing
from collections.abc import Callable
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Discriminator, PlainValidator, Tag, ValidationError, create_model, model_validator

from jvr.io.config.checks import number, number_or_triple, numbers, numbers_or_triples, problem, whole
from jvr.io.config.errors import first_complaint, shown, unknown_choice
from jvr.io.config.schema.table import Table, named
from jvr.io.kinds import KINDS, class_named
from jvr.model.by_value import ByValue
from jvr.model.parameters import alternatives, declared, parts_of, shapes_of


class PartTable(Table):
    """A table of a part of a scene. `part`: what is called with the keys that are given, its class or a function."""

    part: ClassVar[Callable[..., Any]]

    kind: str | None = None

    @model_validator(mode="after")
    def _lengths(self) -> "PartTable":
        """Lists of one length are as long as each other."""
        lengths: dict[Any, tuple[str, int]] = {}
        for name, field in declared(self.part).items() if isinstance(self.part, type) else ():
            value, axes = getattr(self, name, None), shapes_of(field)[0]
            if not isinstance(value, list) or not axes or not isinstance(axes[0], str):
                continue
            first, count = lengths.setdefault(axes[0], (name, len(value)))
            least = field.metadata["parameter"].least
            if len(value) < least:
                raise problem(f"has too few entries, {len(value)}; it needs at least {least}", name)
            if len(value) != count:
                raise problem(f"has {len(value)} entries, {first} has {count}: give as many", name)
        return self


# Tables of kinds that say something else than the arguments of a class, and what all tables of a family have besides.
WRITTEN: dict[type, dict[str, type[PartTable]]] = {}
BASES: dict[type, type[PartTable]] = {}


def part(family: type, default: str | None = None) -> PlainValidator:
    """A table of one of the kinds of a family, or the name of a kind; `default`: the kind of a table that names none."""
    return PlainValidator(lambda value: _table(family, default, named(value)))


def _table(family: type, default: str | None, value: Any) -> PartTable:
    if not isinstance(value, dict):
        raise problem(f"must be a table of keys, not {shown(value)}")
    written, kind = WRITTEN.get(family, {}), value.get("kind", default)
    if kind is None:
        raise problem("missing; it says what this table describes", "kind")
    if kind not in [*KINDS[family], *written]:
        raise problem(unknown_choice(kind, [*KINDS[family], *written]), "kind")
    table = written[kind] if kind in written else table_of(class_named(KINDS[family][kind]), BASES.get(family, PartTable))
    try:
        return table.model_validate(value)
    except ValidationError as error:
        # The kind is no part of a place here, and may be called as a key is.
        key, text = first_complaint(error, {name: inner for name, inner in value.items() if name != "kind"})
        raise problem(text, key or None) from None


@functools.cache
def table_of(cls: type, base: type[PartTable] = PartTable) -> type[PartTable]:
    """The table of a class: of its declared parameters, those that its constructor takes and that can be said in a table."""
    keys: dict[str, Any] = {}
    for name, argument in inspect.signature(cls.__init__).parameters.items():
        field = declared(cls).get(name)
        kind = None if field is None else _type_of(field)
        if kind is not None:
            keys[name] = (kind, ... if argument.default is argument.empty else None)
    table = create_model(f"{cls.__name__}Table", __base__=base, **keys)
    table.part = cls
    return table


def _type_of(field: Any) -> Any:
    """What pydantic checks a key with; `None` for a part that no file can name."""
    about, kinds, parts = field.metadata["parameter"], alternatives(field.type), parts_of(field.type)
    if parts:
        family = next((family for family in KINDS if issubclass(parts[0], family)), None)
        one = None if family is None else Annotated[Any, part(family)]
        return list[one] if one is not None and typing.get_origin(field.type) is tuple else one
    if field.metadata.get("static"):
        if float in kinds:
            return Annotated[float, number(about.about, about.within)]
        return Annotated[int, whole(about.about, about.within)] if int in kinds else field.type
    if not about.by_scalar:
        return Annotated[Any, _numbers(field, about.about)]
    constant = _numbers(field, f"{about.about}, or a table with positions and values")
    values: Any = (Annotated[list[float], numbers(None, "one for each position", about.within)], ...)
    by_value = create_model("ByValueTable", __base__=table_of(ByValue), values=values)
    tag = Discriminator(lambda value: "(by value)" if isinstance(value, dict) else "(constant)")
    return Annotated[Annotated[Any, constant, Tag("(constant)")] | Annotated[by_value, Tag("(by value)")], tag]


def _numbers(field: Any, what: str) -> BeforeValidator:
    """The check of an array, by its shape."""
    within = field.metadata["parameter"].within
    match shapes_of(field):
        case ((),):
            return number(what, within)
        case ((), (3,)):
            return number_or_triple(what, within)
        case ((int(count),),):
            return numbers(count, what, within)
        case ((str(),),):
            return numbers(None, what, within)
        case _:
            return numbers_or_triples(what, within)
