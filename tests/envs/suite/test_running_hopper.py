"""The running hopper: the robot of Gymnasium, and the rewards of Xu et al. 2022 in NumPy."""

from pathlib import Path

import gymnasium
import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs.learning.training import shac_arguments
from tests.envs.suite import planar
from tests.envs.suite.mujoco_states import batch, resets

M, STATES = planar.RUNNING, planar.STATES["hopper_run"]


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("hopper_run")


def test_robot_is_the_one_of_gymnasium():
    """Accelerations in the air, with the armature and damping of Xu et al."""
    folder = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
    theirs = mujoco.MjModel.from_xml_path(str(folder / "hopper.xml"))
    theirs.dof_armature[3:], theirs.dof_damping[3:] = 1, 2
    rng = np.random.default_rng(0)
    for _ in range(5):
        q, v, u = rng.normal(size=6), rng.normal(size=6), rng.uniform(-1, 1, 3)
        q[1], q[3:] = 3.0, rng.uniform([-2.6, -2.6, -0.7], [0, 0, 0.7])
        found = []
        for m, height in ((M, 0.0), (theirs, 1.25)):  # theirs counts the height from the floor
            d = mujoco.MjData(m)
            d.qpos[:], d.qvel[:], d.ctrl[:] = q, v, u
            d.qpos[1] += height
            mujoco.mj_forward(m, d)
            found.append(d.qacc.copy())
        np.testing.assert_allclose(*found, atol=1e-11 * np.abs(found[1]).max())


def test_reward_and_termination(env):
    state, keys = batch(env, STATES), jax.random.split(jax.random.key(1), len(STATES))
    _, state, reward, done, info = jax.vmap(env.step_once)(keys, state, state.ctrl)
    after = state.state
    lows = 0
    for i, (_, _, u) in enumerate(STATES):
        z, pitch, speed = after.q[i, 1], after.q[i, 2], after.v[i, 0]
        d = np.clip(z + 0.3, -1.0, 0.3)
        due = {"forward": speed, "height": d if d >= 0 else -200 * d * d}
        due |= {"upright": 1 - (pitch / (np.pi / 6)) ** 2, "effort": -0.1 * (u**2).sum()}
        for name, x in due.items():
            np.testing.assert_allclose(info["rewards"][name][i], x, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(reward[i], sum(due.values()), rtol=1e-12)
        assert info["terminated"][i] == done[i] == (z < -0.45)
        lows += z < -0.45
    assert 0 < lows < len(STATES)


def test_starts(env):
    _, state = resets(env, 256)
    for x in (state.state.q, state.state.v):
        assert np.abs(x).max() <= 0.05
        np.testing.assert_allclose(np.std(x, 0), 0.1 / np.sqrt(12), rtol=0.15)


@pytest.mark.slow
def test_a_learner_by_gradients_runs():
    """A third of the training of a CPU. A robot that stands has a return of 1,300."""
    with jax.enable_x64(False):
        chosen = rb.envs.learning.settings("hopper_run", "shac", "cpu")
        env = rb.envs.make("hopper_run")
        given = shac_arguments(chosen | {"steps": chosen["steps"] // 3, "reports": 1})
        found = rb.envs.learning.shac(env, jax.random.key(0), **given)
        episodes = rb.envs.learning.evaluate(env, found.policy, jax.random.key(1), 32)
    assert episodes.returns.mean() > 1500 and found.skipped == 0
