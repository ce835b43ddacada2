"""Computed torque: the error obeys its linear equation, in closed form and in MuJoCo C."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
import rbjax.control as control
from rbjax.errors import InputError
from tests.control.arms import ARM, BALL
from tests.robots import load_quietly

K, D = np.array([30.0, 20.0, 25.0, 40.0]), np.array([8.0, 3.0, 10.0, 5.0])


def wave(t):
    return 0.5 * jnp.sin(jnp.array([1.0, 2.0, 1.5, 0.7]) * t + jnp.arange(4.0))


@pytest.fixture(scope="module")
def arm():
    return load_quietly(ARM)


def errors(model, reference, t, q, v, a):
    """e, e' and e'' at t, by derivatives along the motion through (q, v, a)."""

    def e(s):
        there = rb.integrate(model, q, v * s + a * s * s / 2)
        return rb.difference(model, there, reference(t + s))

    def rate(s):
        return jax.jvp(e, (s,), (1.0,))[1]

    return e(0.0), rate(0.0), jax.jvp(rate, (0.0,), (1.0,))[1]


def test_error_obeys_its_equation(arm):
    """By forward dynamics of the controls, at random states: e'' + D e' + K e = 0."""
    law = control.computed_torque(arm, wave, stiffness=K, damping=D)

    @jax.jit
    def residual(t, q, v):
        state = rb.State(q, v)
        tau = rb.applied_forces(arm, state, law(t, state))
        a = rb.forward_dynamics(arm, q, v, tau)
        e, e1, e2 = errors(arm, wave, t, q, v, a)
        return e2 + D * e1 + K * e, e2

    for k in range(3):
        state = arm.random_state(jax.random.key(k))
        off, size = residual(0.3 * k, state.q, state.v)
        assert np.abs(off).max() <= 1e-10 * max(1.0, np.abs(size).max())


def test_error_of_an_attitude_obeys_its_equation():
    """The same of a ball joint far from its reference, which also turns."""
    model = load_quietly(BALL)

    def reference(t):
        turn = rb.rotations.quaternion.exp(jnp.array([0.3 * t, jnp.sin(t), 0.5 * t * t]))
        return jnp.concatenate([turn, jnp.cos(t)[None]])

    law = control.computed_torque(model, reference, stiffness=K, damping=D)

    @jax.jit
    def residual(t, q, v):
        a = rb.forward_dynamics(model, q, v, law.tau(t, rb.State(q, v)))
        e, e1, e2 = errors(model, reference, t, q, v, a)
        return e2 + D * e1 + K * e, e2

    for k in range(3):
        state = model.random_state(jax.random.key(k))
        off, size = residual(0.4 + k, state.q, state.v)
        assert np.abs(off).max() <= 1e-10 * np.abs(size).max()


def test_motion_has_the_closed_form(arm):
    """Critically damped, from rest: e(t) = (e_0 + (e'_0 + w e_0) t) exp(-w t), integrated."""
    w, target = 6.0, jnp.array([0.5, -0.4, 0.8, 0.2])
    law = control.computed_torque(arm, target, stiffness=w * w)
    start = rb.State(jnp.array([0.1, 0.2, -0.1, 0.4]), jnp.array([0.5, -0.2, 0.3, 0.0]))

    dt = 1e-3
    run = rb.rollout(arm, start, None, dt, steps=1000, tau=law.tau, integrator="rk4",
                     save_every=200)  # fmt: skip
    t = np.asarray(run.ts)[:, None]
    e0, e1 = np.asarray(target - start.q), -np.asarray(start.v)
    want = (e0 + (e1 + w * e0) * t) * np.exp(-w * t)
    got = np.asarray(target - run.q)
    assert np.abs(got - want).max() < 5 * dt  # forces are held over a step: first order in dt


def test_in_mujoco(arm):
    """MuJoCo's accelerations under the law's controls are those that it asks for; and its closed
    loop, with the law called as machine code at each step, converges as the equation says."""
    m = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(m)
    law = control.computed_torque(arm, wave, stiffness=36.0)
    state = arm.random_state(jax.random.key(1))

    def both(t, q, v):
        state = rb.State(q, v)
        return law(t, state), law.acceleration(t, state)

    act = rb.compile(both, jnp.float64(0.0), state.q, state.v)
    data.qpos, data.qvel = state.q, state.v
    e0, e1 = np.asarray(wave(0.0) - state.q), np.asarray(jax.jvp(wave, (0.0,), (1.0,))[1] - state.v)
    worst = 0.0
    for k in range(1200):
        t = np.float64(k * m.opt.timestep)
        data.ctrl[:], asked = act(t, data.qpos.copy(), data.qvel.copy())
        if k % 300 == 0:
            mujoco.mj_forward(m, data)
            np.testing.assert_allclose(data.qacc, asked, rtol=1e-9, atol=1e-9)
            want = (e0 + (e1 + 6.0 * e0) * t) * np.exp(-6.0 * t)
            worst = max(worst, np.abs(np.asarray(wave(t)) - data.qpos - want).max())
        mujoco.mj_step(m, data)
    assert worst < 5e-3  # forces are held for a step: e is off by up to 0.5 ms of its rate
    assert np.abs(np.asarray(wave(0.6)) - data.qpos).max() < 0.2 * np.abs(e0).max()


def test_reference_with_its_derivatives_is_the_same(arm):
    def given(t):
        q, v = jax.jvp(wave, (t,), (1.0,))
        return q, v, jax.jvp(lambda t: jax.jvp(wave, (t,), (1.0,))[1], (t,), (1.0,))[1]

    state = arm.random_state(jax.random.key(0))
    one, two = (
        control.computed_torque(arm, r, stiffness=10.0).tau(0.4, state) for r in (wave, given)
    )
    np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12)


def test_operations_of_a_derivative_are_counted(arm):
    """A policy with the rate of an algorithm inside, as a moving reference has one, may run in a
    thread: its size is known."""

    def rate(t):
        return jax.jvp(lambda t: rb.forward_kinematics(arm, wave(t)).p, (t,), (1.0,))[1]

    values = rb.operation_count(lambda t: rb.forward_kinematics(arm, wave(t)).p, 0.1)
    assert rb.operation_count(rate, 0.1).total > values.total > 0


def test_models_and_references_that_the_law_cannot_follow(arm):
    with pytest.raises(InputError, match="nothing drives 'hinge'"):
        control.computed_torque(load_quietly("cart_pole"), jnp.zeros(2), stiffness=1.0)
    with pytest.raises(InputError, match="constraints"):
        control.computed_torque(load_quietly("four_bar"), jnp.zeros(3), stiffness=1.0)
    wrong = control.computed_torque(arm, lambda t: jnp.zeros(3), stiffness=1.0)
    with pytest.raises(InputError, match="expected \\(4,\\)"):
        wrong.tau(0.0, arm.default_state())
