"""From checked tables to the objects of `jvr`: the one place where a name becomes an object."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jvr.io.config.cameras import cameras_of
from jvr.io.config.environment import (
    Precompute,
    background_of,
    environment_parts,
    fit_scene,
    geometry_of,
    keeps_radiance_transfer,
    precomputed,
)
from jvr.io.config.errors import ConfigError, blame
from jvr.io.config.light import graded, light_parts, lights_of_views
from jvr.io.config.load import Config, started
from jvr.io.config.parts import made, made_value
from jvr.io.config.priors import priors_of, start_voxels, transforms_of
from jvr.io.config.schema.transfer import TransferTable
from jvr.io.config.schema.whole import FileTable, FitTable, VolumeTable
from jvr.io.config.targets import Lights, Views, held_out_indices, views_in_files
from jvr.io.config.transfers import build_transfer
from jvr.io.config.unknowns import unknowns_of
from jvr.model.camera import AbstractCamera, PerspectiveCamera, fibonacci_sphere
from jvr.model.scene import Scene
from jvr.model.transfer import AbstractTransfer, LutTransfer
from jvr.model.volume import Volume
from jvr.rendering.render import render
from jvr.rendering.settings import Settings

READ_KEYWORDS = ("shape", "dtype", "spacing", "origin", "direction", "slope", "intercept")
READ_KEYWORDS += ("array", "series", "axes", "channel", "time", "missing", "nan_value")


class FitJob(NamedTuple):
    """A fit as a configuration describes it.

    - `scene`: where it starts; `cameras`, `targets`: of the views that take part; pixels that do not count are NaN.
    - `truth`: the transfer function that rendered the targets, `None` where they are files.
    - `held_out`: cameras and images that take no part, and the lights of each where views have their own; `None` without any.
    - `keywords`: of `jvr.fit`: unknowns, solver, loss, priors, weights and so on.
    - `keeps_radiance_transfer`: whether the radiance transfer stays that of the start though the unknowns change it.
    - `levels`: on how many grids the voxels are found (`jvr.fit_on_grids`).
    """

    scene: Scene
    cameras: tuple[AbstractCamera, ...]
    targets: tuple[np.ndarray, ...]
    truth: AbstractTransfer | None
    held_out: tuple[Any, ...] | None
    keywords: dict[str, Any]
    keeps_radiance_transfer: bool = False
    levels: int = 1


def build_settings(config: Config) -> Settings:
    """`jvr.Settings` of `[settings]`."""
    return made(config.where, "settings", config.tables.settings)


def build_volume(config: Config) -> Volume:
    """Reads the volume of `[volume]`, or computes it.

    **Raises** `ConfigError` where its file is missing, and what `jvr.read_volume` raises.
    """
    table = config.tables.volume
    volume = _builtin() if table.path is None else _read(config, table, table.path)
    volume = interpolated(config, volume)
    if table.scale is not None:
        low, high = table.scale
        scaled = (np.asarray(volume.values, np.float64) * float(volume.slope) + float(volume.intercept) - low) / (high - low)
        parts = (
            jnp.asarray(np.clip(scaled, 0, 1).astype(np.float32)),
            jnp.ones_like(volume.slope),
            jnp.zeros_like(volume.intercept),
        )
        volume = eqx.tree_at(lambda v: (v.values, v.slope, v.intercept), volume, parts)
    with blame(config.name, "volume.packed"):
        return volume.packed() if table.packed else volume


def interpolated(config: Config, volume: Volume) -> Volume:
    """A volume with the interpolation that a configuration says."""
    table = config.tables.volume.interpolation
    if table is None:
        return volume
    return eqx.tree_at(lambda v: v.interpolation, volume, made(config.where, "volume.interpolation", table))


def build_scene(config: Config, volume: Volume | None = None) -> Scene:
    """The scene to render: with `[truth]` where there is one, else with `[transfer]`, else with what a fit starts from."""
    volume = build_volume(config) if volume is None else volume
    tables = config.tables
    if tables.truth is not None:
        return _scene(config, volume, _transfer(config, tables.truth, volume, "truth"))
    if tables.transfer is not None:
        return _scene(config, volume, _transfer(config, tables.transfer, volume, "transfer"))
    return _scene(config, volume, _start(config, volume))


def build_cameras(config: Config, volume: Volume, transfer: AbstractTransfer | None = None) -> tuple[AbstractCamera, ...]:
    """All cameras of `[camera]`, in order; `transfer`: what `frame = "visible"` goes by."""
    if transfer is None and any(table.frame == "visible" for table in config.tables.camera):
        transfer = build_scene(config, volume).transfer
    cameras: list[AbstractCamera] = []
    for i, table in enumerate(config.tables.camera):
        key = f"camera[{i}]" if len(config.tables.camera) > 1 else "camera"
        if isinstance(table, FileTable):
            cameras.extend(_cameras_in(config, table, f"{key}.path"))
            continue
        with blame(config.where(key), key):
            cameras.extend(cameras_of(table, volume, transfer))
    return tuple(cameras)


def _cameras_in(config: Config, table: FileTable, key: str) -> tuple[AbstractCamera, ...]:
    from jvr.io.interop.camera_files import read_cameras

    with blame(config.where(key), key):
        return read_cameras(config.find(table.path, key), table.width, table.height, ras=table.ras)


def build_start(config: Config) -> tuple[Volume, tuple[AbstractCamera, ...], Scene]:
    """The volume of a fit, its cameras, and the scene that it starts from, before anything is computed of that.

    **Raises** `ConfigError` where there is no `[fit]`.
    """
    fit, volume = _fit(config), build_volume(config)
    cameras = build_cameras(config, volume)
    return volume, cameras, _scene(started(config), start_voxels(fit, volume), _start_transfer(config, fit, volume))


def _fit(config: Config) -> FitTable:
    if config.tables.fit is None:
        raise ConfigError(config.name, "fit", "missing; add a table [fit] that says what to find")
    return config.tables.fit


def build_fit(
    config: Config, read_image: Callable[..., np.ndarray] | None = None, precompute: Precompute = precomputed
) -> FitJob:
    """Everything that `jvr.fit` needs; renders the targets of a synthetic experiment.

    `precompute`: `jvr.precompute`, or something that takes its keywords.

    **Raises** `ConfigError` where there is no `[fit]`, or something in it does not go together.
    """
    fit, tables, settings = _fit(config), config.tables, build_settings(config)
    volume, cameras, first = build_start(config)
    begun, scene = started(config), fit_scene(config, first, precompute)
    lights, truth = lights_of_views(config, len(cameras)), None
    believed = build_cameras(begun, volume)
    if tables.truth is None:
        inside, outside = views_in_files(config, fit, believed, lights, read_image)
    else:
        truth = _transfer(config, tables.truth, volume, "truth")
        true_scene = precompute(_scene(config, volume, truth))
        inside, outside = _rendered(true_scene, settings, _extra_cameras(config, fit, cameras, volume), lights)
        # Where the fit believes them to be.
        start = _extra_cameras(begun, fit, believed, volume)
        inside = inside._replace(cameras=tuple(camera for camera, out in start if not out))
    keywords = _all_keywords(config, fit, first, inside.cameras) | {"weights": inside.weights, "lights": inside.lights}
    held_out = (
        (outside.cameras, outside.images, *([] if outside.lights is None else [outside.lights])) if outside.cameras else None
    )
    levels = 1 if fit.voxels is None else fit.voxels.levels
    return FitJob(scene, inside.cameras, inside.images, truth, held_out, keywords, keeps_radiance_transfer(config), levels)


def _rendered(
    scene: Scene, settings: Settings, cameras: list[tuple[AbstractCamera, bool]], lights: Lights | None
) -> tuple[Views, Views]:
    """The views that take part and those that are held out, with pictures of a scene. Beyond the given views its own lights shine."""
    from jvr.fitting.groups import lit

    under = None if lights is None else (*lights, *[scene.lights] * (len(cameras) - len(lights)))
    scenes = [scene if under is None else lit(scene, under[i], i) for i in range(len(cameras))]
    pictures = [np.asarray(render(one, camera, settings).rgb) for one, (camera, _) in zip(scenes, cameras, strict=True)]
    where = lambda out: [i for i, (_, held) in enumerate(cameras) if held == out]
    of = lambda values, out: None if values is None else tuple(values[i] for i in where(out))
    seen = [camera for camera, _ in cameras]
    inside, outside = (Views(of(seen, out) or (), of(pictures, out) or (), None, of(under, out)) for out in (False, True))
    return inside, outside


def _builtin() -> Volume:
    from jvr.io.demo import demo_volume

    return demo_volume()


def _read(config: Config, table: VolumeTable, path: str) -> Volume:
    from jvr.io.volumes import read_volume

    found = config.find(path, "volume.path", table.source)
    keywords = {name: getattr(table, name) for name in READ_KEYWORDS if getattr(table, name) is not None}
    return read_volume(found, **keywords)


def _scene(config: Config, volume: Volume, transfer: AbstractTransfer) -> Scene:
    tables = config.tables
    clipping = None if tables.clipping is None else made_value(config.where, "clipping", tables.clipping)
    light = light_parts(config, transfer) | environment_parts(config)
    fitted = () if tables.fit is None else tables.fit.unknowns
    if not any(name.startswith("volume.") for name in fitted):
        volume = graded(volume, light, transfer)
    surroundings = {"background": background_of(config), "clipping": clipping, "geometry": geometry_of(config)}
    if tables.optical is not None:
        surroundings["optical"] = made(config.where, "optical", tables.optical)
    return Scene(volume, transfer, **surroundings, **light)


def _transfer(config: Config, table: TransferTable, volume: Volume, key: str) -> AbstractTransfer:
    path = getattr(table, "path", None)
    file = None if path is None else config.find(path, f"{key}.path")
    return build_transfer(table, volume, config.where(key), key, file)


def _start_transfer(config: Config, fit: FitTable, volume: Volume) -> AbstractTransfer:
    """The given one, the truth where it is not what is fitted, or a flat table."""
    tables = config.tables
    if tables.transfer is not None:
        return _transfer(config, tables.transfer, volume, "transfer")
    known = not any(name.startswith("transfer.") for name in fit.unknowns)
    if tables.truth is not None and fit.start is None and known:
        return _transfer(config, tables.truth, volume, "truth")
    return _start(config, volume)


def _start(config: Config, volume: Volume) -> AbstractTransfer:
    """A flat table over the volume's range of values, or a given one."""
    from jvr.fitting.initialise import flat_transfer

    fit = config.tables.fit
    start = None if fit is None else fit.start
    if start is None:
        with blame(config.where("volume"), "volume"):
            return flat_transfer(volume)
    with blame(config.where("fit.start"), "fit.start"):
        opacity = 0.018 if start.opacity is None else start.opacity
        sigma_t = opacity / float(jnp.min(volume.spacing)) if start.sigma_t is None else start.sigma_t
        if start.domain is None:
            flat = flat_transfer(volume, start.entries, opacity=sigma_t * float(jnp.min(volume.spacing)), grey=start.grey)
            return flat
        return LutTransfer(np.full((start.entries, 3), start.grey), np.full(start.entries, sigma_t), start.domain)


def _all_keywords(config: Config, fit: FitTable, scene: Scene, cameras: tuple[AbstractCamera, ...]) -> dict[str, Any]:
    """Keywords of `jvr.fit` for a scene before anything was computed for it."""
    keywords = {
        **_keywords(config, fit),
        "unknowns": unknowns_of(config, fit, scene, cameras),
        "settings": build_settings(config),
    }
    return keywords | {"transforms": transforms_of(fit, scene.volume, len(cameras))}


def _keywords(config: Config, fit: FitTable) -> dict[str, Any]:
    from jvr.fitting.losses import DSSIM, AbsoluteError, Huber, SquaredError

    losses = {
        "squared-error": SquaredError,
        "absolute-error": AbsoluteError,
        "dssim": DSSIM,
        "huber": lambda: Huber(fit.huber_delta),
    }
    return {
        "solver": _solver(fit),
        "loss": losses[fit.loss](),
        "priors": priors_of(fit),
        "exposure": fit.exposure,
        "keep_samples": fit.keep_samples,
        "smooth_undetermined": fit.smooth_undetermined,
        "coarse_levels": fit.coarse_levels,
        "max_steps": fit.max_steps,
    }


def _solver(fit: FitTable) -> Any:
    import optax
    import optimistix as optx

    from jvr.fitting.least_squares import Dogleg, GaussNewton, LevenbergMarquardt
    from jvr.fitting.minimisers import LBFGSB

    chunked = {"levenberg-marquardt": LevenbergMarquardt, "gauss-newton": GaussNewton, "dogleg": Dogleg}
    if fit.solver in chunked:
        return chunked[fit.solver](**({} if fit.rtol is None else {"rtol": fit.rtol}))
    rtol = 1e-6 if fit.rtol is None else fit.rtol
    if fit.solver == "lbfgsb":
        return LBFGSB(tol=rtol)
    if fit.solver == "adam":
        return optx.OptaxMinimiser(optax.adam(fit.learning_rate), rtol=rtol, atol=rtol)
    quasi_newton = {"bfgs": optx.BFGS, "lbfgs": optx.LBFGS}[fit.solver]
    return quasi_newton(rtol=rtol, atol=1e-2 * rtol)


def _extra_cameras(
    config: Config, fit: FitTable, cameras: tuple[AbstractCamera, ...], volume: Volume
) -> list[tuple[AbstractCamera, bool]]:
    """The cameras, each with whether it is held out; a number asks for views between the given ones."""
    if isinstance(fit.held_out, list):
        chosen = held_out_indices(config, fit.held_out, len(cameras))
        return [(camera, i in chosen) for i, camera in enumerate(cameras)]
    given = [(camera, False) for camera in cameras]
    if not fit.held_out:
        return given
    first = cameras[0]
    if not isinstance(first, PerspectiveCamera):
        where = config.where("fit.held_out")
        raise ConfigError(where, "fit.held_out", "extra views are for perspective cameras: give a list of indices instead")
    center = np.asarray(volume.center)
    radius = float(np.linalg.norm(np.asarray(first.world_from_camera)[:3, 3] - center))
    # Every second view of a finer spiral: none of them is a view of a rig with fewer cameras.
    finer = fibonacci_sphere(center, radius, 2 * fit.held_out + 1, first.fov_y, first.width, first.height)
    return [*given, *((camera, True) for camera in finer[1::2])]
