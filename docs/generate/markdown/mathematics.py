"""Formulas as MathML, made when the site is built, so that a page needs no script to show them."""

from __future__ import annotations

import re
from functools import cache

from latex2mathml.converter import convert

DISPLAY = re.compile(r"^( *)\$\$(.+?)\$\$[ \t]*$", re.DOTALL | re.MULTILINE)
INLINE = re.compile(r"(?<![\\$\w])\$(?=[^\s$])([^$\n]*?[^\s$\\])\$(?![\w$])")
#: a matrix in square brackets, which the style sheet draws: a font may have none of its height
BRACKETS = re.compile(r"<mo>&#x0005B;</mo><mtable>((?:(?!<mtable>).)*?)</mtable><mo>&#x0005D;</mo>")
#: characters that Markdown would take as its own inside a formula
MARKS = str.maketrans({c: f"&#{ord(c)};" for c in "*_[]|`\\"})


def with_mathml(text: str) -> str:
    """Replace the formulas of a text: `$...$` in a line, and `$$...$$` on lines of their own."""
    text = DISPLAY.sub(lambda m: f'\n{m[1]}<div class="formula">{mathml(m[2], True)}</div>\n', text)
    # Markdown would take <math> at the start of a line as a block
    return INLINE.sub(lambda m: f"<span>{mathml(m[1], False)}</span>", text)


@cache
def mathml(latex: str, display: bool) -> str:
    """One formula as MathML."""
    # a bracket after a line break or at the beginning of a matrix is no option
    source = re.sub(r"(\\\\|\\begin\{\w+\}) *\[", r"\1{}[", " ".join(latex.split()))
    try:
        found = convert(source, display="block" if display else "inline")
    except Exception as error:
        raise ValueError(f"the formula {latex.strip()!r} cannot be read: {error!r}") from error
    if unknown := re.findall(r"\\\w+", found):
        raise ValueError(f"the formula {latex.strip()!r} has unknown commands: {unknown}")
    return BRACKETS.sub(r'<mtable class="bracketed">\1</mtable>', found).translate(MARKS)
