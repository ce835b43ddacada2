"""The order of pages: that of the links of a folder's index, then by title."""

from docs.generate import tree


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
    assert {"reference", "registries", "command_line", "home", "style_sheet"} <= set(names)
    assert names[-1] == "llms"
