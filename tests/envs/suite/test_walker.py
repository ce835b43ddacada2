"""Walker tasks against MuJoCo C with the same file, and dm_control's formulas in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite import planar
from tests.envs.suite.mujoco_states import at, resets, sensor, stepped

M, STATES = planar.WALKER, planar.STATES["walker_walk"]
TASKS = {"walker_stand": None, "walker_walk": 1.0, "walker_run": 8.0}


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("walker_walk")


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
