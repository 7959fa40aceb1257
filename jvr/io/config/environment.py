"""From tables to environments, materials and radiance transfer, and what of them a fit may compute beforehand."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from jvr.io.config.errors import blame
from jvr.io.config.load import Config
from jvr.io.config.parts import made
from jvr.io.config.schema.environment import (
    EnvironmentTable,
    GeometryImageTable,
    ImageTable,
    MaterialsTable,
    MaterialTable,
    MerlTable,
    RadianceTransferTable,
    RotationTable,
    SurroundingsImageTable,
    SurroundingsTable,
)
from jvr.model.effects import AbstractMaterial
from jvr.model.environment import EnvironmentLight
from jvr.model.environment_map import EnvironmentMap
from jvr.model.material import AbstractBRDF
from jvr.model.scene import Scene, material_order

Precompute = Callable[..., Scene]
# Parts of the scene that occlusion and in-scattering are computed from.
SHAPES = {
    "occlusion": ("transfer", "volume", "clipping", "occlusion"),
    "shadows": ("transfer", "volume", "clipping", "lights", "geometry", "shadows"),
}


def environment_parts(config: Config) -> dict[str, Any]:
    """What a configuration says about environment lighting, as keywords of `jvr.Scene`."""
    tables, parts = config.tables, {}
    if tables.radiance_transfer is not None:
        parts["radiance_transfer"] = made(config.where, "radiance_transfer", tables.radiance_transfer, "frozen")
    if tables.environment:
        several = len(tables.environment) > 1
        keys = [f"environment[{i}]" if several else "environment" for i in range(len(tables.environment))]
        lights = [_environment(config, key, table) for key, table in zip(keys, tables.environment, strict=True)]
        parts["environment"] = sum(lights[1:], lights[0])
        if tables.material is not None:
            order = material_order(parts["environment"], parts.get("radiance_transfer"))
            parts["material"] = _material(config, tables.material, order)
    return parts


def background_of(config: Config) -> Any:
    """What a configuration says is behind the volume: a colour, a map or nothing."""
    table = config.tables.background
    if not isinstance(table, SurroundingsTable):
        return table
    if isinstance(table, SurroundingsImageTable):
        found = _from_file(config, "background", table, EnvironmentMap.from_image)
        found = EnvironmentMap(table.scale * found.pixels, order=found.order)
    else:
        found = made(config.where, "background", table, "rotation")
    with blame(config.where("background"), "background"):
        return found.rotated(_rotation(table.rotation)) if table.rotation else found


def geometry_of(config: Config) -> Any:
    """The opaque geometry of a configuration, or `None`."""
    table = config.tables.geometry
    if not isinstance(table, GeometryImageTable):
        return None if table is None else made(config.where, "geometry", table)
    place = "geometry.path"
    image = config.find(table.path, place, table.source)
    with blame(config.where(place), place):
        return table.part(image)


def precomputed(scene: Scene, **keywords: Any) -> Scene:
    """`jvr.precompute`, which is imported for scenes alone that it has something to do in."""
    if not scene.is_precomputable:
        return scene
    from jvr.io.precompute import precompute

    return precompute(scene, **keywords)


def keeps_radiance_transfer(config: Config) -> bool:
    """Whether a fit keeps the radiance transfer of its start though its unknowns change it."""
    table = config.tables.radiance_transfer
    return table is not None and table.frozen and _fits(config, *_shapes_radiance_transfer(table))


def _shapes_radiance_transfer(table: RadianceTransferTable) -> tuple[str, ...]:
    """Parts of the scene that radiance transfer is computed from."""
    material = ("material",) if table.bleeding is not None and table.bleeding.part.reads_material else ()
    return ("transfer", "volume", "clipping", *material)


def fit_scene(config: Config, scene: Scene, precompute: Precompute) -> Scene:
    """The scene that a fit starts from, with all computed beforehand that the fit does not change, or keeps as it is at its start."""
    keep, table, later = {}, config.tables.radiance_transfer, {}
    if scene.environment_light is not None:
        keep = {"keep_material": _fits(config, "material"), "keep_unscattered": _fits(config, "radiance_transfer")}
    if table is not None and not table.frozen and _fits(config, *_shapes_radiance_transfer(table)):
        later["radiance_transfer"] = scene.radiance_transfer
    # They follow the unknowns, as the light that they take away is a part of what these explain.
    later |= {part: getattr(scene, part) for part, of in SHAPES.items() if part in scene.precomputable and _fits(config, *of)}
    return dataclasses.replace(precompute(dataclasses.replace(scene, **dict.fromkeys(later)), **keep), **later)


def _fits(config: Config, *parts: str) -> bool:
    """Whether an unknown lies in one of these parts of the scene."""
    fit = config.tables.fit
    return fit is not None and any(name.replace("[", ".").split(".")[0] in parts for name in fit.unknowns)


def _environment(config: Config, key: str, table: EnvironmentTable) -> EnvironmentLight:
    is_image = isinstance(table, ImageTable)
    light = _image(config, key, table) if is_image else made(config.where, key, table, "rotation", "clamped")
    with blame(config.where(key), key):
        light = EnvironmentLight(light.coefficients, clamped=table.clamped is not False)
        return light.rotated(_rotation(table.rotation)) if table.rotation else light


def _image(config: Config, key: str, table: ImageTable) -> EnvironmentLight:
    return EnvironmentLight(table.scale * _from_file(config, key, table, EnvironmentLight.from_image).coefficients)


def _from_file(config: Config, key: str, table: ImageTable | SurroundingsImageTable, read: Callable[..., Any]) -> Any:
    """What `read` makes of the file of a table and of its other keys."""
    place = f"{key}.path"
    image = config.find(table.path, place, table.source)
    keywords = {name: value for name, value in table.given().items() if name not in ImageTable.model_fields}
    with blame(config.where(place), place):
        return read(image, **keywords)


def _rotation(turns: list[RotationTable]) -> np.ndarray:
    """The matrix of turns, the first one made first."""
    matrix = np.eye(3)
    for turn in turns:
        x, y, z = np.asarray(turn.axis) / np.linalg.norm(turn.axis)
        cross, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.radians(turn.degrees)
        # Rodrigues' formula.
        matrix = (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross) @ matrix
    return matrix


def _material(config: Config, table: MaterialTable | MaterialsTable, order: int) -> AbstractMaterial:
    if not isinstance(table, MaterialsTable):
        return _one_material(config, "material", table, order, table.threshold)
    from jvr.model.material import MaterialByValue

    threshold = table.materials[0].threshold
    parts = [_one_material(config, f"material.materials[{i}]", m, order, threshold) for i, m in enumerate(table.materials)]
    with blame(config.where("material"), "material"):
        found = MaterialByValue(table.positions, parts)
        # Materials that have no place beside each other say so when they are joined.
        found.projected(0)
        return found


def _one_material(config: Config, key: str, table: MaterialTable, order: int, threshold: float | None) -> AbstractMaterial:
    brdf = _measured(config, key, table) if isinstance(table, MerlTable) else made(config.where, key, table, "threshold")
    if threshold is None:
        return brdf
    from jvr.model.material import HarmonicMaterial

    with blame(config.where(key), key):
        return HarmonicMaterial.project(brdf, order, threshold=threshold)


def _measured(config: Config, key: str, table: MerlTable) -> AbstractBRDF:
    with blame(config.where(f"{key}.path"), f"{key}.path"):
        return table.part(config.find(table.path, f"{key}.path", table.source))
