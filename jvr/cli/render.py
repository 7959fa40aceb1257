"""`jvr render`: pictures of a configuration or of a volume file."""

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jvr.cli.beforehand import Beforehand
from jvr.cli.inputs import BadInput, check_inputs_stay, explain, inputs_of, reading, refused_by_jvr
from jvr.cli.runtime import plain, progress, provenance, start_jax
from jvr.io.animation import write_animation
from jvr.io.config import Config, build_cameras, build_scene, build_settings
from jvr.io.config.schema.transfer import PresetTable, SlicerTable
from jvr.io.first_picture import what_is_seen
from jvr.io.volumes.errors import available_memory
from jvr.model.volume import Volume

# Of a pixel: colour, opacity, depth and steps, and a copy of each.
BYTES = 48
# Seconds that an animation takes to go round.
TURN = 6.0


def render_pictures(
    config: Config, output: Path, volume: Volume | None = None, *, animated: bool = False, layers: bool = False
) -> dict[str, Any]:
    """Renders every camera of a configuration: to `output`, or with several cameras to numbered files beside it, and where these are to be
    `animated`, to a moving picture beside them. `volume`: that of the configuration, where it is read already."""
    if layers and output.suffix.lower() != ".exr":
        raise BadInput("--layers: a PNG has no room for them; name an .exr with -o")
    start_jax()
    began = time.perf_counter()
    beforehand = Beforehand()
    with reading():
        scene, settings = build_scene(config, volume), build_settings(config)
        cameras = build_cameras(config, scene.volume, scene.transfer)
        if isinstance(config.tables.transfer, PresetTable | SlicerTable) and (note := what_is_seen(scene.volume, scene.transfer)):
            explain(f"note: {note}", 0)
        _check_memory(cameras)
        outputs, inputs = _names(output, len(cameras)), inputs_of(config)
        moving = output.with_suffix(".gif") if animated else None
        for path in [*outputs, *([moving] if moving else [])]:
            check_inputs_stay(path, inputs)
        scene = beforehand(scene)
    import equinox as eqx
    import jax

    from jvr.cli.runtime import compiling
    from jvr.pictures import write_image
    from jvr.rendering.layers import render_layers
    from jvr.rendering.render import render

    pictures, frames, compile_seconds = [], [], 0.0
    if settings.skipping:
        scene = eqx.tree_at(lambda s: s.volume, scene, scene.volume.bricked())
    with progress("rendering"):
        for i, camera in enumerate(cameras):
            with compiling() as compiled:
                start = time.perf_counter()
                picture = jax.block_until_ready(_rendered(render_layers if layers else render, scene, camera, settings))
                seconds = time.perf_counter() - start
            compile_seconds += compiled[0]
            pictures.append(_numbers(picture, camera, outputs[i], seconds - compiled[0]))
            # With a background the colours are no longer those of the medium alone, which is what alpha belongs to.
            alpha = np.asarray(picture.alpha) if scene.background is None else None
            depth = {"depth": np.asarray(picture.depth)} if outputs[i].suffix.lower() == ".exr" else {}
            named = {} if picture.layers is None else picture.layers._asdict()
            write_image(outputs[i], np.asarray(picture.rgb), alpha, **depth, layers=named)
            frames.extend([np.asarray(picture.rgb)] if moving else [])
        if moving:
            write_animation(moving, frames, seconds=TURN)
            outputs.append(moving)
    return {
        "command": "render",
        "config": config.name,
        "outputs": [str(path) for path in outputs],
        "pictures": pictures,
        "seconds": time.perf_counter() - began,
        "compile_seconds": compile_seconds,
        "precomputed": beforehand.report,
        **provenance(),
    }


def _check_memory(cameras: Sequence[Any]) -> None:
    """Refuses pictures that the memory cannot take, before hours are spent on them."""
    width, height = max(((camera.width, camera.height) for camera in cameras), key=math.prod)
    needed, free = width * height * BYTES, available_memory()
    if free is not None and needed > free:
        raise BadInput(f"{width} x {height} pixels need {needed:,} bytes, {free:,} are free in memory: choose a smaller --size")


def _rendered(render: Any, *arguments: Any) -> Any:
    """A picture. What renders no scene of this kind says so while it is compiled."""
    try:
        return render(*arguments)
    except (ValueError, TypeError) as error:
        if not refused_by_jvr(error):
            raise
        raise BadInput(f"render: {error}") from error


def _names(output: Path, count: int) -> list[Path]:
    if count == 1:
        return [output]
    digits = max(2, len(str(count - 1)))
    return [output.with_name(f"{output.stem}_{i:0{digits}d}{output.suffix}") for i in range(count)]


def _numbers(picture: Any, camera: Any, path: Path, seconds: float) -> dict[str, Any]:
    return {
        "output": str(path),
        "width": camera.width,
        "height": camera.height,
        "seconds": seconds,
        "mean_alpha": plain(picture.alpha.mean()),
        "mean_radiance": plain(picture.rgb.mean()),
        "mean_steps": plain(picture.stats.steps.mean()),
    }
