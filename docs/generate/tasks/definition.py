"""The definition of a task: docstrings as paragraphs, lists, tables and formulas.

In a docstring, an indented line with two blanks between words is a row of a table: a term and its
formula. An indented line that begins with a dash is an item of a list. Other indented lines are
formulas.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterator
from itertools import groupby

from docs.generate.markdown.plain_text import escaped
from docs.generate.markdown.table import table

ITEM = re.compile(r"^ +- ")
ROW = re.compile(r"^ +\w+(?: \w+)* {2,}\S")
#: the title of a publication, with its asterisks escaped
TITLE = re.compile(r"\\\*([A-Z][^*\\]+)\\\*")
#: sections of a docstring that other parts of the page have
ELSEWHERE = ("Args:", "Example:", "sparse:", "touch:", "speed:", "orientation:")


def definition(make: Callable) -> list[str]:
    """The docstring of the file of a task, and what the task's own adds, as Markdown."""
    shared, own = (inspect.cleandoc(x.__doc__ or "") for x in (sys.modules[make.__module__], make))
    shared, source = without_source(shared)
    own, own_source = without_source(own)
    paragraphs = [*shared.split("\n\n")[1:], *own.split("\n\n")[1:]]
    kept = [p for p in paragraphs if not p.startswith(ELSEWHERE)]
    if "\n" in shared.split("\n\n")[0]:
        kept.insert(0, shared.split("\n\n")[0].partition("\n")[2])
    found = own_source or source
    return [*(b for p in kept for b in blocks(p)), *([f"Source: {found}"] if found else [])]


def without_source(text: str) -> tuple[str, str]:
    """A docstring without its paragraph "Source: ...", and that paragraph in one line."""
    found = re.search(r"\n\nSource: (.*?)(?=\n\n|$)", text, re.DOTALL)
    if found is None:
        return text, ""
    return text.replace(found[0], ""), " ".join(found[1].split())


def blocks(paragraph: str) -> Iterator[str]:
    """The text, the lists, the tables and the formulas of a paragraph."""
    lines = paragraph.split("\n")
    for indented, run in groupby(lines, key=lambda line: line.startswith("  ")):
        part = list(run)
        if not indented:
            yield TITLE.sub(r"*\1*", escaped(" ".join(part)))
        elif ITEM.match(part[0]):
            yield "\n".join(f"- {escaped(item)}" for item in joined(part, ITEM))
        elif ROW.match(part[0]):
            cells = (re.split(r" {2,}", line, maxsplit=1) for line in joined(part, ROW))
            yield table(("", ""), [(f"`{a}`", escaped(b)) for a, b in cells])
        else:
            yield "```text\n" + "\n".join(line.strip() for line in part) + "\n```"


def joined(lines: list[str], begin: re.Pattern) -> Iterator[str]:
    """The items of a list or table, each with its lines of continuation."""
    margin = len(lines[0]) - len(lines[0].lstrip())
    item = ""
    for line in lines:
        if line[margin:].startswith(" ") or not begin.match(line):
            item += " " + line.strip()
            continue
        if item:
            yield item
        item = line.strip().removeprefix("- ")
    yield item
