"""From tables to lights, shading, shadows, scattering and normals. What a configuration does not name is not imported."""

from typing import Any

from jvr.io.config.errors import ConfigError
from jvr.io.config.load import Config
from jvr.io.config.parts import made
from jvr.model.normals import PrecomputedGradient
from jvr.model.transfer import AbstractTransfer
from jvr.model.volume import Volume


def light_parts(config: Config, transfer: AbstractTransfer) -> dict[str, Any]:
    """What a configuration says about light, as keywords of `jvr.Scene`."""
    tables, parts = config.tables, {}
    if tables.lights:
        each = [made(config.where, f"lights[{i}]", table) for i, table in enumerate(tables.lights)]
        # A luminous ball is many lights.
        parts["lights"] = tuple(light for one in each for light in (one if isinstance(one, tuple) else (one,)))
    for name in ("shading", "shadows", "scattering", "normals"):
        if getattr(tables, name) is not None:
            parts[name] = made(config.where, name, getattr(tables, name))
    if transfer.takes_gradient and "normals" in parts and parts["normals"].of_opacity:
        key = "normals.of_opacity"
        raise ConfigError(config.where(key), key, "must be false: the transfer function takes the gradient of the scalar")
    return parts


def graded(volume: Volume, parts: dict[str, Any], transfer: AbstractTransfer) -> Volume:
    """The volume with gradients at its voxels, where precomputed ones are asked for."""
    normals, others = parts.get("normals"), [parts[name] for name in ("scattering", "material") if name in parts]
    asked = "shading" in parts or transfer.takes_gradient or any(part.needs_gradient for part in others)
    return volume.graded() if asked and isinstance(normals, PrecomputedGradient) and not normals.of_opacity else volume
