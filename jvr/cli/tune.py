"""`jvr tune`: the cheapest settings for a wanted error, or the most accurate ones for a wanted time."""

import re
import time
import tomllib
from pathlib import Path
from typing import Any

from jvr.atomic import replacing
from jvr.cli.beforehand import Beforehand
from jvr.cli.inputs import BadInput, reading
from jvr.cli.runtime import progress, provenance, start_jax
from jvr.io.config import Config, build_cameras, build_scene
from jvr.march.quadrature import PreIntegrated
from jvr.rendering.measure import Measurement
from jvr.rendering.settings import Settings
from jvr.rendering.tune import tune

KEYS = ("step", "termination", "quadrature")


def tune_settings(config: Config, output: Path, error: float | None, seconds: float | None) -> dict[str, Any]:
    """Finds settings for the first camera of a configuration and writes a copy of it with them.

    **Raises** `BadInput` where nothing meets the target, with what can be met; nothing is written then.
    """
    start_jax()
    began = time.perf_counter()
    beforehand = Beforehand()
    with reading():
        scene = build_scene(config)
        camera = build_cameras(config, scene.volume)[0]
        with_settings(config.text, Settings())
        scene = beforehand(scene)
    with progress("measuring"), reading():
        found = tune(scene, camera, error=error, seconds=seconds)
    if not found.met:
        if error is not None:
            raise BadInput(
                f"--error {error:g} is out of reach on this scene: the least that was reached is {found.measured.rmse:.2g}"
            )
        raise BadInput(
            f"--time {seconds:g} is out of reach on this scene: the least that was reached is {found.measured.seconds:.2g} s"
        )
    with replacing(output) as temporary:
        temporary.write_text(with_settings(config.text, found.settings), encoding="utf-8")
    return {
        "command": "tune",
        "config": config.name,
        "output": str(output),
        "settings": _named(found.settings),
        "predicted": _numbers(found.predicted),
        "measured": _numbers(found.measured),
        "candidates": [{**_named(m.settings), **_numbers(m)} for m in found.candidates],
        "precomputed": beforehand.report,
        "seconds": time.perf_counter() - began,
        **provenance(),
    }


def with_settings(text: str, settings: Settings) -> str:
    """A configuration with other values of `KEYS` in its table `[settings]`; the rest stays as it was written.

    **Raises** `ValueError` where the settings are not a table of their own.
    """
    values = [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value:g}" for key, value in _named(settings).items()]
    header = re.search(r"^\s*\[settings\][^\n]*$", text, re.MULTILINE)
    if header is None:
        if "settings" in tomllib.loads(text):
            raise ValueError(
                "settings: write them as a table, with a line [settings] above its keys, so that they can be replaced"
            )
        return text.rstrip("\n") + "\n\n[settings]\n" + "\n".join(values) + "\n"
    rest = text[header.end() :]
    following = re.search(r"^\s*\[", rest, re.MULTILINE)
    inside = rest if following is None else rest[: following.start()]
    kept = re.sub(rf"^\s*({'|'.join(KEYS)})\s*=[^\n]*\n?", "", inside, flags=re.MULTILINE)
    return text[: header.end()] + "\n" + "\n".join(values) + "\n" + kept.lstrip("\n") + rest[len(inside) :]


def _named(settings: Settings) -> dict[str, Any]:
    quadrature = "pre-integrated" if isinstance(settings.quadrature, PreIntegrated) else "midpoint"
    return {"step": settings.step, "termination": settings.termination, "quadrature": quadrature}


def _numbers(m: Measurement) -> dict[str, float]:
    return {"seconds": m.seconds, "rmse": m.rmse, "largest": m.largest, "ssim": m.ssim, "samples": m.samples}
