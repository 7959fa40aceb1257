"""Tables of transfer functions."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from jvr.io.config.checks import increasing, number, numbers, problem, whole
from jvr.io.config.schema.table import Colour, Extinction, Extinctions, Positions, Range, Scalar, Steepness, Table
from jvr.model.ranges import NOT_NEGATIVE, POSITIVE, Interval


class GradientOpacityTable(Table):
    """`jvr.GradientOpacity`: no extinction where the gradient is `low` or less, all of it from `high` on."""

    low: Steepness
    high: Steepness


class OfScalarTable(Table):
    """A transfer function of the scalar alone, whose extinction the gradient can scale."""

    gradient_opacity: GradientOpacityTable | None = None


class LinearTable(OfScalarTable):
    """`jvr.LinearTransfer`."""

    kind: Literal["linear"]
    positions: Annotated[Positions, Field(min_length=2)]
    rgb: list[Colour]
    sigma_t: Extinctions

    @model_validator(mode="after")
    def _check(self) -> "LinearTable":
        self._same_length("positions", "rgb", "sigma_t")
        return self


class LutTable(OfScalarTable):
    """`jvr.LutTransfer`."""

    kind: Literal["lut"]
    domain: Range
    rgb: Annotated[list[Colour], Field(min_length=2)]
    sigma_t: Extinctions

    @model_validator(mode="after")
    def _check(self) -> "LutTable":
        self._same_length("rgb", "sigma_t")
        return self


class GaussianTable(OfScalarTable):
    """`jvr.GaussianTransfer`."""

    kind: Literal["gaussian"]
    center: Annotated[list[float], numbers(None, "in the data's own units"), Field(min_length=1)]
    width: Annotated[list[float], numbers(None, "in the data's own units", POSITIVE)]
    height: Extinctions
    rgb: list[Colour]

    @model_validator(mode="after")
    def _check(self) -> "GaussianTable":
        self._same_length("center", "width", "height", "rgb")
        return self


class GaussianPart(Table):
    """`height * exp(-(s - center)^2 / (2 width^2))`."""

    kind: Literal["gaussian"]
    center: Scalar
    width: Annotated[float, number("in the data's own units", POSITIVE)]
    height: Extinction


class RampPart(Table):
    """0 up to the first value of `between`, `height` from the second on, linear in between."""

    kind: Literal["ramp"]
    between: Range
    height: Extinction


Part = Annotated[GaussianPart | RampPart, Field(discriminator="kind")]


class SampledTable(OfScalarTable):
    """A `jvr.LutTransfer` with extinction summed from parts and colours blended smoothly between a few."""

    kind: Literal["sampled"]
    entries: Annotated[int, whole("entries of the table", Interval(2, 65_536))]
    domain: Range
    positions: Positions
    rgb: list[Colour]
    extinction: list[Part]

    @model_validator(mode="after")
    def _check(self) -> "SampledTable":
        self._same_length("positions", "rgb")
        return self


class GradientTable(Table):
    """`jvr.GradientTransfer`: rows by scalar, columns by length of the gradient."""

    kind: Literal["gradient"]
    domain: Range
    magnitudes: Annotated[list[float], numbers(2, "low, high in data units per mm", NOT_NEGATIVE), AfterValidator(increasing)]
    rgb: Annotated[list[list[Colour]], Field(min_length=2)]
    sigma_t: list[Extinctions]

    @model_validator(mode="after")
    def _check(self) -> "GradientTable":
        self._same_length("rgb", "sigma_t")
        for i, (rgb, sigma_t) in enumerate(zip(self.rgb, self.sigma_t, strict=True)):
            for name, row in (("rgb", rgb), ("sigma_t", sigma_t)):
                if len(row) != len(self.rgb[0]):
                    raise problem(f"has {len(row)} entries, rgb[0] has {len(self.rgb[0])}: give as many", f"{name}[{i}]")
        return self


# Presets that take their range from the volume.
RELATIVE = ("scan", "mr", "micro_ct")


class PresetTable(OfScalarTable):
    """One of `jvr.presets`: for CT in Hounsfield units, or for values whose range is given, or found in the volume."""

    kind: Literal["preset"]
    preset: Literal["ct", "ct_bone", "ct_soft_tissue", "ct_lung", "ct_vessels", "scan", "mr", "micro_ct", "labels"]
    range: Range | None = None
    sigma_t: Extinction | None = None

    @model_validator(mode="after")
    def _check(self) -> "PresetTable":
        if self.range is not None and self.preset not in RELATIVE:
            raise problem(f"belongs to {', '.join(RELATIVE)}; {self.preset} has its own", "range")
        if self.sigma_t is not None and self.preset.startswith("ct"):
            raise problem(f"{self.preset} has its own", "sigma_t")
        return self


class WindowTable(OfScalarTable):
    """`jvr.presets.window_level`; without window and level they come from the volume's values."""

    kind: Literal["window"]
    window: Annotated[float, number("width in the data's own units", POSITIVE)] | None = None
    level: Scalar | None = None
    sigma_t: Extinction | None = None
    rgb: Colour = Field(default=[1.0, 1.0, 1.0])

    @model_validator(mode="after")
    def _check(self) -> "WindowTable":
        if (self.window is None) != (self.level is None):
            raise problem("missing; give window and level, or neither", "window" if self.window is None else "level")
        return self


class TransferFile(OfScalarTable):
    """A transfer function in a file of its own, as a fit writes it."""

    kind: Literal["file"]
    path: str


OfScalar = LinearTable | LutTable | GaussianTable | SampledTable | PresetTable | WindowTable
AnyTransfer = OfScalar | GradientTable | TransferFile
TransferTable = Annotated[AnyTransfer, Field(discriminator="kind")]
