"""Every notebook runs from its plain-text source, and its executed twin is of that source.

Most run only with the slow tests. Of every notebook the quick tests see that its names
and the arguments of its calls are those of rbjax, and that its executed twin is of this source.
"""

import ast
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import jupytext
import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "notebooks").glob("*.py"))
QUICK = ("first_hour",)
RUNS = [
    path if path.stem in QUICK else pytest.param(path, marks=pytest.mark.slow) for path in SOURCES
]


def name_of(path):
    return path.stem


each_notebook = pytest.mark.parametrize("source", SOURCES, ids=name_of)


def code(notebook) -> list[str]:
    return [cell["source"].strip() for cell in notebook.cells if cell["cell_type"] == "code"]


@pytest.mark.parametrize("source", RUNS, ids=name_of)
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


def faults(source: str) -> list[str]:
    """Names that an imported module or class lacks, and calls that do not fit a signature."""
    tree = ast.parse(source)
    nodes = list(ast.walk(tree))
    scope: dict = {}
    imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    exec(compile(ast.Module(imports, []), "imports", "exec"), scope)
    for node in tree.body:  # `lab = rb.stability`
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Attribute):
            target = ast.unparse(node.targets[0])
            if inspect.ismodule(found := resolved(node.value, scope)):
                scope[target] = found
    found = []
    for node in nodes:
        at = f"line {getattr(node, 'lineno', 0)}"
        try:
            if isinstance(node, ast.Attribute):
                resolved(node, scope)
            elif isinstance(node, ast.Call) and callable(f := resolved(node.func, scope)):
                spread = any(isinstance(a, ast.Starred) for a in node.args)
                named = [k.arg for k in node.keywords]
                if not spread and None not in named:
                    inspect.signature(f).bind(*node.args, **dict.fromkeys(map(str, named)))
        except (AttributeError, TypeError) as error:
            found.append(f"{at}: {ast.unparse(node)}: {error}")
        except ValueError:  # written in C: no signature
            continue
    return found


def resolved(node: ast.expr, scope: dict):
    """What a dotted name is, as far as it goes through modules and classes; else None."""
    if isinstance(node, ast.Name):
        return scope.get(node.id)
    if not isinstance(node, ast.Attribute):
        return None
    above = resolved(node.value, scope)
    return getattr(above, node.attr) if inspect.ismodule(above) or inspect.isclass(above) else None


@each_notebook
def test_names_and_arguments_fit(source):
    assert not faults(source.read_text())


def test_what_does_not_fit_is_found():
    start = "import rbjax as rb\nlab = rb.stability\n"
    right = "lab.scenes(); rb.rollout(1, 2, None, 0.1, steps=3); x = rb.State(1, 2).q"
    assert not faults(start + right)
    for wrong in ("lab.nothing()", "rb.forces.Nothing", "rb.rollout(1, 2, stepz=3)", "rb.load()"):
        assert faults(start + wrong), wrong


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
