"""Brax' PPO with environments of rbjax: the environment it trains on, names of JAX that it needs,
and the conversion of its networks.

Brax calls a batch of samples; a step of all of them is one kernel. The episodes begin again by
themselves inside the kernel.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from rbjax.envs.learning.critic import Critic
from rbjax.envs.learning.networks import Network, Normaliser
from rbjax.envs.learning.policy import Policy
from rbjax.errors import InputError


def brax_modules() -> tuple[Any, Any, Any]:
    """Return Brax' `train` of PPO, its networks, and its `State`.

    Raises:
        InputError: Brax is not installed.
    """
    try:
        from brax.envs.base import State
        from brax.training.agents.ppo import networks, train
    except ImportError as error:
        raise InputError(
            f"ppo: Brax cannot be imported ({error}), expected brax 0.14; pip install 'rbjax[envs]'"
        ) from error
    return train.train, networks, State


class BraxBatch:
    """A batch of samples of an environment, as Brax trains on it (`wrap_env=False`).

    Args:
        env: `rb.envs.Environment`.
        State: Brax' class of states.
        params: parameters of the environment; None for its own.
    """

    def __init__(self, env: Any, State: Any, params: Any = None) -> None:
        self.env, self.State, self.params = env, State, params
        self.low, self.high = finite_range(env)

    @property
    def observation_size(self) -> Any:
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return "rbjax"

    @property
    def unwrapped(self) -> BraxBatch:
        return self

    def reset(self, rng: jax.Array) -> Any:
        """Begin episodes, from a batch of keys."""
        keys = jax.vmap(jax.random.split)(rng)
        obs, state = jax.vmap(self.env.reset, (0, None))(keys[:, 0], self.params)
        shapes = jax.eval_shape(self._advance, keys[:, 1], state, jnp.zeros(self._shape(rng)))
        zero = jnp.zeros(rng.shape[0], shapes[2].dtype)
        metrics = {name: jnp.zeros(x.shape, x.dtype) for name, x in shapes[3]["rewards"].items()}
        return self.State(state, obs, zero, zero, metrics, self._info(keys[:, 1], zero, {}))

    def step(self, state: Any, action: jax.Array) -> Any:
        """Advance all samples by a control step. action: (B, na), in -1..1."""
        keys = jax.vmap(jax.random.split)(state.info["rng"])
        obs, after, reward, info = self._advance(keys[:, 0], state.pipeline_state, action)
        done = info["done"].astype(reward.dtype)
        metrics = {**state.metrics, **info["rewards"]}
        kept = {**state.info, **self._info(keys[:, 1], done, info)}
        return state.replace(
            pipeline_state=after, obs=obs, reward=reward, done=done, metrics=metrics, info=kept
        )

    def _advance(self, keys: jax.Array, state: Any, action: jax.Array) -> tuple:
        dtype = state.action.dtype
        mid, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        action = (mid + half * action).astype(dtype)
        step = jax.vmap(self.env.step, (0, 0, 0, None))
        obs, after, reward, done, info = step(keys, state, action, self.params)
        return obs, after, reward, {**info, "done": done}

    def _shape(self, rng: jax.Array) -> tuple[int, int]:
        return rng.shape[0], self.env.action_size

    def _info(self, rng: jax.Array, done: jax.Array, info: Mapping[str, Any]) -> dict[str, Any]:
        zero = jnp.zeros_like(done)
        length = info.get("length", zero).astype(done.dtype)
        return {
            "rng": rng,
            "truncation": info.get("truncated", zero).astype(done.dtype),
            "episode_done": done,
            "steps": length,
            "episode_metrics": {"sum_reward": info.get("return", zero), "length": length},
        }


def finite_range(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the action range of an environment, with -1..1 for actions without limits."""
    low, high = (np.asarray(x, np.float32) for x in env.action_range)
    limited = np.isfinite(high - low)
    return np.where(limited, low, -1.0), np.where(limited, high, 1.0)


@contextlib.contextmanager
def names_of_jax() -> Iterator[None]:
    """Provide names that Brax 0.14 calls and that newer versions of JAX no longer have."""
    name = "device_put_replicated"
    if hasattr(jax, name):
        yield
        return
    setattr(jax, name, put_replicated)
    try:
        yield
    finally:
        delattr(jax, name)


def put_replicated(x: Any, devices: Sequence[Any]) -> Any:
    """Return arrays with a leading axis of devices, a copy on each."""
    each = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))

    def put(x: Any) -> jax.Array:
        return jax.device_put(jnp.stack([x] * len(devices)), each)

    return jax.tree.map(put, x)


def convert_policy(env: Any, parameters: Any) -> Policy:
    """Convert Brax' parameters (statistics, policy, value) to a `Policy` with the same actions."""
    low, high = (jnp.asarray(x) for x in finite_range(env))
    net = convert_network(parameters[1])
    return Policy(net, convert_statistics(parameters[0], "policy"), None, low, high)


def convert_critic(parameters: Any, group: str, factor: float) -> Critic:
    """Convert Brax' value function to a `Critic`. factor: from its unit to that of a critic."""
    net = convert_network(parameters[2])
    last = (factor * net.weights[-1], factor * net.biases[-1])
    net = Network((*net.weights[:-1], last[0]), (*net.biases[:-1], last[1]), net.activation)
    return Critic(net, convert_statistics(parameters[0], group))


def convert_network(parameters: Mapping[str, Any]) -> Network:
    """Convert a network of Brax, whose activation is swish, to a `Network`."""
    layers = parameters["params"]
    names = sorted(layers, key=lambda name: int(name.rsplit("_", 1)[1]))
    weights = tuple(jnp.asarray(layers[name]["kernel"]).T for name in names)
    return Network(weights, tuple(jnp.asarray(layers[name]["bias"]) for name in names), "silu")


def convert_statistics(statistics: Any, group: str) -> Normaliser:
    """Convert Brax' running statistics of an observation group."""
    mean, std = statistics.mean, statistics.std
    if isinstance(mean, Mapping):
        mean, std = mean[group], std[group]
    count = statistics.count
    count = float(int(count)) if hasattr(count, "lo") else float(count)
    return Normaliser(
        jnp.asarray(mean), jnp.asarray(std), jnp.asarray(count, mean.dtype), float("inf")
    )
