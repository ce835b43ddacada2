"""Functions of the weighted reward terms that return the reward of a control step."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import flag, real_number


def product_of_rewards(rewards: Mapping[str, jax.Array], dt: Any) -> Any:
    """Compute the reward of a control step: the product of the weighted terms. dt is not used.

    Use it as `Task.total_reward` if every term is between 0 and 1 and all of them are needed.

    Args:
        rewards: name of a reward term -> its weighted value (), without unit.
        dt: control step, s.

    Returns:
        (), the reward of the step.

    Source: Tassa et al., *DeepMind Control Suite*, 2018, sec. 2.4.

    Example:
        >>> from rbjax.envs.terms import product_of_rewards
        >>> product_of_rewards({"upright": 0.5, "centered": 0.5}, 0.02)
        0.25
    """
    return math.prod(rewards.values())


def clipped_sum(
    low: float, high: float, *, times_dt: bool = False
) -> Callable[[Mapping[str, jax.Array], Any], Any]:
    """Return the function of the reward of a control step: the clipped sum of the weighted terms.

    Use it as `Task.total_reward`.

    Args:
        low, high: limits of the reward, in units of the reward.
        times_dt: whether the sum is multiplied by the control step in s.

    Returns:
        Function (name -> weighted term (), dt) that returns the reward () of a step.

    Raises:
        InputError: low above high, or not numbers.

    Source: Zakka et al., *MuJoCo Playground*, 2025.

    Example:
        >>> from rbjax.envs.terms import clipped_sum
        >>> float(clipped_sum(0.0, 10.0)({"forward": 2.0, "effort": -5.0}, 0.02))
        0.0
    """

    lower = real_number("clipped_sum", "low", low, finite=False)
    real_number("clipped_sum", "high", high, least=lower, finite=False)
    flag("clipped_sum", "times_dt", times_dt)

    def total(rewards: Mapping[str, jax.Array], dt: Any) -> Any:
        found = sum(rewards.values())
        return jnp.clip(dt * found if times_dt else found, low, high)

    return total
