"""What a fit finds, by the names in a configuration: arrays of the scene, such as `transfer.rgb`, and of its cameras."""

import difflib
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jvr.io.config.errors import ConfigError
from jvr.io.config.load import Config
from jvr.io.config.schema.whole import FitTable
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene

# `cameras.fov_y` is that of every view, `cameras[2].fov_y` that of one, `shared(cameras.fov_y)` one for all.
OF_CAMERAS = re.compile(r"cameras(?:\[(\d+)\])?\.(\w+)|shared\(cameras\.(\w+)\)")


def unknowns_of(config: Config, fit: FitTable, scene: Scene, cameras: tuple[AbstractCamera, ...]) -> Callable[..., Any]:
    """The function that picks the arrays that `fit.unknowns` names, for `jvr.fit`.

    **Raises** `ConfigError` for a name that no floating-point array of the scene or of its cameras has.
    """
    names = [re.sub(r"\.(\d+)(?=\.|$)", r"[\1]", name) for name in fit.unknowns]
    for i, name in enumerate(names):
        if name.startswith(("cameras", "shared(")):
            _check_of_cameras(config, i, name, cameras)
        else:
            _check_of_scene(config, i, name, scene)
    pick = lambda scene, cameras: tuple(_picked(name, scene, cameras) for name in names)
    if any(OF_CAMERAS.fullmatch(name) for name in names):
        return pick
    return lambda scene: pick(scene, ())


def _picked(name: str, scene: Scene, cameras: tuple[Any, ...]) -> Any:
    match = OF_CAMERAS.fullmatch(name)
    if match is None:
        return _arrays(scene)[name]
    index, field, common = match.groups()
    if common is not None:
        from jvr.fitting.unknowns import shared

        return shared([getattr(camera, common) for camera in cameras])
    return [getattr(camera, field) for camera in cameras] if index is None else getattr(cameras[int(index)], field)


def _check_of_cameras(config: Config, i: int, name: str, cameras: tuple[AbstractCamera, ...]) -> None:
    key, match = f"fit.unknowns[{i}]", OF_CAMERAS.fullmatch(name)
    forms = "'cameras.fov_y' of every view, 'cameras[0].fov_y' of one, 'shared(cameras.fov_y)' of all as one"
    if match is None:
        raise ConfigError(config.where(key), key, f"'{name}' is no array of cameras; they are named as {forms}")
    index, field = match[1], match[2] or match[3]
    if index is not None and int(index) >= len(cameras):
        problem = f"'{name}' is that of a camera that does not take part; the views that do are 0 to {len(cameras) - 1}"
        raise ConfigError(config.where(key), key, problem)
    for camera in cameras if index is None else cameras[int(index) : int(index) + 1]:
        known = [n for n, value in vars(camera).items() if isinstance(value, jax.Array)]
        if field not in known:
            problem = f"'{name}' is not an array of a {type(camera).__name__}; known: {', '.join(known)}"
            raise ConfigError(config.where(key), key, problem)


def _check_of_scene(config: Config, i: int, name: str, scene: Scene) -> None:
    arrays = _arrays(scene)
    fittable = [name for name, leaf in arrays.items() if jnp.issubdtype(leaf.dtype, jnp.floating)]
    if name in fittable:
        return
    near = difflib.get_close_matches(name, fittable, 1, 0.6)
    hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(fittable)}"
    problem, key = "is not an array of the scene", f"fit.unknowns[{i}]"
    if name in arrays:
        problem, hint = (
            "holds integers, which have no derivative",
            "volume.scale = [low, high] makes voxels floating-point numbers",
        )
    raise ConfigError(config.where(key), key, f"'{name}' {problem}; {hint}")


def _arrays(scene: Scene) -> dict[str, jax.Array]:
    """As `jvr.fitting.unknowns.leaves_by_name`, without importing what fits: a configuration is checked before that."""
    return {jax.tree_util.keystr(path).lstrip("."): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(scene)}
