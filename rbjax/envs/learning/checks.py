"""Checks of the arguments of trainings."""

from __future__ import annotations

from typing import Any

from rbjax.arguments import instance, integer, real_number
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


def check_discount(where: str, name: str, discount: Any) -> None:
    """Raise InputError unless a discount is in 0 <= g < 1.

    A value is (1 - g) sum g^k r_k, which is zero for g = 1.
    """
    real_number(where, name, discount, least=0.0, most=1.0)
    if discount >= 1:
        raise InputError(
            f"{where}: {name} is {discount}, expected at least 0 and below 1, because rewards have "
            f"the factor 1 - {name}; 0.99 counts about 100 steps"
        )
