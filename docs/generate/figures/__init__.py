"""Keeps the numbers that Markdown files type equal to benchmarks/results.

A number of a Markdown file names its figure in a comment behind it:

    Go1 walks at 73<!-- = gpu.contact.go1.rollout --> million steps a second.

`python -m docs.generate.figures` writes the present numbers into README.md and docs/; `--check`
lists the ones that differ, and `--list` prints every figure. tests/docs/test_figures.py checks.

- `kinds`: where a number may come from: a results file, a table, a registry, a test
- `gpu`, `one_core`, `accuracy`, `contact`, `constrained`, `wheels`, `flexible`, `control`,
  `identification`, `learning`, `held`: the figures by subject
"""

from __future__ import annotations

import re
from pathlib import Path

from docs.generate import measured
from docs.generate.figures import (
    accuracy,
    constrained,
    contact,
    control,
    flexible,
    gpu,
    held,
    identification,
    learning,
    one_core,
    wheels,
)
from docs.generate.figures.kinds import Figure

ROOT = measured.ROOT
TYPED = re.compile(r"(-?\d[\d.,e-]*)<!-- = ([\w.-]+) -->")
FIGURES: dict[str, Figure] = (
    gpu.FIGURES
    | one_core.FIGURES
    | accuracy.FIGURES
    | contact.FIGURES
    | constrained.FIGURES
    | wheels.FIGURES
    | flexible.FIGURES
    | control.FIGURES
    | identification.FIGURES
    | learning.FIGURES
    | held.FIGURES
)


def figure(name: str) -> str:
    """The figure of this name as text, such as "73"."""
    if name not in FIGURES:
        raise LookupError(
            f"no figure {name!r}; `python -m docs.generate.figures --list` prints the names"
        )
    found = FIGURES[name]
    return measured.text(found.value(), found.digits)


def renewed(markdown: str) -> str:
    """The text with the present number before each comment.

    >>> renewed("orders to 1<!-- = held.orders -->")
    'orders to 0.15<!-- = held.orders -->'
    """
    return TYPED.sub(lambda found: f"{figure(found[2])}<!-- = {found[2]} -->", markdown)


def files(root: Path = ROOT) -> list[Path]:
    """README.md and every Markdown file of docs/."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md"))]


def differing(root: Path = ROOT) -> list[str]:
    """Every number that differs from the results: file, typed, present."""
    return [
        f"{path.relative_to(root)}: {name} is {figure(name)}, the text has {typed}"
        for path in files(root)
        for typed, name in TYPED.findall(path.read_text())
        if typed != figure(name)
    ]
