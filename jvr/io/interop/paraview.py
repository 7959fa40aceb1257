"""Presets of ParaView: colour maps in JSON, with opacity where they have it.

A file is a list of maps. Each has a `Name`, `RGBPoints` (scalar, red, green, blue, one after another), a `ColorSpace`, and it may have
`Points` (scalar, opacity, midpoint, sharpness).
"""

import difflib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from jvr.atomic import replacing
from jvr.io.interop.curves import Curve
from jvr.io.interop.preset_files import PresetError, json_of, refusing, rows_of
from jvr.io.interop.presets import Preset, VolumeProperty, preset_of, property_of, warn_of

WHAT, REMEDY = "a preset of ParaView", "export it anew in the dialog Choose Preset of ParaView"
SPACES = {name.lower(): name for name in ("RGB", "HSV", "Lab", "Diverging", "Step", "ProLab")}
SPACES |= {"cielab": "Lab", "lab/ciede2000": "Lab"}


def read_paraview(
    path: str | os.PathLike,
    name: str | None = None,
    *,
    range: tuple[float | int, float | int] | None = None,
    unit_distance: float | int = 1.0,
    encoding: str = "linear",
) -> Preset:
    """A preset of a JSON file that ParaView has exported.

    **Arguments:** `name`: which of several; `range`: the scalars that its ends are moved to, as ParaView does with the range of the
    data; `unit_distance`: the world length that opacities belong to (the representation's Scalar Opacity Unit Distance, which presets do
    not say); `encoding`: as of `from_vtk_property`. Where a file has no opacity, it rises from 0 to 1 across the colours, which is said.
    **Raises** `PresetError`, a `ValueError`, for what is none, for maps of categories, and names that it does not have; `OSError` where it
    cannot be read.
    """
    file = Path(path)
    with refusing(file, WHAT, REMEDY):
        table = _chosen(file, json_of(file, WHAT, REMEDY), name)
        lost: dict[str, str] = {}
        colour = _colour(file, table, lost)
        if "Points" in table:
            opacity = Curve.of(rows_of(table["Points"], 4, "Points"))
        else:
            lost["opacity"] = "the file has none: 0 to 1 across the colours"
            ends = np.array([colour.x[0], colour.x[-1]])
            opacity = Curve.of(np.column_stack([ends, [0, 1]]), shaped=False)
        if range is not None:
            opacity, colour = (_moved(curve, range) for curve in (opacity, colour))
        preset = preset_of(VolumeProperty(opacity, colour, unit_distance=unit_distance, lost=lost), encoding=encoding)
    warn_of(preset.lost, str(file))
    return preset


def _chosen(file: Path, data: Any, name: str | None) -> dict[str, Any]:
    tables = data if isinstance(data, list) else [data]
    names = [str(table.get("Name", "")) for table in tables]
    if name is None and len(tables) == 1:
        return tables[0]
    if name in names:
        return tables[names.index(name)]
    near = difflib.get_close_matches(name or "", names, 1, 0.6)
    listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    if name is None:
        raise PresetError(
            file, f"it has {len(tables)} presets: name one of {listed}" if tables else f"it has no presets; {REMEDY}"
        )
    raise PresetError(file, f"it has no preset {name!r}; " + (f"did you mean {near[0]!r}?" if near else f"it has {listed}"))


def _colour(file: Path, table: dict[str, Any], lost: dict[str, str]) -> Curve:
    if "RGBPoints" not in table and "IndexedColors" in table:
        raise PresetError(file, "its colours are of categories, without scalars: choose a continuous map")
    said = str(table.get("ColorSpace", "RGB"))
    if said.lower() not in SPACES:
        raise ValueError(f"its ColorSpace {said[:40]!r} is not one of {', '.join(dict.fromkeys(SPACES.values()))}")
    if said.lower() == "lab/ciede2000":
        lost[f"colours through {said}"] = "through Lab instead"
    rows = rows_of(table["RGBPoints"], 4, "RGBPoints")
    outside = {
        side: np.array([float(c) for c in table[f"{word}RangeColor"]])
        for side, word in (("below", "Below"), ("above", "Above"))
        if table.get(f"Use{word}RangeColor")
    }
    if any(color.shape != (3,) for color in outside.values()):
        raise ValueError("a colour outside of the range must have three numbers")
    wrap, scale = bool(table.get("HSVWrap", True)), bool(table.get("UseLogScale", False))
    return Curve.of(rows, shaped=False, space=SPACES[said.lower()], wrap=wrap, logarithmic=scale, **outside)


def _moved(curve: Curve, ends: tuple[float | int, float | int]) -> Curve:
    low, high = curve.x[0], curve.x[-1]
    if not ends[0] < ends[1]:
        raise ValueError(f"range must be low < high, not {ends[0]:g} and {ends[1]:g}")
    if not low < high:
        raise ValueError("all of its points are at one scalar, which no range can be moved to")
    rows = curve.rows()
    if curve.logarithmic and low > 0 and ends[0] > 0:
        way = np.log(rows[:, 0] / low) / np.log(high / low)
        rows[:, 0] = ends[0] * (ends[1] / ends[0]) ** way
    else:
        rows[:, 0] = ends[0] + (rows[:, 0] - low) * ((ends[1] - ends[0]) / (high - low))
    shape = {name: getattr(curve, name) for name in ("space", "wrap", "logarithmic", "below", "above")}
    return Curve.of(rows, **shape)


def write_paraview(path: str | os.PathLike, preset: Preset, name: str = "jvr") -> dict[str, str]:
    """Writes a preset, such as `jvr.io.interop.Preset(scene.transfer)`, as JSON that ParaView imports in its dialog Choose Preset.

    **Arguments:** `name`: what ParaView shows. **Returns** what the file does not hold, by name, which is said in one warning as well.
    **Raises** `ValueError` for transfer functions of more than the scalar, `OSError` where the file cannot be written.
    """
    said = property_of(preset)
    lost = dict(said.lost)
    if said.gradient is not None:
        lost["opacity by gradient"] = "presets of ParaView have none"
    if said.shade:
        lost["shading"] = "set Shade and the coefficients in ParaView"
    if said.interpolation == "nearest":
        lost["nearest interpolation"] = "set the Interpolation Type in ParaView"
    if said.unit_distance != 1:
        lost["unit distance"] = f"set Scalar Opacity Unit Distance to {said.unit_distance:g} in ParaView"
    table = {
        "Name": name,
        "ColorSpace": "RGB",
        "RGBPoints": np.column_stack([said.colour.x, said.colour.values]).ravel().tolist(),
        "Points": said.opacity.rows().ravel().tolist(),
    }
    with replacing(path) as temporary:
        temporary.write_text(json.dumps([table], indent=1) + "\n", encoding="utf-8")
    warn_of(lost, str(path))
    return lost
