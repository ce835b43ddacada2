"""llms.txt, a list of links for language models, and llms-full.txt, the text of all pages.

They are made from the tree that the other generators have filled (https://llmstxt.org).
"""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from docs.generate import tree
from docs.generate.reference import rooms

#: largest sizes in bytes
SMALL, LARGE = 10_000, 1_000_000
#: folders in llms-full.txt, the most useful first; pages that do not fit are left out, with a note
FULL = ("start", "howto", "guides", "develop", "tutorials", "tasks", "theory", "benchmarks")
#: folders whose pages llms.txt lists one by one
LISTED = ("start", "howto", "guides", "tutorials")


def pages(root: Path) -> tree.Pages:
    """The two files, from .cache/docs."""
    out = root / ".cache" / "docs"
    return {"llms.txt": short(out), "llms-full.txt": full(out)}


def address(page: Path, out: Path) -> str:
    """A page's address in the site."""
    path = page.relative_to(out).as_posix().removesuffix(".md")
    return path.removesuffix("index").rstrip("/") + "/"


def summary(page: Path) -> str:
    """The first sentence below the title."""
    text = re.sub(r"\A.*?^# [^\n]*\n", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    paragraph = " ".join(text.strip().split("\n\n")[0].split())
    paragraph = re.sub(r"\[([^\]]*)\](\([^)]*\)|\[[^\]]*\])", r"\1", paragraph)
    sentence = re.split(r"(?<=[.!?]) ", paragraph)[0]
    return sentence if not sentence.startswith(("|", "```", "!", "<", "-", ":::")) else ""


def short(out: Path) -> str:
    """Links to pages by tab, with a sentence each where there is room."""
    head = [
        "# rbjax", "",
        "> Differentiable rigid-body dynamics in JAX: a robot file goes in; fast, accurate, "
        "differentiable motion comes out, in a batch of one or of a million.", "",
        "The text of the pages, and the signatures of all public names: llms-full.txt",
    ]  # fmt: skip
    for length in (90, 60, 40, 0):
        text = "\n".join([*head, *(line for tab in tree.TABS for line in _tab(tab, out, length))])
        if len(text.encode()) <= SMALL:
            return text + "\n"
    raise ValueError(f"llms.txt has more than {SMALL} bytes; list fewer pages")


def _tab(tab: str, out: Path, length: int) -> list[str]:
    lines = ["", f"## {tree.TABS[tab]}", ""]
    for folder in (tab, *tree.SECTIONS.get(tab, ())):
        found = sorted((out / folder).rglob("*.md"), key=lambda p: (p.name != "index.md", p))
        if folder not in LISTED:
            found = [p for p in found if p.name == "index.md" or tab == "reference"][:40]
        for page in found:
            text = summary(page) if length else ""
            text = f": {text[:length].rsplit(' ', 1)[0]}" if len(text) > length else f": {text}"
            line = f"- [{tree.title(page)}]({address(page, out)})"
            lines.append(line + (text if text.strip(": ") else ""))
    return lines if len(lines) > 3 else []


def full(out: Path) -> str:
    """The text of all pages but the reference's, as many as fit, and the public names."""
    names = signatures()
    parts, size, left = [], len(names.encode()), []
    for folder in FULL:
        for page in sorted((out / folder).rglob("*.md")):
            text = f"<!-- {address(page, out)} -->\n\n{plain(page.read_text())}\n\n"
            if size + len(text.encode()) > LARGE - 10_000:
                left.append(address(page, out))
                continue
            parts.append(text)
            size += len(text.encode())
    note = [f"Pages that are left out: {', '.join(left)}\n\n"] if left else []
    return "".join(["# rbjax\n\n", *parts, *note, names])


def signatures() -> str:
    """Every public name with its signature and its first sentence."""
    lines = ["# Public names", ""]
    for room in rooms.all_rooms():
        for entry in rooms.entries(room):
            if entry.home != entry.path or entry.kind == "module":
                continue
            try:
                parameters = inspect.signature(entry.value).parameters.values()
            except (TypeError, ValueError):
                parameters = ()
            call = ", ".join(p.name if p.default is p.empty else f"{p.name}=" for p in parameters)
            shown = f"({call})" if entry.kind == "object" else ""
            lines.append(f"- `{entry.path}{shown}`: {entry.summary}")
    return "\n".join([*lines, ""])


def plain(text: str) -> str:
    """A page without pictures and with the sources of its formulas."""
    text = re.sub(r"!\[([^\]]*)\]\([^)]*\)", r"[picture: \1]", text)
    return re.sub(r"\[([^\]]*)\]\[rbjax[^\]]*\]", r"\1", text)
