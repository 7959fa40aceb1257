"""Tables of the fitted values with their standard errors."""

import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import equinox as eqx
import numpy as np

from jvr.fitting.result import POSE
from jvr.fitting.unknowns import leaves_by_name
from jvr.model.camera import AbstractCamera
from jvr.model.transfer import AbstractTransfer, GaussianTransfer
from jvr.pictures import srgb_from_linear
from jvr.report.page.words import COLOURS, TITLES, entries_in_words, with_error

# Longer tables are folded away until a reader opens them.
OPEN_ROWS = 20
MOST_ROWS = 1024
# Fields that say where entries are.
PLACES = ("positions", "center", "width")


def transfer_values(transfer: AbstractTransfer, errors: dict[str, np.ndarray]) -> str:
    """A table of the transfer function's entries, one row each."""
    names = [name for name in (*PLACES, "height", "sigma_t", "emission", "rgb") if getattr(transfer, name, None) is not None]
    arrays = {name: np.asarray(getattr(transfer, name)) for name in names}
    if "rgb" not in arrays:
        return ""
    swatches = srgb_from_linear(arrays["rgb"])
    colour_errors = errors.get("rgb", np.zeros_like(swatches))
    head = ["entry", ""] + [label for name in names for label in _headings(name, arrays[name])]
    rows = []
    for i, swatch in enumerate(swatches[:MOST_ROWS]):
        cells = [f"{i}", _swatch(swatch, colour_errors[i])]
        for name in names:
            values, spread = np.ravel(arrays[name][i]).tolist(), errors.get(name)
            spreads = [None] * len(values) if spread is None else np.ravel(spread[i]).tolist()
            cells += [_cell(value, error) for value, error in zip(values, spreads, strict=True)]
        rows.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    kind = "Gaussians" if isinstance(transfer, GaussianTransfer) else "entries of the table"
    note = (
        "Each value with its standard error, which is that of weighted least squares at the solution and leaves out what the "
        "model itself cannot describe. Values without one were not fitted. Positions are in the volume's own units, extinctions "
        "in 1 / world length (1 / mm for medical files), emissions in radiance / world length, colours linear."
    )
    state, titles = " open" if len(rows) <= OPEN_ROWS else "", "".join(f"<th>{title}</th>" for title in head)
    return "\n".join(
        [
            f'<h2>Fitted values</h2><p class="soft">{note}</p>{_undetermined(transfer, errors)}',
            f"<details{state}><summary>All {len(rows)} {kind}</summary>",
            f'<div class="scroll"><table><thead><tr>{titles}</tr></thead>',
            f"<tbody>{''.join(rows)}</tbody></table></div></details>",
        ]
    )


def _swatch(colour: np.ndarray, error: np.ndarray) -> str:
    """A patch of the colour (sRGB, 0 ... 1); hatched where the images do not determine it."""
    if not np.isfinite(error).all():
        return '<span class="swatch hatched"></span>'
    codes = ", ".join(str(int(code)) for code in np.rint(255 * colour))
    return f'<span class="swatch" style="background: rgb({codes})"></span>'


def _headings(name: str, array: np.ndarray) -> list[str]:
    label = TITLES.get(name, name)
    return [label] if array.ndim == 1 else [f"{label}, {channel}" if name != "rgb" else channel for channel in COLOURS]


def _cell(value: float, error: float | None) -> str:
    if error is None:
        return f"{value:.5g}"
    if not np.isfinite(error):
        return '<span class="unknown">not determined</span>'
    return escape(with_error(value, error))


def _undetermined(transfer: AbstractTransfer, errors: dict[str, np.ndarray]) -> str:
    """In words, which values the images say nothing about."""
    parts = []
    for name, error in errors.items():
        unknown = ~np.isfinite(error.reshape(len(error), -1)).all(axis=1)
        if unknown.any():
            parts.append(f"{TITLES.get(name, name)} of {entries_in_words(np.flatnonzero(unknown), transfer)}")
    if not parts:
        return ""
    return f'<p class="unknown">The images do not determine the {escape("; the ".join(parts))}.</p>'


def other_values(scene: Any, errors: Mapping[str, np.ndarray]) -> str:
    """What was fitted beside a transfer function of the scalar: small arrays as numbers, others by size alone."""
    rest = scene if scene.transfer.takes_gradient else eqx.tree_at(lambda s: s.transfer, scene, None)
    values, rows = leaves_by_name(rest), []
    for name, error in errors.items():
        if name not in values:
            continue
        value = np.asarray(values[name])
        if value.size <= 16:
            text = ", ".join(_cell(v, e) for v, e in zip(value.ravel().tolist(), error.ravel().tolist(), strict=True))
        else:
            unknown = int(np.sum(~np.isfinite(error)))
            text = f"{value.size:,} values" + (
                ", too many for standard errors here"
                if np.isnan(error).all()
                else f", of which the images do not determine {unknown:,}"
            )
        rows.append(f"<tr><th>{escape(name)}</th><td>{text}</td></tr>")
    return f'<h2>Other fitted values</h2><div class="scroll"><table>{"".join(rows)}</table></div>' if rows else ""


def camera_values(cameras: Sequence[AbstractCamera], errors: Mapping[str, np.ndarray]) -> str:
    """What was fitted of cameras: poses by their standard errors, other values as they are."""
    rows = []
    for name, error in errors.items():
        if "cameras" not in name:
            continue
        cells = (
            [_error(e, unit) for e, unit in zip(error.tolist(), ["°"] * 3 + [" mm"] * 3, strict=True)] if POSE in name else None
        )
        if cells is None:
            view = re.search(r"\[(\d+)\]", name)
            field = name.rstrip(")").rpartition(".")[2]
            value = np.ravel(np.asarray(getattr(cameras[int(view[1]) if view else 0], field)))
            cells = [_cell(v, e) for v, e in zip(value.tolist(), np.ravel(error).tolist(), strict=True)]
        rows.append(f"<tr><th>{escape(name)}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>")
    if not rows:
        return ""
    note = "Of a pose the standard errors: rotations about the centre of the volume and translations of it, along x, y and z of the world."
    table = f'<div class="scroll"><table>{"".join(rows)}</table></div>'
    return f'<h2>Cameras</h2><p class="soft">{note}</p>{table}'


def _error(error: float, unit: str) -> str:
    return f"± {error:.2g}{unit}" if np.isfinite(error) else '<span class="unknown">not determined</span>'
