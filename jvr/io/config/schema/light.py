"""Tables of everything about light: lights, shading, shadows, scattering, normals.

A parameter that is left out has the default of its class in jvr.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from jvr.io.config.checks import increasing, number, number_or_triple, numbers, numbers_or_triples, problem, whole
from jvr.io.config.errors import shown
from jvr.io.config.schema.table import CONSTANT, CONSTANT_OR_BY_VALUE, ByValue, Length, Position, Steepness, Table, named

Intensity = Annotated[Any, number_or_triple("how bright", 0.0)]
Direction = Annotated[list[float], numbers(3, "x, y, z, the way the light travels")]
Cone = Annotated[float, number("degrees between axis and edge of the cone", 0.0, 180.0)]


class DirectionalTable(Table):
    """`jvr.DirectionalLight`."""

    kind: Literal["directional"]
    direction: Direction
    irradiance: Intensity | None = None


class PointTable(Table):
    """`jvr.PointLight`."""

    kind: Literal["point"]
    position: Position
    intensity: Intensity | None = None
    radius: Length | None = None
    attenuation: Annotated[list[float], numbers(3, "constant, linear, quadratic", 0.0)] | None = None


class SpotTable(Table):
    """`jvr.SpotLight`."""

    kind: Literal["spot"]
    position: Position
    direction: Direction
    intensity: Intensity | None = None
    inner: Cone | None = None
    outer: Cone | None = None
    radius: Length | None = None
    attenuation: Annotated[list[float], numbers(3, "constant, linear, quadratic", 0.0)] | None = None


class HeadTable(Table):
    """`jvr.HeadLight`."""

    kind: Literal["head"]
    irradiance: Intensity | None = None


class AmbientTable(Table):
    """`jvr.AmbientLight`."""

    kind: Literal["ambient"]
    radiance: Intensity | None = None


class AreaTable(Table):
    """What luminous balls and discs share: as many point lights as `samples`, at places drawn with `seed`."""

    position: Position
    radius: Length
    intensity: Intensity = 1.0
    seed: Annotated[int, whole("seed of random numbers", 0)] = 0
    samples: Annotated[int, whole("point lights", 1)] | None = None


class SphereTable(AreaTable):
    """`jvr.sphere_light`."""

    kind: Literal["sphere"]


class DiscTable(AreaTable):
    """`jvr.disc_light`."""

    kind: Literal["disc"]
    direction: Direction


def _lights(value: Any) -> Any:
    """One table or name, or a list of them."""
    return [named(table) for table in (value if isinstance(value, list) else [value])]


AnyLight = DirectionalTable | PointTable | SpotTable | HeadTable | AmbientTable | SphereTable | DiscTable
Lights = Annotated[list[Annotated[AnyLight, Field(discriminator="kind")]], BeforeValidator(_lights)]


def casts_shadows(light: AnyLight) -> bool:
    return not isinstance(light, HeadTable | AmbientTable)


ByValueHint = "or a table with positions and values"
Share = Annotated[Annotated[float, number(f"share of the light, {ByValueHint}", 0.0), CONSTANT] | ByValue, CONSTANT_OR_BY_VALUE]
Exponent = Annotated[Annotated[float, number(f"exponent, {ByValueHint}", 1.0), CONSTANT] | ByValue, CONSTANT_OR_BY_VALUE]


class MatteTable(Table):
    """What all surfaces have."""

    ambient: Share | None = None
    diffuse: Share | None = None
    threshold: Steepness | None = None
    two_sided: bool | None = None


class LambertTable(MatteTable):
    """`jvr.Lambert`."""

    kind: Literal["lambert"]


class GlossyTable(MatteTable):
    """`jvr.Phong` or `jvr.BlinnPhong`."""

    kind: Literal["phong", "blinn-phong"]
    specular: Share | None = None
    shininess: Exponent | None = None


Shading = Annotated[LambertTable | GlossyTable, Field(discriminator="kind"), BeforeValidator(named)]

Texels = Annotated[int, whole("rays along each axis of the map", 2)]
Layers = Annotated[int, whole("layers along each ray of the map", 1)]


class RaysTable(Table):
    """`jvr.ShadowRays`."""

    kind: Literal["rays"]
    step: Annotated[float, number("length of a step in voxels of the smallest spacing", 0.0, inner=True)] | None = None
    termination: Annotated[float, number("transmittance at which a shadow ray ends, 0 for never", 0.0, 0.999)] | None = None


class ShadowVolumeTable(Table):
    """`jvr.ShadowVolume`."""

    kind: Literal["volume"]
    resolution: Annotated[float, number("nodes for each voxel along an axis", 0.0, 4.0)] | None = None


class ShadowMapTable(Table):
    """`jvr.ShadowMap`."""

    kind: Literal["map"]
    texels: Texels | None = None
    threshold: Annotated[float, number("opacity of an occluder", 0.0, 1.0, inner=True)] | None = None
    softness: Annotated[int, whole("texels to each side", 0)] | None = None
    bias: Annotated[float, number("depth in voxels", 0.0)] | None = None


class OpacityMapTable(Table):
    """`jvr.OpacityShadowMap`."""

    kind: Literal["opacity-map"]
    texels: Texels | None = None
    layers: Layers | None = None


class DeepMapTable(Table):
    """`jvr.DeepShadowMap`."""

    kind: Literal["deep-map"]
    texels: Texels | None = None
    layers: Layers | None = None
    error: Annotated[float, number("difference of transmittance", 0.0, 1.0, inner=True)] | None = None


SHADOWS = ("rays", "volume", "map", "opacity-map", "deep-map")


def _one_method(value: Any) -> Any:
    """A table or a name; two methods at once, however they are written, are refused by their names."""
    if isinstance(value, list):
        methods = [table.get("kind") if isinstance(table, dict) else table for table in value]
    else:
        methods = [k for k in (value if isinstance(value, dict) else ()) if k in SHADOWS]
        methods = [*filter(None, [value.get("kind")]), *methods] if methods else []
    if len(methods) > 1:
        names = " and ".join(f"'{method}'" for method in methods)
        raise problem(f'{names} exclude each other: keep one of them, such as [shadows] kind = "{methods[0]}"')
    if methods:
        raise problem(f'must be a table with a kind, such as [shadows] kind = "{methods[0]}", not {shown(value)}')
    return named(value)


AnyShadows = RaysTable | ShadowVolumeTable | ShadowMapTable | OpacityMapTable | DeepMapTable
Shadows = Annotated[AnyShadows, Field(discriminator="kind"), BeforeValidator(_one_method)]

Asymmetry = Annotated[
    Annotated[Any, number_or_triple(f"-1 backward, 0 even, 1 forward, {ByValueHint}", -1.0, 1.0, inner=True), CONSTANT] | ByValue,
    CONSTANT_OR_BY_VALUE,
]


class EvenTable(Table):
    """`jvr.Isotropic` or `jvr.Rayleigh`."""

    kind: Literal["isotropic", "rayleigh"]


class HenyeyGreensteinTable(Table):
    """`jvr.HenyeyGreenstein`."""

    kind: Literal["henyey-greenstein"]
    g: Asymmetry


class DoubleHenyeyGreensteinTable(Table):
    """`jvr.DoubleHenyeyGreenstein`."""

    kind: Literal["double-henyey-greenstein"]
    g1: Asymmetry
    g2: Asymmetry
    weight: Annotated[Any, number_or_triple("share of the first lobe", 0.0, 1.0)]


class SchlickTable(Table):
    """`jvr.Schlick`."""

    kind: Literal["schlick"]
    k: Asymmetry


class DraineTable(Table):
    """`jvr.Draine`."""

    kind: Literal["draine"]
    g: Asymmetry
    alpha: Annotated[Any, number_or_triple("0 for Henyey-Greenstein", 0.0)]


class JendersieEonTable(Table):
    """`jvr.JendersieEon`."""

    kind: Literal["jendersie-eon"]
    diameter: Annotated[Any, number_or_triple("micrometres", 5.0, 50.0)]


def _from_0_to_180(value: list[float]) -> list[float]:
    if value[:1] != [0.0] or value[-1:] != [180.0]:
        raise problem(f"must run from 0 (forward) to 180 (backward), not {shown(value)}")
    return increasing(value)


class TabulatedTable(Table):
    """`jvr.TabulatedPhase`."""

    kind: Literal["tabulated"]
    degrees: Annotated[list[float], numbers(None, "angles in degrees"), AfterValidator(_from_0_to_180)]
    values: Annotated[list[Any], numbers_or_triples("in any unit", 0.0)]

    @model_validator(mode="after")
    def _check(self) -> "TabulatedTable":
        self._same_length("degrees", "values")
        return self


class MixtureTable(Table):
    """`jvr.Mixture`."""

    kind: Literal["mixture"]
    phases: Annotated[list["Phase"], Field(min_length=1)]
    weights: Annotated[list[Any], numbers_or_triples("weight of a phase function", 0.0)]

    @model_validator(mode="after")
    def _check(self) -> "MixtureTable":
        self._same_length("phases", "weights")
        return self


OneLobe = EvenTable | HenyeyGreensteinTable | SchlickTable
AnyPhase = OneLobe | DoubleHenyeyGreensteinTable | DraineTable | JendersieEonTable | TabulatedTable | MixtureTable
Phase = Annotated[AnyPhase, Field(discriminator="kind"), BeforeValidator(named)]
MixtureTable.model_rebuild()

Albedo = Annotated[
    Annotated[Any, number_or_triple(f"share of the extinguished light, {ByValueHint}", 0.0, 1.0), CONSTANT] | ByValue,
    CONSTANT_OR_BY_VALUE,
]


class ScatteringTable(Table):
    """`jvr.SingleScattering`."""

    phase: Phase | None = None
    albedo: Albedo | None = None
    threshold: Annotated[float, number("length of a gradient, data units per mm", 0.0, inner=True)] | None = None


class NormalsTable(Table):
    """`jvr.AnalyticGradient` and its kin."""

    kind: Literal["analytic", "forward", "central", "sobel", "precomputed"] = "analytic"
    of_opacity: bool = False


Normals = Annotated[NormalsTable, BeforeValidator(named)]
