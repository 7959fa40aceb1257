"""Fitted images beside their targets, and how far apart they are."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jvr.pictures import srgb_from_linear
from jvr.report.plots.look import INK, SOFT, WIDTH

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_VIEWS = 6
TIMES = "\N{MULTIPLICATION SIGN}"


def comparison_strip(targets: Sequence[Any], fitted: Sequence[Any], *, before: Sequence[Any] | None = None) -> "Figure":
    """Targets, fitted images and their difference, one row for each view, at most six rows spread over the views.

    Images are linear radiance `(height, width, 3)`, shown clipped to 0 ... 1 in sRGB. The difference is the largest of the three
    channels' absolute differences, all rows to one scale, which the column's title states as a factor. `before`: images from
    before the fit, as one more column.
    """
    from matplotlib.figure import Figure

    check_pairs(targets, fitted, before)
    shown = np.unique(np.linspace(0, len(targets) - 1, min(MOST_VIEWS, len(targets))).round().astype(int))
    pairs = [(np.asarray(targets[i], np.float64), np.asarray(fitted[i], np.float64)) for i in shown]
    differences = [np.abs(found - target).max(axis=-1) for target, found in pairs]
    factor = difference_factor(differences)
    titles = ["target", *(["before the fit"] if before is not None else []), "fitted", f"difference {TIMES} {factor:,}"]

    # Beside the pictures: labels of the rows, titles and the colour bar.
    width = (WIDTH - 0.5) / len(titles)
    heights = [width * target.shape[0] / target.shape[1] for target, _ in pairs]
    figure = Figure(figsize=(WIDTH, sum(heights) + 0.06 * len(heights) + 0.9), layout="constrained")
    grid = figure.subplots(len(pairs), len(titles), squeeze=False, gridspec_kw={"height_ratios": heights})
    mapped = None
    for row, i, (target, found), difference in zip(grid, shown, pairs, differences, strict=True):
        pictures = [target, *([np.asarray(before[i])] if before is not None else []), found]
        for axes, picture in zip(row, pictures, strict=False):
            axes.imshow(srgb_from_linear(np.nan_to_num(picture)), interpolation="nearest")
        mapped = row[-1].imshow(difference, cmap="magma", vmin=0, vmax=1 / factor, interpolation="nearest")
        row[0].set_ylabel(f"view {i + 1}\n{decibels(target, found)}", color=INK, fontsize=9)
        for axes in row:
            axes.set_xticks([])
            axes.set_yticks([])
            for spine in axes.spines.values():
                spine.set_visible(False)
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, color=INK, fontsize=10)
    if mapped is not None:
        bar = figure.colorbar(mapped, ax=grid, location="bottom", shrink=0.5, aspect=40, pad=0.02)
        bar.set_label("difference of radiance, largest of the three channels", color=INK, fontsize=9)
        bar.ax.tick_params(colors=SOFT, labelsize=8)
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    return figure


def check_pairs(targets: Sequence[Any], *others: Sequence[Any] | None) -> None:
    """**Raises** `ValueError` unless there is a target, and for each target one image of its shape among each of the others."""
    if not len(targets):
        raise ValueError("there are no target images: give at least one")
    for images in others:
        if images is None:
            continue
        if len(images) != len(targets):
            raise ValueError(f"there are {len(targets)} targets and {len(images)} images to compare: give one for each")
        for i, (target, image) in enumerate(zip(targets, images, strict=True)):
            if np.shape(target) != np.shape(image):
                raise ValueError(f"view {i + 1}: the target has shape {np.shape(target)}, the image {np.shape(image)}")


def difference_factor(differences: Sequence[np.ndarray]) -> int:
    """The factor (1, 2, 5, 10, 20, ..., a million at most) that makes nearly all differences of radiance at most 1."""
    flat = np.concatenate([np.ravel(difference) for difference in differences])
    flat = flat[np.isfinite(flat)]
    high = float(np.quantile(flat, 0.995)) if flat.size else 0.0
    steps = [digit * 10**power for power in range(6) for digit in (1, 2, 5)] + [10**6]
    if not flat.any():
        return 1
    return max([step for step in steps if step * high <= 1], default=1)


def decibels(target: Any, found: Any) -> str:
    """PSNR of one image relative to radiance 1, in words. Where the target is not finite it is not known."""
    known = np.isfinite(target)
    error = float(np.mean(np.square(np.asarray(found, np.float64)[known] - np.asarray(target, np.float64)[known])))
    return "identical" if error == 0 else f"{-10 * np.log10(error):.1f} dB" if np.isfinite(error) else "not finite"
