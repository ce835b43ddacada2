"""The result of a comparison: a row for each quantity, a column for each engine and precision."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from rbjax.optional import require

if TYPE_CHECKING:
    from rich.table import Table

from rbjax.display import Display, displayed, plural

#: columns, in order; all are compared with MuJoCo C in f64
COLUMNS = ("rbjax f64", "rbjax f32", "MJX f64", "MJX f32")


@dataclass(frozen=True)
class Error:
    """Relative errors over the states: the median and the worst."""

    median: float
    worst: float


@displayed
@dataclass(frozen=True)
class ReportRow:
    """A quantity, with its errors and the largest allowed errors of rbjax.

    Fields:
        quantity: name of the quantity.
        errors: column -> `Error`, relative.
        tolerances: column -> largest allowed error.
    """

    quantity: str
    errors: dict[str, Error]
    tolerances: dict[str, float]

    def passes(self, column: str) -> bool:
        """Return whether a column is within tolerance, or has none. nan never passes."""
        if column not in self.tolerances or column not in self.errors:
            return True
        return bool(self.errors[column].worst <= self.tolerances[column])


@displayed
@dataclass(frozen=True)
class Report:
    """A comparison with MuJoCo C.

    Fields:
        model: name of the robot.
        states: the number of states.
        seconds: the length of the trajectory.
        rows: one for each quantity.
        switched_off: features disabled on both sides.
        notes: limits of the comparison.

    Example:
        >>> report = Report("pendulum", 1, 1.0, (), ())
        >>> report.success
        True
    """

    model: str
    states: int
    seconds: float
    rows: tuple[ReportRow, ...]
    switched_off: tuple[str, ...]
    notes: tuple[str, ...] = field(default=())

    def _display_(self) -> Display:
        result = "within tolerances" if self.success else "out of tolerances"
        title = f"Report: {self.model!r}, {plural(self.states, 'state')}, {result}"
        rows = [
            (
                r.quantity,
                *(f"{r.errors[c].worst:.1e}" if c in r.errors else "-" for c in self.columns),
            )
            for r in self.rows
        ]
        return Display(title, rows, ("worst error", *self.columns))

    @property
    def success(self) -> bool:
        """True if every rbjax column is within its tolerances."""
        return all(row.passes(column) for row in self.rows for column in row.tolerances)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns that were measured."""
        return tuple(c for c in COLUMNS if any(c in row.errors for row in self.rows))

    def row(self, quantity: str) -> ReportRow:
        """Return the row of a quantity."""
        return next(row for row in self.rows if row.quantity == quantity)

    def table(self) -> Table:
        """Make a rich table of the worst errors; out of tolerance in red."""
        caption = f"Worst relative error over {self.states} states against MuJoCo C in f64."
        if self.switched_off:
            caption += f"\nSwitched off on both sides: {'; '.join(self.switched_off)}."
        for note in self.notes:
            caption += f"\n{note}"
        rich = require("Report.table", "rich.table", "use to_dict()")
        table = rich.Table(title=self.model, caption=caption, caption_justify="left")
        table.add_column("quantity")
        for column in self.columns:
            table.add_column(column, justify="right")
        for row in self.rows:
            table.add_row(row.quantity, *(self._cell(row, column) for column in self.columns))
        return table

    def _cell(self, row: ReportRow, column: str) -> str:
        if column not in row.errors:
            return "-"
        text = f"{row.errors[column].worst:.1e}"
        if row.passes(column):
            return f"[green]{text}[/]" if column in row.tolerances else text
        return f"[bold red]{text} > {row.tolerances[column]:.0e}[/]"

    def to_dict(self) -> dict[str, Any]:
        """Convert the report to a dict, for JSON."""
        return {
            "model": self.model,
            "success": self.success,
            "states": self.states,
            "seconds": self.seconds,
            "switched_off": list(self.switched_off),
            "notes": list(self.notes),
            "rows": [
                {
                    "quantity": row.quantity,
                    "tolerances": row.tolerances,
                    "errors": {c: [e.median, e.worst] for c, e in row.errors.items()},
                }
                for row in self.rows
            ],
        }


def relative(actual: np.ndarray, expected: np.ndarray, floor: float = 1e-3) -> Error:
    """Compute the relative errors of samples (first axis): their median and the worst one.

    The error of a sample is the largest deviation over its largest entry, or over `floor` if that
    is larger.
    """
    axes = tuple(range(1, expected.ndim))
    deviation = np.abs(actual - expected).max(axes, initial=0.0)
    size = np.maximum(np.abs(expected).max(axes, initial=0.0), floor)
    errors = deviation / size
    return Error(float(np.median(errors)), float(errors.max(initial=0.0)))
