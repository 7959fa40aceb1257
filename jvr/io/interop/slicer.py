"""Presets of 3D Slicer: its 31 named ones, and the files `.vp` and `.vp.json` that it saves.

A `.vp` has nine lines: interpolation (0 nearest, 1 linear), shading, diffuse, ambient, specular, specular power, and three functions,
scalar opacity, gradient opacity and colour, each with how many numbers follow. Its opacities belong to a millimetre, as VTK's do by
default. A `.vp.json` says the unit distance, midpoints and sharpness, too.
"""

import functools
import json
import os
import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from jvr.atomic import replacing
from jvr.io.interop.curves import Curve
from jvr.io.interop.preset_files import PresetError, json_of, refusing, rows_of, text_of
from jvr.io.interop.presets import Preset, VolumeProperty, preset_of, property_of, warn_of

REMEDY = "save it anew in the module Volume Rendering of 3D Slicer"
SCHEMA = "https://raw.githubusercontent.com/slicer/slicer/main/Modules/Loadable/VolumeRendering/Resources/Schema/"
VERSION = "volume-property-schema-v1.0.0.json#"
# Slicer reads no more of a line of a .vp.
LONGEST = 1023
LINES = ("interpolation", "shading", "diffuse", "ambient", "specular", "specular power", "opacity", "gradient opacity", "colour")


def slicer_presets() -> tuple[str, ...]:
    """Names of the presets of 3D Slicer, in its order; they are numbered from 1."""
    return tuple(_presets())


def slicer_preset(which: str | int, *, spacing: float | int = 1.0, encoding: str = "linear") -> Preset:
    """A preset of 3D Slicer by its name, such as "CT-Bone", or by its number in Slicer's list, 1 ... 31.

    **Arguments:** `spacing`, `encoding`: as of `from_vtk_property`. Opacities belong to a millimetre.
    **Raises** `ValueError` for names and numbers that Slicer does not have.
    """
    preset = preset_of(slicer_property(which), spacing, encoding)
    warn_of(preset.lost, str(which))
    return preset


def slicer_property(which: str | int) -> VolumeProperty:
    """What a preset of 3D Slicer says, by its name or number. **Raises** `ValueError` for those that Slicer does not have."""
    names = slicer_presets()
    if isinstance(which, int) and 1 <= which <= len(names):
        which = names[which - 1]
    if which not in names:
        raise ValueError(f"no preset of 3D Slicer is called {which!r}: its names, numbered from 1, are {', '.join(names)}")
    table = _presets()[str(which)]
    gradient = _plain(table["gradient"], 2) if "gradient" in table else None
    return VolumeProperty(_plain(table["opacity"], 2), _plain(table["colour"], 4), gradient, 1.0, table["shade"], *table["light"])


@functools.cache
def _presets() -> dict[str, Any]:
    return tomllib.loads(resources.files("jvr.io.interop").joinpath("slicer.toml").read_text(encoding="utf-8"))


def _plain(numbers: Any, columns: int, name: str = "a function") -> Curve:
    rows = rows_of(numbers, columns, name)
    # As Slicer has it: a point that lies in front of the one before is moved there.
    rows[:, 0] = np.maximum.accumulate(rows[:, 0])
    return Curve.of(rows, shaped=False)


def read_slicer(
    path: str | os.PathLike, *, unit_distance: float | int | None = None, spacing: float | int = 1.0, encoding: str = "linear"
) -> Preset:
    """The preset of a `.vp` or `.vp.json` that 3D Slicer has saved.

    **Arguments:** `unit_distance`: the world length that opacities belong to, in place of the file's, or of a millimetre; `spacing`,
    `encoding`: as of `from_vtk_property`.
    **Raises** `PresetError`, a `ValueError`, for what is none, and for a schema of another version; `OSError` where it cannot be read.
    """
    file = Path(path)
    as_json = file.suffix.lower() == ".json"
    with refusing(file, f"a {'.vp.json' if as_json else '.vp'} of 3D Slicer", REMEDY):
        said = _read_json(file) if as_json else _read_lines(file)
        if unit_distance is not None:
            said = VolumeProperty(**{**vars(said), "unit_distance": unit_distance})
        preset = preset_of(said, spacing, encoding)
    warn_of(preset.lost, str(file))
    return preset


def _read_lines(file: Path) -> VolumeProperty:
    lines = [line.strip() for line in text_of(file, "a .vp of 3D Slicer", REMEDY).splitlines()]
    if len(lines) < len(LINES) or not all(lines[: len(LINES)]):
        missing = next((k for k in range(len(LINES)) if k >= len(lines) or not lines[k]), 0)
        raise ValueError(f"line {missing + 1}, {LINES[missing]}, is missing")
    interpolation, shade, diffuse, ambient, specular, power = (float(line) for line in lines[:6])
    opacity, gradient, colour = (_counted(lines[k], columns, LINES[k]) for k, columns in ((6, 2), (7, 2), (8, 4)))
    kind = ("nearest", "linear", "cubic")[min(max(int(interpolation), 0), 2)]
    return VolumeProperty(opacity, colour, gradient, 1.0, shade != 0, ambient, diffuse, specular, power, kind)


def _counted(line: str, columns: int, name: str) -> Curve:
    count, *numbers = line.split()
    if int(count) != len(numbers):
        raise ValueError(f"{name} announces {count} numbers and has {len(numbers)}")
    return _plain(numbers, columns, name)


def _read_json(file: Path) -> VolumeProperty:
    data = json_of(file, "a .vp.json of 3D Slicer", REMEDY)
    schema = str(data["@schema"])
    version = re.search(r"volume-property-schema-v(\d+)\.[\d.]+\.json", schema)
    if version is None:
        raise ValueError(f"its schema is {schema[-80:]!r}")
    if version[1] != "1":
        raise PresetError(file, f"its schema is version {version[1]}, known is 1: save it as .vp in 3D Slicer")
    lost: dict[str, str] = {}
    for name, place in (("other properties", data["volumeProperties"]), ("other components", _first(data)["components"])):
        if len(place) > 1:
            lost[name] = f"the first of {len(place)} is taken"
    table, part = _first(data), _first(data)["components"][0]
    light = {"ambient": 0.1, "diffuse": 0.7, "specular": 0.2, "specularPower": 10.0} | part.get("lighting", {})
    ignored = bool(part.get("disableGradientOpacity", False)) or "gradientOpacity" not in part
    return VolumeProperty(
        _shaped(part["scalarOpacity"], "y"),
        _shaped(part["rgbTransferFunction"], "color"),
        None if ignored else _shaped(part["gradientOpacity"], "y"),
        float(part.get("scalarOpacityUnitDistance", 1.0)),
        bool(part.get("shade", False)),
        *(float(light[name]) for name in ("ambient", "diffuse", "specular", "specularPower")),
        interpolation=str(table.get("interpolationType", "linear")),
        lost=lost,
    )


def _first(data: Any) -> Any:
    return data["volumeProperties"][0]


def _shaped(function: Any, value: str) -> Curve:
    rows = [
        [point["x"], *np.ravel(point[value]), point.get("midpoint", 0.5), point.get("sharpness", 0.0)]
        for point in function["points"]
    ]
    return Curve.of(rows_of(np.ravel(rows), 6 if value == "color" else 4, value))


def write_slicer(path: str | os.PathLike, preset: Preset) -> dict[str, str]:
    """Writes a preset, such as `jvr.io.interop.Preset(scene.transfer, scene.shading)`, for 3D Slicer, as `.vp.json` or `.vp`.

    **Returns** what the file does not hold, by name, which is said in one warning as well.
    **Raises** `ValueError` for other endings, for transfer functions of more than the scalar (but for `jvr.GradientOpacity`), and for
    those of more points than a line of a `.vp` holds in Slicer; `OSError` where it cannot be written.
    """
    file, said = Path(path), property_of(preset)
    lost = dict(said.lost)
    if file.name.lower().endswith(".vp.json"):
        text = json.dumps({"@schema": SCHEMA + VERSION, "volumeProperties": [_tables(said)]}, indent=1) + "\n"
    elif file.suffix.lower() == ".vp":
        text = _lines(said, file)
        if said.unit_distance != 1:
            lost["unit distance"] = f"opacities belong to {said.unit_distance:g}, to a millimetre in a .vp: write .vp.json"
    else:
        raise PresetError(file, "presets of 3D Slicer are written as .vp.json or .vp")
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8")
    warn_of(lost, str(file))
    return lost


def _tables(said: VolumeProperty) -> dict[str, Any]:
    points = lambda curve, value: {
        "points": [
            {"x": x, value: list(values) if len(values) > 1 else values[0], "midpoint": 0.5, "sharpness": 0.0}
            for x, values in zip(curve.x.tolist(), curve.values.tolist(), strict=True)
        ]
    }
    light = {"ambient": said.ambient, "diffuse": said.diffuse, "specular": said.specular, "specularPower": said.power}
    part = {
        "componentWeight": 1.0,
        "shade": said.shade,
        "lighting": light,
        "disableGradientOpacity": said.gradient is None,
        "scalarOpacityUnitDistance": said.unit_distance,
        "rgbTransferFunction": {"type": "colorTransferFunction", **points(said.colour, "color")},
        "scalarOpacity": {"type": "piecewiseLinearFunction", **points(said.opacity, "y")},
        "gradientOpacity": {"type": "piecewiseLinearFunction", **points(_gradient(said), "y")},
    }
    return {"independentComponents": True, "interpolationType": said.interpolation, "components": [part]}


def _gradient(said: VolumeProperty) -> Curve:
    return said.gradient or Curve.of(np.array([[0, 1], [255, 1]]), shaped=False)


def _lines(said: VolumeProperty, file: Path) -> str:
    numbers = [int(said.interpolation != "nearest"), int(said.shade), said.diffuse, said.ambient, said.specular, said.power]
    for digits in (15, 9, 7):
        lines = [f"{number:.{digits}g}" for number in numbers]
        for curve in (said.opacity, _gradient(said), said.colour):
            flat = np.column_stack([curve.x, curve.values]).ravel()
            lines.append(" ".join([str(len(flat)), *(f"{number:.{digits}g}" for number in flat)]))
        if max(map(len, lines)) <= LONGEST:
            return "\n".join(lines) + "\n"
    raise PresetError(file, f"too many points for a .vp, of whose lines 3D Slicer reads {LONGEST:,} characters: write .vp.json")
