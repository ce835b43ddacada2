"""HTML pages in one file: headings, paragraphs, tables and pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence

_CSS = """
body { font: 16px/1.55 system-ui, "Segoe UI", Helvetica, Arial, sans-serif; color: #22303c;
  max-width: 62rem; margin: 3rem auto; padding: 0 1.5rem; background: #fff; }
h1 { font-size: 2.1rem; line-height: 1.2; margin-bottom: .3rem; }
h2 { margin-top: 3rem; padding-top: 1rem; border-top: 1px solid #d9dee3; }
.lead { font-size: 1.15rem; color: #4a5a68; }
figure { margin: 1.5rem 0; } figure img { width: 100%; height: auto; }
figcaption, .note, footer { font-size: .88rem; color: #5d6b78; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; }
th { text-align: left; border-bottom: 2px solid #22303c; padding: .35rem .8rem .35rem 0; }
td { border-bottom: 1px solid #e6eaee; padding: .35rem .8rem .35rem 0; white-space: nowrap; }
pre { background: #f4f6f8; padding: .9rem 1.1rem; border-radius: 6px; overflow-x: auto; }
code { font: 13.5px/1.5 ui-monospace, Menlo, Consolas, monospace; }
footer { margin-top: 3rem; border-top: 1px solid #d9dee3; padding-top: 1rem; }
"""


def page(title: str, lead: str, body: Sequence[str], footer: str) -> str:
    """Format a page. The parts of its body are HTML, the other arguments plain text.

    Example:
        >>> from rbjax.html_page import page, table
        >>> "<td>1 &lt; 2</td>" in page("Sums", "", [table(["true"], [["1 < 2"]])], "")
        True
    """
    e = html.escape
    return "\n".join([
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{e(title)}</title>',
        f'<meta name="viewport" content="width=device-width"><style>{_CSS}</style></head><body>',
        f'<h1>{e(title)}</h1><p class="lead">{e(lead)}</p>',
        *body,
        f"<footer>{e(footer)}</footer></body></html>",
        "",
    ])  # fmt: skip


def element(tag: str, words: str, kind: str = "") -> str:
    """Format text within a tag."""
    attribute = f' class="{kind}"' if kind else ""
    return f"<{tag}{attribute}>{html.escape(words)}</{tag}>"


def link(to: str, words: str) -> str:
    """Format a paragraph with a link to a file in the same folder."""
    return f'<p><a href="{html.escape(to)}">{html.escape(words)}</a></p>'


def code(text: str) -> str:
    """Format preformatted code."""
    return f"<pre><code>{html.escape(text)}</code></pre>"


def listed(items: Sequence[str]) -> str:
    """Format a bulleted list."""
    return f"<ul>{''.join(element('li', item) for item in items)}</ul>"


def table(columns: Sequence[str], rows: Sequence[Sequence[str]], style: str = "") -> str:
    """Format a table that scrolls on narrow pages. style: CSS of each cell, for other pages."""
    cells = f' style="{style}"' if style else ""

    def line(tag: str, row: Sequence[str]) -> str:
        return f"<tr>{''.join(f'<{tag}{cells}>{html.escape(x)}</{tag}>' for x in row)}</tr>"

    head = line("th", columns) if columns or not style else ""
    body = "".join(line("td", row) for row in rows)
    return f'<div class="scroll"><table>{head}{body}</table></div>'


def picture(png: bytes, caption: str) -> str:
    """Format a picture with its caption below."""
    data, words = base64.b64encode(png).decode(), html.escape(caption)
    return (
        f'<figure><img alt="{words}" src="data:image/png;base64,{data}">\n'
        f"<figcaption>{words}</figcaption></figure>"
    )
