"""The colors of rbjax, its matplotlib style (`with plt.rc_context(STYLE): ...`), and its axes."""

from __future__ import annotations

import re
from typing import Any

from rbjax.errors import InputError
from rbjax.optional import require

INK, PAPER, GRID = "#22303c", "#ffffff", "#d9dee3"
BLUE, ORANGE, GREEN, RED, PURPLE, TEAL = (
    "#2a6fb0", "#e8832a", "#3d9a5f", "#c8433f", "#7a5ba8", "#2a9aa0",
)  # fmt: skip
PALETTE = (BLUE, ORANGE, GREEN, PURPLE, RED, TEAL)

STYLE: Any = {
    "figure.facecolor": PAPER, "axes.facecolor": PAPER, "axes.edgecolor": INK,
    "axes.labelcolor": INK, "axes.titlesize": 11, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "grid.color": GRID, "grid.linewidth": 0.7, "axes.axisbelow": True,
    "text.color": INK, "xtick.color": INK, "ytick.color": INK, "font.size": 10,
    "legend.frameon": True, "legend.edgecolor": "none", "legend.framealpha": 0.8,
    "legend.fontsize": 9, "savefig.dpi": 130,
    "axes.prop_cycle": f"cycler('color', {PALETTE})",
}  # fmt: skip


def rgb(color: Any) -> tuple[float, float, float]:
    """Convert a colour to red, green and blue from 0 to 1.

    Args:
        color: "#rrggbb", three numbers, or any other colour of matplotlib, which must then be
            installed.

    Example:
        >>> rgb("#ff0033")
        (1.0, 0.0, 0.2)
    """
    if isinstance(color, str) and re.fullmatch("#[0-9a-fA-F]{6}", color):
        red, green, blue = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
        return red, green, blue
    if isinstance(color, tuple) and len(color) == 3:
        return color
    red, green, blue = require(f"the colour {color!r}", "matplotlib.colors").to_rgb(color)
    return red, green, blue


def axes_of(
    where: str, ax: Any, count: int | None = None, size: tuple[float, float] = (6, 5)
) -> Any:
    """Return the axis of the caller, or `count` axes, one above the other. None makes a figure in
    the style of rbjax.

    Raises:
        InputError: not an axis of matplotlib, or fewer than `count` of them.
    """
    if ax is None:
        plt = require(where, "matplotlib.pyplot")
        with plt.rc_context(STYLE):
            return plt.subplots(count or 1, sharex=True, figsize=size, layout="constrained")[1]
    several = [ax] if count is None else ax
    if count is not None and (not hasattr(ax, "__len__") or len(ax) < count):
        raise InputError(f"{where}: ax is {type(ax).__name__}, expected {count} axes")
    for one in several:
        if not hasattr(one, "add_collection"):
            raise InputError(
                f"{where}: ax is {type(one).__name__}, expected an axis of matplotlib, such as "
                "matplotlib.pyplot.gca()"
            )
    return ax


def is_dark(figure: Any) -> bool:
    """Return whether the background of a figure, or of an axis with a frame, is dark."""
    red, green, blue, opacity = figure.patch.get_facecolor()
    return opacity > 0.5 and 0.3 * red + 0.6 * green + 0.1 * blue < 0.4


def legend(ax: Any, **options: Any) -> None:
    """Add a legend without a frame, in the colour of the labels of the axis."""
    ax.legend(frameon=False, labelcolor=ax.xaxis.label.get_color(), **options)
