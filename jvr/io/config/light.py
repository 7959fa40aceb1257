"""From tables to lights, shading, shadows, occlusion, scattering, normals, surfaces and mirrors. What is not named is not imported."""

from typing import Any

from jvr.io.config.errors import ConfigError
from jvr.io.config.load import Config
from jvr.io.config.parts import made
from jvr.model.light import AbstractLight
from jvr.model.normals import PrecomputedGradient
from jvr.model.parts import asks_gradient
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import Volume


def light_parts(config: Config, transfer: AbstractTransfer) -> dict[str, Any]:
    """What a configuration says about light, as keywords of `jvr.Scene`."""
    tables, parts = config.tables, {}
    if tables.lights:
        parts["lights"] = _lights(config, tables.lights, "lights")
    for name in ("shading", "shadows", "scattering", "normals", "surfaces", "specular", "occlusion"):
        if getattr(tables, name) is not None:
            parts[name] = made(config.where, name, getattr(tables, name))
    if transfer.takes_gradient and "normals" in parts and parts["normals"].of_opacity:
        key = "normals.of_opacity"
        raise ConfigError(config.where(key), key, "must be false: the transfer function takes the gradient of the scalar")
    return parts


def lights_of_views(config: Config, views: int) -> tuple[tuple[AbstractLight, ...], ...] | None:
    """The lights of each view of a fit, `None` where all have the scene's.

    **Raises** `ConfigError` where their number is not that of the views.
    """
    tables = None if config.tables.fit is None else config.tables.fit.lights
    if tables is None:
        return None
    if len(tables) != views:
        problem = f"{len(tables)} entries for {views} cameras: give the lights of each view, one table or a list of them"
        raise ConfigError(config.where("fit.lights"), "fit.lights", problem)
    return tuple(_lights(config, each, f"fit.lights[{i}]") for i, each in enumerate(tables))


def _lights(config: Config, tables: list[Any], key: str) -> tuple[AbstractLight, ...]:
    each = [made(config.where, f"{key}[{i}]", table) for i, table in enumerate(tables)]
    # A luminous ball is many lights.
    return tuple(light for one in each for light in (one if isinstance(one, tuple) else (one,)))


def graded(volume: Volume, parts: dict[str, Any], transfer: AbstractTransfer) -> Volume:
    """The volume with gradients at its voxels, where precomputed ones are asked for."""
    normals, others = parts.get("normals"), [parts[name] for name in ("scattering", "material", "specular") if name in parts]
    asked = "shading" in parts or transfer.takes_gradient or any(asks_gradient(part) for part in others)
    if not asked or not isinstance(normals, PrecomputedGradient) or normals.of_opacity:
        return volume
    return volume.graded_by_sobel() if normals.sobel else volume.graded()
