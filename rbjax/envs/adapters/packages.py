"""Optional packages: an error with the command that installs them."""

from __future__ import annotations

import importlib.util

from rbjax.envs.environment import Environment
from rbjax.errors import InputError


def require(where: str, package: str, extra: str) -> None:
    """Raise an `InputError` with the command to install a package, if it is not installed.

    where: function, for the message.
    extra: extra of rbjax that installs the package.
    """
    if importlib.util.find_spec(package) is None:
        raise InputError(
            f"{where}: the package {package} is not installed, expected it beside rbjax; "
            f"pip install 'rbjax[{extra}]' installs it"
        )


def check_environment(where: str, environment: object) -> None:
    """Raise an `InputError` if an object is not an `Environment`."""
    if not isinstance(environment, Environment):
        raise InputError(
            f"{where}: environment is {type(environment).__name__}, expected an "
            "rb.envs.Environment; rb.envs.make(name) makes one"
        )
