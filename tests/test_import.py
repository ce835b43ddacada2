"""`import rbjax` imports little; the rest is imported on its first use, and works as if it had."""

import ast
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import rbjax as rb

#: packages that take long to import, and rooms that import them
HEAVY = """
    chex diffrax glfw lineax llvmlite.ir matplotlib mpmath mujoco optax optimistix PIL rich
    scipy.integrate scipy.interpolate scipy.optimize scipy.signal scipy.stats typer
    rbjax.body rbjax.constraints rbjax.control rbjax.forces rbjax.kinematics rbjax.loading
    rbjax.motion rbjax.planning rbjax.plotting rbjax.solvers rbjax.stability rbjax.sysid
    rbjax.wheeled
"""
CHILD = """
import sys
import jax.numpy
before = {*sys.modules}
import rbjax
heavy = {heavy!r}
print(sorted(name for name in heavy if name in sys.modules and name not in before))

# the first use of a room may be within a trace: its constants are no part of that
import jax, jax.numpy as jnp
def end(v):
    model = rbjax.load("cart_pole")
    return rbjax.rollout(model, model.default_state().replace(v=v), None, 0.01, steps=2).q[-1]
one = jax.jit(end)(jnp.ones(2))
assert jnp.abs(one - end(jnp.ones(2))).max() < 1e-6
import rbjax.control
assert rbjax.recommend.solver
"""


def test_heavy_packages_are_imported_on_use():
    child = subprocess.run(
        [sys.executable, "-c", CHILD.replace("{heavy!r}", repr(HEAVY.split()))],
        capture_output=True, text=True, cwd=Path(__file__).parents[1],
    )  # fmt: skip
    assert child.returncode == 0, child.stderr
    assert child.stdout.strip() == "[]"


def test_every_public_name_is_there_and_listed():
    assert {*rb.__all__} <= {*dir(rb)}
    for name in rb.__all__:
        assert getattr(rb, name) is getattr(rb, name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        rb.nothing  # noqa: B018


def test_dir_lists_the_public_names_only():
    """Without helpers, and without the modules that a room imports."""
    assert {*dir(rb)} == {*rb.__all__, "loading", "motion", "__version__"}
    packages = [m.name for m in pkgutil.walk_packages(rb.__path__, "rbjax.") if m.ispkg]
    rooms = [importlib.import_module(name) for name in packages]
    public = [
        x for x in rooms if hasattr(x, "__all__") and not x.__name__.endswith((".cli", ".demo"))
    ]
    assert len(public) > 30
    assert [x.__name__ for x in public if dir(x) != sorted(x.__all__)] == []


def test_tools_that_read_types_see_the_names_that_are_imported_on_use():
    """A type checker reads the imports under TYPE_CHECKING."""
    tree = ast.parse(Path(rb.__file__).read_text())
    block = next(n for n in tree.body if isinstance(n, ast.If))
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    typed = {a.name for n in block.body for a in n.names}
    from rbjax import _MODULES, _PACKAGES

    assert typed == {*_PACKAGES, *_MODULES}
