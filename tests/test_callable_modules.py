"""No function of a package hides a module of the package, and both can be used."""

import importlib
import inspect
import pickle
import pkgutil
import sys
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.callable_modules import CallableModule, make_modules_callable

PACKAGES = ["rbjax"] + [
    x.name for x in pkgutil.walk_packages(rb.__path__, "rbjax.") if x.ispkg
]  # fmt: skip


@pytest.mark.parametrize("package", PACKAGES)
def test_import_as_gives_the_module(package: str) -> None:
    """Of each module of each package, by the statement that a user writes."""
    room = importlib.import_module(package)
    for module in pkgutil.iter_modules(room.__path__):
        if module.name.startswith("__"):
            continue
        scope: dict = {}
        exec(f"import {package}.{module.name} as found", scope)
        assert isinstance(scope["found"], ModuleType), module.name
        assert scope["found"] is sys.modules[f"{package}.{module.name}"]


def test_the_module_is_called_as_the_function() -> None:
    import rbjax.control.linear.regulators as k

    assert rb.control.lqr is k
    assert pickle.loads(pickle.dumps(k)) is k
    assert list(inspect.signature(rb.control.lqr).parameters)[:2] == ["A", "B"]


def test_the_module_is_transformed_as_the_function() -> None:
    A, B, Q, R = (jnp.eye(2) * x for x in (0.1, 1.0, 1.0, 1.0))
    lqr = rb.control.lqr
    assert isinstance(lqr, CallableModule)
    one = lqr(A, B, Q, R)
    many = jax.vmap(jax.jit(lqr), (0, None, None, None))(A[None], B, Q, R)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
        np.testing.assert_allclose(x, y[0], rtol=1e-12)


def test_other_names_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """A function without a module of its name, a module, and a number."""
    room, inner = ModuleType("room"), ModuleType("room.f")
    vars(room).update(f=lambda x: 2 * x, g=abs, inner=inner, n=3)
    monkeypatch.setitem(sys.modules, "room", room)
    monkeypatch.setitem(sys.modules, "room.f", inner)
    make_modules_callable("room")
    make_modules_callable("room")  # a second time changes nothing
    assert room.f is inner and room.f(2) == 4  # type: ignore[operator]
    assert room.g is abs and room.n == 3 and room.inner is inner
