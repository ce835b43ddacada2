"""Modules that share their name with a function of their package.

`rbjax.control.lqr` is a module, and also a function of `rbjax.control`. A package attribute has one
value. If that is the function, `import rbjax.control.lqr as k` gives the function. So the value is
the module, and a call of the module calls the function.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any


class CallableModule(ModuleType):
    """A module whose call calls `__wrapped__`, the function of the same name."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return vars(self)["__wrapped__"](*args, **kwargs)

    def __reduce__(self) -> Any:
        return importlib.import_module, (self.__name__,)


def make_modules_callable(package: str) -> None:
    """Replace each function of a package that hides a module of the package by that module. A call
    of the module then calls the function. Call this at the end of the package's `__init__`."""
    names = vars(sys.modules[package])
    for name, value in list(names.items()):
        module = sys.modules.get(f"{package}.{name}")
        if module is not None and value is not module and callable(value):
            vars(module)["__wrapped__"] = value
            module.__class__ = CallableModule
            names[name] = module
