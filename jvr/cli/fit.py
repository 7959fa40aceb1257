"""`jvr fit` and `jvr demo`: one folder with everything that a fit found."""

import contextlib
import json
import re
import shlex
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jvr.cli.beforehand import Beforehand
from jvr.cli.folder import (
    CAMERAS,
    CHECKPOINT,
    CHECKPOINTS,
    KNOWLEDGE,
    PAGE,
    RESULT,
    TRANSFER,
    VOLUME,
    alone_in,
    check_results,
    results_in,
)
from jvr.cli.inputs import BadInput, Interrupted, inputs_of, reading, refused_by_jvr, warnings_as_lines
from jvr.cli.runtime import nested, plain, progress, provenance, start_jax
from jvr.cli.signals import INTERRUPTED, Terminated, said
from jvr.io.config import Config, FitJob, build_fit, write_transfer
from jvr.io.config.cameras import write_cameras
from jvr.io.config.parts import choices_of
from jvr.io.knowledge import write_knowledge
from jvr.io.volumes.written import write_metaimage
from jvr.model.exact import in_double


def demo_config() -> Path:
    """The configuration of `jvr demo`: installed with the package, or beside it where the package is used from its repository."""
    package = Path(__file__).parents[1]
    installed = package / "configs" / "demo.toml"
    return installed if installed.exists() else package.parent / "configs" / "demo.toml"


def fit_scene(config: Config, folder: Path, *, resume: bool = False, force: bool = False) -> dict[str, Any]:
    """Runs the fit of a configuration and writes pictures, transfer function, numbers and page into `folder`.

    **Raises** `BadInput` where the folder holds what would be written over, and another fit writes there: `resume` goes on from its
    checkpoint, `force` replaces results of another run.
    """
    start_jax()
    began = time.perf_counter()
    beforehand = Beforehand()
    checkpoint = folder / CHECKPOINT
    with contextlib.ExitStack() as whole:
        # A folder that is not there yet is made once the input is known to be good.
        is_there = folder.exists()
        if is_there:
            whole.enter_context(alone_in(folder))
        with reading(), progress("reading the volume and the target images"):
            check_results(folder, inputs_of(config), resume=resume, force=force)
            job = build_fit(config, precompute=beforehand)
        if not is_there:
            folder.mkdir(parents=True, exist_ok=True)
            whole.enter_context(alone_in(folder))
        whole.enter_context(_about_the_kept_radiance_transfer(job))
        result = _fit(job, checkpoint, resume)
        with progress("writing the results"):
            return _write(config, job, result, folder, began, beforehand)


@contextlib.contextmanager
def _about_the_kept_radiance_transfer(job: FitJob) -> Iterator[None]:
    """No warnings that a radiance transfer is kept which the configuration asks to keep."""
    with warnings.catch_warnings():
        if job.keeps_radiance_transfer:
            warnings.filterwarnings("ignore", "the radiance transfer was computed for another", RuntimeWarning)
        yield


def _fit(job: FitJob, checkpoint: Path, resume: bool) -> Any:
    from jvr.fitting.fit import fit
    from jvr.fitting.grids import fit_on_grids

    keywords = dict(job.keywords, held_out=job.held_out, checkpoint=checkpoint, resume=resume)
    if not resume:
        checkpoint.unlink(missing_ok=True)
    try:
        with warnings_as_lines():
            if job.levels > 1:
                return fit_on_grids(job.scene, job.cameras, job.targets, levels=job.levels, **keywords)
            return fit(job.scene, job.cameras, job.targets, **keywords)
    except (KeyboardInterrupt, Terminated) as error:
        kept = f"{checkpoint} is kept, --resume goes on from it" if checkpoint.exists() else "no step was finished"
        status = error.status if isinstance(error, Terminated) else INTERRUPTED
        raise Interrupted(f"{said(status)}: {kept}", status) from error
    except ValueError as error:
        if not refused_by_jvr(error):
            raise
        raise BadInput(f"fit: {error}") from error


def _write(config: Config, job: FitJob, result: Any, folder: Path, began: float, beforehand: Beforehand) -> dict[str, Any]:
    from jvr.atomic import replacing

    fitted = _pictures(result.scene, result.exposure, result.cameras, job, job.keywords["lights"])
    # Of another run: it may have had more views.
    for path in results_in(folder):
        if not re.fullmatch(CHECKPOINTS, path.name):
            path.unlink()
    for i, (target, found) in enumerate(zip(job.targets, fitted, strict=True)):
        _write_views(folder, f"{i:02d}", target, found)
    held_cameras, held_targets, *held_lights = job.held_out or ((), ())
    held_fitted = _pictures(result.scene, result.exposure, held_cameras, job, *held_lights)
    for i, (target, found) in enumerate(zip(held_targets, held_fitted, strict=True)):
        _write_views(folder, f"held_out_{i:02d}", target, found)
    write_transfer(folder / TRANSFER, result.scene.transfer)
    if "volume.values" in result.unknowns:
        write_metaimage(folder / VOLUME, result.scene.volume)
    write_cameras(folder / CAMERAS, result.cameras)
    write_knowledge(folder / KNOWLEDGE, config, result)
    report = _report(config, job, result, (fitted, held_fitted))
    report["transfer_kept"] = _with_transfer_of_its_own(job, result, beforehand) if job.keeps_radiance_transfer else None
    report |= {"precomputed": beforehand.report, "seconds": time.perf_counter() - began}
    with replacing(folder / RESULT) as temporary:
        temporary.write_text(json.dumps(report, allow_nan=False, indent=1), encoding="utf-8")
    _write_page(folder, config, job, result, fitted)
    return report


def _with_transfer_of_its_own(job: FitJob, result: Any, beforehand: Beforehand) -> dict[str, Any]:
    """How the result looks once its radiance transfer is its own and not that of the start."""
    import equinox as eqx

    scene = beforehand(eqx.tree_at(lambda s: s.radiance_transfer.projected, result.scene, None))
    return _scores(job.targets, _pictures(scene, result.exposure, result.cameras, job, job.keywords["lights"]))


def _pictures(scene: Any, exposure: float, cameras: Any, job: FitJob, lights: Any = None) -> list[np.ndarray]:
    """What a scene looks like from each camera, under its own lights or those of each view, in the radiance of the target images."""
    from jvr.fitting.groups import lit
    from jvr.rendering.render import render

    scenes = [scene if lights is None else lit(scene, lights[i], i) for i in range(len(cameras))]
    settings = job.keywords["settings"]
    return [exposure * np.asarray(render(one, camera, settings).rgb) for one, camera in zip(scenes, cameras, strict=True)]


def _write_views(folder: Path, name: str, target: np.ndarray, fitted: np.ndarray) -> None:
    from jvr.pictures import write_image

    for kind, image in (("target", target), ("fitted", fitted), ("difference", fitted - target)):
        write_image(folder / f"{kind}_{name}.exr", image)
        # A PNG holds no negative light: there the size of the difference is shown, ten times enlarged, and black for what is not known.
        shown = np.where(np.isfinite(image), image, 0)
        write_image(folder / f"{kind}_{name}.png", 10 * np.abs(shown) if kind == "difference" else shown)


def _write_page(folder: Path, config: Config, job: FitJob, result: Any, fitted: list[np.ndarray]) -> None:
    from jvr.io.describe import describe
    from jvr.report.page import write_fit_page

    sets = [part for text in config.overrides for part in ("--set", text)]
    write_fit_page(
        folder / PAGE,
        title=Path(config.name).stem.replace("_", " "),
        result=result,
        targets=job.targets,
        fitted=fitted,
        before=_pictures(job.scene, 1.0, job.cameras, job, job.keywords["lights"]),
        truth=job.truth,
        command=shlex.join(["jvr", "fit", config.name, "-o", str(folder), *sets]),
        config_text=config.text or None,
        histogram=describe(job.scene.volume)["histogram"],
    )


def _report(config: Config, job: FitJob, result: Any, pictures: Any) -> dict[str, Any]:
    """The machine-readable object of a fit. What the images do not determine has the standard error `null`."""
    tables = config.tables
    held_targets = job.held_out[1] if job.held_out else ()
    stats = result.stats
    return {
        "command": "fit",
        "config": config.name,
        "settings": choices_of(job.keywords["settings"]),
        "fit": tables.fit.model_dump() if tables.fit else None,
        "outcome": result.outcome.value,
        "exposure": result.exposure,
        "fit_seconds": stats.seconds,
        "views": _scores(job.targets, pictures[0]),
        "held_out": _scores(held_targets, pictures[1]),
        "history": [{name: plain(value) for name, value in entry._asdict().items()} for entry in result.history],
        # Of voxels there are none, and too many to say so of each.
        "standard_errors": {name: None if np.isnan(a).all() else nested(a) for name, a in result.errors_by_name.items()},
        "rank": stats.rank,
        "condition": plain(stats.condition),
        "residual_variance": plain(stats.residual_variance),
        "structured": stats.structured,
        "design_effect": plain(stats.design_effect),
        "smoothed": dict(stats.smoothed),
        "cameras": [in_double(c.world_from_camera, c.remainder).tolist() for c in result.cameras],
        "worst_determined": [[name, plain(share)] for name, share in stats.worst],
        "kept_bytes": stats.kept_bytes,
        "page": PAGE,
        **provenance(),
    }


def _scores(targets: Any, fitted: Any) -> dict[str, Any]:
    """PSNR (of radiance 1) of each view and of all pixels together, and SSIM of each view; `null` for equal images. Where a target is not
    finite it is not known."""
    from jvr.rendering.measure import psnr, similarity

    flat = lambda images: np.concatenate([np.ravel(image) for image in images])
    return {
        "psnr": [plain(psnr(*pair)) for pair in zip(targets, fitted, strict=True)],
        "mean_psnr": plain(psnr(flat(targets), flat(fitted))) if len(targets) else None,
        "ssim": [plain(similarity(*pair)) for pair in zip(targets, fitted, strict=True)],
    }
