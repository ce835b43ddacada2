"""Simulated recordings: beside rollout, with delays, sensors and controllers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import PD, Calibration, Grid, Setup
from rbjax.sysid.simulation.setup import read_sensor, simulate_motion

MODEL = rb.load("cart_pole")
START = rb.State(jnp.array([0.1, 0.4]), jnp.array([0.0, -0.3]))
T, N = 0.01, 60
CTRLS = jnp.asarray(np.sin(np.arange(N) * 0.3)[:, None] * 3)


def moved(delay=None, ctrls=CTRLS, longest=0, controller=None, substeps=1):
    setup = Setup.of(MODEL, controller, delay)
    grid = Grid(T, substeps, "rk4", longest)
    return simulate_motion(lambda p: setup, jnp.zeros(1), START, ctrls, grid)


def test_it_is_the_rollout():
    want = jax.jit(lambda: rb.rollout(MODEL, START, CTRLS, T, integrator="rk4"))()
    found = jax.jit(moved)()
    np.testing.assert_allclose(found.q, want.q, atol=1e-13)
    np.testing.assert_allclose(found.v, want.v, atol=1e-12)


def test_a_delay_of_whole_periods_shifts_commands():
    late = jax.jit(lambda d: moved(d, longest=4))
    shifted = jnp.concatenate([CTRLS[:1]] * 3 + [CTRLS[:-3]])
    want = jax.jit(lambda: moved(ctrls=shifted))()
    np.testing.assert_allclose(late(3 * T).q, want.q, atol=1e-13)
    np.testing.assert_allclose(late(0.0).q, jax.jit(moved)().q, atol=1e-13)


def test_the_derivative_by_a_delay():
    end = lambda d: moved(d, longest=4).q[-1]  # noqa: E731
    slope = jax.jit(jax.jacfwd(end))
    both = jax.jit(lambda d, h: (end(d + h) - end(d - h)) / (2 * h))
    np.testing.assert_allclose(slope(1.37 * T), both(1.37 * T, 1e-5), rtol=1e-6)
    at_a_period = jax.jit(end)  # continuous there
    np.testing.assert_allclose(at_a_period(2 * T - 1e-9), at_a_period(2 * T + 1e-9), atol=1e-7)


def test_a_servo_acts_on_what_its_sensors_read():
    servo = PD(jnp.array([20.0]), jnp.array([1.0]))

    class First(rb.model.record.Record):
        """The servo of the cart, which reads the cart's columns."""

        inner: PD

        def __call__(self, t, seen, command):
            return self.inner(t, rb.State(seen.q[:1], seen.v[:1]), command)

    found = jax.jit(lambda: moved(controller=First(servo)))()
    state, want = START, [START.q]
    for k in range(5):
        u = 20.0 * (CTRLS[k] - state.q[:1]) - state.v[:1]
        state = rb.step(MODEL, state, u, T, integrator="rk4")
        want.append(state.q)
    np.testing.assert_allclose(found.q[:6], np.stack(want), atol=1e-13)


def test_readings_between_instants_are_cubic():
    coarse, fine = Grid(T), Grid(T / 2)
    setup = Setup.of(MODEL)
    path = jax.jit(moved)()
    halves = simulate_motion(lambda p: setup, jnp.zeros(1), START, jnp.repeat(CTRLS, 2, 0), fine)
    times = jnp.arange(2 * N + 1) * T / 2
    read = lambda s, path, grid, kind, t: read_sensor(s, path, grid, kind, t)  # noqa: E731
    q = read(setup, path, coarse, "q", times)
    np.testing.assert_allclose(q, halves.q, atol=1e-6)
    np.testing.assert_allclose(q[::2], path.q, atol=1e-14)
    np.testing.assert_allclose(read(setup, path, coarse, "v", times)[::2], path.v, atol=1e-12)


def test_a_sensor_has_a_scale_a_bias_and_a_delay():
    seen = Calibration(jnp.array([0.1, 0.2]), jnp.array([2.0, 1.0]), jnp.asarray(T))
    setup = Setup.of(MODEL)
    setup = setup.replace(sensors=setup.sensors | {"q": seen})
    path = jax.jit(moved)()
    found = read_sensor(setup, path, Grid(T), "q", jnp.array([2 * T, 3 * T]))
    np.testing.assert_allclose(found, path.q[1:3] * seen.scale + seen.bias, atol=1e-14)


@pytest.mark.parametrize("attitude", ["free_body"])
def test_attitudes_between_instants_keep_their_length(attitude):
    model = rb.load(attitude)
    start = model.default_state().replace(v=jnp.arange(1.0, model.nv + 1) / 3)
    setup = Setup.of(model)
    path = simulate_motion(lambda p: setup, jnp.zeros(1), start, jnp.zeros((20, model.nu)), Grid(T))
    fine = simulate_motion(
        lambda p: setup, jnp.zeros(1), start, jnp.zeros((40, model.nu)), Grid(T / 2)
    )
    q = read_sensor(setup, path, Grid(T), "q", jnp.arange(41) * T / 2)
    np.testing.assert_allclose(jnp.linalg.norm(q[:, 3:7], axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(q, fine.q, atol=1e-5)
