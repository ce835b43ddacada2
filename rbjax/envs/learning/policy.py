"""Policies: an observation to an action, with noise for exploration.

y = network(normaliser(obs)) + std e,  e ~ N(0, 1),      a = mid + half tanh(y)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import flag, instance
from rbjax.envs.actions import action_center_and_scale
from rbjax.envs.environment import Environment
from rbjax.envs.learning.checks import check_hidden, check_std
from rbjax.envs.learning.networks import Normaliser, network, normaliser
from rbjax.errors import InputError
from rbjax.model.record import Record

NOISE_FLOOR = 1e-3  # of a standard deviation that the network returns


class Policy(Record):
    """A policy: an observation to an action.

    network: callable pytree (n,) -> (na,), or (2 na,) if it returns the noise, too.
    normaliser: `Normaliser` of the observation; None for none.
    log_std: (na,) logarithm of the noise's standard deviation before tanh; None for no noise, or if
        the network returns it.
    low, high: (na,) range of the actions; without limits there is no tanh.
    squash: if true, tanh maps actions with limits into their ranges.
    """

    network: Any
    normaliser: Normaliser | None
    log_std: jax.Array | None
    low: jax.Array
    high: jax.Array
    squash: bool = eqx.field(static=True, default=True)

    def __call__(self, obs: Any, key: jax.Array | None = None) -> jax.Array:
        """Return an action (na,).

        Args:
            obs: observation (n,), or a dict with the group "policy".
            key: of `jax.random`, for the noise; None for the mean action.
        """
        x = policy_group(obs)
        if self.normaliser is not None:
            x = self.normaliser(x)
        y, std = self.network(x), None
        if y.shape[0] == 2 * self.low.shape[0]:
            y, raw = jnp.split(y, 2)
            std = jax.nn.softplus(raw) + NOISE_FLOOR
        elif self.log_std is not None:
            std = jnp.exp(self.log_std)
        if key is not None and std is not None:
            y = y + std * jax.random.normal(key, y.shape, y.dtype)
        return self._into_range(y) if self.squash else y

    def include(self, obs: Any, mean: Callable = lambda x: x, parts: int = 1) -> Policy:
        """Return a copy whose normaliser includes further observations."""
        if self.normaliser is None:
            return self
        return self.replace(normaliser=self.normaliser.include(policy_group(obs), mean, parts))

    def _into_range(self, y: jax.Array) -> jax.Array:
        limited, center, scale = action_center_and_scale(self.low, self.high)
        return jnp.where(limited, center + scale * jnp.tanh(y), y)


def policy_group(obs: Any) -> jax.Array:
    """Return the observation of the policy, from an array or a dict of groups."""
    return obs["policy"] if isinstance(obs, dict) else obs


def critic_group(obs: Any) -> jax.Array:
    """Return the observation of the value function: group "critic" if there is one."""
    if not isinstance(obs, dict):
        return obs
    return obs["critic"] if "critic" in obs else obs["policy"]


def group_size(env: Any, group: str) -> int:
    """Return the length of the observation of a group; of "policy" if there is no such group."""
    size = env.observation_size
    if not isinstance(size, dict):
        return size
    return size[group] if group in size else size["policy"]


def new_policy(
    env: Any,
    key: jax.Array,
    hidden: Sequence[int] = (64, 64),
    *,
    activation: str = "elu",
    std: float | None = 0.4,
    normalise: bool = True,
) -> Policy:
    """Create an untrained `Policy` for an environment, with mean actions near the middle.

    Args:
        env: `rb.envs.Environment`.
        key: of `jax.random`.
        hidden: sizes of the hidden layers.
        activation: "tanh", "elu" or "silu".
        std: standard deviation of the noise before tanh, without unit; None for a policy without
            noise.
        normalise: whether the policy normalises observations by running statistics.

    Returns:
        `Policy`, a function (o,) -> (na,) of the observation group "policy".

    Raises:
        InputError: not an environment, not a key, or numbers out of range.
        UnknownName: no such activation.

    Example:
        >>> import jax
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> policy = rb.envs.learning.new_policy(env, jax.random.key(0))
        >>> obs, state = env.reset(jax.random.key(1))
        >>> policy(obs).shape
        (1,)
    """
    instance("new_policy", "env", env, Environment, "an rb.envs.Environment")
    check_std("new_policy", std)
    flag("new_policy", "normalise", normalise)
    size, na = group_size(env, "policy"), env.action_size
    net = network(key, (size, *check_hidden("new_policy", hidden), na), activation)
    return wrap(env, net, normaliser(size) if normalise else None, std)


def wrap(env: Any, net: Any, statistics: Normaliser | None, std: float | None) -> Policy:
    """Return a `Policy` of a callable pytree, with the action range of the environment."""
    low, high = (jnp.asarray(x, jnp.zeros(()).dtype) for x in env.action_range)
    noise = None if std is None else jnp.full(low.shape, np.log(std), low.dtype)
    return Policy(net, statistics, noise, low, high)


def as_policy(where: str, env: Any, policy: Any) -> Policy:
    """Check a policy or a callable pytree (n,) -> (na,), and return it as a `Policy`.

    A callable pytree gives the actions: they are not normalised, squashed or disturbed.
    """
    if not callable(policy):
        raise InputError(
            f"{where}: the policy is {type(policy).__name__}, expected a Policy or a callable "
            "pytree such as rb.envs.learning.network(key, (n, 32, na))"
        )
    if not isinstance(policy, Policy):
        policy = wrap(env, policy, None, None)
        policy = Policy(policy.network, None, None, policy.low, policy.high, squash=False)
    size, na = group_size(env, "policy"), env.action_size
    try:
        found = eqx.filter_eval_shape(policy, jnp.zeros(size))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{where}: the policy fails for an observation ({size},), expected a function of it "
            f"that returns ({na},): {error}"
        ) from error
    if jnp.shape(found) != (na,):
        raise InputError(
            f"{where}: the policy of an observation ({size},) returned shape {jnp.shape(found)}, "
            f"expected ({na},)"
        )
    if not jax.tree.leaves(eqx.filter(policy.network, eqx.is_inexact_array)):
        raise InputError(
            f"{where}: the policy has no floating arrays to train; give one that is a pytree of "
            "them, such as rb.envs.learning.network(...) or jax.tree_util.Partial(function, gains)"
        )
    return policy


def split_policy(policy: Policy) -> tuple[Policy, Policy]:
    """Return the trained arrays of a policy, and the rest of it."""
    nothing = jax.tree.map(lambda _: False, policy)
    wanted = eqx.tree_at(
        lambda p: (p.network, p.log_std), nothing,
        jax.tree.map(eqx.is_inexact_array, (policy.network, policy.log_std)),
        is_leaf=lambda x: x is None,
    )  # fmt: skip
    return eqx.partition(policy, wanted)
