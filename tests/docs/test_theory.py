"""Every section that `docs/theory/index.md` lists for a book is on a page of that book."""

import re

import pytest

from tests.docs.pages import DOCS, prose

#: the heading of a book on the index, and the folder of its pages
BOOKS = {
    "Olguín Díaz": "olguin_diaz", "Lynch & Park": "lynch_park", "Cai Zixing": "cai",
    "Masarati": "masarati", "Featherstone": "featherstone",
}  # fmt: skip
THERE = [book for book, folder in BOOKS.items() if (DOCS / "theory" / folder).is_dir()]


def numbers(cell: str) -> list[str]:
    """Section numbers of a cell such as "3.1, 3.2" or "5.4.1 to 5.4.3"."""
    found = []
    for part in cell.split(","):
        first, _, last = part.strip().partition(" to ")
        found.append(first)
        if last:
            stem, _, end = last.rpartition(".")
            start = int(first.rpartition(".")[2]) + 1
            found += [f"{stem}.{k}" if stem else str(k) for k in range(start, int(end) + 1)]
    return found


def sections(book: str) -> list[str]:
    """Section numbers of a book on the index."""
    index = (DOCS / "theory" / "index.md").read_text()
    part = next((p for p in re.split(r"^## ", index, flags=re.M) if p.startswith(book)), "")
    return [n for row in re.findall(r"^\| ([\dA-D][^|]*) \|", part, re.M) for n in numbers(row)]


@pytest.mark.parametrize("book", THERE)
def test_every_section_is_on_a_page(book):
    pages = [prose(p.read_text()) for p in (DOCS / "theory" / BOOKS[book]).glob("*.md")]
    headings = re.findall(r"^#+ .*|\*\*.*?\*\*", "\n".join(pages), re.M)
    listed = sections(book)
    assert listed
    missing = [n for n in listed if not any(n in numbers_in(h) for h in headings)]
    assert not missing, f"{book}: no page has the sections {missing}"


def numbers_in(heading: str) -> set[str]:
    """Numbers of sections in a heading: those it has, and those between "8.1 to 8.3"."""
    found = set(re.findall(r"(?<![\w.])(?:\d+(?:\.\d+)*|[A-D])(?![\w.]*\w)", heading))
    for first, last in re.findall(r"(\d[\d.]*\d|\d) to (\d[\d.]*\d|\d)", heading):
        found |= set(numbers(f"{first} to {last}"))
    return found


@pytest.mark.parametrize("book", THERE)
def test_every_page_has_a_figure_that_it_draws(book):
    for page in sorted((DOCS / "theory" / BOOKS[book]).glob("*.md")):
        text = page.read_text()
        drawn = set(re.findall(r'savefig\("(figures/[\w.]+)"', text))
        shown = set(re.findall(r"!\[[^\]]+\]\((figures/[\w.]+)\)", text))
        assert page.stem == "index" or drawn, page
        assert drawn == shown, page
        for figure in shown:
            assert (page.parent / figure).stat().st_size < 60_000, figure
