"""Checks of the arguments of adapters."""

from __future__ import annotations

from rbjax.arguments import instance
from rbjax.envs.environment import Environment
from rbjax.envs.episode import Params
from rbjax.errors import InputError


def check_environment(where: str, environment: object, params: object = None) -> None:
    """Raise an `InputError` unless the arguments are an `Environment`, and `Params` or None."""
    if not isinstance(environment, Environment):
        raise InputError(
            f"{where}: environment is {type(environment).__name__}, expected an "
            "rb.envs.Environment; rb.envs.make(name) makes one"
        )
    if params is not None:
        instance(where, "params", params, Params, "Params, as environment.default_params, or None")
