"""Tables of everything about light: lights, shading, shadows, occlusion, scattering, normals, surfaces, mirrors.

Most are those of classes (`jvr.io.config.schema.parts`); here is what says something else.
"""

from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from jvr.io.config.checks import increasing, number_or_triple, numbers, numbers_or_triples, problem, whole
from jvr.io.config.errors import shown
from jvr.io.config.schema.parts import WRITTEN, KindTable, part
from jvr.io.config.schema.table import Length, Position, one_or_more
from jvr.io.kinds import KINDS
from jvr.model.effects import (
    AbstractOcclusion,
    AbstractScattering,
    AbstractShading,
    AbstractShadows,
    AbstractSpecular,
    AbstractSurfaces,
)
from jvr.model.light import AbstractLight
from jvr.model.normals import AbstractNormals
from jvr.model.phase import AbstractPhase
from jvr.model.ranges import AT_LEAST_ONE, DIRECTION, NOT_NEGATIVE


class AreaTable(KindTable):
    """What luminous balls and discs share: as many point lights as `samples`, at places drawn with `seed`."""

    position: Position
    radius: Length
    intensity: Annotated[Any, number_or_triple("power per solid angle", NOT_NEGATIVE)] = 1.0
    seed: Annotated[int, whole("seed of random numbers", NOT_NEGATIVE)] = 0
    samples: Annotated[int, whole("point lights", AT_LEAST_ONE)] | None = None


class SphereTable(AreaTable):
    """`jvr.sphere_light`."""

    @staticmethod
    def part(seed: int, **keywords: Any) -> Any:
        import jax

        from jvr.model.light import sphere_light

        return sphere_light(**keywords, key=jax.random.key(seed))


class DiscTable(AreaTable):
    """`jvr.disc_light`."""

    direction: Annotated[list[float], numbers(3, "x, y, z, the way that the light travels", DIRECTION)]

    @staticmethod
    def part(seed: int, **keywords: Any) -> Any:
        import jax

        from jvr.model.light import disc_light

        return disc_light(**keywords, key=jax.random.key(seed))


WRITTEN[AbstractLight] = {"sphere": SphereTable, "disc": DiscTable}


def _from_0_to_180(value: list[float]) -> list[float]:
    if value[:1] != [0.0] or value[-1:] != [180.0]:
        raise problem(f"must run from 0 (forward) to 180 (backward), not {shown(value)}")
    return increasing(value)


class TabulatedTable(KindTable):
    """`jvr.TabulatedPhase`."""

    degrees: Annotated[list[float], numbers(None, "angles in degrees"), AfterValidator(_from_0_to_180)]
    values: Annotated[list[Any], numbers_or_triples("in any unit", NOT_NEGATIVE)]

    @staticmethod
    def part(degrees: list[float], values: list[Any]) -> Any:
        from jvr.model.mie import TabulatedPhase

        return TabulatedPhase(np.radians(degrees), values)


WRITTEN[AbstractPhase] = {"tabulated": TabulatedTable}


def casts_shadows(light: KindTable) -> bool:
    """Whether a light of this table does; luminous balls and discs do."""
    return getattr(light.part, "casts_shadows", True)


def _one_method(value: Any) -> Any:
    """A table or a name; two methods at once, however they are written, are refused by their names."""
    if isinstance(value, list):
        methods = [table.get("kind") if isinstance(table, dict) else table for table in value]
    else:
        table = value if isinstance(value, dict) else {}
        # Numbers are keys of a method: `rays` is a kind, and how many of them in-scattering has.
        methods = [k for k, given in table.items() if k in KINDS[AbstractShadows] and not isinstance(given, int | float)]
        methods = [*filter(None, [table.get("kind")]), *methods] if methods else []
    if len(methods) > 1:
        names = " and ".join(f"'{method}'" for method in methods)
        raise problem(f'{names} exclude each other: keep one of them, such as [shadows] kind = "{methods[0]}"')
    if methods:
        raise problem(f'must be a table with a kind, such as [shadows] kind = "{methods[0]}", not {shown(value)}')
    return value


OneOrMore = Annotated[list[Annotated[Any, part(AbstractLight)]], BeforeValidator(one_or_more)]
Lights = Annotated[OneOrMore, Field(validate_default=True)]
Shading = Annotated[Any, part(AbstractShading)]
Shadows = Annotated[Any, part(AbstractShadows), BeforeValidator(_one_method)]
Occlusion = Annotated[Any, part(AbstractOcclusion, "local")]
Scattering = Annotated[Any, part(AbstractScattering, "single")]
Normals = Annotated[Any, part(AbstractNormals, "analytic")]
Surfaces = Annotated[Any, part(AbstractSurfaces, "isosurfaces")]
Specular = Annotated[Any, part(AbstractSpecular, "specular")]
