"""Packages that rbjax does not require: every module can be imported without them, and a call that
needs one names the extra that installs it."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import rbjax as rb
from rbjax.optional import EXTRAS, require

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
#: rooms that are imported only if their extra is installed
REQUIRING = ("rbjax/cli/", "rbjax/demo/")


def names(requirements: list[str]) -> set[str]:
    """The names of requirements, with those of the extras of rbjax that they name."""
    found = set()
    for one in requirements:
        match = re.match(r"([\w.-]+)(?:\[([\w,]+)\])?", one)
        assert match
        if match[1] == "rbjax":
            for extra in match[2].split(","):
                found |= names(PROJECT["optional-dependencies"][extra])
        else:
            found.add(match[1].lower())
    return found


def test_extras_install_the_packages() -> None:
    dependencies = {
        "rsl": {"torch", "tensordict"},  # by rsl-rl-lib
        "envs": {"orbax-checkpoint"},  # by brax
    }
    for name, extra in EXTRAS.values():
        installed = names(PROJECT["optional-dependencies"][extra])
        assert name in installed | dependencies.get(extra, set()), (name, extra)
        assert name not in names(PROJECT["dependencies"])


def imported_with_the_module(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """The imports of a file outside of functions and of `if TYPE_CHECKING:`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        elif not isinstance(node, ast.FunctionDef | ast.Lambda):
            yield from imported_with_the_module(node)


def test_no_module_imports_an_optional_package() -> None:
    found = []
    candidate = re.compile(rf"^\s*(import|from) ({'|'.join(EXTRAS)})\b", re.MULTILINE)
    for path in sorted((ROOT / "rbjax").rglob("*.py")):
        file = path.relative_to(ROOT).as_posix()
        if file.startswith(REQUIRING) or not candidate.search(path.read_text()):
            continue
        for node in imported_with_the_module(ast.parse(path.read_text())):
            whole = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module]
            found += [(file, x) for x in whole if x and x.partition(".")[0] in EXTRAS]
    assert not found, "import these in the functions that need them, by rbjax.optional.require"


CHILD = """
import importlib, pkgutil, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing!r}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
import jax.numpy as jnp
import rbjax as rb

for module in pkgutil.walk_packages(rb.__path__, "rbjax."):
    if not module.name.startswith(("rbjax.cli", "rbjax.demo")):
        importlib.import_module(module.name)

# main functions need none of them
model = rb.load("double_pendulum")
state = rb.State(jnp.ones(2), jnp.zeros(2))
run = rb.rollout(model, state, None, 0.01, steps=5)
assert rb.validation.compare("pendulum", states=2, mjx=False, seconds=0.02, gradient=False).success
rb.plotting.animate(model, run, {folder!r} + "/a.html", source="double_pendulum")
print(rb.recommend.solver(model, state, 0.1).name)

for call in (
    lambda: rb.plotting.draw(model, state.q),
    lambda: rb.plotting.animate(model, run, {folder!r} + "/a.gif"),
    lambda: rb.stability.linear_analysis("rk4"),
    lambda: rb.viewer.view(model),
    lambda: rb.validation.compare("pendulum", states=2, mjx=False, seconds=0.02).table(),
    lambda: rb.planning.OccupancyGrid.from_ros({folder!r} + "/map.yaml"),
    lambda: rb.envs.adapters.to_gymnasium(rb.envs.make("cart_pole_balance")),
):
    try:
        call()
    except rb.MissingPackage as error:
        print(error)

from rbjax.__main__ import main
main()
"""


@pytest.mark.slow
def test_without_any_of_them(tmp_path: Path) -> None:
    (tmp_path / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.6\n"
        "free_thresh: 0.2\n"
    )
    (tmp_path / "map.pgm").write_bytes(b"P5 1 1 255\n0")
    code = CHILD.replace("{missing!r}", repr({*EXTRAS, "cycler"}))
    code = code.replace("{folder!r}", repr(str(tmp_path)))
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert child.returncode == 2, child.stderr
    solver, *sentences = child.stdout.splitlines()
    assert solver and (tmp_path / "a.html").exists()
    extras = [re.search(r"pip install 'rbjax\[(\w+)\]'", x)[1] for x in sentences]  # type: ignore[index]
    assert extras == ["plots", "plots", "stability", "viewer", "cli", "plots", "envs"]
    assert child.stderr.splitlines()[-1].endswith("pip install 'rbjax[cli]'")


def test_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(rb.MissingPackage, match=r"view: .* viser .* 'rbjax\[viewer\]', or "):
        require("view", "viser", "wait")
    assert issubclass(rb.MissingPackage, ImportError)


def test_an_error_inside_of_a_package_is_not_hidden(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "viser.py").write_text("import a_package_that_viser_needs")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "viser", raising=False)
    with pytest.raises(ModuleNotFoundError, match="a_package_that_viser_needs") as found:
        require("view", "viser")
    assert not isinstance(found.value, rb.MissingPackage)
