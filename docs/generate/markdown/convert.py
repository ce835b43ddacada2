"""Pages as the site generator reads them: formulas as MathML, names as links to the reference."""

from __future__ import annotations

import os
import re

from docs.generate.markdown.mathematics import with_mathml
from docs.generate.markdown.plain_text import linked

FENCE = re.compile(r"^( *)(```+|~~~+)([^\n]*)\n.*?^\1\2[ \t]*$", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"(``.+?``|`[^`\n]+`)")
#: a page that is named by its path in the repository
FILES = re.compile(r"(?<![\[`])`docs/((?:develop|guides|theory|benchmarks|start)/[\w/-]+\.md)`")
HEADING = re.compile(r"^#+ .*$", re.MULTILINE)


def convert(text: str, links: dict[str, str], path: str = "index.md") -> str:
    """Convert a page outside its fenced blocks. path: of the page, below docs/."""
    out, end = [], 0
    for fence in FENCE.finditer(text):
        out += [_prose(text[end : fence.start()], links, path), _fence(fence[0])]
        end = fence.end()
    return "".join([*out, _prose(text[end:], links, path)])


def _fence(block: str) -> str:
    """A block that does not run is shown as any other."""
    return re.sub(r"^( *```)python \{.*\}", r"\1python", block)


def _prose(text: str, links: dict[str, str], path: str) -> str:
    """Formulas outside code; names and pages in code as links, except in headings."""
    kept: list[str] = []

    def keep(found: re.Match[str]) -> str:
        kept.append(found[0])
        return f"\0{len(kept) - 1}\0"

    text = with_mathml(CODE.sub(keep, text))
    text = re.sub(r"\0(\d+)\0", lambda m: kept[int(m[1])], text)
    text = FILES.sub(lambda m: f"[{m[0]}]({os.path.relpath(m[1], os.path.dirname(path))})", text)
    out, end = [], 0
    for heading in HEADING.finditer(text):
        out += [linked(text[end : heading.start()], links), heading[0]]
        end = heading.end()
    return "".join([*out, linked(text[end:], links)])
