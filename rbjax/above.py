"""Names of a package that are defined in a module which imports the package.

`rbjax.solvers.recommend` simulates motions, so its module imports `rbjax.solvers`. The top package
registers an import function for each of these names before any of these packages is imported. The
`__getattr__` of each package calls it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

_names: dict[str, dict[str, Callable[[], Any]]] = defaultdict(dict)


def names_from_above(package: str) -> dict[str, Callable[[], Any]]:
    """The table of a package: name -> function that imports it."""
    return _names[package]
