"""`jvr render` of a volume file: a configuration made for what the file holds."""

import dataclasses
import re
import typing
from pathlib import Path
from typing import Any

from jvr.cli.inputs import BadInput, load
from jvr.cli.runtime import start_jax
from jvr.io.config import Config, build_volume, config_from, interpolated
from jvr.io.config.errors import did_you_mean
from jvr.io.config.schema.transfer import PresetTable
from jvr.io.interop.slicer import slicer_presets
from jvr.model.volume import Volume


@dataclasses.dataclass(frozen=True)
class Wishes:
    """What somebody says about the picture of a volume; `None` where the volume decides."""

    preset: str | None = None
    view: str | None = None
    up: list[float] | None = None
    background: str | None = None
    orbit: int | None = None
    lit: bool | None = None

    def named(self) -> str | None:
        """The flag of one that is there."""
        return next((f"--{field.name}" for field in dataclasses.fields(self) if getattr(self, field.name) is not None), None)


def configured(given: Path, sets: list[str], keywords: dict[str, Any], wishes: Wishes) -> tuple[Config, Volume | None, list[str]]:
    """The configuration of a picture, the volume where it is read already, and what was guessed, a line each."""
    if given.suffix.lower() == ".toml":
        if refused := wishes.named():
            raise BadInput(f"{refused} is for a volume file; for a configuration use --set")
        return load(given, sets, keywords), None, []
    from jvr.io.first_picture import first_picture

    start_jax()
    if wishes.preset is not None and wishes.preset not in known_presets():
        raise BadInput(f"--preset {wishes.preset}: unknown preset; {did_you_mean(wishes.preset, known_presets())}")
    of_volume = [text for text in sets if re.match(r"\s*volume\s*[.=]", text)]
    if whole := next((text for text in of_volume if re.match(r"\s*volume\s*=", text)), None):
        raise BadInput(f"--set {whole}: set the keys of the volume one by one, such as volume.spacing=[1,1,2]")
    volume = build_volume(load(given, of_volume, keywords))
    tables, notes = first_picture(volume, given, wishes.preset, lit=wishes.lit is not False)
    tables["volume"] = {"path": str(given.absolute()), **keywords, **tables.get("volume", {})}
    tables["background"] = [0.0, 0.0, 0.0] if wishes.background is None else _colour(wishes.background)
    tables["camera"] = _camera(wishes, tables["camera"])
    config = config_from(tables, str(given), given.parent, sets)
    return config, interpolated(config, volume), notes


def known_presets() -> list[str]:
    """What `--preset` may be: presets of jvr and of 3D Slicer."""
    return [*typing.get_args(PresetTable.model_fields["preset"].annotation), *slicer_presets()]


def _camera(wishes: Wishes, guessed: dict[str, Any]) -> dict[str, Any]:
    """The table of the camera, or of the cameras of an orbit."""
    if wishes.orbit is None:
        return guessed | {name: value for name, value in (("view", wishes.view), ("up", wishes.up)) if value is not None}
    if wishes.orbit < 2:
        raise BadInput(f"--orbit {wishes.orbit}: must be at least 2 pictures")
    if wishes.view is not None:
        raise BadInput("--view: an orbit looks from all around; leave --view or --orbit out")
    around = {"kind": "orbit", "count": wishes.orbit, "frame": guessed["frame"]}
    return around if wishes.up is None else around | {"axis": wishes.up}


def _colour(text: str) -> list[float]:
    """A background as linear radiance: a name, `#rrggbb`, or three numbers that are linear already."""
    from matplotlib.colors import to_rgba

    from jvr.pictures import linear_from_srgb

    try:
        if "," in text:
            red, green, blue = (float(part) for part in text.split(","))
            return [red, green, blue]
        *colour, alpha = to_rgba(text)
        # A single number would be a grey code, and "none" black.
        if alpha < 1 or re.fullmatch(r"[\d.\s]+", text):
            raise ValueError
        return [float(c) for c in linear_from_srgb(colour)]
    except ValueError:
        example = "white, #20242c, or three numbers of linear radiance such as 0.1,0.1,0.2"
        raise BadInput(f"--background {text}: must be a colour such as {example}") from None
