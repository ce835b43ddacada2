"""The order of pages: that of the links of a folder's index, then by title."""

import re

from docs.generate import tree
from tests.docs.pages import DOCS


def write(folder, **pages):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages.items():
        (folder / f"{name}.md").write_text(text)


def test_pages_come_as_the_index_links_them(tmp_path):
    write(tmp_path / "start", index="# Start\n[b](b.md) [in](inner/x.md) ![p](figures/p.svg)\n",
          a="# A page\n", b="# `B`, the other\n", c="# Another\n")  # fmt: skip
    write(tmp_path / "start" / "inner", index="# Inner\n", x="# X\n")
    (tmp_path / "start" / "figures").mkdir()
    (tmp_path / "start" / "figures" / "p.svg").write_text("")
    assert tree.navigation(tmp_path) == [
        {"rbjax": "index.md"},
        {"Start": [
            "start/index.md",
            {"B, the other": "start/b.md"},
            {"Inner": ["start/inner/index.md", {"X": "start/inner/x.md"}]},
            {"A page": "start/a.md"},
            {"Another": "start/c.md"},
        ]},
    ]  # fmt: skip


def test_every_generator_is_found():
    names = tree.generators()
    assert {"reference.pages", "reference.command_line", "tasks.pages", "home"} <= set(names)
    assert names[-1] == "llms"


def test_every_page_is_linked_from_the_index_of_its_folder():
    missing = []
    for index in DOCS.rglob("index.md"):
        if index.parent in (DOCS, DOCS / "reference"):  # whose index is generated, or README
            continue
        links = set(re.findall(r"\]\(([\w./-]+)", index.read_text()))
        pages = {p.name for p in index.parent.glob("*.md")} - {"index.md"}
        missing += [str(index.parent / p) for p in pages if p not in links]
    assert not missing, "they would come last in the site: link them from index.md"
