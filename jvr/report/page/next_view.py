"""What one more view would bring."""

from html import escape
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jvr.fitting.result import FitResult


def one_more_view(result: "FitResult") -> str:
    """The best of default candidates and which errors it would lower, nothing for a fit of voxels."""
    from jvr.fitting.next_view import COUNT, best_of

    best = best_of(result)
    if best is None:
        return ""
    x, y, z = np.asarray(best.camera.world_from_camera, float)[:3, 3]
    rows = []
    for name in best.before:
        before, after = np.ravel(best.before[name]), np.ravel(best.errors[name])
        most = np.unravel_index(int(np.argmin(after / before)), np.shape(best.before[name]))
        entry = f"[{', '.join(map(str, most))}]" if most else ""
        change = f"{best.before[name][most]:.2g} &rarr; {best.errors[name][most]:.2g}"
        medians = f"<td>{np.median(before):.2g}</td><td>{np.median(after):.2g}</td>"
        rows.append(f"<tr><td>{escape(name)}</td>{medians}<td>{entry} {change}</td></tr>")
    head = "".join(f"<th>{title}</th>" for title in ("unknowns", "median error", "with one more view", "lowered most"))
    return (
        "<h2>What one more view would bring</h2>"
        f"<p>Of {COUNT} views from all around, as far away as the given ones, one from ({x:.4g}, {y:.4g}, {z:.4g}) would bring most: "
        f"{best.gain:.1f} bits about all unknowns together. What the images leave open counts here as uncertain by as much as it may "
        "plausibly be, and residuals as noise.</p>"
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        '<p class="soft">jvr next-view ranks cameras of your own.</p>'
    )
