"""Tables of classes: a key for each parameter that a class declares, checked as it is declared; what is left out has the default of the
constructor.

A place that takes a part of a scene, such as a phase function, takes a table with a `kind`, or the name of a kind alone. Its table is made
when a file names it, so that no class is imported that no file names.
"""

import dataclasses
import functools
import inspect
import json
import typing
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import Discriminator, PlainValidator, Tag, ValidationError, create_model, model_validator

from jvr.io.config.checks import number, number_or_each, number_or_triple, numbers, numbers_or_triples, problem, whole
from jvr.io.config.errors import first_complaint, shown, unknown_choice
from jvr.io.config.schema.table import Colour, Table, named
from jvr.io.kinds import KINDS, maker_of
from jvr.model.parameters import AbstractByScalar, Shape, alternatives, declared, parts_of, shapes_of
from jvr.model.ranges import COLOUR, NOT_NEGATIVE, Interval


class PartTable(Table):
    """A table of a part of a scene.

    - `part`: what is called with the keys that are given, its class or a function; tables without one are made into something where they
      are used.
    - `found`: arguments that a table may leave out though a constructor needs them, as they are found elsewhere then; `unsaid`: those
      that it has no keys for, as its other keys say them.
    """

    part: ClassVar[Callable[..., Any]]
    found: ClassVar[tuple[str, ...]] = ()
    unsaid: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="after")
    def _lengths(self) -> "PartTable":
        """Lists of one length are as long as each other."""
        lengths: dict[str, tuple[str, int]] = {}
        for name, field in declared(getattr(self, "part", None)).items():
            shape, least = shapes_of(field)[0], field.metadata["parameter"].least
            _compare_lengths(getattr(self, name, None), shape, name, least, lengths)
        return self


Checked = TypeVar("Checked", bound=PartTable)


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


class KindTable(PartTable):
    """A table that says what kind of part it describes."""

    kind: str | None = None


# Tables of kinds that say something else than the arguments of a class, and what all tables of a family, or of one of its kinds, have
# besides.
WRITTEN: dict[type, dict[str, type[KindTable]]] = {}
BASES: dict[type | tuple[type, str], type[KindTable]] = {}


def part(family: type, default: str | None = None) -> PlainValidator:
    """A table of one of the kinds of a family, or the name of a kind; `default`: the kind of a table that names none."""
    return PlainValidator(lambda value: _part(family, default, value))


def _part(family: type, default: str | None, value: Any) -> KindTable:
    kinds = kinds_of(family)
    if isinstance(value, str):
        if value not in kinds:
            raise problem(unknown_choice(value, kinds))
        value = named(value)
    if not isinstance(value, dict):
        raise problem(f"must be a table of keys, or one of {', '.join(map(repr, kinds))}, not {shown(value)}")
    kind = value.get("kind", default)
    if kind is None:
        raise problem("missing; it says what this table describes", "kind")
    if kind not in kinds:
        raise problem(unknown_choice(kind, kinds), "kind")
    table = table_for(family, kind)
    for key in value:
        others = [] if key in table.model_fields else [k for k in kinds if key in table_for(family, k).model_fields]
        if others:
            raise problem(f"unknown key; only kind = {' or '.join(map(json.dumps, others))} has it", key)
    return checked_table(table, value)


def kinds_of(family: type) -> list[str]:
    """What the kinds of a family are called."""
    return [*KINDS[family], *WRITTEN.get(family, {})]


def table_for(family: type, kind: str) -> type[KindTable]:
    """The table of a kind."""
    written = WRITTEN.get(family, {})
    base = BASES.get((family, kind), BASES.get(family, KindTable))
    return written[kind] if kind in written else table_of(maker_of(family, kind), base)


def only(cls: type, *names: str) -> PlainValidator:
    """A table of a class, in a place that takes no other; `names`: of its keys, where they are not all parameters of the class."""
    return PlainValidator(lambda value: checked_table(table_of(cls, PartTable, names), value))


def checked_table(table: type[Checked], value: Any) -> Checked:
    """The table of these keys; what is wrong with them is one problem that names its key."""
    if not isinstance(value, dict):
        raise problem(f"must be a table of keys, not {shown(value)}")
    try:
        return table.model_validate(value)
    except ValidationError as error:
        # The kind is no part of a place here, and may be called as a key is.
        key, text = first_complaint(error, {name: inner for name, inner in value.items() if name != "kind"})
        raise problem(text, key or None) from None


@functools.cache
def table_of(maker: Callable[..., Any], base: type[Checked] = PartTable, names: tuple[str, ...] = ()) -> type[Checked]:
    """The table of a class or function: of its declared parameters, those that it takes, that can be said in a table and, where some are
    named, are among `names`. Keys that `base` has are as they are there."""
    keys: dict[str, Any] = {}
    for name, argument in inspect.signature(maker.__init__ if isinstance(maker, type) else maker).parameters.items():
        field = declared(maker).get(name)
        said = name in base.model_fields or name in base.unsaid or (names and name not in names)
        kind = None if field is None or said else _type_of(field)
        if kind is not None:
            keys[name] = (kind, ... if argument.default is argument.empty and name not in base.found else None)
    table = create_model(f"{maker.__name__}Table", __base__=base, **keys)
    if "part" not in vars(base):
        # A function would become a method.
        table.part = staticmethod(maker)
    return table


def _type_of(field: Any) -> Any:
    """What pydantic checks a key with; `None` for a part that no file can name."""
    about, kinds, parts = field.metadata["parameter"], alternatives(field.type), parts_of(field.type)
    if parts:
        family = next((family for family in KINDS if issubclass(parts[0], family)), None)
        one = None if family is None else Annotated[Any, part(family)]
        return list[one] if one is not None and typing.get_origin(field.type) is tuple else one
    if field.metadata.get("static"):
        most = {"high": min(about.within.high, about.most)} if isinstance(about.within, Interval) else {}
        within = dataclasses.replace(about.within, **most)
        if float in kinds:
            return Annotated[float, number(about.about, within)]
        return Annotated[int, whole(about.about, within)] if int in kinds else field.type
    # Constructors take brighter light than fits make, up to a limit of their own.
    within = NOT_NEGATIVE if isinstance(about.within, Interval) and about.within.light else about.within
    if about.within == COLOUR:
        *rows, _ = shapes_of(field)[0]
        return functools.reduce(lambda one, _: list[one], rows, Colour)
    if not about.by_scalar:
        return _numbers(shapes_of(field), about.about, within)
    constant = _numbers(shapes_of(field), f"{about.about}, or a table with positions and values", within)
    values: Any = (Annotated[list[float], numbers(None, "one for each position", about.within)], ...)
    varying = PlainValidator(functools.partial(_by_scalar, values))
    tag = Discriminator(lambda value: "(varying)" if isinstance(value, dict) else "(constant)")
    return Annotated[Annotated[constant, Tag("(constant)")] | Annotated[Any, varying, Tag("(varying)")], tag]


def _by_scalar(values: Any, given: dict[str, Any]) -> KindTable:
    """The table of a coefficient by scalar, whose `values` are in the range of the number in whose place it stands; without a `kind` it is
    one by value."""
    kind = given.get("kind", "value")
    if kind not in kinds_of(AbstractByScalar):
        raise problem(unknown_choice(kind, kinds_of(AbstractByScalar)), "kind")
    return checked_table(create_model("VaryingTable", __base__=table_for(AbstractByScalar, kind), values=values), given)


def _numbers(shapes: tuple[Shape, ...], what: str, within: Any) -> Any:
    """What pydantic checks an array with, by its shapes."""
    match shapes:
        case ((),):
            return Annotated[float, number(what, within)]
        case ((), (3,)):
            return Annotated[Any, number_or_triple(what, within)]
        case ((), (str(),)):
            return Annotated[Any, number_or_each(what, within)]
        case ((int(count),),):
            return Annotated[list[float], numbers(count, what, within)]
        case ((str(),),):
            return Annotated[list[float], numbers(None, what, within)]
        case ((str(),), (str(), 3)):
            return Annotated[list[Any], numbers_or_triples(what, within)]
        case _:
            return list[_numbers(tuple(shape[1:] for shape in shapes), what, within)]
