"""Tables of benchmarks/results as Markdown: which files, which rows, which columns.

A `Table` shows a row of the files as a line. A `Pivot` spreads one column's values over the columns
of the table, such as one column a robot. Below each stands where its numbers come from.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from docs.generate import measured
from docs.generate.measured import Row

SHOWN = 2  # lines of origin below a table; more are folded
DATA = "results"  # in the folder of the pages, on the site


#: how robots and engines are written
SPELLED = {
    "panda": "Panda",
    "g1": "G1",
    "go1": "Go1",
    "cassie": "Cassie",
    "humanoid_feet": "humanoid on two feet",
    "arm7": "7-joint arm",
    "indy7": "Indy7",
    "tree60": "tree of 60 hinges",
    "mjx": "MJX",
    "crocoddyl": "Crocoddyl",
}


def spelled(word: str) -> str:
    """A value of a file as a reader wants it: names of robots, blanks for underscores."""
    if word in SPELLED:
        return SPELLED[word]
    code = "." in word or word.startswith("mj_")
    return word.replace("|", ", ") if code else word.replace("|", ", ").replace("_", " ")


@dataclass(frozen=True)
class Column:
    """A column: the key of a row, or a function of a row; its title; digits; a factor."""

    of: str | Callable[[Row], Any]
    title: str | None = None
    digits: int = 3
    scale: float = 1.0

    def head(self) -> str:
        return self.of if self.title is None and isinstance(self.of, str) else self.title or ""

    def cell(self, row: Row) -> str:
        value = self.of(row) if callable(self.of) else row.get(self.of)
        if value is None:
            return "-"
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, int | float):
            return measured.text(value * self.scale if self.scale != 1 else value, self.digits)
        return spelled(str(value))


@dataclass(frozen=True)
class Table:
    """Rows of some results files.

    `files` are patterns. `where` chooses rows, by values of columns or by a function. `command`
    repeats the measurement, if the file does not name it itself. `optional` files may be absent.
    """

    files: tuple[str, ...]
    columns: tuple[Column, ...]
    command: str = ""
    where: dict[str, Any] | Callable[[Row], bool] = field(default_factory=dict)
    sort: Callable[[Row], Any] | None = None
    limit: int = 0
    optional: bool = False

    def names(self) -> list[str]:
        return matching(self.files, self.optional)

    def rows(self) -> list[Row]:
        """The chosen rows; each has its device as "on" and the name of its file as "file"."""
        found = []
        for name in self.names():
            device = measured.subject(name)[1]
            found += [{"on": device, "file": name} | row for row in measured.read(name)["rows"]]
        chosen = (
            [row for row in found if self.where(row)]
            if callable(self.where)
            else list(measured.select(found, **self.where))
        )
        if self.sort:
            chosen.sort(key=self.sort)
        return chosen[: self.limit] if self.limit else chosen

    def markdown(self) -> str:
        if not self.names():
            return f"Not measured yet: `{self.command}`."
        columns = self.columns
        lines = [[c.head() for c in columns]]
        lines += [[c.cell(row) for c in columns] for row in self.rows()]
        return grid(lines) + "\n\n" + origin(self.names(), self.command)


@dataclass(frozen=True)
class Pivot:
    """One value of the rows, spread over columns.

    A line for each value of `index`, a column for each value of `across`; `best` of several.
    """

    files: tuple[str, ...]
    index: tuple[Column, ...]
    across: str
    value: Column
    command: str = ""
    where: dict[str, Any] | Callable[[Row], bool] = field(default_factory=dict)
    best: Callable[[Iterable[float]], float] = max
    order: tuple[Any, ...] = ()
    optional: bool = False

    def names(self) -> list[str]:
        return matching(self.files, self.optional)

    def markdown(self) -> str:
        if not self.names():
            return f"Not measured yet: `{self.command}`."
        plain = Table(self.files, (), where=self.where)
        lines: dict[tuple[str, ...], dict[Any, list[float]]] = {}
        for row in plain.rows():
            one = self.value.of(row) if callable(self.value.of) else row.get(self.value.of)
            if one is not None:
                cells = lines.setdefault(tuple(c.cell(row) for c in self.index), {})
                cells.setdefault(row.get(self.across), []).append(one)
        seen = list(dict.fromkeys(key for cells in lines.values() for key in cells))
        heads = [key for key in self.order if key in seen] or seen
        out = [[c.head() for c in self.index] + [spelled(str(key)) for key in heads]]
        for label, cells in lines.items():
            out.append([*label, *(self._one(cells.get(key)) for key in heads)])
        unit = f"Each cell: {self.value.title}.\n\n" if self.value.title else ""
        return unit + grid(out) + "\n\n" + origin(self.names(), self.command)

    def _one(self, values: list[float] | None) -> str:
        if not values:
            return "-"
        return Column(lambda _: self.best(values), "", self.value.digits, self.value.scale).cell({})


def matching(patterns: Iterable[str], optional: bool = False) -> list[str]:
    """The names of the results files that match, in the order of the patterns. A pattern without a
    file is an error, unless the files are optional."""
    out: list[str] = []
    for pattern in patterns:
        found = fnmatch.filter(measured.names(), pattern)
        if not found and not optional:
            raise LookupError(f"no file of benchmarks/results matches {pattern!r}")
        out += [name for name in found if name not in out]
    return out


def grid(lines: list[list[str]]) -> str:
    """A Markdown table of the lines, the first its head.

    >>> print(grid([["robot", "us"], ["panda", "1.1"]]))
    | robot | us |
    | --- | --- |
    | panda | 1.1 |
    """
    dashes = ["---"] * len(lines[0])
    return "\n".join(f"| {' | '.join(line)} |" for line in [lines[0], dashes, *lines[1:]])


def origin(names: list[str], command: str = "") -> str:
    """Where numbers come from: device, versions, commit, date, command, and the file itself."""
    shared: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        found = measured.read(name)["provenance"]
        how = found.get("command") or command
        key = (measured.machine(name), measured.versions(name), measured.commit(name),
               str(found["date"])[:10], how)  # fmt: skip
        shared.setdefault(key, []).append(name)
    out = []
    for (machine, versions, commit, date, how), files in shared.items():
        links = ", ".join(f"[{name}.json]({DATA}/{name}.json)" for name in files)
        ran = f", `{how}`" if how else ""
        out.append(f"<small>{machine}; {versions}; commit {commit}; {date}{ran}. {links}</small>")
    if len(out) <= SHOWN:
        return "  \n".join(out)
    lines = "\n".join(f"- {line}" for line in out)
    return folded(f"data: {len(names)} files", lines)


def folded(title: str, text: str) -> str:
    """Text that opens on a click."""
    return f'<details markdown="1"><summary>{title}</summary>\n\n{text}\n\n</details>'
