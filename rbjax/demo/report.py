"""The demo's report: sections of text, tables and pictures, as Markdown and as one HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rbjax.html_page import code, element, link, page, picture, table


@dataclass(frozen=True)
class ReportSection:
    """A part of the report."""

    title: str
    text: tuple[str, ...]  # paragraphs
    pictures: tuple[tuple[str, str], ...] = ()  # (file, caption) of each
    columns: tuple[str, ...] = ()  # of a table
    rows: tuple[tuple[str, ...], ...] = ()
    note: str = ""  # below the table
    code: str = ""  # an example
    links: tuple[tuple[str, str], ...] = ()  # (file in the same folder, description) of each
    seconds: float = field(default=0.0)  # the computing time


def write(
    folder: Path, title: str, lead: str, sections: Sequence[ReportSection], footer: str
) -> Path:
    """Write report.md, and report.html with embedded pictures. Return the path of report.html."""
    (folder / "report.md").write_text(_markdown(title, lead, sections, footer))
    path = folder / "report.html"
    path.write_text(_html(folder, title, lead, sections, footer))
    return path


def _markdown(title: str, lead: str, sections: Sequence[ReportSection], footer: str) -> str:
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
        out += [f"[{words}]({name})" for name, words in s.links]
    return "\n\n".join([*out, "---", footer]) + "\n"


def _html(
    folder: Path, title: str, lead: str, sections: Sequence[ReportSection], footer: str
) -> str:
    body: list[str] = []
    for s in sections:
        body.append(element("h2", s.title))
        body += [element("p", paragraph) for paragraph in s.text]
        if s.code:
            body.append(code(s.code))
        body += [picture((folder / name).read_bytes(), caption) for name, caption in s.pictures]
        if s.columns:
            body.append(table(s.columns, s.rows))
        if s.note:
            body.append(element("p", s.note, "note"))
        body += [link(name, words) for name, words in s.links]
    return page(title, lead, body, footer)
