"""`jvr next-view`: which view to take next, from the folder of a finished fit."""

import contextlib
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jvr.cli.beforehand import Beforehand
from jvr.cli.folder import CAMERAS, CHECKPOINT, KNOWLEDGE, RESULT
from jvr.cli.inputs import BadInput, check_inputs_stay, inputs_of, reading, refused_by_jvr, warnings_as_lines
from jvr.cli.runtime import progress, provenance, start_jax
from jvr.io.config import Config, build_cameras, build_settings, build_start, config_from
from jvr.io.config.environment import fit_scene
from jvr.io.config.errors import ConfigError
from jvr.io.config.text import read_toml
from jvr.io.interop import read_cameras
from jvr.io.knowledge import Saved, read_knowledge
from jvr.model.camera import AbstractCamera
from jvr.model.scene import Scene

# Of the best candidates so many are drawn.
DRAWN = 3
# Between the pictures of several, in pixels.
GAP = 4


def rank_views(folder: Path, cameras: Path | None, count: int, output: Path) -> dict[str, Any]:
    """Ranks the cameras of a file, or `count` from all around, by what they would add to the fit of a folder, and draws the best."""
    start_jax()
    began = time.perf_counter()
    with reading(), progress("reading the fit"):
        saved = _saved(folder)
        check_inputs_stay(output, [*inputs_of(saved.config), *([] if cameras is None else [cameras])])
        settings, (_, own, scene) = build_settings(saved.config), build_start(saved.config)
        given = None if cameras is None else _given(cameras, saved.config, scene)
        if (folder / CAMERAS).exists():
            # Cameras that were found stand where the fit has them, not where it began.
            own = _given(folder / CAMERAS, saved.config, scene)
        scene = fit_scene(saved.config, scene, Beforehand())
    from jvr.fitting.next_view import Knowledge, around, ranked, scene_with
    from jvr.pictures import write_image
    from jvr.rendering.render import render

    assert saved.information is not None
    with _refusals(), warnings_as_lines(), progress("comparing views"):
        found = scene_with(scene, saved.values)
        known = Knowledge(found, tuple(saved.values), saved.information, saved.variance, saved.exposure)
        best = ranked(known, around(found, own, count) if given is None else given, settings)
        pictures = [saved.exposure * np.asarray(render(found, one.camera, settings).rgb) for one in best[:DRAWN]]
    write_image(output, _side_by_side(pictures))
    return {
        "command": "next-view",
        "folder": str(folder),
        "cameras": None if cameras is None else str(cameras),
        "views": [_numbers(one) for one in best],
        "output": str(output),
        "seconds": time.perf_counter() - began,
        **provenance(),
    }


def table(report: dict[str, Any]) -> str:
    """The views as lines, the best first."""
    views = report["views"]
    names = list(views[0]["median_error"])
    head = ["rank", "view", "from", "bits", *names]
    rows = [
        [
            str(i + 1),
            str(view["number"]),
            "({:.4g}, {:.4g}, {:.4g})".format(*view["from"]),
            f"{view['bits']:.1f}",
            *(f"{view['median_error'][name]:.2g} -> {view['median_error_after'][name]:.2g}" for name in names),
        ]
        for i, view in enumerate(views)
    ]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)]
    return "\n".join([*lines, f"median standard errors of each array; the best {min(DRAWN, len(views))}: {report['output']}"])


def _saved(folder: Path) -> Saved:
    """What the fit of a folder knows."""
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder; name the one that jvr fit -o has written")
    if not (folder / RESULT).exists():
        unfinished = (folder / CHECKPOINT).exists()
        remedy = "finish it with jvr fit --resume" if unfinished else "name the one that jvr fit -o has written"
        raise BadInput(f"{folder}: holds {'an unfinished fit' if unfinished else 'no results of a fit'}; {remedy}")
    if not (folder / KNOWLEDGE).exists():
        raise BadInput(f"{folder}: was written by an older jvr, without {KNOWLEDGE}; run the fit again, jvr fit --force")
    saved = read_knowledge(folder / KNOWLEDGE)
    if saved.information is None:
        raise BadInput(f"{folder}: {saved.refused}")
    return saved


def _given(path: Path, config: Config, scene: Scene) -> Sequence[AbstractCamera]:
    """The cameras of a file: a configuration's, or those of another program."""
    if path.suffix.lower() != ".toml":
        return read_cameras(path)
    _, data = read_toml(path)
    if "camera" not in data:
        raise ConfigError(str(path), "camera", "missing; add tables [[camera]], as in a configuration")
    there = config_from(config.data | {"camera": data["camera"]}, str(path), path.parent)
    return build_cameras(there, scene.volume, scene.transfer)


def _numbers(one: Any) -> dict[str, Any]:
    median = lambda errors: {name: float(np.median(array)) for name, array in errors.items()}
    place = np.asarray(one.camera.world_from_camera, float)
    return {
        "number": one.number,
        "from": place[:3, 3].tolist(),
        "world_from_camera": place.tolist(),
        "bits": one.gain,
        "median_error": median(one.before),
        "median_error_after": median(one.errors),
    }


@contextlib.contextmanager
def _refusals() -> Iterator[None]:
    """What the library refuses is the input's fault."""
    try:
        yield
    except ValueError as error:
        if not refused_by_jvr(error):
            raise
        raise BadInput(f"next-view: {error}") from error


def _side_by_side(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures in a row, on white."""
    height = max(len(picture) for picture in pictures)
    columns = []
    for picture in pictures:
        columns += [np.ones((height, GAP, 3)), np.pad(picture, ((0, height - len(picture)), (0, 0), (0, 0)), constant_values=1.0)]
    return np.concatenate(columns[1:], axis=1)
