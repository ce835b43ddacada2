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
    """Blocks of Python that run with the others: fenced as "python", without ".slow"."""
    return [code for _, info, code in FENCE.findall(text) if is_program(info)]


def is_program(info: str) -> bool:
    return info.split("{")[0].strip() == "python" and ".slow" not in info


def programs(text: str) -> list[tuple[str, str | None]]:
    """The blocks that run, each with the text that the page says it prints, or None."""
    found: list[tuple[str, str | None]] = []
    end = 0
    for match in FENCE.finditer(text):
        _, info, code = match.groups()
        if info.strip() == "text" and found and not text[end : match.start()].strip():
            found[-1] = (found[-1][0], code)
        elif is_program(info):
            found.append((code, None))
        end = match.end()
    return found


def prose(text: str) -> str:
    """A page without its fenced blocks."""
    return FENCE.sub("", text)
