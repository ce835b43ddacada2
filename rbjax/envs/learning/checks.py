"""Checks of the arguments of trainings."""

from __future__ import annotations

import warnings
from typing import Any

from rbjax.arguments import instance, integer, random_key, real_number
from rbjax.dynamics.arguments import check_takes
from rbjax.envs.environment import Environment
from rbjax.errors import InputError
from rbjax.kinematics.arguments import check_several


def check_training(
    where: str, env: Any, key: Any, iterations: int, batch: int, optimiser: Any, report: Any,
    seconds: Any = None,
) -> None:  # fmt: skip
    """Raise InputError unless these are arguments of a training."""
    instance(where, "env", env, Environment, "an rb.envs.Environment, such as rb.envs.make(name)")
    random_key(where, key)
    if optimiser is not None and not (hasattr(optimiser, "init") and hasattr(optimiser, "update")):
        raise InputError(
            f"{where}: optimiser is {optimiser!r}, expected a transformation of optax, such as "
            "optax.adam(1e-3)"
        )
    integer(where, "iterations", iterations, least=1)
    integer(where, "batch", batch, least=1)
    check_takes(where, "report", report, "steps", "figures", "policy")
    if seconds is not None:
        real_number(where, "seconds", seconds, above=0.0)


def check_hidden(where: str, hidden: Any) -> tuple[int, ...]:
    """Return the sizes of hidden layers as a tuple."""
    sizes = check_several(where, "hidden", hidden, "sizes of layers, such as (64, 64)")
    return tuple(integer(where, f"hidden[{k}]", n, least=1) for k, n in enumerate(sizes))


def check_std(where: str, std: Any) -> None:
    """Raise InputError unless a standard deviation is above zero, or None for no noise."""
    if std is not None:
        real_number(where, "std", std, above=0.0)


def warn_of_skipped(where: str, skipped: Any, iterations: int) -> None:
    """Warn if more than a tenth of the updates of a training were skipped."""
    count = int(skipped)
    if 10 * count > iterations:
        warnings.warn(
            f"{where}: {count} of {iterations} updates were skipped, because their gradients were "
            "not finite, and the policy has not learned from them; see `failed` of the reports, "
            "and check the policy, the initial states and the rewards for NaN",
            stacklevel=3,
        )


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
