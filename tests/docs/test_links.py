"""Links of README and of the pages lead to a file or a heading, in sources and generated pages."""

import re
import unicodedata
from functools import cache
from pathlib import Path

import pytest

from docs.generate import tree
from tests.docs.pages import DOCS, PAGES, ROOT, name, prose

LINK = re.compile(
    r"!?\[(?:[^\]\[]|\[[^\]]*\])*\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)|(?:src|href)=\"([^\"]+)\""
)
EXPLICIT = re.compile(r"\{[^}]*#([\w.-]+)[^}]*\}|\bid=\"([\w.-]+)\"")


@cache
def made() -> dict[str, str]:
    """Text of generated pages, by path below docs/."""
    found = {}
    for generator in tree.generators():
        if generator not in tree.LAST:
            found |= tree.generated(generator, ROOT)
    return {path: x if isinstance(x, str) else "" for path, x in found.items()}


def anchor(heading: str) -> str:
    """The identifier that Python-Markdown gives a heading."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)|[`*]", r"\1", heading)
    plain = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())


def anchors(text: str) -> set[str]:
    """Identifiers of a page: headings, explicit ones, names of the reference."""
    found = {anchor(h) for h in re.findall(r"^#+ (.+?)(?:\s*\{.*\})?$", prose(text), re.MULTILINE)}
    found |= {a or b for a, b in EXPLICIT.findall(text)}
    return found | set(re.findall(r"^::: ([\w.]+)", text, re.MULTILINE))


def dead(page: Path, text: str) -> list[str]:
    """Links of a page that lead nowhere."""
    found = []
    for groups in LINK.findall(re.sub(r"`[^`\n]*`", "", prose(text))):
        link = groups[0] or groups[1]
        if re.match(r"[a-z]+:", link):
            continue
        path, _, heading = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        inside = target.is_relative_to(DOCS)
        if name(page).startswith("docs/") and not inside:
            found.append(link)  # the site has docs/ only
            continue
        below = target.relative_to(DOCS).as_posix() if inside else ""
        readme = page.name == "README.md"  # is read where no page is generated
        content = None if readme else made().get(below)
        if content is None and not target.exists():
            found.append(link)
        elif heading and target.suffix == ".md":
            content = target.read_text() if content is None else content
            if heading not in anchors(content):
                found.append(link)
    return found


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_of_a_page_resolve(page):
    assert not dead(page, page.read_text())


def test_links_of_generated_pages_resolve():
    found = {path: dead(DOCS / path, text) for path, text in made().items() if path.endswith(".md")}
    assert not {path: links for path, links in found.items() if links}


def test_every_page_has_a_title_and_a_tab():
    for page in PAGES[1:]:
        assert tree.title(page)
        folder = page.relative_to(DOCS).parts[0]
        known = {*tree.TABS, *(x for extras in tree.SECTIONS.values() for x in extras), "index.md"}
        assert folder in known, f"{name(page)}: name its folder in docs/generate/tree.py"
