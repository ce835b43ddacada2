"""Go1 with the rewards of a learner by gradients: NumPy and MuJoCo, slopes at rest, curriculum."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs.learning.training import shac_arguments
from tests.envs.suite import walking
from tests.envs.suite.test_go1 import playground_terms

FEET = ("FR", "FL", "RR", "RL")


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("go1_joystick_smooth")


def rounded(x):
    return np.sqrt(x * x + 0.01)


def own_terms(robot, action, command):
    """The weighted terms that `go1_joystick_flat` does not have."""
    _, R, v, w = robot.site("imu")
    x, y = (R.T @ v)[:2]
    s = np.sqrt(command[:2] @ command[:2] + 1e-4)
    along = (command[0] * x + command[1] * y) / s
    across = (command[0] * y - command[1] * x) / s
    lift = 0.0
    for foot in FEET:
        place, _, u, _ = robot.site(foot)
        lift += abs(place[2] - 0.1) * (u[0] ** 2 + u[1] ** 2 + 1e-3) ** 0.25
    # legs in the order of FEET
    thigh, calf = robot.data.qpos[8::3], robot.data.qpos[9::3]
    alike = lambda x: (x[0] - x[3]) ** 2 + (x[1] - x[2]) ** 2  # noqa: E731
    return {
        "progress": 2 * (s - rounded(s - along)),
        "sideways": -0.3 * rounded(across),
        "turn": -0.3 * rounded((R.T @ w)[2] - command[2]),
        "height": robot.data.qpos[2] - 0.15,
        "alive": 1.0,
        "effort": -0.005 * action @ action,
        "diagonal": -2 * (alike(thigh) + 0.5 * alike(calf)),
        "opposed": -2.4 * (thigh.sum() - 4 * 0.9) ** 2 / 4,
        "feet_clearance": -2 * lift,
    }


def test_rewards_and_ends(env):
    params, state = walking.quiet(env)
    q = state.state.q.at[1, 3:7].set(jnp.array([0.0, 1.0, 0.0, 0.0]))  # upside down
    q = q.at[2, 2].set(0.13).at[2, 8::3].set(2.0)  # low, with folded legs
    command = state.variables["command"].at[0].set(0.0)
    state = state.replace(
        state=state.state.replace(q=q), variables=state.variables | {"command": command}
    )
    model, ends = walking.compiled("go1"), 0
    walk = walking.transitions(env, params, state, 3, lambda k: k < 2)
    for before, action, _, after, reward, done, info in walking.samples(walk):
        robot = walking.Robot(model, after.state.q, after.state.v, after.ctrl)
        due, _ = playground_terms(before, action, after, done, robot)
        due = {name: x for name, x in due.items() if name not in ("feet_height", "stand_still")}
        due |= own_terms(robot, action, before.variables["command"])
        assert info["rewards"].keys() == due.keys()
        for name, x in due.items():
            # the same state in both; rounding of velocities of about 10
            np.testing.assert_allclose(info["rewards"][name], x, atol=1e-11, err_msg=name)
        np.testing.assert_allclose(reward, sum(due.values()), atol=1e-10)
        assert done == (robot.site("imu")[1][2, 2] < 0.6 or after.state.q[2] < 0.15)
        ends += done
    assert 4 <= ends < 3 * walking.COUNT


def test_slopes_at_rest(env):
    """The robot stands still, so that the horizontal velocities of its feet are zero."""
    params, state = walking.quiet(env)
    state = state.replace(state=state.state.replace(v=0 * state.state.v))
    keys = jax.random.split(jax.random.key(0), walking.COUNT)

    @jax.jit
    @jax.grad
    def slope(action):
        return jax.vmap(env.step_once, (0, 0, 0, None))(keys, state, action, params)[2].sum()

    found = slope(jnp.zeros((walking.COUNT, 12)))
    assert np.isfinite(found).all() and (np.abs(found) > 0).any(1).all()


def test_curriculum(env):
    params = env.default_params
    early, middle, late = (env.task.curriculum(params, p) for p in (0.0, 0.6, 1.0))
    reset = jax.vmap(env.reset, (0, None))
    keys = jax.random.split(jax.random.key(0), 256)
    command = np.asarray(reset(keys, early)[1].variables["command"])
    assert (command[:, 1:] == 0).all() and 0.5 <= command[:, 0].min() < command[:, 0].max() <= 1.2
    for p in (middle, late, params):
        command = np.asarray(reset(keys, p)[1].variables["command"])
        # uniform in -1.5..1.5, -0.8..0.8, -1.2..1.2; standard deviations of 256 within 10 %
        np.testing.assert_allclose(command.std(0), np.array([3, 1.6, 2.4]) / 12**0.5, rtol=0.1)
    for name, weight in params.weights.items():
        first, last = early.weights[name] / weight, late.weights[name] / weight
        # the own terms but the two of the gait, and the two of tracking, keep their weights
        own = ("progress", "sideways", "turn", "height", "alive", "effort")
        gait = name in ("diagonal", "opposed")
        fixed = name in own or "tracking" in name
        np.testing.assert_allclose([first, last], [1.0 if fixed else 0.15 if gait else 0.3, 1.0])
    for name, due in (("pose", 0.3 + 0.7 / 3), ("diagonal", 0.15 + 0.85 * (0.6 - 0.15) / 0.55)):
        np.testing.assert_allclose(middle.weights[name] / params.weights[name], due)


@pytest.mark.slow
def test_a_learner_by_gradients_moves_forward():
    """With the commands and weights of the beginning, for a third of the steps: most robots have a
    higher return than each robot that stands."""
    with jax.enable_x64(False):
        task = rb.envs.make("go1_joystick_smooth").task
        env = rb.envs.Environment(dataclasses.replace(task, curriculum=None))
        params = task.curriculum(env.default_params, 0.0)
        chosen = rb.envs.learning.settings("go1_joystick_smooth", "shac", "cpu")
        given = shac_arguments(chosen | {"steps": chosen["steps"] // 3, "reports": 1})
        found = rb.envs.learning.shac(env, jax.random.key(0), params=params, **given)
        key = jax.random.key(1)
        stand = lambda obs, key: jnp.zeros(12)  # noqa: E731
        stands, moves = (
            rb.envs.learning.evaluate(env, policy, key, 32, params=params).returns
            for policy in (stand, found.policy)
        )
    # some of the robots fall after so short a training
    assert found.skipped == 0 and np.median(moves) > stands.max()
