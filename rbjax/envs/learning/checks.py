"""Checks of the arguments of trainings."""

from __future__ import annotations

from typing import Any

from rbjax.arguments import instance, integer
from rbjax.envs.environment import Environment
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_key


def check_training(
    where: str, env: Any, key: Any, iterations: int, batch: int, optimiser: Any
) -> None:
    """Raise InputError unless these are arguments of a training."""
    instance(where, "env", env, Environment, "an rb.envs.Environment, such as rb.envs.make(name)")
    check_key(where, key)
    if optimiser is not None and not (hasattr(optimiser, "init") and hasattr(optimiser, "update")):
        raise InputError(
            f"{where}: optimiser is {optimiser!r}, expected a transformation of optax, such as "
            "optax.adam(1e-3)"
        )
    integer(where, "iterations", iterations, least=1)
    integer(where, "batch", batch, least=1)
