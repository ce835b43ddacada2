"""A control step of a batch of episodes under a policy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax


def batch_keys(key: jax.Array, batch: int) -> jax.Array:
    """Return the keys of a control step, (2, batch): of the policy, and of the environment."""
    return jax.random.split(key, (2, batch))


def batch_step(
    policy: Callable, step: Callable, obs: Any, state: Any, key: jax.Array, batch: int
) -> tuple[jax.Array, Any]:
    """Draw the actions of a batch and advance its episodes.

    Args:
        policy: function (obs, key) of one sample that returns an action (na,).
        step: function (keys, state, action) of the batch.
        obs, state: observations and states of the batch.
        key: of `jax.random`.
        batch: number of samples.

    Returns:
        The actions (batch, na), and the result of `step`.
    """
    acting, stepping = batch_keys(key, batch)
    action = jax.vmap(policy)(obs, acting)
    return action, step(stepping, state, action)
