"""`python -m docs.generate.check FOLDER`: links, pictures and addresses of a built site.

Every link and picture leads to a file, every fragment to an element, and nothing is loaded from
another host. Exit code 1 and a list if not.
"""

from __future__ import annotations

import html
import os
import re
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: tags, with those of their attributes that matter here
TAG = re.compile(r"<(a|link|script|img|iframe|source|video)\b([^>]*)>")
ATTRIBUTE = re.compile(r'\b(href|src|rel)="([^"]*)"')
NAMED = re.compile(r'\s(?:id|name)="([^"]*)"')
#: pages that the theme makes, whose links are from the root of a host
OWN = ("404.html",)


@dataclass(frozen=True)
class Page:
    """The identifiers, links and loaded resources of a page."""

    ids: frozenset[str]
    links: tuple[str, ...]
    loaded: tuple[str, ...]


@cache
def page(file: Path) -> Page:
    text = file.read_text()
    links, loaded = [], []
    for tag, rest in TAG.findall(text):
        given = {name: html.unescape(value) for name, value in ATTRIBUTE.findall(rest)}
        if tag == "a":
            links.append(given.get("href", ""))
        elif tag != "link" or given.get("rel") in ("stylesheet", "icon", "preload"):
            loaded.append(given.get("href" if tag == "link" else "src", ""))
    ids = frozenset(html.unescape(name) for name in NAMED.findall(text))
    return Page(ids, tuple(filter(None, links)), tuple(filter(None, loaded)))


@cache
def target(folder: Path, path: str, site: Path) -> Path | None:
    """The file of a link's path on a page in a folder; None if there is none."""
    found = site / path.lstrip("/") if path.startswith("/") else folder / unquote(path)
    found = Path(os.path.normpath(found))
    found = found / "index.html" if found.is_dir() else found
    return found if found.exists() else None


def has(file: Path, fragment: str) -> bool:
    """Whether a page has the element of a link's fragment."""
    return not fragment or fragment in page(file).ids


def faults(site: Path) -> list[str]:
    """A line for each dead link, and for each resource of another host."""
    found = []
    for file in sorted(site.rglob("*.html")):
        name = file.relative_to(site).as_posix()
        if name in OWN:
            continue
        for link in dict.fromkeys([*page(file).links, *page(file).loaded]):
            parts = urlsplit(link)
            if parts.scheme in ("http", "https") or parts.netloc:
                if link in page(file).loaded:
                    found.append(f"{name}: loads {link}")
                continue
            if parts.scheme:
                continue
            goal = target(file.parent, parts.path, site) if parts.path else file
            if goal is None:
                found.append(f"{name}: {link}: no such file")
            elif goal.suffix == ".html" and not has(goal, unquote(parts.fragment)):
                found.append(f"{name}: {link}: no such heading")
    return found


def main() -> None:
    site = Path(sys.argv[1])
    if found := faults(site):
        print(*found, f"{len(found)} faults", sep="\n")
        sys.exit(1)
    print(f"{len(list(site.rglob('*.html')))} pages, no dead link")


if __name__ == "__main__":
    main()
