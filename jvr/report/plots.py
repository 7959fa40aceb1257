"""Figures of a fit: the transfer function with its uncertainty, the way there, and the pictures beside their targets.

Every function returns a `matplotlib` figure that belongs to no window and to no global state; `png` turns one into a file's
bytes. Colours are Okabe and Ito's, which colour-blind readers can tell apart, and no meaning rests on colour alone.
"""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jvr.io.images import srgb_from_linear
from jvr.model.transfer import AbstractTable, AbstractTransfer, GaussianTransfer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from jvr.fitting.fit import Iteration

INK, SOFT, PALE, GRID, HATCH = "#222222", "#6b6b6b", "#d9d9d9", "#ececec", "#b8b8b8"
BLUE, ORANGE, GREEN = "#0072b2", "#d55e00", "#009e73"
CHANNELS = (("red", ORANGE, "o"), ("green", GREEN, "s"), ("blue", BLUE, "^"))
WIDTH = 8.0
TIMES = "\N{MULTIPLICATION SIGN}"
UNDETERMINED = "not determined by the images"
# Entries of a table are drawn as points up to this many; more would hide the line.
MOST_POINTS = 80
MOST_VIEWS = 6
# Where a curve that is not a table is evaluated.
SAMPLES = 512


def png(figure: "Figure", dpi: int = 150) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    return buffer.getvalue()


# --- Transfer function -----------------------------------------------------------------------------------------------


class _Curve(NamedTuple):
    """A transfer function at the values `s` where it is drawn: linear colours and extinction, one column or three."""

    s: np.ndarray
    rgb: np.ndarray
    sigma_t: np.ndarray


def field_errors(transfer: AbstractTransfer, standard_errors: Any) -> dict[str, np.ndarray]:
    """Standard errors by the name of the transfer function's field: `rgb`, `sigma_t`, `positions`, `height`, ...

    **Arguments:** `standard_errors`: a mapping from fields (`"rgb"` or `"transfer.rgb"`), a transfer function that holds errors
    in place of values, or arrays in the structure that a fit's `unknowns` returned. Such arrays are told apart by their shapes:
    all fields in their order, else `rgb` first and then extinction, so pass a mapping where `positions`, `center` or `width` were
    fitted without the others. Arrays that fit no field are left out.
    """
    fields = {name: np.shape(value) for name, value in vars(transfer).items() if value is not None}
    if standard_errors is None:
        return {}
    if isinstance(standard_errors, AbstractTransfer):
        standard_errors = vars(standard_errors)
    if isinstance(standard_errors, Mapping):
        named = {name.rpartition(".")[2]: np.asarray(value) for name, value in standard_errors.items() if value is not None}
        return {name: value for name, value in named.items() if fields.get(name) == value.shape}
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves(standard_errors)]
    if [array.shape for array in arrays] == list(fields.values()):
        return dict(zip(fields, arrays, strict=True))
    likely = ("rgb", "sigma_t", "height", *fields)
    found: dict[str, np.ndarray] = {}
    for array in arrays:
        name = next((name for name in likely if name not in found and fields.get(name) == array.shape), None)
        if name:
            found[name] = array
    return found


def plot_transfer(
    fitted: AbstractTransfer,
    *,
    standard_errors: Any = None,
    truth: AbstractTransfer | None = None,
    histogram: Any = None,
    xlabel: str = "scalar value",
) -> "Figure":
    """Colour strips, extinction and colours of a fitted transfer function against the scalar value, beside the true one.

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
    figure = Figure(figsize=(WIDTH, 5.6 + 0.3 * len(strips)), layout="constrained")
    rows = figure.subplots(
        len(strips) + 2, 1, sharex=True, gridspec_kw={"height_ratios": [0.3] * len(strips) + [2.9, 2.1], "hspace": 0.02}
    )
    for axes, (name, transfer) in zip(rows[:-2], strips, strict=True):
        _strip(axes, name, transfer, span)
    unknown_colour, unknown_extinction = _undetermined(errors.get("rgb")), _undetermined(_extinction_errors(errors))
    is_table = isinstance(fitted, AbstractTable)
    if is_table:
        for axes, unknown in ((rows[-3], unknown_colour), (rows[-2], unknown_extinction), (rows[-1], unknown_colour)):
            _hatch(axes, found.s, unknown)
    _extinction_panel(rows[-2], fitted, found, true, errors)
    _colour_panel(rows[-1], fitted, found, true, errors)
    if histogram is not None:
        _histogram(rows[-2], histogram)
    rows[-1].set_xlabel(xlabel, color=INK)
    rows[-1].set_xlim(*span)
    return figure


def _ends(transfer: AbstractTransfer) -> tuple[float, float]:
    """The values between which a transfer function has something to show."""
    if isinstance(transfer, GaussianTransfer):
        center, width = np.asarray(transfer.center), np.asarray(transfer.width)
        return float(np.min(center - 3.5 * width)), float(np.max(center + 3.5 * width))
    positions = getattr(transfer, "positions", (0.0, 1.0))
    return float(positions[0]), float(positions[-1])


def _curve(transfer: AbstractTransfer, span: tuple[float, float]) -> _Curve:
    """The entries of a table; anything else evaluated across `span`."""
    positions = getattr(transfer, "positions", None)
    if isinstance(transfer, AbstractTable) and positions is not None:
        return _Curve(np.asarray(positions), np.asarray(transfer.rgb), _as_columns(np.asarray(transfer.sigma_t)))
    return _sampled(transfer, np.linspace(*span, SAMPLES))


def _sampled(transfer: AbstractTransfer, s: np.ndarray) -> _Curve:
    classified = jax.vmap(transfer.evaluate)(jnp.asarray(s, jnp.result_type(float)))
    stack = lambda columns: np.stack([np.broadcast_to(np.asarray(column), s.shape) for column in columns], axis=-1)
    return _Curve(s, stack(classified.rgb), stack(classified.sigma_t))


def _as_columns(array: np.ndarray) -> np.ndarray:
    return array[:, None] if array.ndim == 1 else array


def _extinction_errors(errors: dict[str, np.ndarray]) -> np.ndarray | None:
    found = errors.get("sigma_t", errors.get("height"))
    return None if found is None else _as_columns(found)


def _undetermined(errors: np.ndarray | None) -> np.ndarray | None:
    """Which entries have an infinite error in any of their columns."""
    return None if errors is None else np.logical_not(np.isfinite(errors).all(axis=-1))


def _style(axes: "Axes", ylabel: str) -> None:
    axes.set_ylabel(ylabel, color=INK)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=SOFT, labelsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(PALE)


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
    _style(axes, "extinction\n(1 / world length)")
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
    top = _highest(found.sigma_t, _undetermined(spread), true)
    axes.set_ylim(-0.03 * top, 1.12 * top)
    _legend(axes, spread, is_table=isinstance(fitted, AbstractTable))


def _colour_panel(
    axes: "Axes", fitted: AbstractTransfer, found: _Curve, true: _Curve | None, errors: dict[str, np.ndarray]
) -> None:
    _style(axes, "colour\n(linear)")
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


def _highest(sigma_t: np.ndarray, unknown: np.ndarray | None, true: _Curve | None) -> float:
    """Where the extinction axis ends: an undetermined entry may have run off to anywhere and must not squeeze the rest."""
    shown = sigma_t if unknown is None or len(unknown) != len(sigma_t) or unknown.all() else sigma_t[~unknown]
    highest = max(float(shown.max(initial=0.0)), 0.0 if true is None else float(true.sigma_t.max(initial=0.0)))
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


# --- Convergence -----------------------------------------------------------------------------------------------------


def plot_convergence(history: Sequence["Iteration"]) -> "Figure":
    """Objective (logarithmic) and PSNR against the iteration and against seconds.

    Steps that used a part of the rays are hollow points on a grey ground, with the share written above.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, 4.4), layout="constrained")
    rows = figure.subplots(2, 2, sharex="col", sharey="row")
    for row, label in zip(rows, ("objective", "PSNR (dB)"), strict=True):
        _style(row[0], label)
        _style(row[1], "")
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


# --- Pictures --------------------------------------------------------------------------------------------------------


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
    """PSNR of one image relative to radiance 1, in words."""
    error = float(np.mean(np.square(np.asarray(found, np.float64) - np.asarray(target, np.float64))))
    return "identical" if error == 0 else f"{-10 * np.log10(error):.1f} dB" if np.isfinite(error) else "not finite"
