"""An executed notebook as Markdown: text, code, outputs and pictures."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

#: what a cell returns whose last line draws
OF_MATPLOTLIB = re.compile(r"[\[(]*(<matplotlib\.|Text\()|<Axes")
ANSI = re.compile(r"\x1b\[[0-9;]*m")
PICTURES = {"image/png": "png", "image/gif": "gif", "image/jpeg": "jpg", "image/webp": "webp"}
#: longer printed outputs are cut, in lines
LONGEST = 60


@dataclass
class Notebook:
    """An executed notebook: title, first paragraph, Markdown below the title, its files."""

    name: str
    title: str = ""
    first: str = ""
    body: list[str] = field(default_factory=list)
    files: dict[str, bytes] = field(default_factory=dict)
    pictures: list[str] = field(default_factory=list)
    seconds: float = 0.0
    date: str = ""


def read(path: Path) -> Notebook:
    """The notebook of a file; its pictures are named NAME-1.png and so on."""
    data = json.loads(path.read_text())
    out = Notebook(path.stem)
    heading = ""
    for cell in data["cells"]:
        source = "".join(cell["source"]).strip()
        if cell["cell_type"] == "markdown":
            if not out.title:
                title, _, source = source.partition("\n")
                out.title, source = title.removeprefix("# "), source.strip()
                out.first = " ".join(source.split("\n\n")[0].split())
            headings = re.findall(r"^#+ (.+)$", source, re.MULTILINE)
            heading = headings[-1] if headings else heading
            out.body.append(source)
        elif source:
            out.body.append(f"```python\n{source}\n```")
            out.body += outputs(cell["outputs"], out, heading or out.title)
    out.seconds, out.date = clock(data["cells"])
    return out


def outputs(found: list[dict[str, Any]], notebook: Notebook, heading: str) -> list[str]:
    """The outputs of a cell: printed text together, then pictures and pages in their order."""
    printed, shown = "", list[str]()
    for one in found:
        if one["output_type"] == "stream":
            printed += "".join(one["text"])
        elif one["output_type"] == "error":
            raise ValueError(f"{notebook.name}.ipynb has an error: {one['ename']}: {one['evalue']}")
        else:
            shown += filter(None, [display(one["data"], notebook, heading)])
    return ([fenced(printed)] if printed.strip() else []) + shown


def display(data: dict[str, Any], notebook: Notebook, heading: str) -> str:
    """One output that is not printed: a page, a picture, a table, or its text."""
    html = "".join(data.get("text/html", ""))
    if "<script" in html or "<html" in html:
        name = f"{notebook.name}-{len(notebook.files) + 1}.html"
        notebook.files[name] = html.encode()
        return frame(name, heading)
    for kind, suffix in PICTURES.items():
        if kind in data:
            name = f"{notebook.name}-{len(notebook.files) + 1}.{suffix}"
            notebook.files[name] = base64.b64decode("".join(data[kind]))
            notebook.pictures.append(name)
            return f"![{heading}]({name})"
    if html:
        return f"<div>{html}</div>"
    text = "".join(data.get("text/plain", ""))
    return "" if OF_MATPLOTLIB.match(text) else fenced(text)


def frame(name: str, title: str) -> str:
    """A page that plays inside the page; a link opens it alone. The page's address is a folder."""
    look = 'style="width:100%;height:430px"'
    return (
        f'<object type="text/html" data="../{name}" aria-label="{title}" {look}></object>'
        f"\n\n[open it alone]({name})"
    )


def fenced(text: str) -> str:
    """Printed text as a block, without colours, cut if it is long."""
    lines = ANSI.sub("", text).rstrip().splitlines()
    if len(lines) > LONGEST:
        lines = [*lines[:LONGEST], f"... {len(lines) - LONGEST} more lines"]
    return "```text\n" + "\n".join(lines) + "\n```"


def clock(cells: list[dict[str, Any]]) -> tuple[float, str]:
    """Seconds from the first cell's start to the last one's end, and the day, as recorded."""
    times = []
    for cell in cells:
        recorded = cell.get("metadata", {}).get("execution", {})
        times += [recorded[key] for key in ("iopub.execute_input", "shell.execute_reply")
                  if key in recorded]  # fmt: skip
    if not times:
        return 0.0, ""
    found = sorted(datetime.fromisoformat(time.replace("Z", "+00:00")) for time in times)
    return (found[-1] - found[0]).total_seconds(), str(found[0].date())
