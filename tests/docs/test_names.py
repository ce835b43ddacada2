"""Names, files and benchmarks that pages, programs and docstrings mention exist."""

import ast
import functools
import re

import pytest

import rbjax as rb
from tests.docs.pages import PAGES, ROOT, name


def names_in(body: list[ast.stmt]) -> dict[str, ast.stmt]:
    """What a module or a class defines: functions, classes, assigned names."""
    found: dict[str, ast.stmt] = {}
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {t.id: node for t in targets if isinstance(t, ast.Name)}
    return found


@functools.cache
def parsed(file: str) -> ast.Module | None:
    path = ROOT / "rbjax" / file
    return ast.parse(path.read_text()) if path.exists() else None


def defines(file: str, dotted: str) -> bool:
    """Whether a file below rbjax/ defines a name, or a class its attribute."""
    if (module := parsed(file)) is None:
        return False
    body = module.body
    for part in dotted.split("."):
        found = names_in(body)
        if part not in found:
            return False
        node = found[part]
        body = node.body if isinstance(node, ast.ClassDef) else []
    return True


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_names_and_files_of_a_page_exist(page):
    text = page.read_text()
    missing = set()
    for dotted in re.findall(r"\brb\.[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*", text):
        found = rb
        for part in dotted.split(".")[1:]:
            found = getattr(found, part, None)
        if found is None:
            missing.add(dotted)
    for file in re.findall(r"`((?:[a-z_0-9]+/)+[a-z_0-9]+\.py)`", text):
        if not (ROOT / file).exists() and not any((ROOT / "rbjax").rglob(file)):
            missing.add(file)
    for file, dotted in re.findall(r"`([\w/]+\.py):([A-Za-z_][\w.]*)`", text):
        if not defines(file, dotted):
            missing.add(f"{file}:{dotted}")
    assert not missing, f"{name(page)} names {sorted(missing)}"


def sources() -> dict[str, str]:
    """Text of every file that may name a benchmark or a page."""
    files = [ROOT / "Makefile", *ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    for folder in ("benchmarks", "docs/generate", "notebooks", "rbjax", "tests"):
        files += (ROOT / folder).rglob("*.py")
    return {name(file): file.read_text() for file in files}


def test_benchmarks_and_pages_that_are_named_exist():
    benchmarks, pages = set(), set()
    for file, text in sources().items():
        for module in re.findall(r"-m (benchmarks(?:\.[a-z_0-9]+)+)", text):
            benchmarks.add((file, module.replace(".", "/") + ".py"))
        if file not in ("CHANGELOG.md", "tests/docs/test_names.py"):
            for page in re.findall(r"\bdocs/[\w/-]+\.(?:md|png|webp|svg)\b", text):
                pages.add((file, page))
    assert len(benchmarks) > 20 and len(pages) > 20
    missing = [(file, path) for file, path in benchmarks | pages if not (ROOT / path).exists()]
    assert not missing


@pytest.mark.parametrize(
    ("page", "package", "pattern"),
    [
        ("from_mujoco", "mujoco", r"\b(mjd?_\w+)"),
        ("from_mjx", "mujoco.mjx", r"`mjx\.(\w+)"),
        ("from_pinocchio", "pinocchio", r"`pin\.(\w+)"),
    ],
)
def test_other_libraries_have_the_names_of_the_tables(page, package, pattern):
    library = pytest.importorskip(package)
    table = re.findall(r"^\|.*", (ROOT / "docs" / "start" / f"{page}.md").read_text(), re.M)
    named = set(re.findall(pattern, "\n".join(table)))
    assert len(named) > 7 and not {x for x in named if not hasattr(library, x)}
