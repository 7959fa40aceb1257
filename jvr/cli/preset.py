"""`jvr preset`: transfer functions from and to the presets of other programs."""

from pathlib import Path
from typing import Any

from jvr.cli.inputs import BadInput, check_file_output, check_inputs_stay
from jvr.cli.runtime import start_jax
from jvr.io.config import read_transfer, write_transfer
from jvr.io.config.errors import did_you_mean
from jvr.io.interop import paraview, slicer
from jvr.io.interop.presets import ENCODINGS, Preset

ENDINGS = ".toml, .vp.json, .vp or .json"


def convert(
    given: str, output: Path, name: str | None, ends: str | None, unit_distance: float | None, spacing: float, encoding: str
) -> dict[str, Any]:
    """Reads one preset and writes another; what is lost is warned of, and in the report."""
    if encoding not in ENCODINGS:
        raise BadInput(f"--encoding {encoding}: must be {' or '.join(ENCODINGS)}")
    if unit_distance is not None and not 0 < unit_distance < float("inf"):
        raise BadInput(f"--unit-distance {unit_distance:g}: must be a positive number of millimetres")
    if not output.name.lower().endswith((".toml", ".vp", ".json")):
        raise BadInput(f"-o {output}: presets are written as {ENDINGS}")
    check_file_output(output, "preset.toml")
    if Path(given).is_file():
        check_inputs_stay(output, [Path(given)])
    start_jax()
    preset = _read(given, name, _range(ends), unit_distance, spacing, encoding)
    lost = dict(preset.lost)
    match _kind(output):
        case ".toml":
            write_transfer(output, preset.transfer)
        case ".paraview":
            lost |= paraview.write_paraview(output, preset, name or Path(given).stem)
        case _:
            lost |= slicer.write_slicer(output, preset)
    shading = None if preset.shading is None or _kind(output) != ".toml" else _said(preset.shading)
    return {"command": "preset", "given": given, "output": str(output), "lost": lost, "shading": shading}


def _kind(path: Path) -> str:
    lower = path.name.lower()
    return ".vp" if lower.endswith((".vp", ".vp.json")) else ".paraview" if lower.endswith(".json") else path.suffix.lower()


def _read(
    given: str, name: str | None, ends: tuple[float, float] | None, unit_distance: float | None, spacing: float, encoding: Any
) -> Preset:
    file = Path(given)
    kind = _kind(file)
    if ends is not None and kind != ".paraview":
        raise BadInput("--range: is for presets of ParaView (.json)")
    if given in slicer.slicer_presets():
        return slicer.slicer_preset(given, spacing=spacing, encoding=encoding)
    if kind not in (".toml", ".vp", ".paraview"):
        raise BadInput(f"{given}: neither a preset of 3D Slicer nor {ENDINGS}; {did_you_mean(given, slicer.slicer_presets())}")
    if kind == ".toml":
        return Preset(read_transfer(file), unit_distance=unit_distance or 1.0, encoding=encoding, spacing=spacing)
    if kind == ".vp":
        return slicer.read_slicer(file, unit_distance=unit_distance, spacing=spacing, encoding=encoding)
    return paraview.read_paraview(file, name, range=ends, unit_distance=unit_distance or 1.0, encoding=encoding)


def _range(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise BadInput(f"--range {text}: must be two numbers, such as -1000,3000") from None
    return low, high


def _said(shading: Any) -> str:
    """The coefficients of Phong's model as a table of a configuration has them."""
    names = ("ambient", "diffuse", "specular", "shininess")
    return 'kind = "phong", ' + ", ".join(f"{name} = {float(getattr(shading, name)):.6g}" for name in names)
