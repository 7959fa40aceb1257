"""One HTML page about one fit, complete in itself: pictures, curves, numbers, and how to make it again."""

import base64
import importlib.metadata
import os
import platform
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jvr.io.images import replacing, srgb_from_linear
from jvr.model.transfer import AbstractTable, AbstractTransfer, GaussianTransfer
from jvr.report.plots import (
    MOST_VIEWS,
    check_pairs,
    comparison_strip,
    decibels,
    field_errors,
    plot_convergence,
    plot_transfer,
    png,
)
from jvr.types import Outcome

if TYPE_CHECKING:
    from jvr.fitting.fit import FitResult

# Longer tables are folded away until a reader opens them.
OPEN_ROWS = 20
MOST_ROWS = 1024
PACKAGES = ("jvr", "jax", "jaxlib", "equinox", "optimistix", "numpy")
TITLES = {"rgb": "colour", "sigma_t": "extinction", "height": "height", "center": "centre", "positions": "position"}
COLOURS = ("red", "green", "blue")

STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; padding: 2.5rem 1.25rem 4rem; max-width: 60rem; background: #fff; color: #222;
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .5rem; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .5rem; }
p { max-width: 44rem; margin: .5rem 0; }
.lead { font-size: 1.1rem; }
.soft, figcaption { color: #5c5c5c; font-size: .9rem; }
figure { margin: 1rem 0; }
figure img { width: 100%; height: auto; display: block; }
dl { display: grid; grid-template-columns: repeat(auto-fill, minmax(13rem, 1fr)); gap: .75rem; margin: 1.5rem 0; }
dl div { border: 1px solid #e2e2e2; border-radius: .4rem; padding: .6rem .8rem; }
dt { color: #5c5c5c; font-size: .85rem; }
dd { margin: 0; font-size: 1.25rem; font-variant-numeric: tabular-nums; }
dd small { display: block; font-size: .8rem; color: #5c5c5c; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid #ececec; white-space: nowrap; }
th { color: #5c5c5c; font-weight: 600; }
.swatch { display: inline-block; width: 1.6rem; height: .9rem; border: 1px solid #ccc; vertical-align: middle; }
.hatched { background: repeating-linear-gradient(135deg, #fff 0 3px, #b8b8b8 3px 4px); }
.unknown { color: #9a4600; }
pre { background: #f6f6f6; border: 1px solid #e2e2e2; border-radius: .4rem; padding: .8rem; overflow-x: auto; font-size: .85rem; }
summary { cursor: pointer; margin: .5rem 0; }
""".strip()


def write_fit_page(
    path: str | os.PathLike,
    *,
    title: str,
    result: "FitResult",
    targets: Sequence[Any],
    fitted: Sequence[Any],
    truth: AbstractTransfer | None = None,
    command: str | None = None,
    config_text: str | None = None,
    versions: Mapping[str, str] | None = None,
    before: Sequence[Any] | None = None,
    unknowns: Sequence[str] | None = None,
    histogram: Any = None,
) -> Path:
    """Writes the page of a fit: one HTML file without scripts that refers to nothing outside of itself. Returns its path.

    **Arguments:**

    - `result`: of `jvr.fit`. `targets`, `fitted`, `before`: images `(height, width, 3)`, linear radiance, one for each view: as
      given, as the fitted scene looks, and (optional) as the scene looked before the fit.
    - `truth`: the transfer function that made the targets, where it is known.
    - `command`, `config_text`: what to type to make the page again, and the configuration it read.
    - `versions`: of packages; without them those installed are named.
    - `unknowns`: names of the fitted arrays in the order of `result.standard_errors`, such as
      `("transfer.rgb", "transfer.sigma_t")`. Without them they are recognised by their shapes, see
      `jvr.report.plots.field_errors`.
    - `histogram`: of the volume's values, drawn behind the extinction, see `jvr.report.plots.plot_transfer`.

    The file appears under its name once it is whole. **Raises** `ValueError` where the numbers of images differ, `OSError` where
    the file cannot be written.
    """
    check_pairs(targets, fitted, before)
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(result.standard_errors)]
    if unknowns is not None and len(unknowns) != len(leaves):
        raise ValueError(f"there are {len(leaves)} fitted arrays and {len(unknowns)} names in unknowns: give one for each")
    named = None if unknowns is None else dict(zip(unknowns, leaves, strict=True))
    transfer = result.scene.transfer
    of_transfer = result.standard_errors if named is None else _within(named, "transfer.")
    errors = field_errors(transfer, of_transfer)
    sections = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{_verdict(result, targets, fitted)}</p>',
        _summary(result, leaves, targets, fitted),
        _pictures(targets, fitted, before),
        _transfer(transfer, errors, truth, histogram, _reached_by_light(transfer)),
        _values(transfer, errors),
        _other_values(result.scene, named),
        _determination(result, leaves, transfer),
        _convergence(result),
        _again(result, command, config_text, versions),
    ]
    path = Path(path)
    with replacing(path) as temporary:
        temporary.write_text(_document(title, "\n".join(sections)), encoding="utf-8")
    return path


def _document(title: str, body: str) -> str:
    # The policy makes a browser refuse whatever is not in this file.
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{STYLE}
</style>
</head>
<body>
{body}
</body>
</html>
"""


def _within(named: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name: array for name, array in named.items() if name.startswith(prefix)}


def _reached_by_light(transfer: AbstractTransfer) -> bool:
    """Whether the transfer function has any extinction at all."""
    table = getattr(transfer, "sigma_t", getattr(transfer, "height", None))
    return table is None or bool(np.any(np.asarray(table) > 0))


def _figure(figure: Any, alt: str, caption: str) -> str:
    data = base64.b64encode(png(figure)).decode("ascii")
    return f'<figure><img alt="{escape(alt)}" src="data:image/png;base64,{data}"><figcaption>{caption}</figcaption></figure>'


# --- Numbers ---------------------------------------------------------------------------------------------------------


def _verdict(result: "FitResult", targets: Sequence[Any], fitted: Sequence[Any]) -> str:
    """The fit in two sentences."""
    ended = {
        Outcome.CONVERGED: "The fit converged",
        Outcome.STEP_LIMIT: "The fit reached its limit of iterations before it converged",
        Outcome.NON_FINITE: "The fit met a value that is not finite and kept its last good state",
        Outcome.INTERRUPTED: "The fit was interrupted and kept its last good state",
    }[result.outcome]
    text = f"{ended}, after {_count(len(result.history), 'iteration')} and {_seconds(result.stats.seconds)}. "
    held_out = _held_out(result)
    if held_out is None:
        psnr = _all_decibels(targets, fitted)
        return f"{text}The images it was given come out with a PSNR of {psnr}; no other views were held out to check it."
    views, psnr, ssim = held_out
    come = "comes" if len(result.stats.held_out) == 1 else "come"
    return f"{text}{views} that took no part in it {come} out with a PSNR of {psnr} and an SSIM of {ssim}."


def _held_out(result: "FitResult") -> tuple[str, str, str] | None:
    """Number, mean PSNR and mean SSIM of the held-out views, in words."""
    scores = result.stats.held_out
    if not scores:
        return None
    psnr, ssim = np.mean(scores, axis=0)
    return _count(len(scores), "view"), "identical" if psnr == np.inf else f"{psnr:.1f} dB", f"{ssim:.4f}"


def _summary(result: "FitResult", leaves: Sequence[np.ndarray], targets: Sequence[Any], fitted: Sequence[Any]) -> str:
    stats, count = result.stats, _unknown_count(result, leaves)
    tiles = [
        ("outcome", result.outcome.value.partition(";")[0], ""),
        ("iterations", f"{len(result.history)}", ""),
        ("time", _seconds(stats.seconds), "compiling included"),
        ("PSNR, fitted views", _all_decibels(targets, fitted), f"{_count(len(targets), 'image')}, radiance 1 is the peak"),
    ]
    if held_out := _held_out(result):
        views, psnr, ssim = held_out
        tiles += [("PSNR, held-out views", psnr, f"mean of {views}"), ("SSIM, held-out views", ssim, f"mean of {views}")]
    tiles += [
        ("residual", f"{np.sqrt(stats.residual_variance):.2g}", "radiance, root mean square of a channel"),
        ("rank", f"{stats.rank} of {count}", "combinations of unknowns that the images determine"),
        (
            "kept samples",
            _bytes(stats.kept_bytes),
            "volume values along the rays" if stats.kept_bytes else "resampled in every step",
        ),
    ]
    if result.exposure != 1.0:
        tiles.append(("exposure", f"{result.exposure:.4g}", "fitted factor from rendered to target radiance"))
    cell = lambda name, value, note: (
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}{f'<small>{escape(note)}</small>' if note else ''}</dd></div>"
    )
    return "<dl>" + "".join(cell(*tile) for tile in tiles) + "</dl>"


def _unknown_count(result: "FitResult", leaves: Sequence[np.ndarray]) -> int:
    """Exposure is an unknown too where it was fitted, but has no entry among the standard errors."""
    return sum(leaf.size for leaf in leaves) + (result.exposure != 1.0)


def _all_decibels(targets: Sequence[Any], fitted: Sequence[Any]) -> str:
    flat = lambda images: np.concatenate([np.ravel(np.asarray(image)) for image in images])
    return decibels(flat(targets), flat(fitted))


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def _seconds(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {rest} s"


def _bytes(count: int) -> str:
    for unit, each in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= each:
            return f"{count / each:.3g} {unit}"
    return f"{count} bytes" if count else "none"


# --- Pictures and curves ---------------------------------------------------------------------------------------------


def _pictures(targets: Sequence[Any], fitted: Sequence[Any], before: Sequence[Any] | None) -> str:
    shown = f"{MOST_VIEWS} of the {len(targets)} views are shown." if len(targets) > MOST_VIEWS else ""
    start = "the scene before the fit, " if before is not None else ""
    caption = (
        f"The images that were given, {start}the fitted scene, and its difference from the given images, enlarged so that it can "
        f"be seen: the scale is in radiance, where 1 is white. {shown}"
    )
    alt = "Target images, fitted images and their enlarged differences"
    return "<h2>Pictures</h2>" + _figure(comparison_strip(targets, fitted, before=before), alt, caption)


def _transfer(
    transfer: AbstractTransfer, errors: dict[str, np.ndarray], truth: AbstractTransfer | None, histogram: Any, extinct: bool
) -> str:
    drawn = plot_transfer(transfer, standard_errors=errors, truth=truth, histogram=histogram)
    caption = (
        "The strip shows each value's colour, the upper curve how strongly it absorbs, the lower one its three colour channels. "
    )
    if errors:
        caption += "Shaded around a curve: one standard error to each side. "
    if any(not np.isfinite(error).all() for error in errors.values()):
        caption += "Hatched or hollow: the images do not determine these entries, their values mean nothing. "
    if truth is not None:
        caption += "Dashed: the transfer function that made the images. "
    if not extinct:
        caption += "Its extinction is zero everywhere: this scene is empty. "
    return "<h2>Transfer function</h2>" + _figure(drawn, "Fitted transfer function with standard errors", caption)


def _convergence(result: "FitResult") -> str:
    caption = "The objective and the PSNR of the rays in use after each iteration. "
    if any(entry.rays < 1 for entry in result.history):
        caption += "Hollow points on grey: iterations that used only the stated share of the rays. "
    drawn = plot_convergence(result.history)
    return "<h2>Convergence</h2>" + _figure(drawn, "Objective and PSNR against iteration and seconds", caption)


# --- Fitted values ---------------------------------------------------------------------------------------------------


def _values(transfer: AbstractTransfer, errors: dict[str, np.ndarray]) -> str:
    """A table of the transfer function's entries, one row each."""
    names = [name for name in ("positions", "center", "width", "height", "sigma_t", "rgb") if hasattr(transfer, name)]
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
        "in 1 / world length (1 / mm for medical files), colours linear."
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


def with_error(value: float, error: float) -> str:
    """A value and its standard error, the latter to two digits and the value to as many places: "0.4137 ± 0.0012"."""
    if not error > 0 or not np.isfinite(value):
        return f"{value:.5g} ± {error:.2g}"
    places = 1 - int(np.floor(np.log10(error)))
    if places > 8 or places < -3:
        return f"{value:.4g} ± {error:.2g}"
    places = max(places, 0)
    return f"{value:.{places}f} ± {error:.{places}f}"


def _undetermined(transfer: AbstractTransfer, errors: dict[str, np.ndarray]) -> str:
    """In words, which values the images say nothing about."""
    parts = []
    for name, error in errors.items():
        unknown = ~np.isfinite(error.reshape(len(error), -1)).all(axis=1)
        if unknown.any():
            parts.append(f"{TITLES.get(name, name)} of {_entries(np.flatnonzero(unknown), transfer)}")
    if not parts:
        return ""
    return f'<p class="unknown">The images do not determine the {escape("; the ".join(parts))}.</p>'


def _entries(indices: np.ndarray, transfer: AbstractTransfer) -> str:
    """Runs of entries: "entries 0 to 3, 7"."""
    runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
    text = ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
    noun = ("Gaussian", "Gaussians") if isinstance(transfer, GaussianTransfer) else ("entry", "entries")
    return f"{noun[len(indices) > 1]} {text}"


def _other_values(scene: Any, named: Mapping[str, np.ndarray] | None) -> str:
    """What was fitted beside the transfer function: small arrays as numbers, others by size alone."""
    rows = []
    for name, error in (named or {}).items():
        if name.startswith("transfer."):
            continue
        value = np.asarray(_at(scene, name))
        if value.size <= 16:
            text = ", ".join(_cell(v, e) for v, e in zip(value.ravel().tolist(), error.ravel().tolist(), strict=True))
        else:
            unknown = int(np.sum(~np.isfinite(error)))
            text = f"{value.size:,} values, of which the images do not determine {unknown:,}"
        rows.append(f"<tr><th>{escape(name)}</th><td>{text}</td></tr>")
    return f'<h2>Other fitted values</h2><div class="scroll"><table>{"".join(rows)}</table></div>' if rows else ""


def _at(scene: Any, name: str) -> Any:
    """The part of a scene with a name such as `volume.values` or `lights[0].direction`."""
    for part in re.findall(r"\w+", name):
        scene = scene[int(part)] if part.isdigit() else getattr(scene, part)
    return scene


def _determination(result: "FitResult", leaves: Sequence[np.ndarray], transfer: AbstractTransfer) -> str:
    stats, count = result.stats, _unknown_count(result, leaves)
    missing = count - stats.rank
    if missing > 0:
        are = "are" if missing > 1 else "is"
        rank = f"{_count(missing, 'combination')} of the {count} unknowns {are} not determined by the images at all."
    else:
        ratio = f"{np.sqrt(stats.condition):.2g}"
        rank = f"The images determine all {count} unknowns, the best combination {ratio} times as sharply as the worst."
    parts = [f"<h2>What the images tell least about</h2><p>{rank}</p>"]
    if stats.worst:
        parts.append(f"<p>{escape(worst_in_words(stats.worst, transfer))}</p>")
        share = "; ".join(f"{name} {coefficient:+.2f}" for name, coefficient in stats.worst)
        parts.append(f'<p class="soft">Largest coefficients, each unknown in units of its own sensitivity: {escape(share)}.</p>')
    return "".join(parts)


def worst_in_words(worst: Sequence[tuple[str, float]], transfer: AbstractTransfer) -> str:
    """The worst-determined combination as a sentence: what one can raise and lower together without changing the pictures."""
    raised = _unknowns_in_words([name for name, coefficient in worst if coefficient > 0], transfer)
    lowered = _unknowns_in_words([name for name, coefficient in worst if coefficient < 0], transfer)
    if not lowered or not raised:
        return f"Changing {_listed(raised or lowered)} together hardly changes the pictures."
    return f"Raising {_listed(raised)} while lowering {_listed(lowered)} hardly changes the pictures."


def _unknowns_in_words(names: Sequence[str], transfer: AbstractTransfer) -> list[str]:
    """`transfer.rgb[2, 1]` and `transfer.rgb[2, 0]` as "the red and green of entry 2 (at 0.133)"."""
    places = getattr(transfer, "positions", getattr(transfer, "center", None))
    noun = "entry" if isinstance(transfer, AbstractTable) else "Gaussian"
    channels: dict[tuple[str, str], list[int]] = {}
    for name in names:
        match = re.fullmatch(r"transfer\.(\w+)\[(\d+)(?:, (\d+))?\]", name)
        key = (match[1], match[2]) if match else (name.removesuffix("[]"), "")
        channels.setdefault(key, []).extend([int(match[3])] if match and match[3] else [])
    words = []
    for (field, entry), which in channels.items():
        coloured = _listed([COLOURS[c] for c in sorted(which)]) if which else ""
        what = TITLES.get(field, field)
        if field == "rgb":
            what = what if len(which) == 3 else coloured
        elif coloured:
            what = f"{what} in {coloured}"
        at = f" (at {float(places[int(entry)]):.4g})" if entry and places is not None else ""
        if field == "domain":
            words.append(f"the {('lower', 'upper')[int(entry)]} end of the domain")
        else:
            words.append(f"the {what} of {noun} {entry}{at}" if entry else field)
    return words


def _listed(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


# --- How to make it again --------------------------------------------------------------------------------------------


def _again(result: "FitResult", command: str | None, config_text: str | None, versions: Mapping[str, str] | None) -> str:
    versions = _installed() if versions is None else versions
    parts = ["<h2>Make it again, cite it</h2>"]
    if command:
        parts.append(f"<p>This command made the page:</p><pre>{escape(command)}</pre>")
    if config_text:
        parts.append(f"<details><summary>The configuration it read</summary><pre>{escape(config_text)}</pre></details>")
    listed = ", ".join(f"{name} {version}" for name, version in versions.items())
    parts.append(f'<p class="soft">Made with {escape(listed)}.</p>')
    own = f" {versions['jvr']}" if "jvr" in versions else ""
    parts.append(
        f"<p>In a paper: “Transfer functions were fitted to the images with jvr{escape(own)}, a differentiable direct volume "
        "renderer in JAX; standard errors are those of weighted least squares at the solution.” Give the command and the "
        "configuration as well.</p>"
    )
    return "".join(parts)


def _installed() -> dict[str, str]:
    found = {"Python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
