"""`product_of_rewards`, for terms between 0 and 1."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import jax


def product_of_rewards(rewards: Mapping[str, jax.Array], dt: Any) -> Any:
    """Compute the reward of a control step: the product of the weighted terms. dt is not used.

    Use it as `Task.total` if every term is between 0 and 1 and all of them are needed.

    Source: Tassa et al., *DeepMind Control Suite*, 2018, sec. 2.4.

    Example:
        >>> from rbjax.envs.terms import product_of_rewards
        >>> product_of_rewards({"upright": 0.5, "centered": 0.5}, 0.02)
        0.25
    """
    return math.prod(rewards.values())
