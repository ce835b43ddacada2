"""Evaluation of a policy: returns and lengths of whole episodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import flag, instance, integer, random_key
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_takes
from rbjax.envs.batch_step import batch_step
from rbjax.envs.environment import Environment
from rbjax.envs.learning.policy import Policy, as_policy


@displayed
class Episodes(NamedTuple):
    """Whole episodes under a policy, each (episodes,).

    returns: sum of the rewards. lengths: steps. terminated: ended by a termination or a failure.
    """

    returns: jax.Array
    lengths: jax.Array
    terminated: jax.Array

    @staticmethod
    def empty(episodes: int, dtype: Any) -> tuple[Episodes, jax.Array]:
        """Return episodes without steps, and which of them are running: all."""
        yes = jnp.ones(episodes, bool)
        return Episodes(jnp.zeros(episodes, dtype), jnp.zeros(episodes, int), ~yes), yes

    def include(
        self, running: jax.Array, reward: jax.Array, done: jax.Array, terminated: jax.Array
    ) -> tuple[Episodes, jax.Array]:
        """Return the episodes with a further step of the running ones, and which still run."""
        found = Episodes(
            self.returns + jnp.where(running, reward, 0.0),
            self.lengths + running,
            self.terminated | (running & terminated),
        )
        return found, running & ~done


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
        policy: a `Policy`, or a function (obs, key) that returns an action (na,); key is None if
            noise is False.
        key: () of `jax.random`.
        episodes: number of episodes, simulated at the same time.
        noise: whether the policy draws its actions; False for the mean actions.
        params: parameters of the environment; None for its own.

    Returns:
        `Episodes`, with returns in units of the reward and lengths in control steps.

    Raises:
        InputError: not an environment, not a key, or fewer than one episode.

    Example:
        >>> import jax
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> policy = rb.envs.learning.new_policy(env, jax.random.key(0), (4,))
        >>> rb.envs.learning.evaluate(env, policy, jax.random.key(1), 3).returns.shape
        (3,)
    """
    instance("evaluate", "env", env, Environment, "an rb.envs.Environment")
    random_key("evaluate", key)
    integer("evaluate", "episodes", episodes, least=1)
    flag("evaluate", "noise", noise)
    check_takes("evaluate", "policy", policy, "obs", "key")
    if isinstance(policy, Policy):
        as_policy("evaluate", env, policy)
    one, two = jax.random.split(key)

    @jax.jit
    def run(params: Any) -> Episodes:
        obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(one, episodes), params)
        act = policy if noise else lambda obs, key: policy(obs, None)
        step = jax.vmap(lambda keys, state, action: env.step(keys, state, action, params))

        def move(carry: Any, key: jax.Array) -> tuple[Any, None]:
            obs, state, found, running = carry
            _, moved = batch_step(act, step, obs, state, key, episodes)
            obs, state, reward, done, info = moved
            found = found.include(running, reward, done, info["terminated"])
            return (obs, state, *found), None

        start: Any = (obs, state, *Episodes.empty(episodes, env.dtype))
        (_, _, found, _), _ = jax.lax.scan(move, start, jax.random.split(two, env.episode))
        return found

    return run(params)
