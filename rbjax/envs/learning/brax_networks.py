"""Networks of Brax: conversion of trained parameters to a `Policy` and a `Critic`.

Brax' networks have hidden layers with swish, and inputs normalised by running statistics. Its
policy returns mean and raw standard deviation of a normal distribution, whose samples pass tanh.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.envs.actions import action_center_and_scale
from rbjax.envs.learning.critic import Critic
from rbjax.envs.learning.networks import Network, Normaliser
from rbjax.envs.learning.policy import Policy


def convert_policy(env: Any, parameters: Any) -> Policy:
    """Convert Brax' parameters (statistics, policy, value) to a `Policy` with the same actions."""
    low, high = (jnp.asarray(x, jnp.float32) for x in env.action_range)
    _, center, scale = jax.jit(action_center_and_scale)(low, high)
    low, high = (jax.device_put(np.asarray(center) + s * np.asarray(scale)) for s in (-1, 1))
    statistics = convert_statistics(parameters[0], "state")
    return Policy(convert_network(parameters[1]), statistics, None, low, high)


def convert_critic(parameters: Any, group: str, factor: float) -> Critic:
    """Convert Brax' value function to a `Critic`. factor: from its unit to that of a critic."""
    net = convert_network(parameters[2], factor)
    return Critic(net, convert_statistics(parameters[0], group))


def convert_network(parameters: Mapping[str, Any], factor: float = 1.0) -> Network:
    """Convert a network of Brax, whose activation is swish, to a `Network`.

    factor: of the last layer. The arrays are converted on the host, where no shape needs a program.
    """
    layers = parameters["params"]
    names = sorted(layers, key=lambda name: int(name.rsplit("_", 1)[1]))
    weights = [np.asarray(layers[name]["kernel"]).T for name in names]
    biases = [np.asarray(layers[name]["bias"]) for name in names]
    weights[-1], biases[-1] = (x * np.asarray(factor, x.dtype) for x in (weights[-1], biases[-1]))
    on_device = jax.device_put((tuple(weights), tuple(biases)))
    return Network(on_device[0], on_device[1], "silu")


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
