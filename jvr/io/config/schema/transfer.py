"""Tables of transfer functions."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from jvr.io.config.checks import number, problem, whole
from jvr.io.config.errors import unknown_choice
from jvr.io.config.schema.parts import BASES, WRITTEN, KindTable, only, part
from jvr.io.config.schema.table import Colour, Extinction, Length, Positions, Range, Scalar, Table
from jvr.io.interop.slicer import slicer_presets
from jvr.model.gradient_transfer import GradientOpacity
from jvr.model.ranges import POSITIVE, Interval
from jvr.model.transfer import AbstractTransfer, LutTransfer


class TransferTable(KindTable):
    """What all transfer functions of the scalar have: the gradient can scale their extinction."""

    gradient_opacity: Annotated[Any, only(GradientOpacity, "low", "high")] | None = None


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


class SampledTable(TransferTable):
    """A `jvr.LutTransfer` with extinction summed from parts and colours blended smoothly between a few."""

    entries: Annotated[int, whole("entries of the table", Interval(2, 65_536))]
    domain: Range
    positions: Positions
    rgb: list[Colour]
    extinction: list[Part]

    @model_validator(mode="after")
    def _check(self) -> "SampledTable":
        self._same_length("positions", "rgb")
        return self

    @staticmethod
    def part(
        entries: int, domain: list[float], positions: list[float], rgb: list[Any], extinction: list[GaussianPart | RampPart]
    ) -> LutTransfer:
        s = np.linspace(domain[0], domain[1], entries)
        sigma_t = np.zeros_like(s)
        for one in extinction:
            if isinstance(one, GaussianPart):
                sigma_t += one.height * np.exp(-0.5 * np.square((s - one.center) / one.width))
            else:
                low, high = one.between
                sigma_t += one.height * np.clip((s - low) / (high - low), 0, 1)
        return LutTransfer(_blend(s, np.asarray(positions), np.asarray(rgb)), sigma_t, domain)


def _blend(s: np.ndarray, positions: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """Colours between those at `positions`, by smoothstep, so that they have no kinks."""
    u = np.interp(s, positions, np.arange(len(positions)))
    low = np.minimum(u.astype(int), max(len(positions) - 2, 0))
    fraction = np.clip(u - low, 0, 1)[:, None]
    fraction = fraction * fraction * (3 - 2 * fraction)
    return (1 - fraction) * rgb[low] + fraction * rgb[np.minimum(low + 1, len(rgb) - 1)]


# Presets that take their range from the volume.
RELATIVE = ("scan", "mr", "micro_ct")


class PresetTable(TransferTable):
    """One of `jvr.presets`: for CT in Hounsfield units, or for values whose range is given, or found in the volume."""

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


class WindowTable(TransferTable):
    """`jvr.presets.window_level`; without window and level they come from the volume's values."""

    window: Annotated[float, number("width in the data's own units", POSITIVE)] | None = None
    level: Scalar | None = None
    sigma_t: Extinction | None = None
    rgb: Colour = Field(default=[1.0, 1.0, 1.0])

    @model_validator(mode="after")
    def _check(self) -> "WindowTable":
        if (self.window is None) != (self.level is None):
            raise problem("missing; give window and level, or neither", "window" if self.window is None else "level")
        return self


def _slicer_name(value: Any) -> Any:
    if isinstance(value, str) and value not in slicer_presets():
        raise problem(unknown_choice(value, slicer_presets()))
    return value


class ImportedTable(TransferTable):
    """A preset of another program: what its colours are, and the length that its opacities belong to; with `entries` as a table of so many,
    evenly spaced from its first point to its last, which a fit can change between its points."""

    unit_distance: Length | None = None
    encoding: Literal["linear", "srgb"] = "linear"
    entries: Annotated[int, whole("entries of the table", Interval(2, 65_536))] | None = None


class SlicerTable(ImportedTable):
    """A preset of 3D Slicer: one of its own by name, or a file."""

    name: Annotated[str, BeforeValidator(_slicer_name)] | None = None
    path: str | None = None

    @model_validator(mode="after")
    def _check(self) -> "SlicerTable":
        self._one_of("name", "path")
        if self.name is not None and self.unit_distance is not None:
            raise problem("belongs to files; presets by name have a millimetre", "unit_distance")
        return self


class ParaViewTable(ImportedTable):
    """A preset of ParaView in JSON, the one called `name`, its ends moved to `range`."""

    path: str
    name: str | None = None
    range: Range | None = None


class TransferFile(TransferTable):
    """A transfer function in a file of its own, as a fit writes it."""

    path: str


BASES[AbstractTransfer] = TransferTable
WRITTEN[AbstractTransfer] = {
    "sampled": SampledTable,
    "preset": PresetTable,
    "window": WindowTable,
    "slicer": SlicerTable,
    "paraview": ParaViewTable,
    "file": TransferFile,
}
Transfer = Annotated[Any, part(AbstractTransfer)]
