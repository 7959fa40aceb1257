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

from pydantic import Discriminator, PlainValidator, Tag, ValidationError, create_model, model_validator

from jvr.io.config.checks import number, number_or_triple, numbers, numbers_or_triples, problem, whole
from jvr.io.config.errors import first_complaint, shown, unknown_choice
from jvr.io.config.schema.table import Colour, Table, named
from jvr.io.kinds import KINDS, class_named
from jvr.model.by_value import ByValue
from jvr.model.parameters import Shape, alternatives, declared, parts_of, shapes_of
from jvr.model.ranges import COLOUR, NOT_NEGATIVE, Interval


class PartTable(Table):
    """A table of a part of a scene. `part`: what is called with the keys that are given, its class or a function; tables without one are
    made into something where they are used."""

    part: ClassVar[Callable[..., Any]]

    kind: str | None = None

    @model_validator(mode="after")
    def _lengths(self) -> "PartTable":
        """Lists of one length are as long as each other."""
        lengths: dict[str, tuple[str, int]] = {}
        cls = getattr(self, "part", None)
        for name, field in declared(cls).items() if isinstance(cls, type) else ():
            shape, least = shapes_of(field)[0], field.metadata["parameter"].least
            _compare_lengths(getattr(self, name, None), shape, name, least, lengths)
        return self


def _compare_lengths(value: Any, shape: Shape, name: str, least: int, lengths: dict[str, tuple[str, int]]) -> None:
    """Of a list along a named axis, and of the lists in it."""
    if not isinstance(value, list) or not shape or not isinstance(shape[0], str):
        return
    first, count = lengths.setdefault(shape[0], (name, len(value)))
    if len(value) < least:
        raise problem(f"has too few entries, {len(value)}; it needs at least {least}", name)
    if len(value) != count:
        raise problem(f"has {len(value)} entries, {first} has {count}: give as many", name)
    for i, row in enumerate(value):
        _compare_lengths(row, shape[1:], f"{name}[{i}]", least, lengths)


# Tables of kinds that say something else than the arguments of a class, and what all tables of a family have besides.
WRITTEN: dict[type, dict[str, type[PartTable]]] = {}
BASES: dict[type, type[PartTable]] = {}


def part(family: type, default: str | None = None) -> PlainValidator:
    """A table of one of the kinds of a family, or the name of a kind; `default`: the kind of a table that names none."""
    return PlainValidator(lambda value: checked_table(_table_for(family, default, _keys(named(value))), named(value)))


def only(cls: type, *names: str) -> PlainValidator:
    """A table of a class, in a place that takes no other; `names`: of its keys, where they are not all parameters of the class."""
    return PlainValidator(lambda value: checked_table(table_of(cls, PartTable, names), _keys(value)))


def _keys(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise problem(f"must be a table of keys, not {shown(value)}")
    return value


def _table_for(family: type, default: str | None, value: dict[str, Any]) -> type[PartTable]:
    written, kind = WRITTEN.get(family, {}), value.get("kind", default)
    if kind is None:
        raise problem("missing; it says what this table describes", "kind")
    if kind not in [*KINDS[family], *written]:
        raise problem(unknown_choice(kind, [*KINDS[family], *written]), "kind")
    return written[kind] if kind in written else table_of(class_named(KINDS[family][kind]), BASES.get(family, PartTable))


def checked_table(table: type[PartTable], value: dict[str, Any]) -> PartTable:
    """The table of these keys; what is wrong with them is one problem that names its key."""
    try:
        return table.model_validate(value)
    except ValidationError as error:
        # The kind is no part of a place here, and may be called as a key is.
        key, text = first_complaint(error, {name: inner for name, inner in value.items() if name != "kind"})
        raise problem(text, key or None) from None


@functools.cache
def table_of(cls: type, base: type[PartTable] = PartTable, names: tuple[str, ...] = ()) -> type[PartTable]:
    """The table of a class: of its declared parameters, those that its constructor takes, that can be said in a table and, where some are
    named, are among `names`."""
    keys: dict[str, Any] = {}
    for name, argument in inspect.signature(cls.__init__).parameters.items():
        field = declared(cls).get(name)
        kind = None if field is None or (names and name not in names) else _type_of(field)
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
    # Constructors take brighter light than fits make, up to a limit of their own.
    within = NOT_NEGATIVE if isinstance(about.within, Interval) and about.within.light else about.within
    if about.within == COLOUR:
        *rows, _ = shapes_of(field)[0]
        return functools.reduce(lambda one, _: list[one], rows, Colour)
    if not about.by_scalar:
        return _numbers(shapes_of(field), about.about, within)
    constant = _numbers(shapes_of(field), f"{about.about}, or a table with positions and values", within)
    values: Any = (Annotated[list[float], numbers(None, "one for each position", about.within)], ...)
    by_value = create_model("ByValueTable", __base__=table_of(ByValue), values=values)
    tag = Discriminator(lambda value: "(by value)" if isinstance(value, dict) else "(constant)")
    return Annotated[Annotated[constant, Tag("(constant)")] | Annotated[by_value, Tag("(by value)")], tag]


def _numbers(shapes: tuple[Shape, ...], what: str, within: Any) -> Any:
    """What pydantic checks an array with, by its shapes."""
    match shapes:
        case ((),):
            return Annotated[float, number(what, within)]
        case ((), (3,)):
            return Annotated[Any, number_or_triple(what, within)]
        case ((int(count),),):
            return Annotated[list[float], numbers(count, what, within)]
        case ((str(),),):
            return Annotated[list[float], numbers(None, what, within)]
        case ((str(),), (str(), 3)):
            return Annotated[list[Any], numbers_or_triples(what, within)]
        case _:
            return list[_numbers(tuple(shape[1:] for shape in shapes), what, within)]
