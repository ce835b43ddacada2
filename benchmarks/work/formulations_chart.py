"""The picture of `formulations`: error against cost, and what is left of the rows.

`python -m benchmarks.work.formulations_chart` draws it again from the results.
"""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullFormatter

from benchmarks.shared.charts import PAGE, save_chart, saved
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, PURPLE, RED, STYLE, TEAL

PICTURE = Path(__file__).parents[2] / "docs" / "guides" / "figures" / "formulations.png"
#: formulation -> colour, marker; the marker is the family's
LOOKS = {
    "projected": (BLUE, "o"), "multipliers": (ORANGE, "o"), "baumgarte": (RED, "o"),
    "kkt": (INK, "o"), "null_space_qr": (GREEN, "s"), "null_space_svd": (TEAL, "s"),
    "partitioning": (PURPLE, "s"), "udwadia_kalaba": (ORANGE, "^"), "force_projection": (RED, "^"),
    "augmented_lagrangian": (INK, "^"), "penalty": (TEAL, "^"), "compliant": (PURPLE, "^"),
    "tangent_space": (BLUE, "s"), "recursive": (RED, "s"),
    "index_2": (ORANGE, "D"), "index_3": (GREEN, "D"), "ggl": (PURPLE, "D"),
}  # fmt: skip
BEST, WORST = -16, 0  # log10 of the gaps that the colours tell apart
FAILED = "#22303c"


def draw(rows: list[dict[str, Any]], path: Path = PICTURE) -> Path:
    """A panel for each mechanism, and beneath them the drift at the finest step."""
    runs = [row for row in rows if row["what"] == "run"]
    titles = {row["mechanism"]: row["title"] for row in runs}
    columns, high = 2, -(-len(titles) // 2)
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(PAGE, 3 * high + 7.2), layout="constrained")
        grid = figure.add_gridspec(high + 1, columns, height_ratios=[1] * high + [2])
        handles: dict[str, Any] = {}
        for k, (name, title) in enumerate(titles.items()):
            axis = figure.add_subplot(grid[divmod(k, columns)])
            mine = [row for row in runs if row["mechanism"] == name]
            for key, line in work_precision(axis, mine).items():
                handles.setdefault(key, line)
            axis.set_title(title)
            axis.xaxis.set_minor_formatter(NullFormatter())
            if k % columns == 0:
                axis.set_ylabel("error of q and v at the end")
            axis.set_xlabel("us per second of motion")
        order = [key for key in LOOKS if key in handles]
        drift(figure.add_subplot(grid[high, :]), runs, titles, order)
        figure.legend([handles[key] for key in order], order, loc="outside lower center", ncols=4)
        figure.suptitle(
            "Formulations, f64, one core: error against cost. RK4: circles redundant, squares\n"
            "minimal, triangles unconstrained; diamonds Radau IIA",
            x=0.01, ha="left", fontsize=10,
        )  # fmt: skip
        save_chart(figure, path)
    return path


def work_precision(axis: Any, runs: list[dict[str, Any]]) -> dict[str, Any]:
    """A line for each formulation, of the runs that did not fail; those that always failed are
    named."""
    handles, lost = {}, []
    for key, (colour, marker) in LOOKS.items():
        mine = [row for row in runs if row["formulation"] == key]
        good = [row for row in mine if not row["failure"]]
        if mine and not good:
            lost.append(key)
        (handles[key],) = axis.loglog(
            [row["us_per_second"] for row in good], [max(row["error"], 1e-16) for row in good],
            color=colour, marker=marker, ms=4, lw=1.2,
        )  # fmt: skip
    if lost:
        axis.text(0.97, 0.97, "fails: " + ", ".join(lost), transform=axis.transAxes, ha="right",
                  va="top", fontsize=8)  # fmt: skip
    return handles


def drift(axis: Any, runs: list[dict[str, Any]], titles: dict[str, str], order: list[str]) -> None:
    """log10 of the largest gap of positions and of velocities, at the finest step that was run."""
    finest = max(row["rung"] for row in runs)
    scale, colours = Normalize(BEST, WORST), plt.get_cmap("YlGn_r")
    found = {(r["formulation"], r["mechanism"]): r for r in runs if r["rung"] == finest}
    for y, key in enumerate(order):
        for x, name in enumerate(titles):
            row = found.get((key, name))
            if row is None:
                continue
            fill: Any = FAILED
            text = row["failure"]
            if not text:
                logs = [np.log10(max(row[k], 1e-17)) for k in ("gap", "gap_rate")]
                fill, text = colours(scale(max(logs))), " | ".join(f"{x:.0f}" for x in logs)
            dark = row["failure"] or np.mean(fill[:3]) < 0.45
            axis.add_patch(
                Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=fill, edgecolor="white", lw=0.8)
            )
            axis.text(x, y, text, ha="center", va="center", fontsize=8.5,
                      color="white" if dark else INK)  # fmt: skip
    axis.set(xlim=(-0.5, len(titles) - 0.5), ylim=(len(order) - 0.5, -0.5))
    names = [textwrap.fill(title, 13) for title in titles.values()]
    axis.set_xticks(range(len(titles)), names, fontsize=8.5)
    axis.set_yticks(range(len(order)), order, fontsize=8.5)
    axis.tick_params(length=0)
    axis.grid(False)
    for side in axis.spines.values():
        side.set_visible(False)
    axis.set_title("Drift at the finest step: log10 of the largest residual of values | of rates")


if __name__ == "__main__":
    print(draw(saved("work-formulations-*.json")))
