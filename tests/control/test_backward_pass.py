"""The backward pass beside the Riccati recursion, and its half of the work beside the whole."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from rbjax.control.linear import LinearQuadratic
from rbjax.control.linear.riccati import backward
from rbjax.control.optimal.shooting.backward_pass import (
    Bounds,
    backward_pass,
    box_gains,
    box_qp,
    propagate_value,
    propagate_value_by_velocities,
)
from rbjax.control.optimal.shooting.expansion import Quadratic
from tests.tolerances import F64_IDENTITY, F64_TRANSFORM, relative_error

N, n, m = 4, 4, 2


def drawn(seed: int) -> tuple:
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(N, n, n)), rng.normal(size=(N, n, m))
    H = rng.normal(size=(N + 1, n + m, n + m))
    H = jnp.asarray(H @ H.swapaxes(1, 2) + np.eye(n + m))
    g = jnp.asarray(rng.normal(size=(N + 1, n + m)))
    return jnp.asarray(A), jnp.asarray(B), H, g, jnp.asarray(rng.normal(size=(N, n)))


def test_it_is_the_riccati_recursion_of_a_linear_problem() -> None:
    A, B, H, g, d = drawn(0)
    path = Quadratic(g[:N, 0], g[:N, :n], H[:N, :n, :n], g[:N, n:], H[:N, n:, n:], H[:N, :n, n:])
    end = Quadratic(g[N, 0], g[N, :n], H[N, :n, :n], g[N, n:], H[N, n:, n:], H[N, :n, n:])
    gaps = jnp.concatenate([jnp.zeros((1, n)), d])
    found = backward_pass(A, B, gaps, path, end, None, None, jnp.zeros(()))
    due = backward(
        LinearQuadratic(A, B, d, H[:, :n, :n], g[:, :n], H[:N, n:, n:], g[:N, n:], H[:N, :n, n:])
    )
    assert bool(found.ok)
    assert relative_error(-found.K, due.K) < F64_TRANSFORM
    assert relative_error(-found.k, due.k) < F64_TRANSFORM
    assert relative_error(found.V, due.P) < F64_TRANSFORM


def test_steps_by_velocities_are_half_the_work_of_the_same() -> None:
    rng = np.random.default_rng(1)
    h, nv = 0.1, 3
    low, E = rng.normal(size=(nv, 2 * nv)), rng.normal(size=(nv, 2))
    A = np.concatenate([np.eye(nv, 2 * nv) + h * low, low])
    B = np.concatenate([h * E, E])
    V = rng.normal(size=(2 * nv, 2 * nv))
    V, v = V @ V.T, rng.normal(size=2 * nv)
    args = [jnp.asarray(x) for x in (V, v, A, B)]
    pairs = zip(propagate_value(*args), propagate_value_by_velocities(*args, h), strict=True)
    for one, other in pairs:
        assert relative_error(one, other) < F64_IDENTITY


@pytest.mark.parametrize("seed", range(20))
def test_a_program_in_a_box_beside_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = 5
    G, b = rng.normal(size=(size + 2, size)), rng.normal(size=size + 2)
    low, high = -rng.uniform(0.01, 1, size), rng.uniform(0.01, 1, size)
    due = lsq_linear(G, b, (low, high), tol=1e-14, method="bvls").x
    args = [jnp.asarray(x) for x in (G.T @ G, -G.T @ b, low, high)]
    found = box_qp(*args)
    assert np.abs(found.d - due).max() < 1e-10  # SciPy's own error
    assert bool(found.ok)
    inside = (due > low + 1e-9) & (due < high - 1e-9)
    assert (np.asarray(found.free, bool) == inside).all()


@pytest.mark.parametrize("width", [0.05, 100.0])
def test_gains_in_a_box(width: float) -> None:
    """Some entries at bounds, and none."""
    rng = np.random.default_rng(3)
    H = rng.normal(size=(3, 3))
    H, g, G = H @ H.T + np.eye(3), rng.normal(size=3), rng.normal(size=(3, 5))
    low, high = -width * np.ones(3), width * np.ones(3)
    d, K, ok = box_gains(*map(jnp.asarray, (H, g, G, low, high)))
    free = (low < d) & (d < high)
    assert bool(ok) and bool(free.all()) == (width > 1)
    slope = H @ d + g
    assert np.abs(slope[free]).max(initial=0.0) < F64_TRANSFORM
    due = np.zeros((3, 5))
    due[free] = -np.linalg.solve(H[np.ix_(free, free)], G[free])
    assert relative_error(K, due) < F64_TRANSFORM


def test_gains_of_an_indefinite_hessian_are_not_ok() -> None:
    H, ones = -jnp.eye(2), jnp.ones(2)
    assert not bool(box_gains(H, ones, jnp.ones((2, 3)), -ones, ones)[2])


def cost_of(A, B, gaps, H, g, dx0, du) -> jax.Array:
    """Of a linear problem along controls, from dx0."""
    x, total = dx0, 0.0
    for k in range(N):
        z = jnp.concatenate([x, du[k]])
        total = total + 0.5 * z @ H[k] @ z + g[k] @ z
        x = A[k] @ x + B[k] @ du[k] + gaps[k + 1]
    return total + 0.5 * x @ H[N, :n, :n] @ x + g[N, :n] @ x


def played(A, B, gaps, found, dx0) -> jax.Array:
    """The controls of a full step from dx0."""
    x, us = dx0, []
    for k in range(N):
        us.append(found.k[k] + found.K[k] @ x)
        x = A[k] @ x + B[k] @ us[-1] + gaps[k + 1]
    return jnp.stack(us)


@pytest.mark.slow
@pytest.mark.parametrize("free", [None, (1.0, 0.0, 1.0, 1.0)])
@pytest.mark.parametrize("gapped", [False, True])
def test_slope_curvature_and_gradient_are_those_of_the_cost(gapped: bool, free: Any) -> None:
    """The change of the cost of a full step, and without gaps of a shorter one; the gradient is
    that of autodiff; the controls, and what is free of the start, are the least."""
    A, B, H, g, d = drawn(5)
    gaps = jnp.concatenate([d[:1] if free is None else 0 * d[:1], d]) * gapped
    path = Quadratic(g[:N, 0], g[:N, :n], H[:N, :n, :n], g[:N, n:], H[:N, n:, n:], H[:N, :n, n:])
    end = Quadratic(g[N, 0], g[N, :n], H[N, :n, :n], g[N, n:], H[N, n:, n:], H[N, :n, n:])
    wide = 1e9 * jnp.ones((N, m))
    first = None if free is None else (jnp.asarray(free), -1e9 * jnp.ones(n), 1e9 * jnp.ones(n))
    found = backward_pass(A, B, gaps, path, end, Bounds(-wide, wide), first, jnp.zeros(()))
    cost = lambda dx0, du: cost_of(A, B, gaps, H, g, dx0, du)  # noqa: E731
    us = played(A, B, gaps, found, found.first)
    zero = jnp.zeros((N, m))
    # before the step the states do not follow the dynamics: they are at their knots, with no cost
    full = float(cost(found.first, us))
    assert abs(full - float(found.slope + 0.5 * found.curvature)) < 1e-9 * abs(full)
    by_start, by_controls = jax.grad(cost, (0, 1))(found.first, us)
    assert np.abs(by_controls).max() < 1e-9
    mask = np.zeros(n) if free is None else np.asarray(free)
    assert np.abs(mask * by_start).max() < 1e-9
    assert np.abs(found.first - gaps[0])[mask == 0].max() == 0
    if not gapped:
        half = float(cost(0.5 * found.first, 0.5 * us))
        assert abs(half - float(0.5 * found.slope + 0.125 * found.curvature)) < 1e-9 * abs(half)
        by_start, by_controls = jax.grad(cost, (0, 1))(jnp.zeros(n), zero)
        due = (by_controls**2).sum() + ((mask * by_start) ** 2).sum()
        assert abs(float(found.square) / float(due) - 1) < 1e-12


@pytest.mark.slow
def test_bounds_and_regularisation_of_the_pass() -> None:
    """Controls at a bound that presses have no gradient and no gains; regularisation is added to
    the Hessians of the controls and of the value function."""
    A, B, H, g, _ = drawn(6)
    gaps, one = jnp.zeros((N + 1, n)), jnp.ones((N, m))
    path = Quadratic(g[:N, 0], g[:N, :n], H[:N, :n, :n], g[:N, n:], H[:N, n:, n:], H[:N, :n, n:])
    end = Quadratic(g[N, 0], g[N, :n], H[N, :n, :n], g[N, n:], H[N, n:, n:], H[N, :n, n:])
    zero = jnp.zeros(())
    cost = lambda du: cost_of(A, B, gaps, H, g, jnp.zeros(n), du)  # noqa: E731
    slope = jax.grad(cost)(0 * one)
    low = jnp.where(slope > 0, 0.0, -1e9)  # each control at the bound that presses
    high = jnp.where(slope < 0, 0.0, 1e9)
    held = backward_pass(A, B, gaps, path, end, Bounds(low, high), None, zero)
    assert held.square == 0
    assert np.abs(held.k).max() == 0 and np.abs(held.K).max() == 0
    opposite = backward_pass(A, B, gaps, path, end, Bounds(-high, -low), None, zero)
    assert abs(float(opposite.square) / float((slope**2).sum()) - 1) < 1e-12
    reg = 3.0
    eye_x, eye_u = reg * jnp.eye(n), reg * jnp.eye(m)
    plain = backward_pass(A, B, gaps, path, end, None, None, jnp.asarray(reg))
    more = H.at[:N, :n, :n].add(eye_x).at[:N, n:, n:].add(eye_u).at[N, :n, :n].add(eye_x)
    other = Quadratic(path.c, path.q, more[:N, :n, :n], path.r, more[:N, n:, n:], path.S)
    last = Quadratic(end.c, end.q, more[N, :n, :n], end.r, end.R, end.S)
    due = backward_pass(A, B, gaps, other, last, None, None, zero)
    assert relative_error(plain.K, due.K) < F64_TRANSFORM
    assert relative_error(plain.k, due.k) < F64_TRANSFORM
    assert relative_error(plain.V[:N], due.V[:N]) < F64_TRANSFORM
