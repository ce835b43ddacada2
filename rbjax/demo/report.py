"""The demo's report: sections of words, a table and pictures, as Markdown and as one HTML file."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Section:
    """A part of the report: title, paragraphs, pictures (file, caption), a table, its seconds."""

    title: str
    text: tuple[str, ...]
    pictures: tuple[tuple[str, str], ...] = ()
    columns: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    note: str = ""
    code: str = ""
    seconds: float = field(default=0.0)


def write(folder: Path, title: str, lead: str, sections: Sequence[Section], footer: str) -> Path:
    """report.md beside the pictures, report.html with the pictures inside; returns the latter."""
    (folder / "report.md").write_text(_markdown(title, lead, sections, footer))
    path = folder / "report.html"
    path.write_text(_html(folder, title, lead, sections, footer))
    return path


def _markdown(title: str, lead: str, sections: Sequence[Section], footer: str) -> str:
    out = [f"# {title}", lead]
    for s in sections:
        out += [f"## {s.title}", *s.text]
        if s.code:
            out.append(f"```python\n{s.code}\n```")
        out += [f"![{caption}]({name})" for name, caption in s.pictures]
        if s.columns:
            lines = [s.columns, ("---",) * len(s.columns), *s.rows]
            out.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
        if s.note:
            out.append(f"*{s.note}*")
    return "\n\n".join([*out, "---", footer]) + "\n"


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


def _html(folder: Path, title: str, lead: str, sections: Sequence[Section], footer: str) -> str:
    e = html.escape
    out = [
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{e(title)}</title>',
        f'<meta name="viewport" content="width=device-width"><style>{_CSS}</style></head><body>',
        f'<h1>{e(title)}</h1><p class="lead">{e(lead)}</p>',
    ]
    for s in sections:
        out.append(f"<h2>{e(s.title)}</h2>")
        out += [f"<p>{e(paragraph)}</p>" for paragraph in s.text]
        if s.code:
            out.append(f"<pre><code>{e(s.code)}</code></pre>")
        for name, caption in s.pictures:
            data = base64.b64encode((folder / name).read_bytes()).decode()
            out.append(f'<figure><img alt="{e(caption)}" src="data:image/png;base64,{data}">')
            out.append(f"<figcaption>{e(caption)}</figcaption></figure>")
        if s.columns:
            head = "".join(f"<th>{e(c)}</th>" for c in s.columns)
            body = "".join(
                "<tr>" + "".join(f"<td>{e(c)}</td>" for c in row) + "</tr>" for row in s.rows
            )
            out.append(f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>')
        if s.note:
            out.append(f'<p class="note">{e(s.note)}</p>')
    out.append(f"<footer>{e(footer)}</footer></body></html>")
    return "\n".join(out) + "\n"
