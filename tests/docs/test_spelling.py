"""Common misspellings (codespell) in pages, docstrings and programs, and the length of README."""

import subprocess
import sys

import pytest

from tests.docs.pages import ROOT


def test_spelling():
    pytest.importorskip("codespell_lib", reason="pip install 'rbjax[test]'")
    command = [sys.executable, "-m", "codespell_lib"]  # pyproject.toml has its options
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr


def test_readme_is_short():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 150
    first = next(i for i, line in enumerate(lines) if line.startswith("```python"))
    picture = next(i for i, line in enumerate(lines) if "![" in line or "<img" in line)
    assert max(first, picture) < 40
