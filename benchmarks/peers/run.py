"""All comparisons in one run."""

import statistics
import sys
from collections.abc import Callable, Iterable
from typing import Any

from benchmarks.peers import measure, scenes
from benchmarks.peers.settings import REFERENCE_STEP, TERMINATION, THREADS
from benchmarks.peers.worker import RENDERERS, Absent, Worker

SINGLE_SCATTERING = "not measured: jvr has no single scattering"


def peers(quick: bool = False) -> dict[str, Any]:
    """`jvr` beside VTK, PyTorch, Mitsuba and a compiled loop; what is not installed is said and left out."""
    sizes = measure.QUICK if quick else measure.FULL
    versions, absent = installed()
    present = list(versions)
    four = scenes.four(sizes.voxels, sizes.picture)
    small = [scene.sized(sizes.gradient_picture, sizes.gradient_picture) for scene in four]
    growing = (scenes.growing(n, sizes.picture) for n in sizes.growth)
    growing_small = (scenes.growing(n, sizes.gradient_picture) for n in sizes.gradient_growth)
    result = {
        "quick": quick,
        "threads": THREADS,
        "reference_step": REFERENCE_STEP,
        "termination": TERMINATION,
        "versions": versions,
        "absent": absent,
        "forward": _rows("forward", measure.forward, four, present, sizes.repeats),
        "growth": _rows("growth", measure.forward, growing, present, sizes.repeats),
        "gradient": _rows("gradient", measure.gradient, small, present, min(sizes.repeats, 3)),
        "gradient_growth": _rows("growth of the gradient", measure.gradient, growing_small, present, min(sizes.repeats, 3)),
    }
    _say("absorption")
    fog = scenes.fog(sizes.voxels // 2, sizes.gradient_picture)
    result["absorption"] = measure.absorption(fog, sizes.absorption_error, present, min(sizes.repeats, 3))
    result["single_scattering"] = {"skipped": SINGLE_SCATTERING}
    _say("fit")
    result["fit"] = measure.fit(sizes.fit_picture, present, min(sizes.repeats, 3))
    _say("empty space")
    result["empty_space"] = measure.empty_space(sizes)
    result["figures"] = figures(result)
    return result


def installed() -> tuple[dict[str, str], dict[str, str]]:
    """Versions of the renderers that are there, and why others are not."""
    versions, absent = {}, {}
    for name in RENDERERS:
        try:
            with Worker(name) as worker:
                versions[name] = worker.version
        except Absent as error:
            absent[name] = str(error)
    return versions, absent


def figures(result: dict[str, Any]) -> dict[str, float | None]:
    """Medians over the scenes, and what is a single number anyway; `None` where a peer was absent."""
    over = lambda table, key, name: [row[key][name] for row in result[table] if name in row[key]]
    middle = lambda values: statistics.median(values) if values else None
    return {
        "forward_jvr_over_vtk": middle(over("forward", "jvr_over", "vtk")),
        "forward_jvr_over_vtk_gpu": middle(over("forward", "jvr_over", "vtk_gpu")),
        "forward_jvr_over_compiled": middle(over("forward", "jvr_over", "compiled")),
        "gradient_torch_over_jvr": middle(over("gradient", "over_jvr", "torch")),
        "absorption_mitsuba_over_jvr": result["absorption"].get("over_jvr", {}).get("mitsuba"),
        "fit_over_torch_gradient": result["fit"].get("fit_over_torch_gradient"),
        **result["empty_space"],
    }


def _rows(title: str, measurement: Callable[..., dict], some: Iterable[scenes.Scene], *arguments: Any) -> list[dict[str, Any]]:
    rows = []
    for scene in some:
        _say(f"{title}: {scene.name} ({scene.data}), {' x '.join(map(str, scene.voxels.shape))}")
        rows.append(measurement(scene, *arguments))
    return rows


def _say(text: str) -> None:
    print(f"  {text} ...", file=sys.stderr, flush=True)
