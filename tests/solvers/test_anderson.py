"""Anderson's acceleration on linear maps, and on a map with kinks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.solvers.anderson import History, accelerate


def iterate(f, x, rounds):
    """The errors of the rounds, and the last x."""
    history, errors = History.start(x), []
    for _ in range(rounds):
        value = f(x)
        errors.append(float(jnp.abs(value - x).max()))
        x, history = accelerate(history, x, value, jnp.abs(value - x).max())
    return errors, x


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize("rate", [0.5, -0.98, -3.0, 4.0])
def test_a_linear_map_is_solved_exactly(size, rate):
    """x <- A x + b ends at (I - A)^-1 b, also if the plain iteration diverges."""
    A = np.array([[rate, 0.3], [0.0, 0.4]])[:size, :size]
    b, x = np.arange(1.0, size + 1), jnp.zeros(size)
    errors, x = iterate(lambda x: A @ x + b, x, size + 3)
    np.testing.assert_allclose(x, np.linalg.solve(np.eye(size) - A, b), rtol=1e-9)
    assert errors[-1] < 1e-9


def test_a_map_with_kinks_and_single_precision():
    """max(b - A x, 0): fewer rounds than the plain iteration, and a fixed point that stays."""
    A, b = np.array([[0.6, 0.3, 0.0], [0.2, 0.7, 0.2], [0.0, 0.3, 0.5]]), np.array([1.0, 2.0, -1.0])
    f = lambda x: jnp.maximum(b.astype(x.dtype) - A.astype(x.dtype) @ x, 0.0)  # noqa: E731
    for dtype, bound in ((jnp.float64, 1e-12), (jnp.float32, 1e-6)):
        errors, x = iterate(f, jnp.zeros(3, dtype), 12)
        plain = jnp.zeros(3, dtype)
        for _ in range(12):
            plain = f(plain)
        assert x.dtype == dtype and errors[-1] <= bound < float(jnp.abs(f(plain) - plain).max())
        assert np.isfinite(x).all()


def test_it_runs_in_a_batch():
    def two(x):
        history = History.start(x)
        for _ in range(3):
            f = 1.0 - 2.0 * x
            x, history = accelerate(history, x, f, jnp.abs(f - x).max())
        return x

    np.testing.assert_allclose(jax.vmap(two)(jnp.arange(6.0).reshape(3, 2)), 1 / 3, rtol=1e-12)
