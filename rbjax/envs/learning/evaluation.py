"""Evaluation of a policy: returns and lengths of whole episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import instance, integer
from rbjax.envs.environment import Environment
from rbjax.kinematics.arguments import check_key


class Episodes(NamedTuple):
    """Whole episodes under a policy, each (episodes,).

    returns: sum of the rewards. lengths: steps. terminated: ended by a termination or a failure.
    """

    returns: jax.Array
    lengths: jax.Array
    terminated: jax.Array


def evaluate(
    env: Environment,
    policy: Callable,
    key: jax.Array,
    episodes: int = 128,
    *,
    noise: bool = False,
    params: Any = None,
) -> Episodes:
    """Run whole episodes under a policy.

    Args:
        env: `rb.envs.Environment`.
        policy: a `Policy`, or a function (obs, key) that returns an action; key is None if noise
            is False.
        key: of `jax.random`.
        episodes: number of episodes, simulated at the same time.
        noise: whether the policy draws its actions; False for the mean actions.
        params: parameters of the environment; None for its own.

    Returns:
        `Episodes`.

    Example:
        >>> import jax
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> policy = rb.envs.learning.new_policy(env, jax.random.key(0), (4,))
        >>> rb.envs.learning.evaluate(env, policy, jax.random.key(1), 3).returns.shape
        (3,)
    """
    instance("evaluate", "env", env, Environment, "an rb.envs.Environment")
    check_key("evaluate", key)
    integer("evaluate", "episodes", episodes, least=1)
    one, two = jax.random.split(key)

    @jax.jit
    def run(params: Any) -> Episodes:
        obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(one, episodes), params)
        zero = jnp.zeros(episodes, env.dtype)
        found = Episodes(zero, jnp.zeros(episodes, int), jnp.zeros(episodes, bool))

        def move(carry: Any, key: jax.Array) -> tuple[Any, None]:
            obs, state, running, found = carry
            keys = jax.random.split(key, (2, episodes))
            act = jax.vmap(policy) if noise else jax.vmap(lambda o, key: policy(o, None))
            step = jax.vmap(env.step, (0, 0, 0, None))
            obs, state, reward, done, info = step(keys[1], state, act(obs, keys[0]), params)
            found = Episodes(
                found.returns + jnp.where(running, reward, 0.0),
                found.lengths + running,
                found.terminated | (running & (info["terminated"] | info["failed"])),
            )
            return (obs, state, running & ~done, found), None

        start: Any = (obs, state, jnp.ones(episodes, bool), found)
        (*_, found), _ = jax.lax.scan(move, start, jax.random.split(two, env.episode))
        return found

    return run(params)
