"""`park_trailer` against the kinematics of a car with a trailer, and plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs.suite.trailer import car_with_trailer
from tests.envs.suite.controllers import back_up
from tests.envs.suite.shared import (
    check_float32,
    check_gradient,
    check_physics,
    episodes,
    placed,
    quiet,
)

WHEELBASE, DRAWBAR, BEHIND = 0.5, 0.8, 0.15


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("park_trailer", randomise=False)


def trailer_at(x, y, turn, hitch=0.0, steering=0.0):
    """The coordinates of the car with the trailer's axle at a pose."""
    heading = turn - hitch
    return np.array([
        x + DRAWBAR * np.cos(turn) + BEHIND * np.cos(heading),
        y + DRAWBAR * np.sin(turn) + BEHIND * np.sin(heading),
        heading, steering, hitch,
    ])  # fmt: skip


def test_physics():
    check_physics("park_trailer")


def test_no_axle_slides():
    model = car_with_trailer()
    path = rb.rollout(model, model.default_state(), jnp.tile(jnp.array([-0.7, 0.3]), (60, 1)), 0.01)
    q, w = np.asarray(path.q[-1]), np.asarray(path.v[-1])
    v = np.cos(q[2]) * w[0] + np.sin(q[2]) * w[1]
    turn = v * np.tan(q[3]) / WHEELBASE
    of_trailer = -(v * np.sin(q[4]) + BEHIND * turn * np.cos(q[4])) / DRAWBAR
    due = [v * np.cos(q[2]), v * np.sin(q[2]), turn, w[3], of_trailer - turn]
    assert v < -0.3
    np.testing.assert_allclose(w, due, atol=1e-12)


def test_trailer_folds_exponentially_backwards():
    # straight back without a hitch offset: tan(g/2) grows by exp(distance / drawbar)
    model = car_with_trailer()
    bodies = model.bodies
    on_axle = bodies.position.at[model.body("trailer"), 0].set(0.0)
    model = model.replace(bodies=bodies.replace(position=on_axle))
    begin = model.default_state().replace(q=jnp.array([0, 0, 0, 0, 0.05]))
    path = rb.rollout(model, begin, jnp.tile(jnp.array([-1.0, 0.0]), (2000, 1)), 1e-3)
    q = np.asarray(path.q)
    driven = np.hypot(np.diff(q[:, 0]), np.diff(q[:, 1])).sum()
    due = 2 * np.arctan(np.tan(0.025) * np.exp(driven / DRAWBAR))
    assert abs(q[-1, 2]) < 1e-9 and due > 0.4
    np.testing.assert_allclose(q[-1, 4], due, rtol=2e-3)  # order 1 in the step of 1 ms


def test_steady_turn():
    # ahead the trailer settles on a circle: radii of rear axle, hitch and trailer's axle
    model = car_with_trailer()
    s = 0.3
    path = rb.rollout(model, model.default_state(), jnp.tile(jnp.array([0.8, s]), (3000, 1)), 0.01)
    R = WHEELBASE / np.tan(s)
    own = np.sqrt(R**2 + BEHIND**2 - DRAWBAR**2)
    due = -(np.arctan2(BEHIND, R) + np.arctan2(DRAWBAR, own))
    np.testing.assert_allclose(path.q[-1, 4], due, rtol=1e-6)


def test_rewards_and_observation(env):
    rng = np.random.default_rng(0)
    params = quiet(env)
    for i in range(4):
        x, y, turn, hitch = rng.uniform([0.6, -0.3, -0.2, -0.3], [3, 0.3, 0.2, 0.3])
        state = placed(env, trailer_at(x, y, turn, hitch), seed=i)
        state = state.replace(action=jnp.asarray(rng.uniform(-1, 1, 2)))
        action = rng.uniform(-1, 1, 2)
        key = jax.random.key(i)
        obs, after, reward, done, info = env.step_once(key, state, jnp.asarray(action), params)
        q, v = np.asarray(after.state.q), np.asarray(after.state.v)
        turn = q[2] + q[4]
        axle = q[:2] - BEHIND * np.array([np.cos(q[2]), np.sin(q[2])])
        axle = axle - DRAWBAR * np.array([np.cos(turn), np.sin(turn)])
        speed = np.cos(q[2]) * v[0] + np.sin(q[2]) * v[1]
        due = [*axle, np.cos(turn), np.sin(turn), q[3], q[4], v[3], v[4], speed, v[2], *action]
        np.testing.assert_allclose(obs, due, atol=1e-12)
        e = axle[0] ** 2 + 4 * axle[1] ** 2 + 2 * (1 - np.cos(turn))
        terms = {
            "near": 1 / (1 + e),
            "parked": 0.0,
            "hitch": -0.2 * q[4] ** 2,
            "smooth": -0.1 * ((action - np.asarray(state.action)) ** 2).sum(),
        }
        for name, due in terms.items():
            np.testing.assert_allclose(info["rewards"][name], due, atol=1e-12)
        np.testing.assert_allclose(reward, 0.05 * sum(terms.values()), atol=1e-12)
        assert not done


def test_parked(env):
    hold = jnp.zeros(2)
    cases = {(0.05, 0.05, 0.05): 2.0, (0.15, 0, 0): 0.0, (0, 0.15, 0): 0.0, (0, 0, 0.15): 0.0}
    for at, due in cases.items():
        state = placed(env, trailer_at(*at))
        *_, info = env.step_once(jax.random.key(0), state, hold)
        assert float(info["rewards"]["parked"]) == due, at


@pytest.mark.parametrize("at, name", [
    ((2.0, 0.0, 0.0, 1.25), "jackknifed"), ((2.0, 0.0, 0.0, -1.25), "jackknifed"),
    ((9.5, 0.0, 0.0), "left_yard"), ((5.0, -4.1, 0.0), "left_yard"),
    ((0.5, 0.3, 0.0), "hit_bay"), ((0.9, 0.1, -1.0), "hit_bay"), ((-0.4, 0.0, 0.0), "hit_bay"),
])  # fmt: skip
def test_terminations(env, at, name):
    state = placed(env, trailer_at(*at))
    *_, done, info = env.step_once(jax.random.key(0), state, jnp.zeros(2))
    assert done and info["terminated"] and not info["failed"]
    near_by = placed(env, trailer_at(2.0, 0.0, 0.0, 1.0))
    assert not env.step_once(jax.random.key(0), near_by, jnp.zeros(2))[3]


def test_resets(env):
    params = quiet(env)
    obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(jax.random.key(0), 200), params)
    x, y, c, s, steering, hitch = np.asarray(obs)[:, :6].T
    low, high = (np.asarray(params.values[f"start_{end}"]) for end in ("low", "high"))
    found = np.stack([x, y, np.arctan2(s, c), hitch])
    assert (found.min(1) >= low - 1e-12).all() and (found.max(1) <= high + 1e-12).all()
    spread = found.max(1) - found.min(1)
    assert (spread > 0.9 * (high - low)).all()
    assert not steering.any() and not np.asarray(state.state.v).any()


def test_the_bay_is_a_parameter(env):
    moved = quiet(env, bay=[2.0, -1.0, 0.7])
    rng = np.random.default_rng(0)
    (a, one), (b, other) = (env.reset(jax.random.key(5), p) for p in (quiet(env), moved))
    np.testing.assert_allclose(a, b, atol=1e-12)
    for _ in range(5):
        action = jnp.asarray(rng.uniform(-1, 1, 2))
        a, one, x, *_ = env.step_once(jax.random.key(0), one, action, quiet(env))
        b, other, y, *_ = env.step_once(jax.random.key(0), other, action, moved)
        np.testing.assert_allclose(a, b, atol=1e-11)
        np.testing.assert_allclose(x, y, atol=1e-12)


def test_randomisation():
    env = rb.envs.make("park_trailer")
    _, state = env.reset(jax.random.key(0))
    factor, bias = (np.asarray(state.drawn[k]) for k in ("trailer_mass", "steering_error"))
    assert 0.5 <= factor <= 2 and 0 < abs(bias[1, 0]) <= 0.6
    action = jnp.array([-0.5, 0.2])
    _, after, *_ = env.step_once(jax.random.key(1), state, action)
    model = env.task.model
    bodies, trailer = model.bodies, model.body("trailer")
    bodies = bodies.replace(
        mass=bodies.mass.at[trailer].multiply(factor),
        inertia=bodies.inertia.at[trailer].multiply(factor),
    )
    acts = model.actuators.replace(bias=model.actuators.bias + bias)
    ctrl = jnp.tile(jnp.array([-0.5, 0.12]), (5, 1))
    path = rb.rollout(model.replace(bodies=bodies, actuators=acts), state.state, ctrl, 0.01)
    np.testing.assert_allclose(after.state.q, path.q[-1], atol=1e-12)


def test_gradient(env):
    check_gradient(env, placed(env, trailer_at(2.0, 0.2, 0.1, 0.1)))


def test_float32():
    check_float32("park_trailer")


def test_a_controller_parks():
    # 64 starts with other masses and steering errors, 20 s each: all stand in the bay
    env = rb.envs.make("park_trailer")
    path, _ = episodes(env, back_up(), 400, 64)
    assert not np.asarray(path["terminated"]).any()
    late = np.asarray(path["reward"])[:, -20:] / env.dt
    assert late.min() > 2.9  # near + parked is 3 at most
