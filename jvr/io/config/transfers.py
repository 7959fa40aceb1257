"""Transfer functions in TOML: as a table of a configuration, and as a file of their own that a fit writes."""

import os
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter, ValidationError

from jvr.atomic import replacing
from jvr.io.config.errors import ConfigError, blame, first_complaint
from jvr.io.config.parts import made
from jvr.io.config.schema.transfer import (
    ImportedTable,
    ParaViewTable,
    PresetTable,
    SlicerTable,
    Transfer,
    TransferFile,
    TransferTable,
    WindowTable,
)
from jvr.io.config.text import array_text, read_toml
from jvr.io.interop.paraview import read_paraview
from jvr.io.interop.presets import Preset
from jvr.io.interop.slicer import read_slicer, slicer_preset
from jvr.io.kinds import KINDS
from jvr.model import presets
from jvr.model.gradient_transfer import GradientOpacity
from jvr.model.parameters import declared
from jvr.model.transfer import AbstractTransfer, LinearTransfer, LutTransfer
from jvr.model.volume import Volume
from jvr.model.voxels import typical_range

HEADER = "# A transfer function of jvr: colours are linear RGB, extinction is per world length (mm).\n"
# Optical depth of an automatic window's brightest value, from the centre of the volume to its farthest corner.
AUTOMATIC_DEPTH = 30.0
# A window leaves so many voxels out that lie far beyond all others: a share of all, or a number.
HOT, MOST_HOT = 1e-5, 8
# Optical depth of one voxel of a label: its front hides what is behind.
LABEL_DEPTH = 8.0


def write_transfer(path: str | os.PathLike, transfer: AbstractTransfer) -> None:
    """Writes a transfer function as TOML, every number exactly; the file is replaced at once or not at all.

    **Raises** `TypeError` for a kind of transfer function that has no form in TOML.
    """
    lines = []
    if isinstance(transfer, GradientOpacity):
        bounds = (f"{name} = {array_text(np.asarray(getattr(transfer, name)))}" for name in ("low", "high"))
        lines, transfer = [f"gradient_opacity = {{ {', '.join(bounds)} }}\n"], transfer.transfer
    kind = next((kind for kind, name in KINDS[AbstractTransfer].items() if name == type(transfer).__name__), None)
    if kind is None:
        raise TypeError(f"{type(transfer).__name__} cannot be written as TOML")
    arrays = {name: getattr(transfer, name) for name in declared(type(transfer))}
    lines += [f"{name} = {array_text(np.asarray(array))}\n" for name, array in arrays.items() if array is not None]
    with replacing(path) as temporary:
        temporary.write_text("".join([HEADER, f'kind = "{kind}"\n', *lines]), encoding="utf-8")


def read_transfer(path: str | os.PathLike) -> AbstractTransfer:
    """Reads what `write_transfer` wrote, or any other table of a transfer function that needs no volume.

    **Raises** `ConfigError` for anything else, `OSError` where the file cannot be read.
    """
    name, (_, data) = str(path), read_toml(path)
    try:
        table = TypeAdapter(Transfer).validate_python(data)
    except ValidationError as error:
        raise ConfigError(name, *first_complaint(error, data)) from None
    return build_transfer(table, None, name, "")


def build_transfer(
    table: TransferTable, volume: Volume | None, where: str, key: str, file: Path | None = None
) -> AbstractTransfer:
    """The transfer function of a table; presets and an automatic window look at the volume. `file`: what its path means."""
    if file is None and getattr(table, "path", None) is not None:
        raise ConfigError(where, key, "a transfer file cannot name another file")
    with blame(where, key):
        match table:
            case TransferFile() if file is not None:
                found = read_transfer(file)
            case ImportedTable():
                found = imported(table, volume, file).transfer
                found = found if table.entries is None else resampled(found, table.entries)
            case PresetTable():
                found = _preset(table, volume)
            case WindowTable():
                found = _window(table, volume)
            case _:
                found = made(lambda _: where, key, table, "gradient_opacity")
    return with_gradient(found, table, where, key)


def with_gradient(transfer: AbstractTransfer, table: TransferTable, where: str, key: str) -> AbstractTransfer:
    """The transfer function, scaled by the length of the gradient where its table says so."""
    if table.gradient_opacity is None:
        return transfer
    with blame(where, f"{key}.gradient_opacity".lstrip(".")):
        return GradientOpacity(transfer, **table.gradient_opacity.given())


def imported(table: ImportedTable, volume: Volume | None, file: Path | None) -> Preset:
    """The preset of another program that a table names."""
    # The gradients of other programs are by the mean distance of voxels.
    spacing = 1.0 if volume is None else float(np.mean(np.asarray(volume.spacing)))
    if isinstance(table, ParaViewTable) and file is not None:
        ends = None if table.range is None else (table.range[0], table.range[1])
        return read_paraview(file, table.name, range=ends, unit_distance=table.unit_distance or 1.0, encoding=table.encoding)
    assert isinstance(table, SlicerTable)
    if file is not None:
        return read_slicer(file, unit_distance=table.unit_distance, spacing=spacing, encoding=table.encoding)
    assert table.name is not None
    return slicer_preset(table.name, spacing=spacing, encoding=table.encoding)


def resampled(transfer: AbstractTransfer, entries: int) -> LutTransfer:
    """The points of a piecewise linear transfer function as a table of evenly spaced entries.

    **Raises** `ValueError` for other kinds.
    """
    if not isinstance(transfer, LinearTransfer):
        raise ValueError(
            f"entries are of presets without opacity by gradient, this is a {type(transfer).__name__}: leave them out"
        )
    at, columns = np.asarray(transfer.positions), np.column_stack([np.asarray(transfer.rgb), np.asarray(transfer.sigma_t)])
    x = np.linspace(at[0], at[-1], entries)
    table = np.stack([np.interp(x, at, column) for column in columns.T], axis=1)
    sigma_t = table[:, 3] if transfer.sigma_t.ndim == 1 else table[:, 3:]
    return LutTransfer(table[:, :3], sigma_t, (at[0], at[-1]))


def _preset(table: PresetTable, volume: Volume | None) -> AbstractTransfer:
    preset = getattr(presets, table.preset)
    if table.preset.startswith("ct"):
        return preset()
    if volume is None:
        raise ValueError(f"preset {table.preset} looks at the volume: in a file of its own, a table of numbers is needed")
    if table.preset == "labels":
        spacing = float(np.min(np.asarray(volume.spacing)))
        return preset(int(volume.data().max()), sigma_t=LABEL_DEPTH / spacing if table.sigma_t is None else table.sigma_t)
    low, high = contents(volume) if table.range is None else table.range
    return preset(low, high, sigma_t=AUTOMATIC_DEPTH / float(volume.radius) if table.sigma_t is None else table.sigma_t)


def _window(table: WindowTable, volume: Volume | None) -> LinearTransfer:
    if volume is None and (table.window is None or table.sigma_t is None):
        raise ValueError("a window in a file of its own needs window, level and sigma_t")
    top = AUTOMATIC_DEPTH / float(volume.radius) if table.sigma_t is None and volume is not None else table.sigma_t or 0.0
    if table.window is not None and table.level is not None:
        return presets.window_level(table.window, table.level, sigma_t=top, rgb=table.rgb)
    low, high = contents(volume) if volume is not None else (0.0, 1.0)
    # Darker and fainter below than a ramp would be: what surrounds the brightest parts must not hide them.
    rgb = np.outer([0.1, 0.4, 1.0], table.rgb)
    return LinearTransfer([low, 0.5 * (low + high), high], rgb, np.array([0.0, 0.1, 1.0]) * top)


def contents(volume: Volume) -> tuple[float, float]:
    """From where the surroundings end (Otsu's threshold) to the brightest voxels but a few."""
    from skimage.filters import threshold_otsu

    data = volume.data()
    values = data[:: max(data.size // 2**20, 1)].astype(np.float64) * float(volume.slope) + float(volume.intercept)
    far = typical_range(data, few=HOT, least=MOST_HOT)
    ends = np.sort([float(volume.slope * v + volume.intercept) for v in far])
    # Hot voxels would take Otsu's bins from all others.
    values = np.clip(values, *ends)
    if values.min() == values.max():
        raise ValueError(f"every voxel has the value {values.min():g}: there is nothing to see")
    low, high = float(threshold_otsu(values)), float(np.percentile(values, 99.9))
    return (low, high) if low < high else (float(values.min()), float(values.max()))
