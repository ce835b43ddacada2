"""Pages as the site generator reads them: formulas as MathML, names as links to the reference."""

from __future__ import annotations

import re

from docs.generate.mathematics import with_mathml
from docs.generate.plain_text import linked

FENCE = re.compile(r"^( *)(```+|~~~+)([^\n]*)\n.*?^\1\2[ \t]*$", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"(``.+?``|`[^`\n]+`)")
HEADING = re.compile(r"^#+ .*$", re.MULTILINE)


def convert(text: str, links: dict[str, str]) -> str:
    """Convert a page outside its fenced blocks."""
    out, end = [], 0
    for fence in FENCE.finditer(text):
        out += [_prose(text[end : fence.start()], links), _fence(fence[0])]
        end = fence.end()
    return "".join([*out, _prose(text[end:], links)])


def _fence(block: str) -> str:
    """A block that does not run is shown as any other."""
    return re.sub(r"^( *```)python \{.*\}", r"\1python", block)


def _prose(text: str, links: dict[str, str]) -> str:
    """Formulas outside code; names in code as links, except in headings."""
    kept: list[str] = []

    def keep(found: re.Match[str]) -> str:
        kept.append(found[0])
        return f"\0{len(kept) - 1}\0"

    text = with_mathml(CODE.sub(keep, text))
    text = re.sub(r"\0(\d+)\0", lambda m: kept[int(m[1])], text)
    out, end = [], 0
    for heading in HEADING.finditer(text):
        out += [linked(text[end : heading.start()], links), heading[0]]
        end = heading.end()
    return "".join([*out, linked(text[end:], links)])
