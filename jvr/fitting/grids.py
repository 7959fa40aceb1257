"""Voxels from coarse to fine: a fit on a grid whose voxels lie far apart is where that on a finer one starts."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from jvr.fitting.fit import fit
from jvr.fitting.result import FitResult, Iteration
from jvr.fitting.unknowns import ExposedModel, choose_unknowns, selected
from jvr.model.camera import AbstractCamera
from jvr.model.grids import Shape, coarser, on_grid
from jvr.model.scene import Scene


def fit_on_grids(
    scene: Scene,
    cameras: Sequence[AbstractCamera],
    images: Any,
    *,
    unknowns: Callable[..., Any],
    levels: int = 3,
    held_out: tuple[Any, ...] | None = None,
    max_steps: int = 100,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: bool | Callable[[Iteration], None] | None = None,
    **keywords: Any,
) -> FitResult:
    """`jvr.fit` of voxels from coarse to fine: on the coarsest grid first, and on each finer one from what was found.

    Voxels of each coarser grid lie twice as far apart over the same domain (`n` of them become `n // 2 + 1`), and from grid to grid they
    are interpolated trilinearly, which reproduces a linear field. A step of `jvr.Settings` is so many voxels, so that on a coarser grid
    there are fewer samples as well. What the start holds between the voxels of the coarsest grid is not kept.

    **Arguments:** as of `jvr.fit`, to which `keywords` go; `unknowns`: the voxels, and whatever else; `levels`: how many grids, the last
    one that of `scene.volume`; `max_steps`: on each of them; `checkpoint`: the file of the coarsest grid, beside which those of finer ones
    have a number at the end of their name.

    Returns the fit on the last grid, with the history and the seconds of all.
    **Raises** `ValueError` as `jvr.fit`, where the voxels are not unknown or some are missing, and where there are not so many grids.
    """
    shapes, voxels = _shapes(scene.volume.shape, levels), scene.volume.values
    # Refuses integers, which a coarser grid would make floating-point numbers of.
    choose_unknowns(ExposedModel(scene, None), lambda m: m.scene.volume.values)
    if not any(array is voxels for array in jax.tree.leaves(selected(unknowns, scene, tuple(cameras)))):
        raise ValueError("levels are grids of voxels, which are not asked for: name volume.values, or use jvr.fit")
    files = [None if checkpoint is None else level_file(Path(checkpoint), level) for level in range(levels)]
    for file in () if resume else files:
        # Of an earlier run: another one that is interrupted would find it.
        if file is not None:
            file.unlink(missing_ok=True)
    history: list[Iteration] = []
    result = None
    for level, (shape, file) in enumerate(zip(shapes, files, strict=True)):
        result = fit(
            eqx.tree_at(lambda s: s.volume, scene, on_grid(scene.volume, shape)),
            cameras,
            images,
            unknowns=unknowns,
            held_out=held_out if level == levels - 1 else None,
            max_steps=max_steps,
            checkpoint=file,
            resume=resume,
            progress=_following(history, progress) if callable(progress) else progress,
            **keywords,
        )
        scene, cameras = result.scene, result.cameras
        history = [*history, *(_later(entry, history) for entry in result.history)]
    assert result is not None
    seconds = history[-1].seconds if history else result.stats.seconds
    return result._replace(history=tuple(history), stats=result.stats._replace(seconds=max(seconds, result.stats.seconds)))


def level_file(checkpoint: Path, level: int) -> Path:
    """Where the fit on a grid, counted from the coarsest, saves itself."""
    return checkpoint.with_name(f"{checkpoint.stem}_{level}{checkpoint.suffix}") if level else checkpoint


def _shapes(shape: Shape, levels: int) -> list[Shape]:
    """Grids from coarse to fine."""
    shapes = [shape]
    while len(shapes) < levels and coarser(shapes[0]) != shapes[0]:
        shapes.insert(0, coarser(shapes[0]))
    if levels < 1 or len(shapes) < levels:
        raise ValueError(f"levels must be from 1 to {len(shapes)} for {' x '.join(map(str, shape))} voxels, not {levels}")
    return shapes


def _later(entry: Iteration, before: list[Iteration]) -> Iteration:
    """A line of the history as it follows others."""
    if not before:
        return entry
    return entry._replace(step=entry.step + before[-1].step, seconds=entry.seconds + before[-1].seconds)


def _following(before: list[Iteration], show: Callable[[Iteration], Any]) -> Callable[[Iteration], Any]:
    return lambda entry: show(_later(entry, before))
