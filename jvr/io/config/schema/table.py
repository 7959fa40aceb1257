"""What all tables share: no unknown keys, no conversions between types, and numbers that say their unit."""

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag, model_validator

from jvr.io.config.checks import increasing, number, numbers, numbers_or_triples, problem, whole
from jvr.io.config.errors import did_you_mean, shown


def _no_codes(value: Any) -> Any:
    if isinstance(value, list) and any(isinstance(v, int) and v > 1 for v in value):
        raise problem(
            f"{shown(value)} look like codes 0 ... 255, colours are linear and 1 is white: write ((code / 255 + 0.055) / 1.055)^2.4, "
            "or brighter ones with a decimal point"
        )
    return value


Scalar = Annotated[float, number("in the data's own units")]
Length = Annotated[float, number("mm", 0.0, inner=True)]
Position = Annotated[list[float], numbers(3, "x, y, z in mm")]
Colour = Annotated[list[float], numbers(3, "red, green, blue, linear", 0.0), BeforeValidator(_no_codes)]
Positions = Annotated[list[float], numbers(None, "in the data's own units"), AfterValidator(increasing)]
Range = Annotated[list[float], numbers(2, "low, high in the data's own units"), AfterValidator(increasing)]
Extinctions = Annotated[list[Any], numbers_or_triples("extinction per mm", 0.0)]
Extinction = Annotated[float, number("extinction per mm", 0.0)]
Pixels = Annotated[int, whole("pixels", 1, 65_536)]
Angle = Annotated[float, number("full vertical angle in degrees", 0.0, 180.0, inner=True)]
Steepness = Annotated[float, number("length of a gradient, data units per mm", 0.0)]


class Table(BaseModel):
    """A table of TOML: no unknown keys, no conversions between types."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, data: Any) -> Any:
        for key in data if isinstance(data, dict) else ():
            if key not in cls.model_fields:
                raise problem(f"unknown key; {did_you_mean(key, cls.model_fields)}", key)
        return data

    def given(self) -> dict[str, Any]:
        """What the table says besides its kind: keywords of a constructor, which knows the rest by default."""
        values = {name: getattr(self, name) for name in type(self).model_fields if name != "kind"}
        return {name: value for name, value in values.items() if value is not None}

    def _one_of(self, *names: str) -> None:
        given = [name for name in names if getattr(self, name) is not None]
        if len(given) > 1:
            raise problem(f"excludes {given[0]}: give one of the two", given[1])
        if not given:
            raise problem(f"missing; needs {' or '.join(names)}", names[0])

    def _same_length(self, first: str, *others: str) -> None:
        count = len(getattr(self, first))
        for other in others:
            if len(getattr(self, other)) != count:
                raise problem(f"has {len(getattr(self, other))} entries, {first} has {count}: give as many", other)


class ByValueTable(Table):
    """`jvr.ByValue`."""

    positions: Annotated[Positions, Field(min_length=1)]
    values: Annotated[list[float], numbers(None, "one for each position")]

    @model_validator(mode="after")
    def _check(self) -> "ByValueTable":
        self._same_length("positions", "values")
        return self


# A constant, to be tagged so in the union, or a table with positions and values.
CONSTANT = Tag("(constant)")
ByValue = Annotated[ByValueTable, Tag("(by value)")]
CONSTANT_OR_BY_VALUE = Discriminator(lambda value: "(by value)" if isinstance(value, dict | ByValueTable) else "(constant)")


def named(value: Any) -> Any:
    """A table, or the name of a kind with its defaults."""
    return {"kind": value} if isinstance(value, str) else value
