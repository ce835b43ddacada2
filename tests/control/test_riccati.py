"""The finite horizon beside a dense linear system, closed forms, and derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control.linear import LinearQuadratic, backward
from tests.composing import check_composes
from tests.control.problems import random_problem
from tests.oracles import load
from tests.tolerances import F32_MEDIAN, relative_error

ORACLE = load("linear_quadratic")
in_time = functools.partial(backward, parallel=True)
serial, parallel, rolled = map(jax.jit, (backward, in_time, LinearQuadratic.roll))


def quadratic_cost(z, x, u):
    """The cost of states (N + 1, n) and controls (N, m)."""
    z, x, u = jax.tree.map(np.asarray, (z, x, u))
    of_states = np.einsum("ki,kij,kj->", x, z.Q, x) / 2 + (z.q * x).sum()
    of_controls = np.einsum("ki,kij,kj->", u, z.R, u) / 2 + (z.r * u).sum()
    return of_states + of_controls + np.einsum("ki,kij,kj->", x[:-1], z.S, u)


def by_kkt(z, start):
    """States, controls and multipliers from the dense conditions of optimality."""
    z = jax.tree.map(np.asarray, z)
    N, n, m = z.B.shape
    nx, nu = (N + 1) * n, N * m
    H, g = np.zeros((nx + nu, nx + nu)), np.concatenate([z.q.ravel(), z.r.ravel()])
    rows, right = np.zeros(((N + 1) * n, nx + nu)), np.zeros((N + 1) * n)
    rows[:n, :n], right[:n] = np.eye(n), start
    for k in range(N + 1):
        x = slice(k * n, k * n + n)
        H[x, x] = z.Q[k]
        if k == N:
            break
        u, after = slice(nx + k * m, nx + k * m + m), slice((k + 1) * n, (k + 2) * n)
        H[u, u], H[x, u], H[u, x] = z.R[k], z.S[k], z.S[k].T
        rows[after, after], rows[after, x], rows[after, u] = np.eye(n), -z.A[k], -z.B[k]
        right[after] = z.d[k]
    c = len(rows)
    M = np.block([[H, rows.T], [rows, np.zeros((c, c))]])
    found = np.linalg.solve(M, np.concatenate([-g, right]))
    return found[:nx].reshape(N + 1, n), found[nx : nx + nu].reshape(N, m)


@pytest.mark.parametrize("gains", [serial, parallel])
def test_the_conditions_of_optimality_as_one_linear_system(gains):
    z = random_problem(0, 9, 4, 2)
    start = np.random.default_rng(1).normal(size=4)
    found = gains(z)
    x, u = rolled(z, found, jnp.asarray(start))
    want_x, want_u = by_kkt(z, start)
    assert relative_error(x, want_x) < 1e-11 and relative_error(u, want_u) < 1e-11
    assert found.success
    # the cost to go differs from the cost by a constant of the start
    zero = jnp.zeros(4)
    at_zero = quadratic_cost(z, *rolled(z, found, zero))
    to_go = start @ found.P[0] @ start / 2 + found.p[0] @ start
    assert relative_error(quadratic_cost(z, x, u) - at_zero, to_go) < 1e-11


@pytest.mark.parametrize("N", [16, *(pytest.param(n, marks=pytest.mark.slow) for n in (256, 4096))])
def test_parallel_in_time_is_serial(N):
    z = random_problem(2, N, 12, 6) if N > 16 else random_problem(2, N, 4, 2)
    a, b = serial(z), parallel(z)
    for x, y in zip(a, b, strict=True):
        assert relative_error(x, y) < 1e-10


def test_the_finite_horizon_in_forty_digits():
    o = ORACLE["lqr_discrete"]
    A, B, Q, R, end = (jnp.asarray(o[k], float) for k in ("A", "B", "Q", "R", "P_N"))
    R = R.reshape(1, 1)
    z = LinearQuadratic.constant(A, B, Q, R, o["N"], end)
    found = backward(z)
    assert relative_error(found.P[0], o["P_0"]) < 1e-13
    for k in (0, 25, 49):
        assert relative_error(found.K[k, 0], o[f"K_{k}"]) < 1e-13
    x, u = rolled(z, found, jnp.asarray(o["x0"], float))
    assert abs(float(quadratic_cost(z, x, u)) - o["cost"]) < 1e-13
    assert relative_error(u[:5, 0], o["u_0_4"]) < 1e-13
    assert np.abs(x[-1] - np.array(o["x_N"])).max() < 1e-14


@pytest.mark.parametrize("gains", [serial, parallel])
@pytest.mark.parametrize("bad", ["indefinite", "nan", "inf"])
def test_what_has_no_minimum_is_said_and_never_nan(gains, bad):
    z = random_problem(5, 6, 3, 2)
    value = {"indefinite": -1e3, "nan": np.nan, "inf": np.inf}[bad]
    z = z._replace(R=z.R.at[3, 0, 0].set(value))
    found = gains(z)
    assert not found.success
    assert all(np.isfinite(x).all() for x in found)

    def total(R):
        found = backward(z._replace(R=R))
        return found.K.sum() + found.P.sum()

    if gains is serial and bad == "indefinite":
        assert np.isfinite(jax.jit(jax.grad(total))(z.R)).all()


def test_the_hessian_needs_no_definite_control_cost():
    z = random_problem(6, 5, 3, 2)
    z = z._replace(R=z.R * 0, S=z.S * 0)
    found = serial(z)
    start = np.ones(3)
    assert found.success
    assert relative_error(rolled(z, found, jnp.asarray(start))[1], by_kkt(z, start)[1]) < 1e-9
    assert not parallel(z).success  # which needs one


def test_gains_compose():
    """Under jit, vmap and both modes of differentiation."""
    batch = [random_problem(k, 3, 2, 1) for k in range(3)]
    xs = [np.stack([np.asarray(getattr(z, f)) for z in batch]) for f in ("A", "B", "d", "R", "S")]

    def gains(A, B, d, R, S):
        return backward(batch[0]._replace(A=A, B=B, d=d, R=R, S=S))[:4]

    check_composes(gains, xs)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_problem_is_small_enough_for_a_thread(dtype):
    said = rb.compiler.explain(backward, random_problem(7, 16, 12, 6, dtype))
    assert said.statements < 20_000 and said.array_bytes < 16 * 1024


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_threads(dtype):
    batch = [random_problem(k, 20, 12, 6) for k in range(5)]
    z = jax.tree.map(lambda *x: jnp.stack(x).astype(dtype), *batch)
    found = jax.jit(jax.vmap(rb.threads(backward)))(z)
    want = jax.vmap(backward)(jax.tree.map(lambda *x: jnp.stack(x), *batch))
    for x, y in zip(found, want, strict=True):
        assert relative_error(x, y) < (1e-12 if dtype is np.float64 else 20 * F32_MEDIAN)
