"""From tables to lights, shading, shadows, scattering and normals. What a configuration does not name is not imported."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from jvr.io.config.errors import ConfigError, blame
from jvr.io.config.load import Config
from jvr.io.config.schema.light import (
    AnyLight,
    AnyPhase,
    AnyShadows,
    AreaTable,
    DiscTable,
    EvenTable,
    GlossyTable,
    LambertTable,
    MixtureTable,
    NormalsTable,
    ScatteringTable,
    TabulatedTable,
)
from jvr.io.config.schema.table import ByValueTable, Table
from jvr.model.by_value import ByValue
from jvr.model.effects import AbstractScattering, AbstractShading, AbstractShadows
from jvr.model.light import AmbientLight, DirectionalLight, HeadLight, PointLight, SpotLight, disc_light, sphere_light
from jvr.model.normals import (
    AbstractNormals,
    AnalyticGradient,
    CentralDifferences,
    ForwardDifferences,
    PrecomputedGradient,
    SobelDifferences,
)
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import Volume

LIGHTS = {
    "directional": DirectionalLight,
    "point": PointLight,
    "spot": SpotLight,
    "head": HeadLight,
    "ambient": AmbientLight,
}
NORMALS = {
    "analytic": AnalyticGradient,
    "forward": ForwardDifferences,
    "central": CentralDifferences,
    "sobel": SobelDifferences,
    "precomputed": PrecomputedGradient,
}


def light_parts(config: Config, transfer: AbstractTransfer) -> dict[str, Any]:
    """What a configuration says about light, as keywords of `jvr.Scene`."""
    tables, parts = config.tables, {}
    if tables.lights:
        parts["lights"] = _each(config, "lights", tables.lights, _lights)
    builders: dict[str, Callable[..., Any]] = {
        "shading": _shading,
        "shadows": _shadows,
        "scattering": functools.partial(_scattering, config),
        "normals": _normals,
    }
    for name, builder in builders.items():
        table = getattr(tables, name)
        if table is not None:
            with blame(config.where(name), name):
                parts[name] = builder(table)
    if transfer.takes_gradient and tables.normals is not None and tables.normals.of_opacity:
        key = "normals.of_opacity"
        raise ConfigError(config.where(key), key, "must be false: the transfer function takes the gradient of the scalar")
    return parts


def graded(volume: Volume, parts: dict[str, Any], transfer: AbstractTransfer) -> Volume:
    """The volume with gradients at its voxels, where precomputed ones are asked for."""
    normals, others = parts.get("normals"), [parts[name] for name in ("scattering", "material") if name in parts]
    asked = "shading" in parts or transfer.takes_gradient or any(part.needs_gradient for part in others)
    return volume.graded() if asked and isinstance(normals, PrecomputedGradient) and not normals.of_opacity else volume


def _each(config: Config, key: str, tables: list[Any], builder: Callable[[Any, str], tuple[Any, ...]]) -> tuple[Any, ...]:
    """What all tables of a list are, each blamed for its own mistakes."""
    made: list[Any] = []
    for i, table in enumerate(tables):
        with blame(config.where(f"{key}[{i}]"), f"{key}[{i}]"):
            made.extend(builder(table, f"{key}[{i}]"))
    return tuple(made)


def _lights(table: AnyLight, key: str) -> tuple[Any, ...]:
    if not isinstance(table, AreaTable):
        return (LIGHTS[table.kind](**table.given()),)
    import jax

    keywords = table.given()
    keywords["key"] = jax.random.key(keywords.pop("seed"))
    return (disc_light if isinstance(table, DiscTable) else sphere_light)(**keywords)


def _keywords(table: Table) -> dict[str, Any]:
    """What a table says, with coefficients by value as objects."""
    by_value = lambda value: ByValue(value.positions, value.values) if isinstance(value, ByValueTable) else value
    return {name: by_value(value) for name, value in table.given().items()}


def _shading(table: LambertTable | GlossyTable) -> AbstractShading:
    from jvr.effects.shading import BlinnPhong, Lambert, Phong

    return {"lambert": Lambert, "phong": Phong, "blinn-phong": BlinnPhong}[table.kind](**_keywords(table))


def _shadows(table: AnyShadows) -> AbstractShadows:
    match table.kind:
        case "rays":
            from jvr.effects.shadow_rays import ShadowRays as Kind
        case "volume":
            from jvr.effects.shadow_volume import ShadowVolume as Kind
        case "map":
            from jvr.effects.shadow_map import ShadowMap as Kind
        case "opacity-map":
            from jvr.effects.shadow_volume import OpacityShadowMap as Kind
        case "deep-map":
            from jvr.effects.deep_shadow_map import DeepShadowMap as Kind
    return Kind(**table.given())


def _scattering(config: Config, table: ScatteringTable) -> AbstractScattering:
    from jvr.effects.scattering import SingleScattering

    keywords = _keywords(table)
    if table.phase is not None:
        with blame(config.where("scattering.phase"), "scattering.phase"):
            keywords["phase"] = phase_of(config, "scattering.phase", table.phase)
    return SingleScattering(**keywords)


def phase_of(config: Config, key: str, table: AnyPhase) -> Any:
    """The phase function of a table."""
    from jvr.model import mie, phase

    kinds = {
        "isotropic": phase.Isotropic,
        "rayleigh": phase.Rayleigh,
        "henyey-greenstein": phase.HenyeyGreenstein,
        "double-henyey-greenstein": phase.DoubleHenyeyGreenstein,
        "schlick": phase.Schlick,
        "draine": mie.Draine,
        "jendersie-eon": mie.JendersieEon,
    }
    if isinstance(table, TabulatedTable):
        return mie.TabulatedPhase(np.radians(table.degrees), table.values)
    if isinstance(table, MixtureTable):
        phases = _each(config, f"{key}.phases", table.phases, lambda t, k: (phase_of(config, k, t),))
        return phase.Mixture(phases, table.weights)
    return kinds[table.kind]() if isinstance(table, EvenTable) else kinds[table.kind](**_keywords(table))


def _normals(table: NormalsTable) -> AbstractNormals:
    return NORMALS[table.kind](table.of_opacity)
