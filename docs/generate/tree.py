"""The tree of the site: sources of docs/, generated pages, and the order of pages.

A folder's `index.md` gives the order: pages come in the order of its links, the others after them
by title. A generator is a file of this folder, or of a folder inside, with a function
`pages(root)`, which returns the text or the bytes of each file that it makes, by path below docs/.
"""

from __future__ import annotations

import importlib
import re
import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
#: files of docs/ that are not part of the site
LEFT_OUT = ("generate",)
#: titles of the tabs, by folder
TABS = {
    "start": "Start",
    "tutorials": "Tutorials",
    "howto": "How-to",
    "reference": "Reference",
    "theory": "Theory",
    "benchmarks": "Benchmarks",
    "develop": "Develop",
}
#: folders that are sections of a tab, after the tab's own pages
SECTIONS = {"howto": ("guides", "tasks"), "tutorials": ("animations",)}
#: generators that read the pages of the others
LAST = ("llms",)  # they read what the others have written
MAKES_PAGES = re.compile(r"^def pages\(root", re.MULTILINE)

Pages = dict[str, str | bytes]


def generators() -> list[str]:
    """Names of the generators, in the order in which they run."""
    here = Path(__file__).parent
    files = (p for p in sorted(here.rglob("*.py")) if MAKES_PAGES.search(p.read_text()))
    found = [".".join(p.relative_to(here).with_suffix("").parts) for p in files]
    return [n for n in found if n not in LAST] + [n for n in LAST if n in found]


def generated(name: str, root: Path) -> Pages:
    """The files that one generator makes."""
    return importlib.import_module(f"docs.generate.{name}").pages(root)


def copy_sources(root: Path, out: Path) -> None:
    """Copy docs/ to an empty folder, without its list of folders: README is the home page."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(root / "docs", out, ignore=shutil.ignore_patterns(*LEFT_OUT, "__pycache__"))
    (out / "index.md").unlink()


def write(pages: Pages, out: Path) -> None:
    """Write generated files; a file that exists is an error, as two files would share a page."""
    for path, text in pages.items():
        file = out / path
        if file.exists():
            raise FileExistsError(f"docs/{path} exists, and a generator makes a page of this name")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(text if isinstance(text, bytes) else text.encode())


def title(page: Path) -> str:
    """A page's first heading, without marks of code."""
    found = re.search(r"^# (.+)$", page.read_text(), re.MULTILINE)
    if found is None:
        raise ValueError(f"{page}: a page begins with a line '# Title'")
    return re.sub(r"[`*]|\s*\{.*\}$", "", found[1])


def ordered(folder: Path) -> list[Path]:
    """Pages and folders of a folder: as its index.md links them, then by title."""
    index = folder / "index.md"
    text = index.read_text() if index.exists() else ""
    links = [m.split("#")[0] for m in re.findall(r"\]\(([^)\s]+)\)", text)]
    first: list[Path] = []
    for link in links:
        target = (folder / link).resolve()
        if not target.is_relative_to(folder.resolve()) or target == index.resolve():
            continue
        entry = folder / target.relative_to(folder.resolve()).parts[0]
        if _has_pages(entry) and entry not in first:
            first.append(entry)
    rest = [p for p in folder.iterdir() if _has_pages(p) and p != index and p not in first]
    return first + sorted(rest, key=_sort_key)


def _has_pages(entry: Path) -> bool:
    return (entry.is_file() and entry.suffix == ".md") or any(entry.rglob("*.md"))


def _sort_key(entry: Path) -> str:
    page = entry / "index.md" if entry.is_dir() else entry
    return title(page).lower() if page.exists() else entry.name


def section(folder: Path, out: Path) -> list[Any]:
    """The entries of a folder, as a site's `nav` has them."""
    entries: list[Any] = []
    if (folder / "index.md").exists():
        entries.append((folder / "index.md").relative_to(out).as_posix())
    for entry in ordered(folder):
        if entry.is_dir():
            index = entry / "index.md"
            name = title(index) if index.exists() else entry.name.replace("_", " ").capitalize()
            entries.append({name: section(entry, out)})
        else:
            entries.append({title(entry): entry.relative_to(out).as_posix()})
    return entries


def navigation(out: Path) -> list[Any]:
    """The tabs and their pages. A folder that belongs to no tab is an error."""
    tabs: list[Any] = [{"rbjax": "index.md"}]
    for folder, name in TABS.items():
        entries = section(out / folder, out) if (out / folder).exists() else []
        for extra in SECTIONS.get(folder, ()):
            if any((out / extra).rglob("*.md")):
                index = out / extra / "index.md"
                heading = title(index) if index.exists() else extra.capitalize()
                entries.append({heading: section(out / extra, out)})
        if entries:
            tabs.append({name: entries})
    known = {*TABS, *(x for extras in SECTIONS.values() for x in extras)}
    strays = [p.name for p in out.iterdir() if any(p.rglob("*.md")) and p.name not in known]
    if strays:
        raise ValueError(f"folders of docs/ without a tab: {strays}; name them in {__file__}")
    return tabs
