"""What all tables share: no unknown keys, no conversions between types, and numbers that say their unit."""

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, model_validator

from jvr.io.config.checks import increasing, number, numbers, numbers_or_triples, problem
from jvr.io.config.errors import did_you_mean, shown
from jvr.model.ranges import NOT_NEGATIVE, POSITIVE


def _no_codes(value: Any) -> Any:
    if isinstance(value, list) and any(isinstance(v, int) and v > 1 for v in value):
        raise problem(
            f"{shown(value)} look like codes 0 ... 255, colours are linear and 1 is white: write ((code / 255 + 0.055) / 1.055)^2.4, "
            "or brighter ones with a decimal point"
        )
    return value


Scalar = Annotated[float, number("in the data's own units")]
Length = Annotated[float, number("mm", POSITIVE)]
Position = Annotated[list[float], numbers(3, "x, y, z in mm")]
Colour = Annotated[list[float], numbers(3, "red, green, blue, linear", NOT_NEGATIVE), BeforeValidator(_no_codes)]
Positions = Annotated[list[float], numbers(None, "in the data's own units"), AfterValidator(increasing)]
Range = Annotated[list[float], numbers(2, "low, high in the data's own units"), AfterValidator(increasing)]
Extinctions = Annotated[list[Any], numbers_or_triples("extinction per mm", NOT_NEGATIVE)]
Extinction = Annotated[float, number("extinction per mm", NOT_NEGATIVE)]
Steepness = Annotated[float, number("length of a gradient, data units per mm", NOT_NEGATIVE)]


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


def one_or_more(value: Any) -> Any:
    """One entry, or a list of them."""
    return value if isinstance(value, list) else [value]


def named(value: Any) -> Any:
    """A table, or the name of a kind with its defaults."""
    return {"kind": value} if isinstance(value, str) else value
