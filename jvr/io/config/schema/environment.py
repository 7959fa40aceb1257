"""Tables of environment lighting: environments, materials, radiance transfer.

A parameter that is left out has the default of its class in jvr.
"""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Discriminator, Field, PlainValidator, Tag, model_validator

from jvr.io.config.checks import number, numbers, problem
from jvr.io.config.schema.parts import BASES, WRITTEN, KindTable, PartTable, checked_table, part, table_of
from jvr.io.config.schema.table import Colour, Position, Positions, Steepness, Table, one_or_more
from jvr.model.effects import AbstractBleeding, AbstractRadianceTransfer
from jvr.model.environment import EnvironmentLight
from jvr.model.environment_map import EnvironmentMap
from jvr.model.geometry import AbstractGeometry
from jvr.model.material import AbstractBRDF
from jvr.model.ranges import DIRECTION, NOT_NEGATIVE


class RotationTable(Table):
    """A turn about an axis of the world, counter-clockwise when the axis points to the viewer."""

    axis: Annotated[list[float], numbers(3, "x, y, z, such as [0, 0, 1]", DIRECTION)]
    degrees: Annotated[float, number("angle in degrees")]


Rotations = Annotated[list[RotationTable], BeforeValidator(one_or_more)]


class EnvironmentTable(KindTable):
    """What all environments have: how they are turned, one turn after the other, and whether negative radiance is cut off."""

    rotation: Rotations = Field(default=[])
    clamped: bool | None = None


class ImageTable(EnvironmentTable):
    """Where the map of an environment lies."""

    path: str
    source: str | None = None
    scale: Annotated[float, number("factor between the map's radiance and the scene's", NOT_NEGATIVE)] = 1.0


class SurroundingsTable(KindTable):
    """What maps that are seen directly have: how they are turned, one turn after the other."""

    rotation: Rotations = Field(default=[])


class SurroundingsImageTable(SurroundingsTable):
    """Where a map that is seen directly lies."""

    path: str
    source: str | None = None
    scale: Annotated[float, number("factor between the map's radiance and the scene's", NOT_NEGATIVE)] = 1.0


class GeometryImageTable(KindTable):
    """Where the picture of geometry lies, with its depth."""

    path: str
    source: str | None = None


class MeshTable(KindTable):
    """`jvr.Mesh`."""

    vertices: Annotated[list[Position], Field(min_length=1)]
    faces: Annotated[list[list[int]], Field(min_length=1)]
    rgb: Colour | list[Colour]
    lit: bool = True

    @staticmethod
    def part(**keywords: Any) -> Any:
        from jvr.model.mesh import Mesh

        return Mesh(**keywords)


BASES[AbstractGeometry, "image"], WRITTEN[AbstractGeometry] = GeometryImageTable, {"mesh": MeshTable}
Geometry = Annotated[Any, part(AbstractGeometry)]
BASES |= {EnvironmentLight: EnvironmentTable, (EnvironmentLight, "image"): ImageTable}
BASES |= {EnvironmentMap: SurroundingsTable, (EnvironmentMap, "image"): SurroundingsImageTable}
Environments = Annotated[list[Annotated[Any, part(EnvironmentLight)]], BeforeValidator(one_or_more)]
# A colour, or what is seen in every direction.
Background = Annotated[
    Annotated[Colour, Tag("(colour)")] | Annotated[Any, part(EnvironmentMap), Tag("(map)")],
    Discriminator(lambda value: "(map)" if isinstance(value, dict | str | KindTable) else "(colour)"),
]


class MaterialTable(KindTable):
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


class TranslucentTable(PartTable):
    """A preset of `jvr.Dipole`."""

    preset: str

    @staticmethod
    def part(preset: str) -> Any:
        from jvr.model.dipole import Dipole

        return Dipole.preset(preset)


def _dipole(value: Any) -> PartTable:
    """A preset of `jvr.Dipole`, by its name or in a table, or its numbers."""
    value = {"preset": value} if isinstance(value, str) else value
    if isinstance(value, dict) and "preset" in value:
        if len(value) > 1:
            raise problem("excludes all other keys: a preset has its own sigma_s_prime, sigma_a and eta", "preset")
        return checked_table(TranslucentTable, value)
    from jvr.model.dipole import Dipole

    return checked_table(table_of(Dipole), value)


class RadianceTransferTable(KindTable):
    """What a radiance transfer takes besides its own keys. `frozen`: whether a fit keeps what was computed for its start though its
    unknowns change it."""

    bleeding: Annotated[Any, part(AbstractBleeding)] | None = None
    scattering: Annotated[Any, PlainValidator(_dipole)] | None = None
    frozen: bool = True

    @model_validator(mode="after")
    def _check(self) -> "RadianceTransferTable":
        if getattr(self, "chromaticity", None) is not None and self.bleeding is None:
            raise problem('is for light with a colour: add bleeding = "transfer" or "material"', "chromaticity")
        return self


BASES[AbstractRadianceTransfer] = RadianceTransferTable
RadianceTransfer = Annotated[Any, part(AbstractRadianceTransfer, "projected")]
