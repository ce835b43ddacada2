"""Chart of the error of beams against coordinates, for the elastica with P L^2 / EI = 10.

`python -m benchmarks.flexible.accuracy_chart` writes docs/guides/figures/flexible.png and prints
the rows. Most of its two minutes is compilation.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt

from benchmarks.flexible.beam_scenes import Entry, measure, references
from benchmarks.flexible.own_beams import own_beams
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, PURPLE, RED, STYLE, TEAL

FILE = Path(__file__).parents[2] / "docs" / "guides" / "figures" / "flexible.png"
#: numbers of segments, or of coordinates of strain coordinates
COUNTS = {"strain coordinates": (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12)}
OTHERS = (2, 4, 8, 16, 32)
LEFT_OUT = ("incremental",)
COLORS = (BLUE, TEAL, GREEN, ORANGE, RED, PURPLE, INK)


def points(entry: Entry) -> list[dict[str, Any]]:
    """Rows of a formulation at all of its numbers of segments, without those that fail."""
    rows = [measure(entry, "elastica", n, 1) for n in COUNTS.get(entry.name, OTHERS)]
    return [row for row in rows if row is not None and row["error"] is not None]


def draw(found: dict[str, list[dict[str, Any]]]) -> None:
    """Draw the chart and write it."""
    plt.rcParams.update(STYLE)
    figure, ax = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for (name, rows), color in zip(found.items(), COLORS, strict=False):
        x, y = [row["coordinates"] for row in rows], [row["error"] for row in rows]
        ax.loglog(x, y, "o-", ms=4, color=color, label=name)
    ax.set(
        xlabel="coordinates", ylabel="error of the tip / L", xticks=[1, 2, 4, 8, 16, 32, 64, 128]
    )
    ax.xaxis.set_major_formatter("{x:g}")
    ax.minorticks_off()
    ax.set_title("A cantilever bent by a tip load, P L$^2$ / EI = 10")
    ax.legend()
    figure.savefig(FILE, dpi=130)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    found = {}
    for entry in [*own_beams(), *references()]:
        if not any(word in entry.name for word in LEFT_OUT):
            found[entry.name] = points(entry)
            for row in found[entry.name]:
                print(
                    f"{row['formulation']:30} {row['coordinates']:4} {row['error']:.1e}", flush=True
                )
    draw(found)
