"""Walker tasks against MuJoCo C with the same file, and dm_control's formulas in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite.mujoco_states import (
    after,
    at,
    batch,
    motion,
    mujoco_model,
    resets,
    same_model,
    sensor,
    stepped,
)

M = mujoco_model("walker")
#: a fall from a bent pose, lying on the floor, and a run
STATES = [
    *motion(M, 80, 10, 0, [0.1, 0, 0.2, 0.5, -0.4, 0.1, -0.1, -0.9, 0.3]),
    *motion(M, 80, 10, 1, [-0.8, 0, 1.4, 0.3, -0.1, 0, 0.9, -1.5, -0.4]),
    *(
        (np.array([z, 0, 0.1, 0.2, -0.3, 0.1, 0.3, -0.2, -0.1]), np.eye(9)[1] * s, np.full(6, 0.1))
        for z, s in ((0.02, 0.4), (0.2, 5.0))
    ),
]
TASKS = {"walker_stand": None, "walker_walk": 1.0, "walker_run": 8.0}


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("walker_walk")


def test_model_and_physics(env):
    same_model(env.task.model, M)
    assert env.dt == pytest.approx(0.025) and env.episode == 1000
    found = stepped(env, STATES)[1].state
    contacts = 0
    for i, state in enumerate(STATES):
        q, v = after(M, state, 10)
        contacts += at(M, state).ncon
        # ten steps of contacts, each solved to 1e-12
        np.testing.assert_allclose(found.q[i], q, atol=1e-10)
        np.testing.assert_allclose(found.v[i], v, atol=1e-8)
    assert contacts > 20


def test_observation(env):
    assert env.observation_size == 24
    obs, found, *_ = stepped(env, STATES)
    for i, (_, _, ctrl) in enumerate(STATES):
        d = at(M, (found.state.q[i], found.state.v[i], ctrl))
        orientations = d.xmat[1:].reshape(-1, 3, 3)[:, 0][:, [0, 2]].ravel()
        due = [*orientations, d.body("torso").xpos[2], *d.qvel]
        np.testing.assert_allclose(obs[i], due, atol=1e-13)


def standing(d):
    lack = max(0.0, 1.2 - d.body("torso").xpos[2]) / 0.6
    return np.exp(np.log(0.1) * lack**2)


@pytest.mark.parametrize("name", TASKS)
def test_reward(name):
    speed = TASKS[name]
    _, found, reward, _, info = stepped(rb.envs.make(name), STATES)
    for i, (_, _, ctrl) in enumerate(STATES):
        d = at(M, (found.state.q[i], found.state.v[i], ctrl))
        upright = (1 + d.body("torso").xmat[8]) / 2
        np.testing.assert_allclose(info["rewards"]["standing"][i], standing(d), rtol=1e-12)
        np.testing.assert_allclose(info["rewards"]["upright"][i], upright, atol=1e-14)
        due = (3 * standing(d) + upright) / 4
        if speed is not None:
            lack = max(0.0, speed - sensor(M, d, "velocity")[0]) / (speed / 2)
            moving = max(0.0, 1 - 0.5 * lack)
            np.testing.assert_allclose(info["rewards"]["moving"][i], moving, atol=1e-11)
            due *= (5 * moving + 1) / 6
        np.testing.assert_allclose(reward[i], due, atol=1e-11)


def test_speed_is_a_parameter(env):
    """The reward of the run by the parameters of the walk."""
    _, state = resets(env, 4)
    keys = jax.random.split(jax.random.key(1), 4)
    params = env.default_params.replace(values={"speed": jnp.asarray(8.0)})
    step = lambda env, params: jax.vmap(env.step, (0, 0, 0, None))(  # noqa: E731
        keys, state, jnp.zeros((4, 6)), params
    )
    run = rb.envs.make("walker_run")
    np.testing.assert_allclose(step(env, params)[2], step(run, run.default_params)[2], rtol=1e-14)


def test_starts(env):
    _, state = resets(env, 2048)
    q = np.asarray(state.state.q)
    assert (state.state.v == 0).all() and (q[:, :2] == 0).all()
    low, high = np.concatenate([[[-np.pi, np.pi]], M.jnt_range[3:]]).T
    assert (q[:, 2:] >= low).all() and (q[:, 2:] <= high).all()
    np.testing.assert_allclose(q[:, 2:].std(0), (high - low) / np.sqrt(12), rtol=0.05)


def test_only_time_ends_an_episode(env):
    assert not env.task.terminations
    assert not stepped(env, STATES)[3].any()


def test_single_precision(env):
    """f32 rounds an angle of 3 rad to 2e-7; ten steps amplify it through stiff contacts."""
    with jax.enable_x64(False):
        obs, state, reward, *_ = stepped(rb.envs.make("walker_walk"), STATES)
        assert obs.dtype == reward.dtype == jnp.float32
    double = stepped(env, STATES)
    np.testing.assert_allclose(state.state.q, double[1].state.q, atol=5e-4)
    np.testing.assert_allclose(reward, double[2], atol=5e-4)


def test_gradient_through_contacts():
    """Of the speed after a control step with respect to the action, against central differences;
    no contact begins or ends in the step."""
    env = rb.envs.make("walker_walk")
    state = jax.tree.map(lambda x: x[0], batch(env, STATES[8:9]))
    assert at(M, STATES[8]).ncon > 0

    @jax.jit
    def speed(action):
        _, after, reward, *_ = env.step_once(jax.random.key(0), state, action)
        return reward + (after.state.v**2).sum()

    action, h = jnp.full(6, 0.1), 1e-6
    grad = jax.jit(jax.grad(speed))(action)
    numeric = [(speed(action + e) - speed(action - e)) / (2 * h) for e in h * jnp.eye(6)]
    # rounding of a speed^2 near 100, over 2e-6
    np.testing.assert_allclose(grad, jnp.stack(numeric), rtol=1e-6, atol=1e-6)
