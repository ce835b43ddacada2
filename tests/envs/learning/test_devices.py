"""Training on eight simulated devices: the same numbers as on one."""

import jax
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs.learning import new_critic, new_policy, shac, through_time
from tests.eight_devices import on_eight_devices
from tests.envs.learning.pole import KEY, environment
from tests.tolerances import F64_TRANSFORM, relative_error


def trained(devices):
    """All samples have the same start and no noise, so that the draws of a device do not matter."""
    env = environment(start=lambda key, params: rb.State(*0.3 * np.ones((2, 2))), episode=10**6)
    policy, critic = new_policy(env, KEY, (3,), std=None), new_critic(env, KEY, (3,))
    found = shac(
        env, KEY, policy, critic=critic, iterations=3, batch=16, horizon=4, devices=devices
    )
    short = environment(start=lambda key, params: rb.State(*0.3 * np.ones((2, 2))))
    again = through_time(short, policy, KEY, iterations=2, batch=16, devices=devices)
    return found, again


def on_all():
    assert len(jax.devices()) == 8
    for a, b in zip(jax.tree.leaves(trained(1)), jax.tree.leaves(trained(8)), strict=True):
        assert relative_error(a, b) < 100 * F64_TRANSFORM  # sums of other order, three updates


def ppo_on_all():
    from rbjax.envs.learning import ppo

    jax.config.update("jax_enable_x64", False)
    env = environment()
    found = ppo(
        env, KEY, steps=2000, num_envs=16, batch_size=16, num_minibatches=2, unroll_length=5,
        num_updates_per_batch=1, policy_hidden=(8,), value_hidden=(8,), reports=1, evaluations=16,
        devices=8,
    )  # fmt: skip
    assert np.isfinite(found.rewards).all() and found.rewards.shape == (2,)


@pytest.mark.slow
def test_eight_devices_train_like_one():
    on_eight_devices(on_all)


@pytest.mark.slow
def test_ppo_on_eight_devices():
    pytest.importorskip("brax")
    on_eight_devices(ppo_on_all)
