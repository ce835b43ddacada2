"""The time-varying regulator in a motion, and beside the recursion by numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import time_varying_lqr
from rbjax.model import State
from tests.tolerances import relative_error

N, DT = 60, 0.02


def swing():
    model = rb.load("cart_pole")
    u = 3.0 * jnp.sin(jnp.arange(N) * 0.2)[:, None]
    start = rb.State(jnp.array([0.0, 2.8]), jnp.zeros(2))
    return model, start, u, rb.rollout(model, start, u, DT)


Q, R, END = np.array([10.0, 10.0, 1.0, 1.0]), np.array([0.1]), 100 * np.ones(4)


def test_the_recursion_by_numpy():
    model, _, u, path = swing()
    law = time_varying_lqr(model, path, u, DT, Q, R, END)
    assert law.success and law.K.shape == (N, 1, 4)
    states = State(path.q[:-1], path.v[:-1])
    As, Bs = jax.jit(jax.vmap(lambda x, u: rb.linearise(model, x, u, DT)))(states, u)
    P = np.diag(END)
    for k in reversed(range(N)):
        A, B = np.asarray(As[k]), np.asarray(Bs[k])
        K = np.linalg.solve(np.diag(R) + B.T @ P @ B, B.T @ P @ A)
        P = np.diag(Q) + A.T @ P @ (A - B @ K)
        if k % 20 == 0:
            assert relative_error(law.K[k], K) < 1e-9
    assert relative_error(law.P[0], P) < 1e-9
    without_cost = time_varying_lqr(model, path, u, DT, Q, np.negative(R), END)
    assert not without_cost.success


@pytest.mark.slow
def test_the_law_in_a_motion():
    model, start, u, path = swing()
    law = time_varying_lqr(model, path, u, DT, Q, R, END)
    # on the motion the law repeats its controls
    again = rb.rollout(model, start, law, DT, steps=N)
    assert np.abs(again.q - path.q).max() < 1e-10
    # beside it the cost of a small deviation is what P says, and less than without feedback
    small = start.replace(q=start.q + jnp.array([1e-5, 2e-5]))
    costs = []
    for how in (law, lambda t, state: u[jnp.floor(t / DT + 1e-3).astype(int)]):
        moved = rb.rollout(model, small, how, DT, steps=N)
        dx = np.concatenate([moved.q - path.q, moved.v - path.v], 1)
        du = np.stack([how(k * DT, moved.state(k)) - u[k] for k in range(N)])
        costs += [(Q * dx[:-1] ** 2).sum() + (R * du**2).sum() + (END * dx[-1] ** 2).sum()]
    assert relative_error(costs[0] / (dx[0] @ law.P[0] @ dx[0]), 1.0) < 1e-3
    assert costs[1] > 1.2 * costs[0]


@pytest.mark.slow
def test_attitudes():
    """A quadrotor that rolls over: deviations on the tangent space."""
    model = rb.load("quadrotor")
    weight = float(model.bodies.mass.sum()) * 9.81 / model.nu
    turn = jnp.array([1.05, 1.05, 0.95, 0.95])
    u = weight * jnp.ones((N, 1)) * jnp.where(jnp.arange(N)[:, None] < 20, turn, 1.0)
    start = model.default_state()
    path = rb.rollout(model, start, u, DT)
    law = time_varying_lqr(model, path, u, DT, jnp.ones(12), 0.01 * jnp.ones(4), 100 * jnp.ones(12))
    q = rb.integrate(model, start.q, 0.1 * jnp.ones(6))
    off = start.replace(q=q)
    held, loose = rb.rollout(model, off, law, DT, steps=N), rb.rollout(model, off, u, DT)
    error = [np.abs(rb.difference(model, path.q[-1], p.q[-1])).max() for p in (held, loose)]
    assert law.success and error[1] > 2 * error[0]
