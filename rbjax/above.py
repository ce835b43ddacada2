"""Names that a package offers although a module above it, which imports it, defines them.

`rbjax.solvers.recommend` simulates motions, so its module imports `rbjax.solvers`. The top package
registers how to reach such names before any of these packages is imported, and each looks here.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

_names: dict[str, dict[str, Callable[[], Any]]] = defaultdict(dict)


def names_from_above(package: str) -> dict[str, Callable[[], Any]]:
    """name -> how to import it, of a package."""
    return _names[package]
