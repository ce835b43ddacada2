"""Cart-pole tasks against MuJoCo C with the same file, and against the formulas in NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.linalg

import rbjax as rb
from tests.envs.suite.mujoco_states import (
    after,
    at,
    batch,
    motion,
    mujoco_model,
    resets,
    same_model,
    stepped,
)  # fmt: skip

M = mujoco_model("cart_pole_on_rail")
TASKS = ("cart_pole_balance", "cart_pole_swing_up")
STATES = motion(M, 60, 24, 0, [0.3, 3.0])


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("cart_pole_balance")


def test_model_and_physics(env):
    """A control step, at the stops of the rail too."""
    same_model(env.task.model, M)
    states = [*STATES, (np.array([1.79, 0.2]), np.array([3.0, 1.0]), np.array([0.5]))]
    _, found, *_ = stepped(env, states)
    for i, state in enumerate(states):
        q, v = after(M, state, 1)
        np.testing.assert_allclose(found.state.q[i], q, atol=1e-13)
        np.testing.assert_allclose(found.state.v[i], v, atol=1e-12)


def test_observation(env):
    assert env.observation_size == 5 and env.action_size == 1
    assert (env.action_range[0], env.action_range[1]) == (-1, 1)
    obs, found, *_ = stepped(env, STATES)
    for i in range(len(STATES)):
        d = at(M, (found.state.q[i], found.state.v[i], STATES[i][2]))
        R = d.body("pole").xmat.reshape(3, 3)
        due = [d.qpos[0], R[2, 2], R[0, 2], *d.qvel]
        np.testing.assert_allclose(obs[i], due, atol=1e-15)


def dense(q, v, u):
    """The reward as published, in NumPy."""
    gaussian = lambda x, m: np.exp(np.log(0.1) * (x / m) ** 2)  # noqa: E731
    return (
        (np.cos(q[1]) + 1) / 2 * (1 + gaussian(q[0], 2)) / 2
        * (4 + max(0, 1 - u**2)) / 5 * (1 + gaussian(v[1], 5)) / 2
    )  # fmt: skip


@pytest.mark.parametrize("name", TASKS)
def test_reward(name):
    _, found, reward, _, info = stepped(rb.envs.make(name), STATES)
    assert set(info["rewards"]) == {"upright", "centered", "small_control", "small_velocity"}
    for i, (_, _, u) in enumerate(STATES):
        due = dense(found.state.q[i], found.state.v[i], u[0])
        np.testing.assert_allclose(reward[i], due, rtol=1e-13)


def test_sparse_reward():
    env = rb.envs.make("cart_pole_swing_up", sparse=True)
    angle = np.arccos(0.995)
    inside = np.array([[0.24, angle - 0.01], [-0.24, -angle + 0.01], [0, 2 * np.pi]])
    outside = np.array([[0.26, 0], [0, angle + 0.01], [0, np.pi]])
    states = [(q, np.zeros(2), np.zeros(1)) for q in [*inside, *outside]]
    _, _, reward, *_ = stepped(env, states)
    np.testing.assert_array_equal(reward, [1, 1, 1, 0, 0, 0])


def test_starts():
    """Ranges and spreads: 4,096 samples have a mean within five of its standard deviations."""
    count = 4096
    _, state = resets(rb.envs.make("cart_pole_balance"), count)
    q, v = np.asarray(state.state.q), np.asarray(state.state.v)
    for x, half in zip(q.T, (0.1, 0.034), strict=True):
        assert 0.98 * half < np.abs(x).max() <= half
        np.testing.assert_allclose(x.std(), half / np.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(v.std(0), 0.01, rtol=0.06)
    _, state = resets(rb.envs.make("cart_pole_swing_up"), count)
    deviation = np.concatenate([state.state.q - np.array([0, np.pi]), state.state.v], 1)
    np.testing.assert_allclose(deviation.std(0), 0.01, rtol=0.06)
    np.testing.assert_allclose(deviation.mean(0), 0, atol=5 * 0.01 / np.sqrt(count))


def test_episode_ends_after_ten_seconds(env):
    """And not before: the last step but one, the last one, and the first one of the next."""
    state = batch(env, STATES[:1])
    state = state.replace(step=jnp.full_like(state.step, 998))
    ends = []
    for _ in range(3):
        _, state, _, done, info = jax.vmap(env.step)(
            jax.random.split(jax.random.key(0), 1), state, jnp.zeros((1, 1))
        )
        ends.append((bool(done[0]), bool(info["truncated"][0]), int(state.step[0])))
    assert ends == [(False, False, 999), (True, True, 0), (False, False, 1)]
    assert env.episode * env.dt == pytest.approx(10)


def test_action_that_is_not_finite_ends_the_episode(env):
    actions = jnp.array([[np.nan], [0.0]])
    obs, _, reward, done, info = jax.vmap(env.step)(
        jax.random.split(jax.random.key(0), 2), batch(env, STATES[:2]), actions
    )
    np.testing.assert_array_equal(done, [True, False])
    np.testing.assert_array_equal(info["failed"], [True, False])
    assert reward[0] == 0 and np.isfinite(obs).all()


@pytest.mark.parametrize("name", TASKS)
def test_gradient_with_respect_to_the_action(name):
    """Of the reward of five steps, against central differences."""
    env = rb.envs.make(name)
    _, state = env.reset(jax.random.key(3))
    keys = jax.random.split(jax.random.key(4), 5)

    @jax.jit
    def total(actions):
        def one(state, given):
            _, state, reward, _, _ = env.step_once(given[0], state, given[1])
            return state, reward

        return jax.lax.scan(one, state, (keys, actions))[1].sum()

    actions = jnp.linspace(-0.6, 0.7, 5)[:, None]
    grad, h = jax.jit(jax.grad(total))(actions), 1e-5
    for i in range(5):
        step = jnp.zeros_like(actions).at[i].set(h)
        numeric = (total(actions + step) - total(actions - step)) / (2 * h)
        # differences of a reward near 5, rounded to 1e-15, over 2e-5
        np.testing.assert_allclose(grad[i, 0], numeric, rtol=1e-6, atol=2e-10)


def test_single_precision():
    """f32 rounds q and v to 6e-8 of their size; a step of the pole amplifies it little."""
    with jax.enable_x64(False):
        env = rb.envs.make("cart_pole_balance")
        obs, state, reward, *_ = stepped(env, STATES)
        assert obs.dtype == reward.dtype == state.state.q.dtype == np.float32
    double = stepped(rb.envs.make("cart_pole_balance"), STATES)
    np.testing.assert_allclose(obs, double[0], atol=3e-5)
    np.testing.assert_allclose(reward, double[2], atol=1e-6)


def test_weights_are_factors_of_the_terms(env):
    state = batch(env, STATES)
    params = env.default_params
    weights = params.weights | {"upright": params.weights["upright"] * 2}
    step = lambda params: jax.vmap(env.step, (0, 0, 0, None))(  # noqa: E731
        jax.random.split(jax.random.key(1), len(STATES)), state, state.ctrl, params
    )
    np.testing.assert_allclose(step(params.replace(weights=weights))[2], 2 * step(params)[2])


def test_replaced_task_keeps_its_terms(env):
    """A user's variant: another episode length."""
    task = dataclasses.replace(env.task, episode=7)
    assert rb.envs.Environment(task).episode == 7


def test_a_linear_regulator_balances():
    """The policy inside the kernel: gains of the Riccati equation by SciPy, from MuJoCo's
    derivatives. The reward is at most 1 a step."""
    env = rb.envs.make("cart_pole_balance")
    A, B, d = np.zeros((4, 4)), np.zeros((4, 1)), mujoco.MjData(M)
    mujoco.mjd_transitionFD(M, d, 1e-6, True, A, B, None, None)
    P = scipy.linalg.solve_discrete_are(A, B, np.eye(4), 10 * np.eye(1))
    K = jnp.asarray(np.linalg.solve(10 * np.eye(1) + B.T @ P @ B, B.T @ P @ A))

    def policy(obs, key):
        return -K @ jnp.stack([obs[0], jnp.arctan2(obs[2], obs[1]), obs[3], obs[4]])

    obs, state = resets(env, 8)
    run = jax.vmap(lambda key, obs, state: env.unroll(key, obs, state, policy, 999))
    _, state, path = run(jax.random.split(jax.random.key(2), 8), obs, state)
    assert not path["done"].any() and (state.episode_return > 990).all()
    np.testing.assert_allclose(path["reward"].sum(1), state.episode_return, rtol=1e-12)
