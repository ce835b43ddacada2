"""The physics of the planar robots against MuJoCo C with the same file: hopper, walker."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite.mujoco_states import after, at, batch, same_model
from tests.envs.suite.planar import ROBOTS, STATES

TASKS = {
    "hopper_hop": (0.02, {"touch": False}),
    "walker_walk": (0.025, {}),
    "hopper_run": (1 / 60, {}),
}


@pytest.fixture(scope="module", params=TASKS)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def env(name):
    return rb.envs.make(name, **TASKS[name][1])


def step(env, states):
    """obs, state, reward, done, info of a control step, without a reset."""
    state = batch(env, states)
    keys = jax.random.split(jax.random.key(0), len(states))
    return jax.vmap(env.step_once)(keys, state, state.ctrl)


def test_model_and_physics(name, env):
    m, states = ROBOTS[name], STATES[name]
    same_model(env.task.model, m)
    assert env.dt == pytest.approx(TASKS[name][0]) and env.episode == 1000
    found = step(env, states)[1].state
    contacts = 0
    for i, state in enumerate(states):
        q, v = after(m, state, env.task.decimation)
        contacts += at(m, state).ncon
        # four to ten steps of contacts, each solved to 1e-12
        np.testing.assert_allclose(found.q[i], q, atol=1e-10)
        np.testing.assert_allclose(found.v[i], v, atol=1e-8)
    assert contacts >= 10


def test_single_precision(name, env):
    """f32 rounds an angle of 3 rad to 2e-7; a control step amplifies it through stiff contacts."""
    with jax.enable_x64(False):
        obs, state, reward, *_ = step(rb.envs.make(name, **TASKS[name][1]), STATES[name])
        assert obs.dtype == reward.dtype == jnp.float32
    double = step(env, STATES[name])
    np.testing.assert_allclose(state.state.q, double[1].state.q, atol=5e-4)
    np.testing.assert_allclose(reward, double[2], atol=5e-4, rtol=1e-4)


def test_gradient_through_contacts(name, env):
    """Of the speed after a control step with respect to the action, against central differences;
    no contact begins or ends in the step."""
    state = jax.tree.map(lambda x: x[0], batch(env, STATES[name][8:9]))
    assert at(ROBOTS[name], STATES[name][8]).ncon > 0

    @jax.jit
    def speed(action):
        _, after, reward, *_ = env.step_once(jax.random.key(0), state, action)
        return reward + (after.state.v**2).sum()

    action, h = jnp.full(env.action_size, 0.1), 1e-6
    grad = jax.jit(jax.grad(speed))(action)
    numeric = [(speed(action + e) - speed(action - e)) / (2 * h) for e in h * jnp.eye(len(action))]
    # rounding of a speed^2 near 100, over 2e-6
    np.testing.assert_allclose(grad, jnp.stack(numeric), rtol=1e-6, atol=1e-6)
