"""`race_on_ice` against the friction circle, the single-track model, and plain NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs.suite.ice import AHEAD, TRACK, ice_car, nearest
from tests.envs.suite.controllers import pursue
from tests.envs.suite.shared import (
    check_float32,
    check_gradient,
    check_physics,
    episodes,
    placed,
    quiet,
)

MASS, FRONT, REAR, RADIUS, G = 3.74, 0.15875, 0.17145, 0.05, 9.81
MIDDLE = 0.12 * (FRONT - REAR) / MASS  # x of the centre of mass of the car, m


@pytest.fixture(scope="module")
def env():
    return rb.envs.make("race_on_ice", randomise=False)


def line(u, derivative=0):
    """The centre line of the track, or its derivative, at parameters u (n,)."""
    k = np.arange(1, len(TRACK) + 1)
    at = np.multiply.outer(np.atleast_1d(u), k) + derivative * np.pi / 2
    even, odd = np.cos(at) * k**derivative, np.sin(at) * k**derivative
    own = np.array(TRACK)
    return np.stack([even @ own[:, j] + odd @ own[:, j + 1] for j in (0, 2)], -1)


def on_track(u, offset=0.0, turn=0.0, speed=1.0):
    """Coordinates and velocities of a rolling car at a place of the track."""
    (p,), (d,) = line(u), line(u, 1)
    t = d / np.hypot(*d)
    heading = np.arctan2(t[1], t[0]) + turn
    x, y = p + offset * np.array([-t[1], t[0]])
    rolls = speed / RADIUS
    q = [x, y, heading, 0, 0, 0]
    return q, [speed * np.cos(heading), speed * np.sin(heading), 0, 0, rolls, rolls]


def test_physics():
    check_physics("race_on_ice")


def test_loads_at_rest():
    model = ice_car()
    for tyre, arm in zip(model.forces, (REAR + MIDDLE, FRONT - MIDDLE), strict=True):
        context = rb.forces.Context.of(model, 0.0, model.default_state(), jnp.zeros(2))
        due = MASS * G * arm / (FRONT + REAR)
        np.testing.assert_allclose(tyre.contact(context).load, due, rtol=1e-12)


def test_friction_circle():
    # no state accelerates the centre of mass faster than mu g, and sliding cars reach mu g
    mu = 0.25
    model = ice_car(mu)
    rng = np.random.default_rng(0)
    n = 200
    q = rng.uniform(-1, 1, (n, 6)) * [1, 1, 3, 0.5, 0, 0]
    v = rng.uniform(-1, 1, (n, 6)) * [4, 4, 3, 0, 80, 80]

    def of_middle(q, v):
        a = rb.acceleration(model, rb.State(q, v), jnp.zeros(2))

        def momentum(q, v):
            return rb.centroidal_momentum(model, q, v)[3:5] / MASS

        return jax.jvp(momentum, (q, v), (v, a))[1]  # planar base: q' = v

    a = np.hypot(*np.asarray(jax.jit(jax.vmap(of_middle))(jnp.asarray(q), jnp.asarray(v))).T)
    assert a.max() <= mu * G * (1 + 1e-9)
    assert a.max() > 0.99 * mu * G


def circle(model, speed, steering, seconds=8.0):
    """Drive in a circle at about a constant speed of the rear rim. Return the speed, the rate of
    its direction and the turning rate in the last second."""

    def policy(t, state):
        torque = 0.4 * (speed - RADIUS * state.v[5])
        return jnp.stack([torque, jnp.asarray(steering)])

    begin = model.default_state()
    v = begin.v.at[0].set(speed).at[4:6].set(speed / RADIUS)
    path = rb.rollout(model, begin.replace(v=v), policy, 0.002, steps=round(seconds / 0.002))
    v = np.asarray(path.v)[-500:]
    along = np.unwrap(np.arctan2(v[:, 1], v[:, 0]))
    return np.hypot(v[:, 0], v[:, 1])[1:], np.diff(along) / 0.002, v[1:, 2]


def test_neutral_steer_at_small_slip():
    # cornering stiffnesses in proportion to the loads: yaw rate = v s / L, at any speed
    for aim in (0.5, 1.0, 2.0):
        speed, _, turning = circle(ice_car(0.6, 5.0), aim, 0.01)
        due = speed[-1] * 0.01 / (FRONT + REAR)
        np.testing.assert_allclose(turning[-1], due, rtol=2e-3)  # of slip angles of 1e-2


def test_steady_turn_reaches_the_limit_of_friction():
    # faster and faster circles: v^2 / R = speed * rate of its direction rises to mu g, never above
    mu = 0.2
    model = ice_car(mu)
    reached = []
    for aim in (0.8, 1.1, 1.4, 1.7):
        speed, rate, _ = circle(model, aim, 0.3)
        reached.append(speed * rate / (mu * G))
        np.testing.assert_allclose(reached[-1], reached[-1].mean(), rtol=1e-3)  # it is steady
    assert (np.diff(np.mean(reached, 1)) > 0).all()
    assert 0.9 < np.max(reached) <= 1.0


def test_nearest_point():
    u = np.linspace(0, 2 * np.pi, 200_001)
    points = line(u)
    rng = np.random.default_rng(0)
    for _ in range(20):
        at = rng.uniform(0, 2 * np.pi)
        p = line(at)[0] + rng.uniform(-0.5, 0.5, 2)
        found = nearest(jnp.asarray(TRACK), jnp.asarray(p))
        i = ((points - p) ** 2).sum(-1).argmin()
        away = (float(found.u) - u[i] + np.pi) % (2 * np.pi) - np.pi
        assert abs(away) < 5e-5  # of the points that are searched
        np.testing.assert_allclose(abs(found.offset), np.hypot(*(points[i] - p)), atol=1e-7)


def test_rewards_and_observation(env):
    rng = np.random.default_rng(1)
    params = quiet(env)
    u = np.linspace(0, 2 * np.pi, 100_001)
    points = line(u)
    for i in range(3):
        q, v = on_track(rng.uniform(0, 6), rng.uniform(-0.3, 0.3), rng.uniform(-0.5, 0.5), 1.5)
        state = placed(env, q, v, seed=i).replace(action=jnp.asarray(rng.uniform(-1, 1, 2)))
        action = rng.uniform(-1, 1, 2)
        obs, after, reward, _, info = env.step_once(
            jax.random.key(i), state, jnp.asarray(action), params
        )
        q, v = np.asarray(after.state.q), np.asarray(after.state.v)
        at = u[((points - q[:2]) ** 2).sum(-1).argmin()]
        (p,), (d,), (b,) = line(at), line(at, 1), line(at, 2)
        rate = np.hypot(*d)
        t = d / rate
        offset = t[0] * (q[1] - p[1]) - t[1] * (q[0] - p[0])
        bend = (d[0] * b[1] - d[1] * b[0]) / rate**3
        forward = np.array([np.cos(q[2]), np.sin(q[2])])
        left = np.array([-forward[1], forward[0]])
        ahead = line(at + np.array(AHEAD) / rate) - q[:2]
        due = [
            offset, t @ forward, t @ left * -1, v[:2] @ forward, v[:2] @ left, v[2], q[3],
            *(RADIUS * v[4:]), *np.stack([ahead @ forward, ahead @ left], -1).ravel(), *action,
        ]  # fmt: skip
        np.testing.assert_allclose(obs, due, atol=2e-4)  # of the searched points
        terms = {
            "progress": v[:2] @ t / (1 - bend * offset),
            "edge": -((offset / 0.6) ** 6),
            "smooth": -0.02 * ((action - np.asarray(state.action)) ** 2).sum(),
            "off_track": 0.0,
        }
        for name, value in terms.items():
            np.testing.assert_allclose(info["rewards"][name], value, atol=2e-4)
        np.testing.assert_allclose(reward, 0.02 * sum(terms.values()), atol=1e-5)


def test_progress_is_distance_along_the_track(env):
    # over a lap of the controller, the sum of progress is the length of the centre line
    path, _ = episodes(env, pursue(0.2), 1499, 2)
    u = np.linspace(0, 2 * np.pi, 20_001)
    length = np.hypot(*np.diff(line(u), axis=0).T).sum()
    obs, reward = np.asarray(path["obs"]), np.asarray(path["reward"])
    assert not np.asarray(path["terminated"]).any()
    assert (reward.sum(1) > 1.3 * length).all()  # more than a lap in 30 s
    assert np.abs(obs[..., 0]).max() < 0.6


@pytest.mark.parametrize("changes, ends", [
    ({"offset": 0.65}, True), ({"offset": -0.65}, True), ({"offset": 0.55}, False),
    ({"turn": 2.2}, True), ({"turn": 1.6}, False),
])  # fmt: skip
def test_terminations(env, changes, ends):
    state = placed(env, *on_track(1.0, speed=0.1, **changes))
    *_, done, info = env.step_once(jax.random.key(0), state, jnp.zeros(2), quiet(env))
    assert bool(done) == bool(info["terminated"]) == ends
    assert float(info["rewards"]["off_track"]) == -50.0 * ends


def test_resets(env):
    obs, state = jax.vmap(env.reset, (0, None))(
        jax.random.split(jax.random.key(0), 200), quiet(env)
    )
    obs = np.asarray(obs)
    assert np.abs(obs[:, 0]).max() <= 0.2 + 1e-6 and np.abs(obs[:, 0]).max() > 0.15
    assert np.cos(0.2) - 1e-6 <= obs[:, 1].min()
    assert obs[:, 3].min() >= 0.5 - 1e-9 and obs[:, 3].max() <= 1.5 + 1e-9
    np.testing.assert_allclose(obs[:, 7:9], obs[:, 3:4] * [1, 1], atol=1e-12)  # it rolls
    # starts lie all along the track
    assert np.ptp(np.asarray(state.state.q[:, 0])) > 9


def test_randomisation():
    env = rb.envs.make("race_on_ice")
    _, state = env.reset(jax.random.key(0))
    drawn = {name: float(x) for name, x in state.drawn.items()}
    assert 0.6 <= drawn["friction"] <= 1.2 and 0.9 <= drawn["load"] <= 1.2
    _, after, *_ = env.step_once(jax.random.key(1), state, jnp.array([0.7, 0.4]))
    own = ice_car(0.25 * drawn["friction"], 5.0 * drawn["slip_stiffness"])
    bodies = own.bodies
    bodies = bodies.replace(
        mass=bodies.mass * drawn["load"], inertia=bodies.inertia * drawn["load"]
    )
    own = own.replace(bodies=bodies)
    own = eqx.tree_at(
        lambda m: [f.stiffness for f in m.forces], own,
        [f.stiffness * drawn["load"] for f in own.forces],
    )  # fmt: skip
    ctrl = jnp.tile(jnp.array([0.28, 0.2]), (8, 1))
    path = rb.rollout(own, state.state, ctrl, 0.0025)
    np.testing.assert_allclose(after.state.q, path.q[-1], atol=1e-12)


def test_gradient(env):
    check_gradient(env, placed(env, *on_track(0.7, 0.1, 0.2, 1.5)))


def test_float32():
    # the nearest point is found from positions of 5 m, and sliding amplifies rounding
    check_float32("race_on_ice", tolerance=2e-3)


def test_a_controller_races(env):
    # 30 s at the friction that it knows: more than 1.8 m/s along the centre line on average
    path, _ = episodes(env, pursue(0.25), 1499, 32)
    assert not np.asarray(path["terminated"]).any()
    speed = np.asarray(path["reward"]).mean(1) / env.dt
    assert speed.min() > 1.8
