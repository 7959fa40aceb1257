"""Convergence of a fit: objective and PSNR after each iteration."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jvr.report.plots.look import BLUE, INK, ORANGE, PALE, SOFT, WIDTH, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from jvr.fitting.result import Iteration


def plot_convergence(history: Sequence["Iteration"]) -> "Figure":
    """Objective (logarithmic) and PSNR against the iteration and against seconds.

    Steps that used a part of the rays are hollow points on a grey ground, with the share written above.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, 4.4), layout="constrained")
    rows = figure.subplots(2, 2, sharex="col", sharey="row")
    for row, label in zip(rows, ("objective", "PSNR (dB)"), strict=True):
        style(row[0], label)
        style(row[1], "")
    for axes, label in zip(rows[1], ("iteration", "seconds"), strict=True):
        axes.set_xlabel(label, color=INK)
    if not history:
        rows[0, 0].text(0.5, 0.5, "no iteration was made", transform=rows[0, 0].transAxes, ha="center", color=SOFT)
        return figure
    table = np.array([[entry.step, entry.seconds, entry.loss, entry.psnr, entry.rays] for entry in history], float)
    step, seconds, loss, psnr, rays = table.T
    # Neither zero nor infinity has a place on the axes.
    loss, psnr = np.where(loss > 0, loss, np.nan), np.where(np.isfinite(psnr), psnr, np.nan)
    if np.isfinite(loss).any():
        rows[0, 0].set_yscale("log")
    for column, x in enumerate((step, seconds)):
        for axes, y, colour in zip(rows[:, column], (loss, psnr), (BLUE, ORANGE), strict=True):
            axes.plot(x, y, color=colour, linewidth=1.6, zorder=3)
            axes.scatter(x, y, s=18, color=colour, facecolors=np.where(rays < 1, "white", colour), zorder=4)
            axes.margins(x=0.03)
            _shade_shares(axes, x, rays)
        _name_shares(rows[0, column], x, rays)
    rows[1, 0].xaxis.get_major_locator().set_params(integer=True)
    return figure


def _stretches(x: np.ndarray, rays: np.ndarray) -> list[tuple[float, float, float]]:
    """Start, end and share of rays of each run of steps with one share; empty where every step used all rays."""
    starts = np.flatnonzero(np.diff(rays, prepend=np.nan) != 0)
    middles = np.concatenate([x[:1], (x[1:] + x[:-1]) / 2, x[-1:]])
    if np.all(rays >= 1):
        return []
    return [(float(middles[i]), float(middles[j]), float(rays[i])) for i, j in zip(starts, [*starts[1:], len(x)], strict=True)]


def _shade_shares(axes: "Axes", x: np.ndarray, rays: np.ndarray) -> None:
    for start, end, share in _stretches(x, rays):
        if share < 1:
            axes.axvspan(start, end, color=PALE, alpha=0.2 + 0.6 * (1 - share), linewidth=0, zorder=0)


def _name_shares(axes: "Axes", x: np.ndarray, rays: np.ndarray) -> None:
    """Writes the share of rays above each stretch that is wide enough for it."""
    for start, end, share in _stretches(x, rays):
        if end - start > 0.1 * np.ptp(x):
            text = "all rays" if share >= 1 else f"{100 * share:.2g} %"
            place = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom", "fontsize": 8, "color": SOFT}
            axes.annotate(text, ((start + end) / 2, 1.02), **place)
