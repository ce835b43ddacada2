"""A policy in MuJoCo C: the same returns as in rbjax, and what is rejected."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb


def test_returns_are_those_of_rbjax():
    env = rb.envs.make("cart_pole_balance")
    mj_model = mujoco.MjModel.from_xml_string(rb.write_mjcf(env.task.model))
    gains = jnp.array([0.5, 0.0, 3.0, 0.5, 0.8])
    policy = lambda obs, key: -(gains @ obs)[None]  # noqa: E731
    key = jax.random.key(3)
    due = rb.envs.learning.evaluate(env, policy, key, 4)
    found = rb.validation.evaluate_in_mujoco(env, policy, mj_model, key, 4)
    assert found.lengths.tolist() == due.lengths.tolist()
    # the task has no random numbers after its reset, so the motions are the same but for rounding
    np.testing.assert_allclose(found.returns, due.returns, rtol=1e-6)


def test_wrong_models():
    env = rb.envs.make("cart_pole_balance")
    mj_model = mujoco.MjModel.from_xml_string(rb.write_mjcf(env.task.model))
    policy = lambda obs, key: jnp.zeros(1)  # noqa: E731
    mj_model.opt.timestep = 0.5
    with pytest.raises(rb.InputError, match="timestep"):
        rb.validation.evaluate_in_mujoco(env, policy, mj_model, jax.random.key(0), 1)
    other = mujoco.MjModel.from_xml_string(rb.write_mjcf(rb.load("arm7")))
    with pytest.raises(rb.InputError, match="nq, nv, nu"):
        rb.validation.evaluate_in_mujoco(env, policy, other, jax.random.key(0), 1)
