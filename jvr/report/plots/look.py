"""What all figures of a fit share: colours, axes, and how one becomes a file.

Colours are Okabe and Ito's, which colour-blind readers can tell apart, and no meaning rests on colour alone.
"""

import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, SOFT, PALE, GRID, HATCH = "#222222", "#6b6b6b", "#d9d9d9", "#ececec", "#b8b8b8"
BLUE, ORANGE, GREEN = "#0072b2", "#d55e00", "#009e73"
# Width of every figure, in inches.
WIDTH = 8.0


def png(figure: "Figure", dpi: int = 150) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    return buffer.getvalue()


def style(axes: "Axes", ylabel: str) -> None:
    axes.set_ylabel(ylabel, color=INK)
    axes.grid(True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=SOFT, labelsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(PALE)
