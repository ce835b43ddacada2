"""Every notebook runs from its plain-text source, and its executed twin is of that source."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jupytext
import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "notebooks").glob("*.py"))
each_notebook = pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)


def code(notebook) -> list[str]:
    return [cell["source"].strip() for cell in notebook.cells if cell["cell_type"] == "code"]


@each_notebook
def test_runs_as_a_script(source, tmp_path):
    environment = os.environ | {"MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)}
    run = subprocess.run(
        [sys.executable, str(source)],
        cwd=tmp_path,  # a notebook may write files, but not into the repository
        env=environment,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr


@each_notebook
def test_has_an_executed_twin_with_pictures(source):
    twin = source.with_suffix(".ipynb")
    assert twin.exists(), "run `make notebooks`"
    outputs = [
        output
        for cell in json.loads(twin.read_text())["cells"]
        for output in cell.get("outputs", [])
    ]
    assert any(kind.startswith("image/") for o in outputs for kind in o.get("data", {}))
    assert code(jupytext.read(twin)) == code(jupytext.read(source)), "run `make notebooks`"
