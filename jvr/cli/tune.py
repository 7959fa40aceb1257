"""`jvr tune`: the cheapest choices for a wanted error, or the most accurate ones for a wanted time."""

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
from jvr.io.kinds import kind_of
from jvr.model.scene import Scene
from jvr.rendering.foretelling import turns_of
from jvr.rendering.measure import Measurement
from jvr.rendering.settings import Settings
from jvr.rendering.tune import tune


def tune_settings(config: Config, output: Path, error: float | None, seconds: float | None) -> dict[str, Any]:
    """Finds settings, and what the scene's own knobs should be, for the first camera of a configuration, and writes a copy with them.

    **Raises** `BadInput` where nothing meets the target, with what can be met; nothing is written then.
    """
    start_jax()
    began = time.perf_counter()
    beforehand = Beforehand()
    with reading():
        scene = build_scene(config)
        camera = build_cameras(config, scene.volume)[0]
        # Before minutes of measurements: whether what is found can be written.
        with_tables(config.text, _untouched(scene))
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
    tables = tables_of(found.turned)
    if config.tables.settings.skipping is False:
        # Measured with skipping, without which nothing can be negligible.
        tables["settings"]["skipping"] = True
    with replacing(output) as temporary:
        temporary.write_text(with_tables(config.text, tables), encoding="utf-8")
    return {
        "command": "tune",
        "config": config.name,
        "output": str(output),
        "tables": tables,
        "settings": tables["settings"],
        "predicted": _numbers(found.predicted),
        "measured": _numbers(found.measured),
        "candidates": [_numbers(m) for m in found.candidates],
        "precomputed": beforehand.report,
        "seconds": time.perf_counter() - began,
        **provenance(),
    }


def with_tables(text: str, tables: dict[str, dict[str, Any]]) -> str:
    """A configuration with other values of some keys of its tables; the rest stays as it was written. What is a name alone, such as
    `shadows = "volume"`, becomes a table; a table that is not there is added.

    **Raises** `ValueError` where one is written in a line of its own, so that its keys cannot be replaced.
    """
    for name, values in tables.items():
        text = _with_table(text, name, {key: _toml(value) for key, value in values.items()})
    return text


def _with_table(text: str, name: str, values: dict[str, str]) -> str:
    lines = [f"{key} = {value}" for key, value in values.items()]
    header = re.search(rf"^\s*\[{name}\][^\n]*$", text, re.MULTILINE)
    if header is None:
        held = tomllib.loads(text).get(name)
        if held is None:
            return text.rstrip("\n") + f"\n\n[{name}]\n" + "\n".join(lines) + "\n"
        if not isinstance(held, str):
            raise ValueError(f"{name}: write it as a table, with a line [{name}] above its keys, so that they can be replaced")
        named = {"kind": _toml(held)} | values
        inline = f"{name} = {{ {', '.join(f'{key} = {value}' for key, value in named.items())} }}"
        return re.sub(rf"^\s*{name}\s*=[^\n]*$", inline, text, count=1, flags=re.MULTILINE)
    rest = text[header.end() :]
    following = re.search(r"^\s*\[", rest, re.MULTILINE)
    inside = rest if following is None else rest[: following.start()]
    kept = re.sub(rf"^\s*({'|'.join(values)})\s*=[^\n]*\n?", "", inside, flags=re.MULTILINE)
    return text[: header.end()] + "\n" + "\n".join(lines) + "\n" + kept.lstrip("\n") + rest[len(inside) :]


def tables_of(choice: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What was chosen for each knob, by the tables and keys of a configuration."""
    tables: dict[str, dict[str, Any]] = {"settings": {}}
    for name, value in choice.items():
        place, _, key = name.rpartition(".")
        kind = kind_of(value)
        # A part that is a choice as a whole is known by its kind.
        key, value = ("kind" if place and kind else key), kind or value
        tables.setdefault(place.replace(" ", "_") or "settings", {})[key] = value
    return tables


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    return str(value).lower() if isinstance(value, bool) else f"{value:.9g}"


def _untouched(scene: Scene) -> dict[str, dict[str, Any]]:
    """The tables that may be written, with the first value of each knob."""
    return tables_of({turn.name: turn.knob.values[0] for turn in turns_of(scene, Settings(), 1.0)})


def _numbers(m: Measurement) -> dict[str, float]:
    return {"seconds": m.seconds, "rmse": m.rmse, "largest": m.largest, "ssim": m.ssim, "samples": m.samples}
