"""The backward pass beside the Riccati recursion, and its half of the work beside the whole."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from rbjax.control import LinearQuadratic
from rbjax.control.backward_pass import backward_pass, carried, carried_by_velocities
from rbjax.control.box_qp import box_gains, box_qp
from rbjax.control.expansion import Quadratic
from rbjax.control.riccati import backward
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
    path = Quadratic(
        g[:N, 0], g[:N, :n], H[:N, :n, :n], g[:N, n:], H[:N, n:, n:], H[:N, :n, n:]
    )
    end = Quadratic(g[N, 0], g[N, :n], H[N, :n, :n], g[N, n:], H[N, n:, n:], H[N, :n, n:])
    gaps = jnp.concatenate([jnp.zeros((1, n)), d])
    found = backward_pass(A, B, gaps, path, end, None, None, jnp.zeros(()))
    due = backward(
        LinearQuadratic(
            A, B, d, H[:, :n, :n], g[:, :n], H[:N, n:, n:], g[:N, n:], H[:N, :n, n:]
        )
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
    for one, other in zip(carried(*args), carried_by_velocities(*args, h), strict=True):
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
