"""A transfer function with its uncertainty, beside the true one."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jvr.model.transfer import AbstractTable, AbstractTransfer, GaussianTransfer
from jvr.pictures import srgb_from_linear
from jvr.report.errors import field_errors
from jvr.report.plots.look import BLUE, GREEN, HATCH, INK, ORANGE, PALE, SOFT, WIDTH, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CHANNELS = (("red", ORANGE, "o"), ("green", GREEN, "s"), ("blue", BLUE, "^"))
UNDETERMINED = "not determined by the images"
# Entries of a table are drawn as points up to this many; more would hide the line.
MOST_POINTS = 80
# Where a curve that is not a table is evaluated.
SAMPLES = 512


class _Curve(NamedTuple):
    """A transfer function at the values `s` where it is drawn: linear colours, extinction, one column or three, and emission of its own,
    `None` where it has none."""

    s: np.ndarray
    rgb: np.ndarray
    sigma_t: np.ndarray
    emission: np.ndarray | None


def plot_transfer(
    fitted: AbstractTransfer,
    *,
    standard_errors: Mapping[str, Any] | AbstractTransfer | None = None,
    truth: AbstractTransfer | None = None,
    histogram: Any = None,
    xlabel: str = "scalar value",
) -> "Figure":
    """Colour strips, extinction, colours and, where there is any, emission of a fitted transfer function against the scalar value, beside
    the true one.

    The band is one standard error to each side. Entries whose error is infinite are drawn hollow on a hatched ground. The
    extinction axis spans the true curve and the entries that are determined; others may lie outside.

    **Arguments:** `standard_errors`: see `field_errors`; those of a Gaussian's height are drawn as bars at its centre.
    `histogram`: of the volume's values, `(counts, edges)` as `numpy.histogram` or `{"counts", "edges"}` as `jvr.io.describe`
    returns it; drawn behind the extinction with a logarithmic height.
    """
    from matplotlib.figure import Figure

    errors = field_errors(fitted, standard_errors)
    drawn = [fitted] if truth is None else [truth, fitted]
    span = min(_ends(transfer)[0] for transfer in drawn), max(_ends(transfer)[1] for transfer in drawn)
    found, true = _curve(fitted, span), None if truth is None else _curve(truth, span)
    strips = list(zip(("true", "fitted")[-len(drawn) :], drawn, strict=True))
    glows = found.emission is not None or (true is not None and true.emission is not None)
    heights = [0.3] * len(strips) + [2.9, 2.1] + [2.1] * glows
    figure = Figure(figsize=(WIDTH, 0.6 + sum(heights)), layout="constrained")
    rows = figure.subplots(len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights, "hspace": 0.02})
    for axes, (name, transfer) in zip(rows, strips, strict=False):
        _strip(axes, name, transfer, span)
    extinction, colour = rows[len(strips)], rows[len(strips) + 1]
    if isinstance(fitted, AbstractTable):
        unknown_colour = _undetermined(errors.get("rgb"))
        _hatch(rows[len(strips) - 1], found.s, unknown_colour)
        _hatch(extinction, found.s, _undetermined(_extinction_errors(errors)))
        _hatch(colour, found.s, unknown_colour)
        _hatch(rows[-1], found.s, _undetermined(errors.get("emission")) if glows else None)
    _extinction_panel(extinction, fitted, found, true, errors)
    _colour_panel(colour, fitted, found, true, errors)
    if glows:
        _emission_panel(rows[-1], fitted, found, true, errors)
    if histogram is not None:
        _histogram(extinction, histogram)
    rows[-1].set_xlabel(xlabel, color=INK)
    rows[-1].set_xlim(*span)
    return figure


def _ends(transfer: AbstractTransfer) -> tuple[float, float]:
    """The values between which a transfer function has something to show."""
    if isinstance(transfer, GaussianTransfer):
        center, width = np.asarray(transfer.center), np.asarray(transfer.width)
        return float(np.min(center - 3.5 * width)), float(np.max(center + 3.5 * width))
    low, high = transfer.ends if isinstance(transfer, AbstractTable) else (0.0, 1.0)
    return float(low), float(high)


def _curve(transfer: AbstractTransfer, span: tuple[float, float]) -> _Curve:
    """The entries of a table; anything else evaluated across `span`."""
    positions = getattr(transfer, "positions", None)
    if isinstance(transfer, AbstractTable) and positions is not None:
        own = getattr(transfer, "emission", None)
        emission = None if own is None else np.asarray(own)
        return _Curve(np.asarray(positions), np.asarray(transfer.rgb), _as_columns(np.asarray(transfer.sigma_t)), emission)
    return _sampled(transfer, np.linspace(*span, SAMPLES))


def _sampled(transfer: AbstractTransfer, s: np.ndarray) -> _Curve:
    classified = jax.vmap(transfer.evaluate)(jnp.asarray(s, jnp.result_type(float)))
    stack = lambda columns: np.stack([np.broadcast_to(np.asarray(column), s.shape) for column in columns], axis=-1)
    emission = stack(classified.emission) if classified.emission else None
    return _Curve(s, stack(classified.rgb), stack(classified.sigma_t), emission)


def _as_columns(array: np.ndarray) -> np.ndarray:
    return array[:, None] if array.ndim == 1 else array


def _extinction_errors(errors: dict[str, np.ndarray]) -> np.ndarray | None:
    found = errors.get("sigma_t", errors.get("height"))
    return None if found is None else _as_columns(found)


def _undetermined(errors: np.ndarray | None) -> np.ndarray | None:
    """Which entries have an infinite error in any of their columns."""
    return None if errors is None else np.logical_not(np.isfinite(errors).all(axis=-1))


def _strip(axes: "Axes", name: str, transfer: AbstractTransfer, span: tuple[float, float]) -> None:
    colours = srgb_from_linear(_sampled(transfer, np.linspace(*span, SAMPLES)).rgb)
    axes.imshow(colours[None], extent=(*span, 0.0, 1.0), aspect="auto", interpolation="nearest")
    axes.set_yticks([0.5], [f"{name} colour"], color=INK, fontsize=9)
    axes.tick_params(length=0, labelbottom=False)
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_color(PALE)


def _hatch(axes: "Axes", s: np.ndarray, unknown: np.ndarray | None) -> None:
    """Shades runs of undetermined entries, each as far as halfway to its neighbours."""
    if unknown is None:
        return
    middles = np.concatenate([s[:1], (s[1:] + s[:-1]) / 2, s[-1:]])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], unknown.astype(int), [0]])))
    for first, after in edges.reshape(-1, 2):
        left, right = float(middles[first]), float(middles[after])
        axes.axvspan(left, right, facecolor=(1, 1, 1, 0.55), hatch="////", edgecolor=HATCH, linewidth=0, zorder=2)


def _extinction_panel(
    axes: "Axes", fitted: AbstractTransfer, found: _Curve, true: _Curve | None, errors: dict[str, np.ndarray]
) -> None:
    style(axes, "extinction\n(1 / world length)")
    spread = _extinction_errors(errors)
    grey = found.sigma_t.shape[1] == 1
    looks = (("fitted", BLUE, "o"),) if grey else tuple((f"fitted, {name}", colour, mark) for name, colour, mark in CHANNELS)
    if isinstance(fitted, GaussianTransfer):
        _lines(axes, found, found.sigma_t, None, looks, points=False)
        _height_bars(axes, fitted, spread, looks)
    else:
        _lines(axes, found, found.sigma_t, spread, looks, points=len(found.s) <= MOST_POINTS)
    if true is not None:
        _true_lines(axes, true, true.sigma_t)
    top = _highest(found.sigma_t, _undetermined(spread), None if true is None else true.sigma_t)
    axes.set_ylim(-0.03 * top, 1.12 * top)
    _legend(axes, spread, is_table=isinstance(fitted, AbstractTable))


def _colour_panel(
    axes: "Axes", fitted: AbstractTransfer, found: _Curve, true: _Curve | None, errors: dict[str, np.ndarray]
) -> None:
    style(axes, "colour\n(linear)")
    is_table = isinstance(fitted, AbstractTable)
    spread = errors.get("rgb") if is_table else None
    looks = tuple((name, colour, mark) for name, colour, mark in CHANNELS)
    _lines(axes, found, found.rgb, spread, looks, points=is_table and len(found.s) <= MOST_POINTS)
    if true is not None:
        _true_lines(axes, true, true.rgb)
    known = found.rgb if spread is None else found.rgb[np.isfinite(spread)]
    low, high = float(min(known.min(initial=0.0), 0.0)), float(max(known.max(initial=1.0), 1.0))
    axes.set_ylim(low - 0.05, high + 0.05)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)


def _emission_panel(
    axes: "Axes", fitted: AbstractTransfer, found: _Curve, true: _Curve | None, errors: dict[str, np.ndarray]
) -> None:
    style(axes, "emission\n(radiance / length)")
    is_table = isinstance(fitted, AbstractTable)
    spread, wanted = errors.get("emission") if is_table else None, None if true is None else true.emission
    if found.emission is not None:
        looks = tuple((name, colour, mark) for name, colour, mark in CHANNELS)
        _lines(axes, found, found.emission, spread, looks, points=is_table and len(found.s) <= MOST_POINTS)
    if true is not None and wanted is not None:
        _true_lines(axes, true, wanted)
    top = _highest(found.emission, _undetermined(spread), wanted)
    axes.set_ylim(-0.03 * top, 1.12 * top)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)


def _lines(
    axes: "Axes",
    curve: _Curve,
    columns: np.ndarray,
    spread: np.ndarray | None,
    looks: Sequence[tuple[str, str, str]],
    *,
    points: bool,
) -> None:
    """One line for each column, its error band, and hollow points where the error is infinite."""
    for c, (name, colour, mark) in enumerate(looks):
        y = columns[:, c]
        axes.plot(curve.s, y, color=colour, linewidth=1.8, marker=mark if points else "", markersize=3.5, label=name, zorder=4)
        if spread is None:
            continue
        known = np.isfinite(spread[:, c])
        half = np.where(known, spread[:, c], np.nan)
        axes.fill_between(curve.s, y - half, y + half, color=colour, alpha=0.22, linewidth=0, zorder=3)
        # A band needs two neighbours; a lone entry between undetermined ones still has its bar.
        axes.vlines(curve.s[known], (y - half)[known], (y + half)[known], color=colour, linewidth=1, alpha=0.5, zorder=3)
        if not known.all():
            axes.plot(
                curve.s[~known],
                y[~known],
                mark,
                color=colour,
                markerfacecolor="white",
                markersize=5,
                label="_undetermined",
                zorder=5,
            )


def _true_lines(axes: "Axes", true: _Curve, columns: np.ndarray) -> None:
    for c in range(columns.shape[1]):
        label = "true" if c == 0 else "_true"
        axes.plot(true.s, columns[:, c], color=INK, linewidth=1.1, linestyle=(0, (4, 2)), label=label, zorder=6)


def _height_bars(
    axes: "Axes", fitted: GaussianTransfer, spread: np.ndarray | None, looks: Sequence[tuple[str, str, str]]
) -> None:
    if spread is None:
        return
    height, center = _as_columns(np.asarray(fitted.height)), np.asarray(fitted.center)
    for c, (_, colour, mark) in enumerate(looks):
        known = np.isfinite(spread[:, c])
        axes.errorbar(
            center[known],
            height[known, c],
            spread[known, c],
            fmt=mark,
            color=colour,
            capsize=3,
            markersize=4,
            label="_height",
            zorder=5,
        )
        axes.plot(center[~known], height[~known, c], mark, color=colour, markerfacecolor="white", label="_undetermined", zorder=5)


def _highest(columns: np.ndarray | None, unknown: np.ndarray | None, true: np.ndarray | None) -> float:
    """Where an axis ends: an undetermined entry may have run off to anywhere and must not squeeze the rest."""
    shown = np.zeros(0) if columns is None else columns
    if unknown is not None and len(unknown) == len(shown) and not unknown.all():
        shown = shown[~unknown]
    highest = max(float(shown.max(initial=0.0)), 0.0 if true is None else float(true.max(initial=0.0)))
    return highest if highest > 0 else 1.0


def _legend(axes: "Axes", spread: np.ndarray | None, *, is_table: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles, labels = axes.get_legend_handles_labels()
    if spread is not None:
        band = Patch(facecolor=SOFT, alpha=0.3)
        bar = Line2D([], [], color=SOFT, marker="|", markersize=10, linestyle="")
        hatched = Patch(facecolor="white", hatch="////", edgecolor=HATCH, linewidth=0)
        hollow = Line2D([], [], color=SOFT, marker="o", markerfacecolor="white", linestyle="")
        handles.append(band if is_table else bar)
        labels.append("± 1 standard error")
        if not np.isfinite(spread).all():
            handles.append(hatched if is_table else hollow)
            labels.append(UNDETERMINED.replace(" by", "\nby"))
    axes.legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)


def _histogram(axes: "Axes", histogram: Any) -> None:
    pair = (histogram["counts"], histogram["edges"]) if isinstance(histogram, Mapping) else histogram
    counts, edges = (np.asarray(part, float) for part in pair)
    if counts.size == 0:
        return
    behind = axes.twinx()
    behind.stairs(np.log1p(counts), edges, fill=True, color=PALE, alpha=0.6, label="voxels")
    behind.set_ylim(0, 1.15 * max(float(np.log1p(counts).max()), 1e-9))
    behind.set_yticks([])
    for spine in behind.spines.values():
        spine.set_visible(False)
    behind.set_zorder(axes.get_zorder() - 1)
    axes.patch.set_visible(False)
    axes.text(0.995, 0.97, "grey: voxels, logarithmic", transform=axes.transAxes, ha="right", va="top", fontsize=8, color=SOFT)
