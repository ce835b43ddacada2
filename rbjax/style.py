"""The colors of rbjax, and its matplotlib style: `with plt.rc_context(STYLE): ...`."""

from __future__ import annotations

from typing import Any

from cycler import cycler

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
    "legend.frameon": False, "legend.fontsize": 9, "savefig.dpi": 130,
    "axes.prop_cycle": cycler(color=PALETTE),
}  # fmt: skip
