"""The pages of the documentation: README and the Markdown files below docs/."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
#: a fenced block: its first line after the fence, and its text
FENCE = re.compile(r"^( *)```([^\n`]*)\n(.*?)^\1```[ \t]*$", re.DOTALL | re.MULTILINE)


def name(page: Path) -> str:
    """A page's path from the root of the repository."""
    return page.relative_to(ROOT).as_posix()


def blocks(text: str) -> list[str]:
    """Blocks of Python that run: fenced as "python", without ".no-run"."""
    return [
        code
        for _, info, code in FENCE.findall(text)
        if info.split("{")[0].strip() == "python" and ".no-run" not in info
    ]


def prose(text: str) -> str:
    """A page without its fenced blocks."""
    return FENCE.sub("", text)
