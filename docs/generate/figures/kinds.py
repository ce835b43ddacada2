"""Kinds of figures: where a number comes from, and with how many digits it is written."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from docs.generate import measured


class Figure(Protocol):
    """A number of the pages."""

    digits: int

    def value(self) -> float: ...


@dataclass(frozen=True)
class Number:
    """The best value of a column, or of a function of a row, among some rows of a results file."""

    file: str
    column: str | Callable[[measured.Row], float]
    where: dict[str, Any] = field(default_factory=dict)
    best: Any = max
    scale: float = 1.0
    digits: int = 3

    def value(self) -> float:
        if isinstance(self.column, str):
            found = measured.number(self.file, self.column, self.best, **self.where)
        else:
            found = self.best([self.column(row) for row in measured.rows(self.file, **self.where)])
        return self.scale * found


@dataclass(frozen=True)
class Ratio:
    """One figure over another."""

    of: Figure
    over: Figure
    digits: int = 3

    def value(self) -> float:
        return self.of.value() / self.over.value()


@dataclass(frozen=True)
class Rate:
    """Millions a second of a figure in microseconds."""

    of: Figure
    digits: int = 2

    def value(self) -> float:
        return 1 / self.of.value()


@dataclass(frozen=True)
class Count:
    """The number of different values of a column."""

    file: str
    column: str
    where: dict[str, Any] = field(default_factory=dict)
    digits: int = 0

    def value(self) -> int:
        return len({row[self.column] for row in measured.rows(self.file, **self.where)})


@dataclass(frozen=True)
class Rows:
    """The number of rows that a function accepts."""

    file: str
    accepts: Callable[[measured.Row], bool]
    digits: int = 0

    def value(self) -> int:
        return sum(map(self.accepts, measured.rows(self.file)))


@dataclass(frozen=True)
class Entries:
    """The number of entries of a registry, such as "solvers.all"."""

    registry: str
    digits: int = 0

    def value(self) -> int:
        module, function = self.registry.rsplit(".", 1)
        return len(getattr(importlib.import_module(f"rbjax.{module}"), function)())


@dataclass(frozen=True)
class Held:
    """The tolerance of a test: the number, or the name of tests/tolerances.py, behind a text."""

    test: str
    text: str
    digits: int = 1

    def value(self) -> float:
        source = (measured.ROOT / "tests" / self.test).read_text()
        found = re.search(re.escape(self.text) + r"([A-Z]\w+|[\d.e_-]*\d)", source)
        if not found:
            raise LookupError(f"tests/{self.test} has no number behind {self.text!r}")
        word = found[1]
        return float(_tolerances()[word] if word[0].isalpha() else word)


@dataclass(frozen=True)
class Cell:
    """A number in a table of a page: in the row that begins with these cells, below this head."""

    page: str
    row: tuple[str, ...]
    head: str
    digits: int = 3

    def value(self) -> float:
        text = (measured.ROOT / "docs" / self.page).read_text()
        heads: list[str] = []
        for line in text.splitlines():
            cells = [cell.strip() for cell in line.strip("|").split("|")] if "|" in line else []
            if not cells:
                heads = []
            elif not heads:
                heads = cells
            elif tuple(cells[: len(self.row)]) == self.row and self.head in heads:
                return float(cells[heads.index(self.head)].split()[0].replace(",", ""))
        raise LookupError(f"docs/{self.page} has no row {self.row} with {self.head!r}")


def _tolerances() -> dict[str, float]:
    """The constants of tests/tolerances.py, without an import."""
    body = ast.parse((measured.ROOT / "tests" / "tolerances.py").read_text()).body
    return {
        node.targets[0].id: node.value.value
        for node in body
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and isinstance(node.value, ast.Constant)
    }
