"""The types that a user's type checker sees."""

import importlib
import inspect
import pkgutil
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import rbjax as rb
from tests.package import users_arrays

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
#: lines with errors: an unknown name, a missing argument, a state as an array
WRONG = """
    rb.nothing
    rb.mass_matrix(model)
    rb.mass_matrix(model, state)
"""


@pytest.mark.slow
def test_users_scripts_pass_mypy_strict(tmp_path: Path) -> None:
    """As for an installed package: errors inside rbjax do not count, and wrong calls are errors."""
    (tmp_path / "script.py").write_text((HERE / "users_script.py").read_text() + WRONG)
    (tmp_path / "arrays.py").write_text((HERE / "users_arrays.py").read_text())
    (tmp_path / "mypy.ini").write_text(
        "[mypy]\nstrict = true\n[mypy-rbjax.*]\nignore_errors = true\n"
        "[mypy-chex.*,mujoco.*,llvmlite.*,optax.*,scipy.*,mpmath.*]\n"
        "ignore_missing_imports = true\n"
    )
    child = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", "mypy.ini", "--cache-dir",
         str(ROOT / ".mypy_cache" / "users_script"), "script.py", "arrays.py"],
        capture_output=True, text=True, cwd=tmp_path, env={"MYPYPATH": str(ROOT), "PATH": ""},
    )  # fmt: skip
    found = child.stdout.splitlines()
    here = [x for x in found if x.startswith("script.py")]
    wrong = ["[attr-defined]", "[call-arg]", "[arg-type]"]
    assert [x.partition("  ")[2] for x in here] == wrong, child.stdout
    assert len(found) == 4, child.stdout + child.stderr


@pytest.mark.slow
def test_numpy_arrays_and_lists_are_converted() -> None:
    users_arrays.motion()
    users_arrays.dynamics()
    users_arrays.geometry()


def functions() -> Iterator[tuple[str, Any]]:
    """Every public function, and every public method of public classes."""
    packages = (m for m in pkgutil.walk_packages(rb.__path__, "rbjax.") if m.ispkg)
    names = ["rbjax", *(m.name for m in packages if m.name not in ("rbjax.cli", "rbjax.demo"))]
    for room in map(importlib.import_module, names):
        for name in getattr(room, "__all__", ()):
            x = getattr(room, name)
            if not inspect.isclass(x):
                yield f"{room.__name__}.{name}", x
            # the methods of solvers are of diffrax and optimistix
            elif x.__module__.startswith("rbjax.") and "rbjax.solvers" not in x.__module__:
                for method, value in vars(x).items():
                    if not method.startswith("_"):
                        yield f"{room.__name__}.{name}.{method}", value


def test_public_functions_have_types() -> None:
    found, count = [], 0
    for name, value in functions():
        f = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
        f = inspect.unwrap(f) if callable(f) else f
        if not isinstance(f, types.FunctionType):
            continue
        count += 1
        code = f.__code__
        various = bool(code.co_flags & inspect.CO_VARARGS) + bool(
            code.co_flags & inspect.CO_VARKEYWORDS
        )
        total = code.co_argcount + code.co_kwonlyargcount + various
        arguments = {*code.co_varnames[:total]} - {"self", "cls"}
        if missing := (arguments | {"return"}) - f.__annotations__.keys():
            found.append((name, sorted(missing)))
    assert count > 1000
    assert not found
