"""Checks of the arguments of adapters."""

from __future__ import annotations

from rbjax.envs.environment import Environment
from rbjax.errors import InputError


def check_environment(where: str, environment: object) -> None:
    """Raise an `InputError` if an object is not an `Environment`."""
    if not isinstance(environment, Environment):
        raise InputError(
            f"{where}: environment is {type(environment).__name__}, expected an "
            "rb.envs.Environment; rb.envs.make(name) makes one"
        )
