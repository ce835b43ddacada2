"""Plain text of docstrings as Markdown.

Docstrings are plain text: brackets, asterisks and angle brackets outside backticks are no markup.
Names of the reference in backticks become links.
"""

from __future__ import annotations

import re

#: headings of sections that griffe knows by other names
SECTIONS = {"Example:": "Examples:", "Fields:": "Attributes:"}
#: marks of Markdown; an underscore inside a name is none
MARKS = re.compile(r"[<*\[\]$]|(?<!\w)_|_(?!\w)")
CODE = re.compile(r"(``.+?``|`[^`]+`)", re.DOTALL)


def escaped(text: str) -> str:
    """Plain text as Markdown; what is in backticks stays."""
    parts = CODE.split(text)
    return "".join(p if p.startswith("`") else MARKS.sub(r"\\\g<0>", p) for p in parts)


def linked(text: str, links: dict[str, str]) -> str:
    """Names in backticks, as `rb.rollout` or `rbjax.rollout`, as links to the reference."""

    def link(found: re.Match[str]) -> str:
        name = re.sub(r"^rb\.", "rbjax.", found[1])
        return f"[{found[0]}][{links[name]}]" if name in links else found[0]

    return re.sub(r"(?<![\[`])`((?:rb|rbjax)\.[\w.]+)(?:\([^`)]*\))?`(?![\]`])", link, text)


def markdown(text: str, links: dict[str, str]) -> str:
    """A docstring as Markdown: examples stay as they are."""
    lines, example = [], None
    for line in text.split("\n"):
        bare = line.strip()
        indent = len(line) - len(line.lstrip())
        if bare in ("Example:", "Examples:"):
            example = indent
        elif example is not None and bare and indent <= example:
            example = None
        if bare in SECTIONS:
            lines.append(line.replace(bare, SECTIONS[bare]))
        elif example is not None:
            lines.append(line)
        else:
            lines.append(f"\0{line}")
    return _convert_runs(lines, links)


def _convert_runs(lines: list[str], links: dict[str, str]) -> str:
    """Convert lines that begin with a mark, run by run, as backticks may span lines."""
    out: list[str] = []
    run: list[str] = []
    for line in [*lines, None]:
        if line is not None and line.startswith("\0"):
            run.append(line[1:])
            continue
        if run:
            text = linked(escaped("\n".join(run)), links)
            out += re.sub(r":\n(\s*- )", r":\n\n\1", text).split("\n")
            run = []
        if line is not None:
            out.append(line)
    return "\n".join(out)
