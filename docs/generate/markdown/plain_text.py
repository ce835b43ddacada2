"""Plain text of docstrings as Markdown.

Docstrings are plain text: brackets, asterisks and angle brackets outside backticks are no markup.
Names of the reference in backticks become links.
"""

from __future__ import annotations

import re
from collections.abc import Collection

#: headings of sections that griffe knows by other names
SECTIONS = {"Example:": "Examples:", "Fields:": "Attributes:"}
FENCE = "```pycon"
#: headings of lists of parameters, and an entry for several of them
PARAMETERS = ("Args:", "Fields:", "Attributes:")
SEVERAL = re.compile(r"^( +)(\w+(?:, \w+)+): (.*)$")
#: marks of Markdown; an underscore inside a name is none
MARKS = re.compile(r"[*\[\]$]|(?<!\w)_|_(?!\w)")
CODE = re.compile(r"(``.+?``|`[^`]+`)", re.DOTALL)


def escaped(text: str) -> str:
    """Plain text as Markdown; what is in backticks stays."""
    parts = CODE.split(text)
    return "".join(p if p.startswith("`") else _plain(p) for p in parts)


def _plain(text: str) -> str:
    return MARKS.sub(r"\\\g<0>", text.replace("<", "&lt;"))


def linked(text: str, links: dict[str, str]) -> str:
    """Names in backticks, as `rb.rollout` or `rbjax.rollout`, as links to the reference."""

    def link(found: re.Match[str]) -> str:
        name = re.sub(r"^rb\.", "rbjax.", found[1])
        return f"[{found[0]}][{links[name]}]" if name in links else found[0]

    return re.sub(r"(?<![\[`])`((?:rb|rbjax)\.[\w.]+)(?:\([^`)]*\))?`(?![\]`])", link, text)


def with_fields(text: str, names: Collection[str]) -> str:
    """The docstring of a class whose paragraph "name: meaning" of its fields has a heading."""
    paragraphs = text.split("\n\n")
    for k, paragraph in enumerate(paragraphs):
        lines = paragraph.split("\n")
        entries = [re.match(r"(\w+(?:, \w+)*): ", line) for line in lines]
        found = [name for entry in entries if entry for name in entry[1].split(", ")]
        rest = (line for line, entry in zip(lines, entries, strict=True) if not entry)
        if found and set(found) <= set(names) and all(x.startswith("    ") for x in rest):
            paragraphs[k] = "\n".join(["Fields:", *(f"    {line}" for line in lines)])
    return "\n\n".join(paragraphs)


def markdown(text: str, links: dict[str, str]) -> str:
    """A docstring as Markdown: examples and indented blocks, as of tables, stay as they are."""
    text = re.sub(r"^( *)Example: (.*)$", r"\1Example:\n\1    \2\n", text, flags=re.MULTILINE)
    given = _with_one_name_each(_fenced(text.split("\n")))
    lines, example, section, fenced = [], None, False, False
    for line, following in zip(given, [*given[1:], ""], strict=True):
        bare = line.strip()
        if fenced or bare == FENCE:
            fenced ^= bare in (FENCE, "```")
            lines.append(line)
            continue
        indent = len(line) - len(line.lstrip())
        if bare in ("Example:", "Examples:"):
            example = indent
        elif example is not None and bare and indent <= example:
            example = None
        if bare and not indent:  # "Args:" opens a section, if its text follows at once
            section = bare.endswith(":") and following.startswith("    ")
        if bare in SECTIONS:
            lines.append(line.replace(bare, SECTIONS[bare]))
        elif example is not None or (indent >= 4 and not section):
            lines.append(line)
        else:
            lines.append(f"\0{line}")
    return _convert_runs(lines, links)


def _fenced(lines: list[str]) -> list[str]:
    """Fence the sessions of an interpreter that stand outside of a section of examples."""
    out: list[str] = []
    example: int | None = None  # indentation of the heading
    margin = ""
    inside = False
    for line in [*lines, ""]:
        bare = line.strip()
        indent = len(line) - len(line.lstrip())
        if bare in ("Example:", "Examples:"):
            example = indent
        elif example is not None and bare and indent <= example:
            example = None
        if inside and not bare:
            out.append(f"{margin}```")
            inside = False
        elif example is None and not inside and bare.startswith(">>> "):
            margin = line[:indent]
            out += ["", f"{margin}{FENCE}"]
            inside = True
        out.append(line)
    return out[:-1]


def _with_one_name_each(lines: list[str]) -> list[str]:
    """Give each of several parameters with one text, as in "x, y: numbers", its own entry."""
    out: list[str] = []
    section = None  # indentation of the heading of a list of parameters
    at = 0
    while at < len(lines):
        line = lines[at]
        indent = len(line) - len(line.lstrip())
        if line.strip() in PARAMETERS:
            section = indent
        elif section is not None and line.strip() and indent <= section:
            section = None
        found = SEVERAL.match(line) if section is not None and indent == section + 4 else None
        at += 1
        if not found:
            out.append(line)
            continue
        rest = []
        while at < len(lines) and lines[at].startswith(" " * (indent + 1)):
            rest.append(lines[at])
            at += 1
        for name in found[2].split(", "):
            out += [f"{found[1]}{name}: {found[3]}", *rest]
    return out


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
