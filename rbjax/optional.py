"""Optional packages: the extra of rbjax that installs each, and the error if one is missing.

A module of rbjax imports an optional package inside the function that needs it, so that every
module of rbjax can be imported without it. `rbjax.cli`, `rbjax.demo` and the classes of adapters
are exceptions.
"""

from __future__ import annotations

import contextlib
import importlib
import io
from typing import Any

from rbjax.errors import MissingPackage

#: optional package as it is imported -> its name for pip, and the extra of rbjax that installs it
EXTRAS = {
    "matplotlib": ("matplotlib", "plots"),
    "PIL": ("pillow", "plots"),
    "mpmath": ("mpmath", "stability"),
    "rich": ("rich", "cli"),
    "typer": ("typer", "cli"),
    "viser": ("viser", "viewer"),
    "brax": ("brax", "envs"),
    "gymnasium": ("gymnasium", "envs"),
    "gymnax": ("gymnax", "envs"),
    "orbax": ("orbax-checkpoint", "envs"),
    "rsl_rl": ("rsl-rl-lib", "rsl"),
    "tensordict": ("tensordict", "rsl"),
    "torch": ("torch", "rsl"),
}


def require(where: str, module: str, instead: str = "") -> Any:
    """Import a module of an optional package. What the package prints meanwhile is dropped: Brax
    names the accelerators that it lacks.

    Args:
        where: function that needs it, for the message.
        module: such as "matplotlib.figure"; its package is a key of `EXTRAS`.
        instead: what works without the package, for the message.

    Returns:
        The module.

    Raises:
        MissingPackage: the package is not installed. The message has the command that installs it.

    Example:
        >>> from rbjax.optional import require
        >>> require("draw", "matplotlib.figure").Figure.__name__
        'Figure'
    """
    package = module.partition(".")[0]
    name, extra = EXTRAS[package]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            return importlib.import_module(module)
    except ImportError as error:
        if error.name is not None and error.name.partition(".")[0] != package:
            raise  # the package is installed, and one of its own imports fails
        more = f", or {instead}" if instead else ""
        raise MissingPackage(
            f"{where}: the package {name} is not installed, expected it in addition to rbjax: "
            f"pip install 'rbjax[{extra}]'{more}"
        ) from error
