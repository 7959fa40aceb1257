"""`jvr plan --measure` and `--tolerance`: what each effect costs and shows, and which could go."""

import time
from typing import Any

from jvr.cli.beforehand import Beforehand
from jvr.cli.inputs import BadInput, reading
from jvr.cli.runtime import progress, provenance, start_jax
from jvr.io.config import Config, build_cameras, build_scene, build_settings
from jvr.rendering.advise import Advice, advise


def advise_on(config: Config, tolerance: float | None) -> tuple[Advice, dict[str, Any]]:
    """Measures what each effect of a configuration's scene contributes to the picture of its first camera."""
    import equinox as eqx

    start_jax()
    began = time.perf_counter()
    beforehand = Beforehand()
    with reading():
        scene, settings = build_scene(config), build_settings(config)
        camera = build_cameras(config, scene.volume)[0]
        scene = beforehand(scene)
    if settings.skipping:
        scene = eqx.tree_at(lambda s: s.volume, scene, scene.volume.bricked())
    with progress("measuring"), reading():
        found = advise(scene, camera, settings, tolerance=tolerance)
    report: dict[str, Any] = {
        "picture_seconds": found.seconds,
        "contributions": [{"effect": c.effect, "rmse": c.rmse, "share": c.share} for c in found.contributions],
        "remarks": list(found.remarks),
        "precomputed": beforehand.report,
        "seconds": time.perf_counter() - began,
        **provenance(),
    }
    if found.proposal is not None:
        proposal = found.proposal
        report["proposal"] = {"changes": list(proposal.changes), "rmse": proposal.rmse, "seconds": proposal.seconds}
    return found, report


def as_tolerance(text: str) -> float:
    """A positive number, or a fraction such as `1/255`. **Raises** `BadInput` otherwise."""
    try:
        numerator, _, denominator = text.partition("/")
        value = float(numerator) / float(denominator or 1)
    except (ValueError, ZeroDivisionError):
        value = 0.0
    if not 0 < value < float("inf"):
        raise BadInput(f"--tolerance {text}: give a positive difference of radiance, such as 1/255 or 0.004")
    return value
