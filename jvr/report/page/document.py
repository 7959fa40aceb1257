"""The page as a whole: its sections in their order, its figures, and how to make it again."""

import base64
import importlib.metadata
import os
import platform
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jvr.atomic import replacing
from jvr.model.transfer import AbstractTransfer
from jvr.report.errors import field_errors
from jvr.report.page.next_view import one_more_view
from jvr.report.page.summary import identifiability, summary, verdict
from jvr.report.page.values import camera_values, other_values, transfer_values
from jvr.report.plots import comparison_strip, plot_convergence, plot_transfer, png
from jvr.report.plots.pictures import MOST_VIEWS, check_pairs

if TYPE_CHECKING:
    from jvr.fitting.result import FitResult

PACKAGES = ("jvr", "jax", "jaxlib", "equinox", "optimistix", "numpy")

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
    histogram: Any = None,
) -> Path:
    """Writes the page of a fit: one HTML file without scripts that refers to nothing outside of itself. Returns its path.

    **Arguments:**

    - `result`: of `jvr.fit`. `targets`, `fitted`, `before`: images `(height, width, 3)`, linear radiance, one for each view: as
      given, as the fitted scene looks, and (optional) as the scene looked before the fit.
    - `truth`: the transfer function that made the targets, where it is known.
    - `command`, `config_text`: what to type to make the page again, and the configuration it read.
    - `versions`: of packages; without them those installed are named.
    - `histogram`: of the volume's values, drawn behind the extinction, see `jvr.report.plots.plot_transfer`.

    The file appears under its name once it is whole. **Raises** `ValueError` where the numbers of images differ, `OSError` where
    the file cannot be written.
    """
    check_pairs(targets, fitted, before)
    transfer, errors = result.scene.transfer, field_errors(result.scene.transfer, result.errors_by_name)
    sections = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="lead">{verdict(result, targets, fitted)}</p>',
        summary(result, targets, fitted),
        _pictures(targets, fitted, before),
        *_curves(transfer, errors, truth, histogram),
        other_values(result.scene, result.errors_by_name),
        camera_values(result.cameras, result.errors_by_name),
        identifiability(result, transfer),
        one_more_view(result),
        _convergence(result),
        _again(command, config_text, versions),
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


def _curves(
    transfer: AbstractTransfer, errors: dict[str, np.ndarray], truth: AbstractTransfer | None, histogram: Any
) -> list[str]:
    """The curve and the values of a transfer function. What depends on the gradient as well is no curve; its fitted numbers are among the
    other values."""
    if transfer.takes_gradient or transfer.is_clear:
        return []
    return [_transfer(transfer, errors, truth, histogram, _reached_by_light(transfer)), transfer_values(transfer, errors)]


def _reached_by_light(transfer: AbstractTransfer) -> bool:
    """Whether the transfer function has any extinction at all."""
    table = getattr(transfer, "sigma_t", getattr(transfer, "height", None))
    return table is None or bool(np.any(np.asarray(table) > 0))


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


def _figure(figure: Any, alt: str, caption: str) -> str:
    data = base64.b64encode(png(figure)).decode("ascii")
    return f'<figure><img alt="{escape(alt)}" src="data:image/png;base64,{data}"><figcaption>{caption}</figcaption></figure>'


# --- How to make it again --------------------------------------------------------------------------------------------


def _again(command: str | None, config_text: str | None, versions: Mapping[str, str] | None) -> str:
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
