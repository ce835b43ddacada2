"""Every file and name that `docs/books.md` gives for a book's section exists."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "books.md").read_text()
NAMED = sorted(set(re.findall(r"`([\w/]+\.py):([\w.]+)`", PAGE)))


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


@pytest.mark.parametrize(("file", "name"), NAMED, ids=lambda x: x)
def test_a_name_of_the_page_exists(file, name):
    body = ast.parse((ROOT / "rbjax" / file).read_text()).body
    for part in name.split("."):
        found = names_in(body)
        assert part in found, f"rbjax/{file} defines no {name}"
        node = found[part]
        body = node.body if isinstance(node, ast.ClassDef) else []


def test_every_row_names_code():
    rows = [line for line in PAGE.splitlines() if re.match(r"\| [\dA-D]", line)]
    assert len(rows) > 60
    without = [row for row in rows if not re.search(r"`[\w/]+\.py:\w", row)]
    assert not without, without
