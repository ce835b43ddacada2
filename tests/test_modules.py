"""No function of a package hides a module of the package."""

import importlib
import pkgutil
import sys
from types import ModuleType

import pytest

import rbjax as rb

PACKAGES = ["rbjax"] + [x.name for x in pkgutil.walk_packages(rb.__path__, "rbjax.") if x.ispkg]


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
