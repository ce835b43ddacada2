"""Elastic programs: against a simplex, and what they say of constraints that cannot hold."""

import jax
import numpy as np
import pytest
from scipy.optimize import linprog

from rbjax.planning.timing import elastic_program


def drawn(n: int, m: int, seed: int):
    rng = np.random.default_rng(seed)
    G, g, c = rng.normal(size=(m, n)), rng.uniform(-0.5, 1.5, m), rng.normal(size=n)
    box = -rng.uniform(0.001, 0.5, n), rng.uniform(0.001, 0.5, n)
    return c, G, g, rng.uniform(0.5, 3.0, m), *box


def test_linear_programs_as_by_a_simplex() -> None:
    """Some rows hold, some give way at their price; many programs at once."""
    n, m = 12, 20
    many = [drawn(n, m, seed) for seed in range(4)]
    run = jax.jit(jax.vmap(lambda *x: elastic_program.solve(np.zeros((n, n)), *x, 20)))
    found, multipliers = run(*map(np.stack, zip(*many, strict=True)))
    gave = 0
    for d, l, (c, G, g, p, low, high) in zip(found, multipliers, many, strict=True):
        bounds = [*zip(low, high, strict=True)] + [(0, None)] * m
        want = linprog(np.r_[c, p], np.c_[G, -np.eye(m)], g, bounds=bounds)
        over = np.maximum(G @ d - g, 0)
        assert c @ d + p @ over == pytest.approx(want.fun, abs=1e-8)
        assert ((low <= d) & (d <= high)).all() and ((l >= 0) & (l <= p)).all()
        np.testing.assert_allclose(l, -want.ineqlin.marginals, atol=1e-5)
        gave += (over > 1e-3).sum()
    assert gave > 4


def test_a_quadratic_program_by_hand() -> None:
    """The nearest point of a line, as two rows; a price below the multiplier leaves the line."""
    H, c = np.eye(2), np.array([-2.0, -1.0])  # nearest to (2, 1)
    G, g = np.array([[1.0, 1.0], [-1.0, -1.0]]), np.array([1.0, -1.0])  # x + y = 1
    box = np.full(2, -5.0), np.full(2, 5.0)

    def solved(price):
        return elastic_program.solve(H, c, G, g, np.full(2, price), *box, 20)[0]

    np.testing.assert_allclose(solved(3.0), [1.0, 0.0], atol=1e-7)  # the multiplier is 1
    np.testing.assert_allclose(solved(0.25), [1.75, 0.75], atol=1e-7)
