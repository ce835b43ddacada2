"""L D L^T on lanes against numpy, with blocks, with redundant rows, and its derivative."""

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler import threads
from rbjax.lanes import elimination_order, is_zero, ldlt
from tests.tolerances import F64_ROUNDING

RNG = np.random.default_rng(5)


def positive(n: int, rank: int | None = None) -> np.ndarray:
    J = RNG.normal(size=(n, rank or n + 3))
    return J @ J.T


def lanes(A) -> list:
    return [[a[()] if hasattr(a, "shape") else a for a in row] for row in A]


def solved(A, b, **how):
    return jnp.stack([jnp.asarray(x) for x in ldlt(lanes(A), **how).solve(list(b))])


def test_it_solves() -> None:
    for n in range(1, 9):
        A, b = positive(n), RNG.normal(size=n)
        np.testing.assert_allclose(jax.jit(solved)(A, b), np.linalg.solve(A, b), rtol=1e-9)


def test_blocks_that_do_not_meet_stay_apart() -> None:
    """A matrix of blocks in a scrambled order fills in nothing between them; an arrow whose head
    comes first fills in nothing where the head is eliminated last."""
    places = RNG.permutation(6)
    A = np.zeros((6, 6))
    for some in (places[:2], places[2:]):
        A[np.ix_(some, some)] = positive(len(some))
    known = [[float(a) if a == 0 else jnp.asarray(a) for a in row] for row in A]
    factors = ldlt(known)
    filled = sum(not is_zero(x) for row in factors.L for x in row)
    assert filled == 1 + 6
    b = RNG.normal(size=6)
    np.testing.assert_allclose(np.stack(factors.solve(list(b))), np.linalg.solve(A, b), rtol=1e-9)
    arrow = [[1.0 if i == j or 0 in (i, j) else 0.0 for j in range(6)] for i in range(6)]
    assert 0 in elimination_order(arrow)[-2:]
    arrow[0][0] = 9.0
    grown = ldlt(arrow)
    assert sum(not is_zero(x) for row in grown.L for x in row) == 5


def test_redundant_rows_are_left_out() -> None:
    """Rows that depend on others: their share is zero, what is left solves the equations, and
    derivatives are finite."""
    J = RNG.normal(size=(5, 3))
    A, b = J @ J.T, J @ RNG.normal(size=3)  # rank 3, and the equations can be met
    x = jax.jit(lambda A, b: solved(A, b, least=1e-10))(A, b)
    assert (np.asarray(x) == 0).sum() == 2
    np.testing.assert_allclose(A @ x, b, rtol=1e-9)
    slope = jax.grad(lambda b: solved(A, b, least=1e-10).sum())(b)
    assert np.isfinite(slope).all()


def test_derivatives() -> None:
    A, b = positive(4), RNG.normal(size=4)
    dA, db = positive(4), RNG.normal(size=4)
    _, got = jax.jvp(solved, (A, b), (dA, db))
    want = jax.jvp(jnp.linalg.solve, (A, b), (dA, db))[1]
    np.testing.assert_allclose(got, want, rtol=1e-8)


def test_on_threads() -> None:
    """The same as one sample a GPU thread."""
    A = np.stack([positive(4) for _ in range(3)])
    b = RNG.normal(size=(3, 4))
    got = jax.vmap(threads(solved))(A, b)
    np.testing.assert_allclose(got, jax.vmap(solved)(A, b), rtol=F64_ROUNDING * 100)
