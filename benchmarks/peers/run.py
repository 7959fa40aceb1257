"""All comparisons in one run."""

import os
import sys
from collections.abc import Callable, Iterable
from typing import Any

from benchmarks.peers import measure, scenes
from benchmarks.peers.settings import REFERENCE_STEP, TERMINATION, THREADS
from benchmarks.peers.worker import RENDERERS, Absent, Worker


def peers(quick: bool = False) -> dict[str, Any]:
    """`jvr` beside VTK, PyTorch, Mitsuba and a compiled loop; what is not installed is said and left out."""
    before = _load()
    sizes = measure.QUICK if quick else measure.FULL
    versions, absent = installed()
    present = list(versions)
    # Scans are not made smaller.
    four = (scenes.from_formulas if quick else scenes.four)(sizes.voxels, sizes.picture)
    small = [scene.sized(sizes.small_picture, sizes.small_picture) for scene in four]
    growing = (scenes.growing(n, sizes.picture) for n in sizes.growth)
    fog = scenes.fog(sizes.voxels // 2, sizes.small_picture)
    growing_small = (scenes.growing(n, sizes.small_picture) for n in sizes.gradient_growth)
    rounds, fewer = sizes.repeats, min(sizes.repeats, 3)
    return _with_figures(
        {
            "quick": quick,
            "threads": THREADS,
            "reference_step": REFERENCE_STEP,
            "termination": TERMINATION,
            "versions": versions,
            "absent": absent,
            "opengl": measure.opengl(present),
            "forward": _rows("forward", measure.forward, four, present, rounds),
            "growth": _rows("growth", measure.forward, growing, present, rounds),
            "gradient": _rows("gradient", measure.gradient, four, present, fewer),
            "gradient_small": _rows("gradient of a small picture", measure.gradient, small, present, fewer),
            "gradient_growth": _rows("growth of the gradient", measure.gradient, growing_small, present, fewer),
            "absorption": _row("absorption", measure.absorption, fog, sizes.absorption_error, present, fewer),
            "scattering": scattered(sizes, present),
            "fit": _row("fit", measure.fit, sizes.fit_picture, present, fewer),
            "empty_space": _row("empty space", measure.empty_space, sizes),
            "load": (before, _load()),
        }
    )


def scattering(quick: bool = False) -> dict[str, Any]:
    """Single scattering alone."""
    before = _load()
    versions, absent = installed(("jvr", "mitsuba"))
    rows = scattered(measure.QUICK if quick else measure.FULL, list(versions))
    heads = {"quick": quick, "threads": THREADS, "versions": versions, "absent": absent}
    return {**heads, "scattering": rows, "load": (before, _load())}


def scattered(sizes: measure.Sizes, present: list[str]) -> list[dict[str, Any]]:
    """One row for each medium that scatters."""
    return _rows("scattering", measure.scattering, scenes.scattering(sizes.voxels // 2, sizes.small_picture), sizes, present)


def installed(names: Iterable[str] = RENDERERS) -> tuple[dict[str, str], dict[str, str]]:
    """Versions of the renderers that are there, and why others are not."""
    versions, absent = {}, {}
    for name in names:
        try:
            with Worker(name) as worker:
                versions[name] = worker.version
        except (Absent, RuntimeError) as error:
            absent[name] = str(error)
    return versions, absent


def _with_figures(result: dict[str, Any]) -> dict[str, Any]:
    """Adds the worst over the scenes, and what is a single number anyway; `None` where a peer was absent."""
    over = lambda table, key, name: [row[key][name] for row in result[table] if name in row.get(key, {})]
    most, least = (lambda values, f=f: f(values) if values else None for f in (max, min))
    result["figures"] = {
        "forward_jvr_over_vtk": most(over("forward", "jvr_over", "vtk")),
        "forward_jvr_over_vtk_gpu": most(over("forward", "jvr_over", "vtk_gpu")),
        "forward_jvr_over_compiled": most(over("forward", "jvr_over", "compiled")),
        "gradient_torch_over_jvr": least(over("gradient", "over_jvr", "torch")),
        "small_gradient_torch_over_jvr": least(over("gradient_small", "over_jvr", "torch")),
        "absorption_mitsuba_over_jvr": result["absorption"].get("over_jvr", {}).get("mitsuba"),
        "scattering_mitsuba_over_jvr": least(over("scattering", "over_jvr", "mitsuba")),
        "fit_over_torch_gradient": result["fit"].get("fit_over_torch_gradient"),
        **{name: value for name, value in result["empty_space"].items() if name != "failed"},
    }
    return result


def _rows(title: str, measurement: Callable[..., dict], some: Iterable[scenes.Scene], *arguments: Any) -> list[dict[str, Any]]:
    rows = []
    for scene in some:
        about = f"{scene.name} ({scene.data}), {' x '.join(map(str, scene.voxels.shape))}"
        rows.append(_row(f"{title}: {about}", measurement, scene, *arguments))
    return rows


def _row(title: str, measurement: Callable[..., dict], *arguments: Any) -> dict[str, Any]:
    """What was measured; a renderer that fails costs one row and not the run."""
    print(f"  {title} ...", file=sys.stderr, flush=True)
    try:
        return measurement(*arguments)
    except RuntimeError as error:
        print(f"  failed: {error}", file=sys.stderr, flush=True)
        return {"failed": f"{title}: {error}"}


def _load() -> float:
    """How many processes wanted a core during the last minute: other work on the machine makes the times worthless."""
    return os.getloadavg()[0]
