"""The steady Kalman gain beside SciPy and the filter; a filter in a control loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import rbjax as rb
from rbjax.control import LinearStatus, feedback, lqr_at
from rbjax.control.linear import kalman_gain
from rbjax.estimation import (
    Estimate,
    StateSpace,
    kalman_filter,
    kalman_predict,
    kalman_update,
    model_state_space,
)
from tests.tolerances import relative_error

RNG = np.random.default_rng(0)
A, C = RNG.normal(size=(3, 3)) / 2, RNG.normal(size=(2, 3))
W, V = np.diag([0.3, 0.2, 0.1]), np.array([[0.2, 0.05], [0.05, 0.3]])


def test_the_steady_gain_beside_scipy():
    found = kalman_gain(A, C, W, V)
    P = scipy.linalg.solve_continuous_are(A.T, C.T, W, V)
    assert relative_error(found.P, P) < 1e-12
    assert relative_error(found.gain, np.linalg.solve(V, C @ P).T) < 1e-12
    found = kalman_gain(A, C, W, V, discrete=True)
    P = scipy.linalg.solve_discrete_are(A.T, C.T, W, V)
    assert relative_error(found.P, P) < 1e-12
    assert relative_error(found.gain, np.linalg.solve(C @ P @ C.T + V, C @ P).T) < 1e-12
    hidden = kalman_gain(np.diag([2.0, 0.5, 0.1]), np.array([[0.0, 1, 0], [0, 0, 1]]), W, V)
    assert hidden.status == LinearStatus.not_stabilisable and not hidden.gain.any()


def test_the_filter_becomes_steady_and_its_halves_are_the_filter():
    """kalman_update and kalman_predict, one after the other, are kalman_filter."""
    space = StateSpace.of(lambda x, u, w: A @ x + u + w, lambda x: C @ x)
    N = 40
    u, y = RNG.normal(size=(N, 3)), RNG.normal(size=(N + 1, 2))
    y[3] = np.nan
    whole = jax.jit(lambda: kalman_filter(space, jnp.zeros(3), np.eye(3), u, y, W, V))()

    @jax.jit
    def halves():
        def turn(now, given):
            y, u = given
            after = kalman_update(space, now, y, V)
            return kalman_predict(space, after, u, W), (now, after)

        given = (jnp.asarray(y), jnp.concatenate([u, u[-1:]]))
        return jax.lax.scan(turn, Estimate(jnp.zeros(3), jnp.eye(3)), given)[1]

    before, after = halves()
    assert relative_error(after.state, whole.state) < 1e-13
    assert relative_error(after.covariance, whole.covariance) < 1e-13
    assert relative_error(before.covariance, whole.predicted_covariance) < 1e-13
    steady = kalman_gain(A, C, W, V, discrete=True)
    assert relative_error(before.covariance[-1], steady.P) < 1e-9


@pytest.mark.slow
def test_a_cart_pole_is_held_by_measured_positions():
    """Speeds come from the filter; the loop is stable, and the estimate near the state."""
    model, dt = rb.load("cart_pole"), 0.02
    up, zero = rb.State(jnp.array([0.0, jnp.pi]), jnp.zeros(2)), jnp.zeros(1)
    K = lqr_at(model, up, zero, [10.0, 10.0, 1.0, 1.0], [0.1], dt=dt).K
    law = feedback(model, up, zero, K)
    space = model_state_space(model, lambda state: state.q, dt)
    W, V = jnp.array([1e-8, 1e-8, 1e-4, 1e-4]), jnp.array([1e-6, 1e-6])
    start = rb.State(up.q + jnp.array([0.2, 0.1]), jnp.array([0.1, -0.3]))
    noise = 1e-3 * jax.random.normal(jax.random.key(0), (300, 2))

    @jax.jit
    def run():
        def turn(carry, e):
            state, guess = carry
            guess = kalman_update(space, guess, state.q + e, V)
            u = law(0.0, guess.state)
            off = jnp.concatenate([guess.state.q - state.q, guess.state.v - state.v])
            after = kalman_predict(space, guess, u, W)
            return (rb.step(model, state, u, dt), after), (state, off)

        guess = Estimate(up, jnp.diag(jnp.array([0.1, 0.1, 1.0, 1.0])))
        return jax.lax.scan(turn, (start, guess), noise)[1]

    states, off = run()
    assert np.abs(states.q[-50:] - up.q).max() < 0.02
    assert np.abs(off[-50:, :2]).max() < 5e-3 and np.abs(off[-50:, 2:]).max() < 0.1
