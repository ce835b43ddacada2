"""`damp_flexible_arm` against closed forms of beams, and plain NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import rbjax as rb
from rbjax.envs.suite.flexible_arm import elasticity, flexible_arm
from tests.envs.suite.controllers import damp
from tests.envs.suite.shared import (
    check_float32,
    check_gradient,
    check_physics,
    episodes,
    placed,
    quiet,
)

LENGTH, HUB, EI = 0.9, 0.05, 1.6875
MASS, PAYLOAD = 7800 * 0.03 * 0.0015, 0.2  # kg/m, kg


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("damp_flexible_arm", randomise=False)


def clamped():
    """The arm with a hub that does not move."""
    model = flexible_arm()
    joints = model.joints
    return model.replace(joints=joints.replace(armature=joints.armature.at[0].set(1e9)))


def test_physics():
    check_physics("damp_flexible_arm", tolerance=1e-11)


def test_static_deflection():
    # P L^3 / 3 EI and the slope P L^2 / 2 EI under a small force, reached by a damped motion
    model = clamped()
    stiff = eqx.tree_at(
        elasticity, model, [x * k for x, k in zip(elasticity(model), (1, 40), strict=True)]
    )
    P = 0.01
    push = jnp.zeros((2, 6)).at[1, 4].set(P)
    path = rb.rollout(stiff, stiff.default_state(), None, 0.01, wrenches=push, steps=2000,
                      integrator="discrete", save_every=2000)  # fmt: skip
    pose = rb.forward_kinematics(stiff, path.q[-1])
    assert np.abs(path.v[-1]).max() < 1e-9
    # the linear closed form has an error of order (delta / L)^2 = 2e-6
    np.testing.assert_allclose(pose.p[1, 1], P * LENGTH**3 / (3 * EI), rtol=1e-5)
    np.testing.assert_allclose(pose.R[1, 1, 0], P * LENGTH**2 / (2 * EI), rtol=1e-5)
    context = rb.forces.Context.of(stiff, 0.0, path.state(-1), None)
    to = type("To", (), {"after": context})
    from rbjax.envs.suite.flexible_arm import strain

    np.testing.assert_allclose(strain(to)[0], P * LENGTH / EI, rtol=1e-5)


def test_frequency_with_a_tip_mass():
    # 1 + cos b cosh b + r b (cos b sinh b - sin b cosh b) = 0, r the payload over the strip's mass
    r = PAYLOAD / (MASS * LENGTH)

    def equation(b):
        c, s, C, S = np.cos(b), np.sin(b), np.cosh(b), np.sinh(b)
        return 1 + c * C + r * b * (c * S - s * C)

    b = brentq(equation, 0.3, 1.8)
    due = (b / LENGTH) ** 2 * np.sqrt(EI / MASS)
    model = clamped()
    free = eqx.tree_at(
        elasticity, model, [x * k for x, k in zip(elasticity(model), (1, 0), strict=True)]
    )
    A = np.asarray(rb.linearise(free, free.default_state(), jnp.zeros(1), 1e-3, integrator="rk4").A)
    found = np.abs(np.log(np.linalg.eigvals(A).astype(complex)).imag) / 1e-3
    lowest = found[found > 1e-3].min()
    # three coordinates, and a payload of 2 cm with rotary inertia
    np.testing.assert_allclose(lowest, due, rtol=1e-3)


def test_rewards_and_observation(env):
    rng = np.random.default_rng(0)
    params = quiet(env, goal_time=1e12)
    for i in range(4):
        q = rng.uniform(-1, 1, 4) * [1.5, 0.4, 0.2, 0.1]
        v = rng.uniform(-1, 1, 4) * [1, 0.5, 0.2, 0.1]
        goal = rng.uniform(-1.5, 1.5)
        state = placed(env, q, v, seed=i, goal=goal).replace(action=jnp.array([0.3]))
        action = rng.uniform(-1, 1, 1)
        obs, after, reward, _, info = env.step_once(
            jax.random.key(i), state, jnp.asarray(action), params
        )
        q, v = np.asarray(after.state.q), np.asarray(after.state.v)
        model = env.task.model
        tip = np.asarray(rb.forward_kinematics(model, q).p[1])[:2]
        speed = np.asarray(rb.jacobian(model, q, "payload") @ v)[3:5]
        error = tip / (LENGTH + HUB) - [np.cos(goal), np.sin(goal)]
        measured = [q[0] - goal, v[0], q[1] - q[2] + q[3], v[1] - v[2] + v[3], *action]
        np.testing.assert_allclose(obs["policy"], measured, atol=1e-12)
        critic = [*measured, *q[1:], *v[1:], *error, *speed]
        np.testing.assert_allclose(obs["critic"], critic, atol=1e-12)
        near = 1 / (1 + 100 * error @ error)
        terms = {
            "reach": near,
            "swing": -0.1 * near * speed @ speed,
            "effort": -0.02 * (1.5 * action[0]) ** 2,
            "smooth": -0.02 * (action[0] - 0.3) ** 2,
        }
        for name, value in terms.items():
            np.testing.assert_allclose(info["rewards"][name], value, atol=1e-12)
        np.testing.assert_allclose(reward, 0.02 * sum(terms.values()), atol=1e-12)


@pytest.mark.parametrize("q, ends", [
    ([3.05, 0, 0, 0], True), ([-3.05, 0, 0, 0], True), ([2.9, 0, 0, 0], False),
    ([0, -1.75, 1.75, 0], True), ([0, 2.0, -1.5, 0], True), ([0, 1.0, 0, 0], False),
])  # fmt: skip
def test_terminations(env, q, ends):
    *_, done, info = env.step_once(jax.random.key(0), placed(env, q), jnp.zeros(1), quiet(env))
    assert bool(done) == bool(info["terminated"]) == ends


def test_resets_and_goals(env):
    params = quiet(env, goals=[0.5, 0.9], goal_time=0.5)
    keys = jax.random.split(jax.random.key(0), 100)
    _, state = jax.vmap(env.reset, (0, None))(keys, params)
    goals = [np.asarray(state.variables["goal"])]
    assert np.abs(np.asarray(state.state.q[:, 0])).max() <= 1.5
    step = jax.jit(jax.vmap(env.step_once, (0, 0, 0, None)))
    for i in range(50):
        keys = jax.random.split(jax.random.key(i + 1), 100)
        _, state, *_ = step(keys, state, jnp.zeros((100, 1)), params)
        goals.append(np.asarray(state.variables["goal"]))
    goals = np.stack(goals)
    assert goals.min() >= 0.5 and goals.max() <= 0.9 and np.ptp(goals) > 0.35
    # a new goal with the probability 0.02 / 0.5 a step: 200 of 5,000, within five deviations
    assert abs((np.diff(goals, axis=0) != 0).sum() - 200) < 5 * 14


def test_randomisation():
    env = rb.envs.make("damp_flexible_arm")
    _, state = env.reset(jax.random.key(0))
    drawn = {name: np.asarray(x) for name, x in state.drawn.items()}
    assert 0.7 <= drawn["stiffness"] <= 1.4
    assert drawn["payload"][0] == 1 and 0.5 <= drawn["payload"][1] <= 2
    _, after, *_ = env.step_once(jax.random.key(1), state, jnp.array([0.5]))
    model = env.task.model
    model = model.replace(
        bodies=model.bodies.replace(mass=model.bodies.mass * drawn["payload"]),
        joints=model.joints.replace(damping=model.joints.damping * drawn["friction"]),
    )
    own = [x * drawn["stiffness"] for x in elasticity(model)]
    model = eqx.tree_at(elasticity, model, own)
    path = rb.rollout(model, state.state, jnp.full((5, 1), 0.75), 0.004)
    np.testing.assert_allclose(after.state.q, path.q[-1], atol=1e-11)


def test_gradient(env):
    check_gradient(env, placed(env, [0.3, 0.1, 0.05, 0.0], goal=0.6))


def test_float32():
    check_float32("damp_flexible_arm")


def test_a_regulator_reaches_the_goal_and_damps():
    # 64 starts and goals with other stiffnesses and payloads: within 6 s the payload rests there
    env = rb.envs.make("damp_flexible_arm")
    params = env.default_params
    params = params.replace(values=params.values | {"goal_time": jnp.asarray(1e12)})
    path, state = episodes(env, damp(env), 300, 64, params)
    assert not np.asarray(path["terminated"]).any()
    late = np.asarray(path["reward"])[:, -25:] / env.dt
    assert late.min() > 0.9
    assert np.abs(np.asarray(state.state.v)).max() < 0.05
