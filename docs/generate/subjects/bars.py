"""Charts of bars and of dots on a logarithmic axis, as SVG for light and dark pages."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from docs.generate import measured
from docs.generate.figures import FIGURES

# rbjax/style.py has these, too: tests/docs/test_figures.py compares
PALETTE = ("#2a6fb0", "#e8832a", "#3d9a5f", "#7a5ba8", "#c8433f", "#2a9aa0")
INK, GRID = "#22303c", "#d9dee3"
WIDTH, LEFT, RIGHT, ROW, GAP, TOP = 720, 150, 84, 20, 10, 56
STYLE = (
    f"text{{font:13px system-ui,sans-serif;fill:{INK}}}.t{{font-weight:600;font-size:15px}}"
    f".a{{font-size:12px}}.g{{stroke:{GRID};stroke-width:1}}"
)


@dataclass(frozen=True)
class Bars:
    """Groups of bars, one colour a series: {group: {series: name of a figure}}."""

    title: str
    unit: str
    groups: dict[str, dict[str, str]]

    def svg(self) -> str:
        values = {
            group: {series: FIGURES[name] for series, name in one.items()}
            for group, one in self.groups.items()
        }
        numbers = [f.value() for one in values.values() for f in one.values()]
        axis = Axis.over(numbers, LEFT, WIDTH - RIGHT)
        series_of_all = dict.fromkeys(s for one in values.values() for s in one)
        colours = dict(zip(series_of_all, PALETTE, strict=False))
        out, y = [], float(TOP)
        for group, one in values.items():
            out.append(words(LEFT - 10, y + len(one) * ROW / 2 + 4, group, anchor="end"))
            for series, figure in one.items():
                x = axis.at(figure.value())
                shown = measured.text(figure.value(), figure.digits)
                out.append(box(LEFT, y + 2, x - LEFT, ROW - 4, colours[series]))
                out.append(words(x + 6, y + 15, shown))
                y += ROW
            y += GAP
        return page(self.title, self.unit, axis, out, y, colours)


@dataclass(frozen=True)
class Dots:
    """Every row of a results file as a dot in each series, sorted by the last series."""

    title: str
    unit: str
    file: str
    series: dict[str, str]
    height: int = 240

    def svg(self) -> str:
        keys = list(self.series.values())
        rows = [r for r in measured.rows(self.file) if all(r.get(k) for k in keys)]
        rows.sort(key=lambda row: row[keys[-1]])
        axis = Axis.over([row[k] for row in rows for k in keys], LEFT, WIDTH - RIGHT)
        colours = dict(zip(self.series, PALETTE, strict=False))
        out = []
        for i, row in enumerate(rows):
            y = TOP + (i + 0.5) * self.height / len(rows)
            for series, key in self.series.items():
                x, colour = axis.at(row[key]), colours[series]
                out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>')
        out.append(words(LEFT - 10, TOP + self.height / 2, f"{len(rows)} models", anchor="end"))
        return page(self.title, self.unit, axis, out, TOP + self.height, colours)


@dataclass(frozen=True)
class Axis:
    """A logarithmic axis from 10^low to 10^high between two places."""

    low: int
    high: int
    left: float
    right: float

    @classmethod
    def over(cls, numbers: Sequence[float], left: float, right: float) -> Axis:
        low, high = math.floor(math.log10(min(numbers)) - 0.15), math.ceil(math.log10(max(numbers)))
        return cls(low, max(high, low + 1), left, right)

    def at(self, value: float) -> float:
        share = (math.log10(value) - self.low) / (self.high - self.low)
        return self.left + share * (self.right - self.left)


def words(x: float, y: float, text: str, kind: str = "", anchor: str = "start") -> str:
    """Text at a place; `kind` is a class of STYLE."""
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text class="{kind}" {place}>{html.escape(text)}</text>'


def box(x: float, y: float, width: float, height: float, colour: str) -> str:
    """A filled rectangle."""
    size = f'width="{width:.1f}" height="{height:.1f}"'
    return f'<rect x="{x:.1f}" y="{y:.1f}" {size} rx="2" fill="{colour}"/>'


def page(
    title: str, unit: str, axis: Axis, body: list[str], bottom: float, colours: dict[str, str]
) -> str:
    """The whole file: title, legend, grid lines with their powers, body."""
    parts = [words(12, 20, title, "t")]
    for power in range(axis.low, axis.high + 1, math.ceil((axis.high - axis.low) / 7)):
        x = axis.at(10.0**power)
        ends = f'x1="{x:.1f}" x2="{x:.1f}" y1="{TOP - 4}" y2="{bottom:.0f}"'
        shown = measured.text(10.0**power, 1) if -3 <= power < 6 else f"1e{power}"
        parts += [f'<line class="g" {ends}/>', words(x, bottom + 16, shown, "a", "middle")]
    x = float(LEFT)
    for series, colour in colours.items():
        parts += [box(x, 31, 12, 12, colour), words(x + 17, 42, series)]
        x += 40 + 7.2 * len(series)
    parts += [*body, words((axis.left + axis.right) / 2, bottom + 34, unit, "a", "middle")]
    size = f'viewBox="0 0 {WIDTH} {bottom + 40:.0f}" width="{WIDTH}" height="{bottom + 40:.0f}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img"'
        f' aria-label="{html.escape(title)}"><style>{STYLE}</style>\n'
        + "\n".join(parts)
        + "</svg>\n"
    )
