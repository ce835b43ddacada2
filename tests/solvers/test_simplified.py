"""The simplified matrix of a step beside the dense matrix of all its stages."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.solvers import tableau as tables
from rbjax.solvers.constrained.differential_algebraic import solve_by_corrections
from rbjax.solvers.constrained.simplified import Simplified, Sizes, simplified, weights

K, X, ROWS, H = 4, 1, 2, 0.02  # velocities, states x, rows, step
N = 2 * K + X
METHODS = {
    "radau3": tables.radau_iia(3), "gauss2": tables.gauss(2), "radau1": tables.radau_iia(1)
}  # fmt: skip


class Linear:
    """A linear mechanism, with springs and dampers of a given stiffness and a first-order state,
    on rows of index 2, 3 or both (GGL)."""

    def __init__(self, kind: str, stiff: float, redundant: bool = False):
        rng = np.random.default_rng(2)
        square = rng.normal(size=(K, K))
        M, G = square @ square.T + np.eye(K), rng.normal(size=(ROWS, K))
        if redundant:
            G = np.concatenate([G, G[:1] + G[1:]])
        m = len(G)
        again = m if kind == "ggl" else 0
        depth = ((2,) if kind == "index_3" else (1,)) * m + (1,) * again
        self.sizes = Sizes(N, K, depth, again)
        size = N + m + again
        y, rate, w = np.zeros((size, N)), np.zeros((size, N)), np.zeros((size, m + again))
        u, v, x, rows = slice(0, K), slice(K, 2 * K), slice(2 * K, N), slice(N, N + m)
        rate[u, u], y[u, v] = (M, -M) if again else (np.eye(K), -np.eye(K))
        rate[v, v], rate[x, x], w[v, :m] = M, np.eye(X), -G.T
        y[v, u], y[v, v] = stiff * np.diag(rng.uniform(size=K)), 0.1 * stiff * square @ square.T
        y[v, x], y[x, v], y[x, x] = rng.normal(size=(K, X)), rng.normal(size=(X, K)), 30.0
        y[rows, u if kind == "index_3" else v] = G
        if again:
            w[u, m:], y[N + m :, u] = -G.T, G
        self.slopes = np.concatenate([y, rate, w], 1)
        self.usual = np.tile(np.diag(G @ np.linalg.solve(M, G.T)), 2 if again else 1)

    def dense(self, tableau: tables.Tableau) -> np.ndarray:
        """The matrix of all stages, with its rows integrated back."""
        a = np.array(tableau.a)
        back, size = np.linalg.inv(H * a), len(self.slopes)
        out = np.zeros((len(a), size, len(a), size))
        y, rate, w = np.split(self.slopes, (N, 2 * N), 1)
        for i in range(size):
            p = self.sizes.depth[i - N] if i >= N else 0
            to = np.linalg.matrix_power(back, p)
            out[:, i, :, :N] = np.einsum("ij,c->ijc", to @ (H * a), y[i])
            out[:, i, :, :N] += np.einsum("ij,c->ijc", to, rate[i])
            out[:, i, :, N:] = np.einsum("ij,c->ijc", to, w[i])
        return out.reshape(len(a) * size, -1)


@functools.cache
def solver(kind: str, method: str, redundant: bool = False) -> Callable:
    """From the slopes and the dense matrix of all stages: x of one application of the simplified
    matrix; x by iteration; the same of the transposed matrices; whether these converge."""
    sizes = Linear(kind, 1.0, redundant).sizes
    of = weights(np.array(METHODS[method].a), jnp.float64)

    @jax.jit
    def solved(slopes, dense, usual, r):
        blocks = simplified(lambda d: slopes @ d, sizes, H, of, usual)
        found = Simplified(sizes, H, of, blocks)

        def times(matrix: jax.Array, x: jax.Array) -> jax.Array:
            return (matrix @ x.ravel()).reshape(x.shape)

        def back(d: jax.Array) -> jax.Array:
            return jax.linear_transpose(found.solved, d)(d)[0]

        forward = solve_by_corrections(functools.partial(times, dense), found.solved, r, N)
        transposed = solve_by_corrections(functools.partial(times, dense.T), back, r, N)
        return found.solved(r), forward, transposed

    return lambda given, r: solved(given.slopes, given.dense(METHODS[method]), given.usual, r)


slow = pytest.mark.slow


@pytest.mark.parametrize(
    "method", ["radau3", pytest.param("gauss2", marks=slow), pytest.param("radau1", marks=slow)]
)
@pytest.mark.parametrize("kind", ["index_2", "index_3", "ggl"])
def test_beside_the_dense_matrix(kind: str, method: str) -> None:
    """Once, where positions go with velocities: up to the regularization. Iterated: the solution,
    of the transposed matrix too, however stiff."""
    s = METHODS[method].stages
    r = np.random.default_rng(5).normal(size=(s, len(Linear(kind, 1.0).slopes)))
    for stiff, exact in ((1.0, 1e-12), (1e7, 1e-10)):  # rounding, times conditioning
        given = Linear(kind, stiff)
        dense = given.dense(METHODS[method])
        _, *both = solver(kind, method)(given, r)
        for matrix, (x, done) in zip((dense, dense.T), both, strict=True):
            assert done
            due = np.linalg.solve(matrix, r.ravel()).reshape(r.shape)
            for part in (slice(0, K), slice(K, N), slice(N, None)):
                size = np.abs(due[:, part]).max()
                np.testing.assert_allclose(x[:, part], due[:, part], rtol=0, atol=exact * size)
        if kind != "ggl":
            consistent = np.where(np.arange(r.shape[1]) < K, 0, r)
            want = np.linalg.solve(dense, consistent.ravel()).reshape(r.shape)
            once = solver(kind, method)(given, consistent)[0]
            np.testing.assert_allclose(once, want, rtol=0, atol=1e-5 * np.abs(want).max())


@pytest.mark.parametrize("kind", ["index_2", "index_3", pytest.param("ggl", marks=slow)])
def test_redundant_rows(kind: str) -> None:
    """Rates are those without the redundant row."""
    r = np.random.default_rng(6).normal(size=(3, N + 2 * ROWS))
    rates = []
    for redundant in (False, True):
        given = Linear(kind, 10.0, redundant)
        parts = [r[:, :N]]
        for k in range(2 if kind == "ggl" else 1):
            own = r[:, N + k * ROWS : N + (k + 1) * ROWS]
            parts += [own, own.sum(1, keepdims=True)] if redundant else [own]
        x, done = solver(kind, "radau3", redundant)(given, np.concatenate(parts, 1))[1]
        assert done and np.isfinite(x).all()
        rates.append(np.asarray(x[:, :N]))
    np.testing.assert_allclose(rates[1], rates[0], atol=1e-9)
