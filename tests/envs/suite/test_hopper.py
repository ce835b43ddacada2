"""Hopper tasks against MuJoCo C with the same file, and dm_control's formulas in NumPy."""

import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite import planar
from tests.envs.suite.mujoco_states import at, body_com, resets, sensor, stepped

M, STATES = planar.HOPPER, planar.STATES["hopper_hop"]
STANDING = [
    (np.array([0.3, 0.05 + 0.1 * k, 0.05, 0, -0.1, 0.2, -0.1]), np.eye(7)[0] * s, np.ones(4) * u)
    for k, s, u in [(0, 0.5, 0.2), (1, 1.5, -0.7), (2, 1.99, 1.0), (3, 2.5, 0.0), (4, 0.9, -0.3)]
]


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("hopper_hop")


def test_observation(env):
    """Touch is as MuJoCo senses it at the end of the step."""
    assert env.observation_size == 15
    obs, found, *_ = stepped(env, STATES)
    pressed = 0
    for i, (_, _, ctrl) in enumerate(STATES):
        d = at(M, (found.state.q[i], found.state.v[i], ctrl))
        touch = np.log1p([sensor(M, d, name)[0] for name in ("toe", "heel")])
        np.testing.assert_allclose(obs[i, :13], [*d.qpos[1:], *d.qvel], atol=1e-14)
        np.testing.assert_allclose(obs[i, 13:], touch, atol=1e-8)
        pressed += (touch > 0).sum()
    assert pressed > 3
    assert rb.envs.make("hopper_hop", touch=False).observation_size == 13


def standing(d):
    height = body_com(M, d, "torso")[2] - body_com(M, d, "foot")[2]
    return float(0.6 <= height <= 2)


def hopping(d):
    speed = sensor(M, d, "velocity")[0]
    return 1.0 if speed >= 2 else max(0.0, 1 - 0.5 * (2 - speed) / 1)


@pytest.mark.parametrize("name", ["hopper_hop", "hopper_stand"])
def test_reward(name):
    states = [*STANDING, *STATES]
    _, found, reward, _, info = stepped(rb.envs.make(name, touch=False), states)
    seen = []
    for i, (_, _, ctrl) in enumerate(states):
        d = at(M, (found.state.q[i], found.state.v[i], ctrl))
        parts = {"standing": standing(d), "hopping": hopping(d)}
        parts["small_control"] = (4 + np.maximum(0, 1 - ctrl**2).mean()) / 5
        second = "hopping" if name == "hopper_hop" else "small_control"
        np.testing.assert_allclose(info["rewards"][second][i], parts[second], atol=1e-11)
        np.testing.assert_allclose(info["rewards"]["standing"][i], parts["standing"])
        np.testing.assert_allclose(reward[i], parts["standing"] * parts[second], atol=1e-11)
        seen.append(parts["standing"])
    assert 0 < np.mean(seen) < 1


def test_starts(env):
    _, state = resets(env, 2048)
    q, v = np.asarray(state.state.q), np.asarray(state.state.v)
    assert (v == 0).all() and (q[:, :2] == 0).all()
    low, high = np.concatenate([[[-np.pi, np.pi]], M.jnt_range[3:]]).T
    assert (q[:, 2:] >= low).all() and (q[:, 2:] <= high).all()
    # the mean of 2,048 uniform samples is within five of its standard deviations
    middle = (q[:, 2:].mean(0) - (low + high) / 2) / (high - low)
    assert (np.abs(middle) < 5 / np.sqrt(12 * 2048)).all()
    np.testing.assert_allclose(q[:, 2:].std(0), (high - low) / np.sqrt(12), rtol=0.05)


def test_only_time_ends_an_episode(env):
    assert not env.task.terminations
    done = stepped(env, STATES)[3]
    assert not done.any()
