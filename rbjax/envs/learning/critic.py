"""The value function: an observation to the sum of future rewards, fitted to targets."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax

from rbjax.arguments import flag, instance
from rbjax.envs.environment import Environment
from rbjax.envs.learning.checks import check_hidden
from rbjax.envs.learning.networks import Normaliser, network, normaliser
from rbjax.envs.learning.policy import critic_group, group_size
from rbjax.errors import InputError
from rbjax.model.record import Record

GROUPS = 32  # number of groups of samples; the gradients of groups are computed in parallel


class Critic(Record):
    """A value function, in units of the reward of one step: (1 - g) sum_k g^k r_k.

    network: callable pytree (n,) -> (1,).
    normaliser: `Normaliser` of the observation; None for none.
    """

    network: Any
    normaliser: Normaliser | None

    def __call__(self, obs: Any) -> jax.Array:
        """Return the value of an observation (n,), or of the group "critic" of a dict."""
        x = critic_group(obs)
        return self.network(x if self.normaliser is None else self.normaliser(x))[0]

    def include(self, obs: Any, mean: Callable, parts: int) -> Critic:
        """Return a copy whose normaliser includes further observations."""
        if self.normaliser is None:
            return self
        return Critic(self.network, self.normaliser.include(critic_group(obs), mean, parts))


def new_critic(
    env: Any, key: jax.Array, hidden: Sequence[int] = (64, 64), normalise: bool = True
) -> Critic:
    """Create an untrained `Critic` for an environment.

    The weights of its last layer are small, so that random gradients of V do not mislead the
    policy.

    Args:
        env: `rb.envs.Environment`.
        key: () of `jax.random`.
        hidden: sizes of the hidden layers.
        normalise: whether the critic normalises observations by running statistics.

    Returns:
        `Critic`, a function (o,) -> () of the observation, or of its group "critic".

    Raises:
        InputError: not an environment, not a key, or sizes out of range.

    Example:
        >>> import jax
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> critic = rb.envs.learning.new_critic(env, jax.random.key(0), (16,))
        >>> critic(env.reset(jax.random.key(1))[0]).shape
        ()
    """
    instance("new_critic", "env", env, Environment, "an rb.envs.Environment")
    flag("new_critic", "normalise", normalise)
    sizes = group_size(env, "critic"), *check_hidden("new_critic", hidden), 1
    net = network(key, sizes, "elu", last=0.01)
    return Critic(net, normaliser(sizes[0]) if normalise else None)


def check_critic(where: str, env: Any, critic: Any) -> None:
    """Raise `InputError` unless this is a `Critic` of the environment's observations."""
    instance(where, "critic", critic, Critic, "a Critic, such as new_critic returns")
    got, due = critic.network.sizes[0], group_size(env, "critic")
    if got != due:
        raise InputError(
            f"{where}: the critic takes observations ({got},), expected ({due},), those of "
            f"{env.task.name!r}"
        )


def fit_critic(
    critic: Critic, optimiser_state: Any, fitter: Any, obs: Any, targets: jax.Array, steps: int,
    mean: Callable,
) -> tuple[Critic, Any]:  # fmt: skip
    """Fit a critic to targets by gradient steps on the whole batch.

    Args:
        critic: the value function.
        optimiser_state: state of the optimiser.
        fitter: optax transformation.
        obs: observations, each (h, B, n).
        targets: (h, B); those that are not finite are left out.
        steps: number of steps.
        mean: the mean of a value over the devices.

    Returns:
        The critic and the optimiser's state.
    """
    x = critic_group(obs)
    x, targets = x.reshape(-1, x.shape[-1]), targets.reshape(-1)
    good = jnp.isfinite(targets) & jnp.isfinite(x).all(-1)
    x, targets = jnp.where(good[:, None], x, 0.0), jnp.where(good, targets, 0.0)
    weights = good / jnp.maximum(good.mean(), 1 / len(good))
    # in groups, since a GPU computes a single sum over all samples with little parallelism
    x, targets, weights = jax.tree.map(
        lambda x: x.reshape(math.gcd(GROUPS, len(x)), -1, *x.shape[1:]), (x, targets, weights)
    )

    net, rest = eqx.partition(critic.network, eqx.is_inexact_array)

    def error(net: Any, x: jax.Array, targets: jax.Array, weights: jax.Array) -> jax.Array:
        values = jax.vmap(Critic(eqx.combine(net, rest), critic.normaliser))(x)
        return (weights * (values - targets) ** 2).mean()

    def once(carry: tuple, _: None) -> tuple[tuple, None]:
        net, optimiser_state = carry
        gradients = jax.vmap(jax.grad(error), (None, 0, 0, 0))(net, x, targets, weights)
        gradient = mean(jax.tree.map(lambda x: x.mean(0), gradients))
        update, optimiser_state = fitter.update(gradient, optimiser_state, net)
        return (optax.apply_updates(net, update), optimiser_state), None

    (net, optimiser_state), _ = jax.lax.scan(once, (net, optimiser_state), None, steps)
    return Critic(eqx.combine(net, rest), critic.normaliser), optimiser_state


def weights_of(critic: Critic) -> Any:
    """Return the arrays of a critic that are fitted."""
    return eqx.filter(critic.network, eqx.is_inexact_array)


def follow(target: Critic, critic: Critic, rate: float) -> Critic:
    """Return V' + rate (V - V'), from V' and V."""
    old, rest = eqx.partition(target.network, eqx.is_inexact_array)
    net = jax.tree.map(lambda s, v: s + rate * (v - s), old, weights_of(critic))
    return Critic(eqx.combine(net, rest), target.normaliser)
