"""Tables of environment lighting: environments, materials, radiance transfer.

A parameter that is left out has the default of its class in jvr.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, model_validator

from jvr.io.config.checks import number, number_or_triple, numbers, problem, whole
from jvr.io.config.schema.parts import BASES, WRITTEN, PartTable, part
from jvr.io.config.schema.table import Position, Positions, Steepness, Table, named
from jvr.model.material import AbstractBRDF
from jvr.model.ranges import AT_LEAST_ONE, DEGREES, NOT_NEGATIVE, POSITIVE, TRANSMITTANCE, UNIT_INTERVAL, Interval

Radiance = Annotated[Any, number_or_triple("radiance", NOT_NEGATIVE)]
Order = Annotated[int, whole("order of the harmonics", Interval(0, 10))]


class RotationTable(Table):
    """A turn about an axis of the world, counter-clockwise when the axis points to the viewer."""

    axis: Position
    degrees: Annotated[float, number("angle in degrees")]

    @model_validator(mode="after")
    def _check(self) -> "RotationTable":
        if not any(self.axis):
            raise problem("must be a direction, such as [0, 0, 1], not zero", "axis")
        return self


def _one_or_more(value: Any) -> Any:
    return value if isinstance(value, list) else [value]


Rotations = Annotated[list[RotationTable], BeforeValidator(_one_or_more)]


class AroundTable(Table):
    """What all environments have: how they are turned, one turn after the other."""

    rotation: Rotations = Field(default=[])
    clamped: bool | None = None


class ImageTable(AroundTable):
    """`jvr.EnvironmentLight.from_image`."""

    kind: Literal["image"]
    path: str
    source: str | None = None
    scale: Annotated[float, number("factor between the map's radiance and the scene's", NOT_NEGATIVE)] = 1.0
    order: Order | None = None
    window: Annotated[float, number("band from which nothing is left", POSITIVE)] | None = None


class ConstantTable(AroundTable):
    """`jvr.EnvironmentLight.constant`."""

    kind: Literal["constant"]
    radiance: Radiance | None = None
    order: Order | None = None


class RoundTable(AroundTable):
    """`jvr.EnvironmentLight.disc`."""

    kind: Literal["disc"]
    towards: Annotated[list[float], numbers(3, "x, y, z, from the scene to the light")]
    half_angle: Annotated[float, number("degrees from the middle to the rim", DEGREES)]
    radiance: Radiance | None = None
    order: Order | None = None


def _environments(value: Any) -> Any:
    """One table or name, or a list of them."""
    return [named(table) for table in _one_or_more(value)]


AnyEnvironment = ImageTable | ConstantTable | RoundTable
Environments = Annotated[list[Annotated[AnyEnvironment, Field(discriminator="kind")]], BeforeValidator(_environments)]


class MaterialTable(PartTable):
    """What all materials have. With a threshold they are projected on harmonics when the file is read."""

    threshold: Steepness | None = None


class MerlTable(MaterialTable):
    """`jvr.MerlBRDF.read`."""

    path: str
    source: str | None = None

    @staticmethod
    def part(path: Path) -> Any:
        from jvr.model.merl import MerlBRDF

        return MerlBRDF.read(path)


BASES[AbstractBRDF], WRITTEN[AbstractBRDF] = MaterialTable, {"merl": MerlTable}
OneMaterial = Annotated[Any, part(AbstractBRDF)]


class MaterialsTable(Table):
    """`jvr.MaterialByValue`."""

    positions: Annotated[Positions, Field(min_length=1)]
    materials: list[OneMaterial]

    @model_validator(mode="after")
    def _check(self) -> "MaterialsTable":
        self._same_length("positions", "materials")
        if any(material.threshold is not None for material in self.materials[1:]):
            raise problem("all materials have the threshold of the first: give it there", "materials")
        return self


def _kind_of_material(value: Any) -> str:
    by_value = isinstance(value, MaterialsTable) or (isinstance(value, dict) and {"positions", "materials"} & set(value))
    return "(by value)" if by_value else "(one)"


Material = Annotated[
    Annotated[OneMaterial, Tag("(one)")] | Annotated[MaterialsTable, Tag("(by value)")], Discriminator(_kind_of_material)
]


class DipoleTable(Table):
    """`jvr.Dipole`, or one of its presets."""

    preset: str | None = None
    sigma_s_prime: Annotated[list[float], numbers(3, "reduced scattering in 1 / mm, red, green, blue", POSITIVE)] | None = None
    sigma_a: Annotated[list[float], numbers(3, "absorption in 1 / mm, red, green, blue", NOT_NEGATIVE)] | None = None
    eta: Annotated[float, number("index of refraction", Interval(1.0, 3.0))] | None = None

    @model_validator(mode="after")
    def _check(self) -> "DipoleTable":
        self._one_of("preset", "sigma_s_prime")
        if self.preset is not None and (self.sigma_a is not None or self.eta is not None):
            raise problem("excludes sigma_a and eta: a preset has its own", "preset")
        if self.sigma_s_prime is not None and self.sigma_a is None:
            raise problem("missing; give sigma_a beside sigma_s_prime", "sigma_a")
        return self


def _dipole(value: Any) -> Any:
    return {"preset": value} if isinstance(value, str) else value


class RadianceTransferTable(Table):
    """`jvr.RadianceTransfer`. `frozen`: whether a fit keeps what was computed for its start though its unknowns change it."""

    order: Order | None = None
    rays: Annotated[int, whole("rays for each node", AT_LEAST_ONE)] | None = None
    resolution: Annotated[float, number("nodes for each voxel along an axis", UNIT_INTERVAL)] | None = None
    bleeding: Literal["transfer", "material"] | None = None
    scattering: Annotated[DipoleTable, BeforeValidator(_dipole)] | None = None
    neighbourhood: Annotated[float, number("radius as a share of the longest side", UNIT_INTERVAL)] | None = None
    exact: bool | None = None
    chromaticity: Order | None = None
    step: Annotated[float, number("first step in voxels", POSITIVE)] | None = None
    growth: Annotated[float, number("ratio of a step to the one before", AT_LEAST_ONE)] | None = None
    termination: Annotated[float, number("transmittance at which a ray ends, 0 for never", TRANSMITTANCE)] | None = None
    surface: Annotated[float, number("change of transparency between nodes", POSITIVE)] | None = None
    memory: Annotated[float, number("bytes", POSITIVE)] | None = None
    frozen: bool = True

    @model_validator(mode="after")
    def _check(self) -> "RadianceTransferTable":
        if self.chromaticity is not None and self.bleeding is None:
            raise problem('is for light with a colour: add bleeding = "transfer" or "material"', "chromaticity")
        return self
