"""The protocol of all recommendations: the choice, its cost, the candidates, the reason."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Recommendation:
    """A choice with its reason. Each kind of choice is a subclass, which adds its own fields.

    Fields:
        name: of the choice, in the registry of its kind.
        cost: what the choice minimises.
        candidates: a record of each candidate that was measured, with at least its `name`, its
            `cost`, and `ok`, whether it fulfils the request.
        reason: a sentence with the deciding number.
    """

    name: str
    cost: float
    candidates: tuple[Any, ...]
    reason: str

    def table(self) -> str:
        """The candidates as a table, one a line."""
        if not self.candidates:
            return "no candidate was measured"
        heads = [*self.candidates[0]._fields]
        heads += [] if "cost" in heads else ["cost"]
        rows = [heads, *([_shown(getattr(x, h)) for h in heads] for x in self.candidates)]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        return "\n".join(lines)

    def summary(self) -> str:
        """The reason and the table."""
        return f"{self.reason}\n\n{self.table()}"


def _shown(x: Any) -> str:
    return f"{x:.3g}" if isinstance(x, float) else str(x)
