"""The guides: their examples run, page by page, and the files that commands name exist."""

import re
from pathlib import Path

import pytest

import rbjax as rb

PAGES = [
    pytest.param("docs/contacts.md", marks=pytest.mark.slow),
    pytest.param("docs/environments.md", marks=pytest.mark.slow),
    pytest.param("docs/extending.md", marks=pytest.mark.slow),
    pytest.param("docs/flexible.md", marks=pytest.mark.slow),
    pytest.param("docs/viewer.md", marks=pytest.mark.slow),
    "docs/wheeled.md",
]


@pytest.mark.parametrize("page", PAGES)
def test_examples_run(page):
    text = (Path(__file__).parents[1] / page).read_text()
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert blocks
    scope: dict = {}
    for block in blocks:
        exec(compile(block, page, "exec"), scope)


def test_benchmarks_that_are_named_exist():
    root = Path(__file__).parents[1]
    pages = [root / "Makefile", *root.glob("*.md"), *root.glob("docs/*.md")]
    for folder in ("benchmarks", "notebooks", "rbjax", "tests"):
        pages += (root / folder).rglob("*.py")
    named = {
        (page.relative_to(root), name.replace(".", "/"))
        for page in pages
        for name in re.findall(r"-m (benchmarks(?:\.[a-z_0-9]+)+)", page.read_text())
    }
    assert len(named) > 20
    missing = [(page, name) for page, name in named if not (root / f"{name}.py").exists()]
    assert not missing


ROOT = Path(__file__).parents[1]
GUIDES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_names_and_files_of_a_page_exist(page):
    text = page.read_text()
    missing = set()
    for name in re.findall(r"\brb\.[A-Za-z_]+(?:\.[A-Za-z_]+)*", text):
        found = rb
        for part in name.split(".")[1:]:
            found = getattr(found, part, None)
        if found is None:
            missing.add(name)
    for file in re.findall(r"`((?:[a-z_0-9]+/)+[a-z_0-9]+\.py)`", text):
        if not (ROOT / file).exists() and not any((ROOT / "rbjax").rglob(file)):
            missing.add(file)
    assert not missing, f"{page.name} names {sorted(missing)}"
