"""Differential inverse kinematics against SciPy's bounded least squares and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import rbjax as rb
import rbjax.control as control
from rbjax.errors import InputError
from rbjax.kinematics.velocity_level import bounded_quadratic
from tests.control.arms import arm7

velocity = control.differential_inverse_kinematics
Q = np.array([0.3, 0.4, -0.5, 1.0, 0.6, 1.0, 0.2])


@pytest.fixture(scope="module")
def arm():
    return arm7()


def test_bounded_quadratic_against_scipy():
    """Random problems, half of whose bounds hold something; SciPy's BVLS."""
    rng = np.random.default_rng(0)
    solve = jax.jit(jax.vmap(lambda A, b, low, high: bounded_quadratic(
        A.T @ A, A.T @ b, low, high)))  # fmt: skip
    A, b = rng.normal(size=(20, 9, 6)), 3 * rng.normal(size=(20, 9))
    low, high = -rng.uniform(0, 1, (20, 6)), rng.uniform(0, 1, (20, 6))
    got, optimal = solve(A, b, low, high)
    held = 0
    for k in range(20):
        want = lsq_linear(A[k], b[k], (low[k], high[k]), method="bvls", tol=1e-14).x
        np.testing.assert_allclose(got[k], want, atol=1e-9)
        held += ((want == low[k]) | (want == high[k])).sum()
    assert held > 30 and np.abs(optimal).max() < 1e-9


def test_what_is_left_of_a_search_that_ends_early_is_said(monkeypatch):
    """`optimal` is the projected gradient, entries at a bound that should be left included."""
    rng = np.random.default_rng(2)
    A, b = rng.normal(size=(20, 6, 6)), rng.normal(size=(20, 6))
    low, high = -rng.uniform(0, 0.5, (20, 6)), rng.uniform(0, 0.5, (20, 6))
    most = []
    for steps in (0, 3, 4, 5):
        monkeypatch.setattr("rbjax.kinematics.velocity_level.STEPS", steps / 6)
        x, optimal = jax.vmap(lambda A, b, low, high: bounded_quadratic(
            A.T @ A + jnp.eye(6), A.T @ b, low, high))(A, b, low, high)  # fmt: skip
        x = np.asarray(x)
        down = np.einsum("kij,kj->ki", A.transpose(0, 2, 1) @ A + np.eye(6), x)
        down -= np.einsum("kji,kj->ki", A, b)
        step = np.clip(x - down, low, high) - x  # zero just where no entry can be improved
        rests = np.abs(step).max(1) < 1e-12
        assert (np.asarray(optimal)[~rests] > 1e-9).all() and (optimal[rests] < 1e-9).all()
        most.append((~rests).sum())
    assert most[0] == 20 and min(most) < 20


def test_error_falls_at_the_rate(arm):
    """Without limits J v = rate e, and v is the pseudoinverse's."""
    R, p = rb.frame_pose(arm, jnp.asarray(Q), site="tool")
    goal = control.Goal(site="tool", position=p + 0.01, rotation=R)
    found = velocity(arm, Q, goal, rate=3.0, damping=1e-9)
    J = np.asarray(rb.jacobian(arm, jnp.asarray(Q), site="tool"))
    want = np.linalg.pinv(J) @ np.array([0, 0, 0, 0.03, 0.03, 0.03])
    np.testing.assert_allclose(found.v, want, atol=1e-6)
    assert np.abs(found.residual).max() < 1e-8


def test_limits_hold(arm):
    """Speeds, and the end of a range that is 0.01 rad away, within a step of 0.1 s."""
    q = np.array(Q)
    q[3] = float(arm.joints.range[3, 1]) - 0.01
    _, p = rb.frame_pose(arm, jnp.asarray(q), site="tool")
    goal = control.Goal(site="tool", position=p - 0.3)
    found = velocity(arm, q, goal, rate=5.0, speed=0.8, dt=0.1)
    assert np.abs(found.v).max() <= 0.8 and found.v[3] <= 0.1 + 1e-12
    assert (np.abs(found.v) == 0.8).any() and found.optimality < 1e-8


def test_derivative_with_limits(arm):
    _, p = rb.frame_pose(arm, jnp.asarray(Q), site="tool")
    f = jax.jit(lambda x: velocity(arm, Q, control.Goal(site="tool", position=x), rate=5.0,
                                     speed=0.4, damping=1e-2).v)  # fmt: skip
    at, h = p + jnp.array([0.2, -0.1, 0.1]), 1e-6
    assert (np.abs(f(at)) == 0.4).any()
    J = jax.jit(jax.jacfwd(f))(at)
    Jr = jax.jit(jax.jacrev(f))(at)
    for i in range(3):
        step = h * np.eye(3)[i]
        difference = (f(at + step) - f(at - step)) / (2 * h)
        assert np.abs(J[:, i] - difference).max() < 1e-6 * np.abs(J).max()
    np.testing.assert_allclose(J, Jr, atol=1e-10)


def test_bad_arguments(arm):
    goal = control.Goal(site="tool", position=np.zeros(3))
    with pytest.raises(InputError, match="speed is"):
        velocity(arm, Q, goal, speed=-1.0)
    with pytest.raises(InputError, match="speed has shape"):
        velocity(arm, Q, goal, speed=np.ones(3))
    with pytest.raises(InputError, match="expected Goals"):
        velocity(arm, Q, [np.zeros(3)])
    with pytest.raises(InputError, match="q has shape"):
        velocity(arm, Q[:3], goal)
