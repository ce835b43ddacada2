"""Matrices of pairs beside exact fractions."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.control.linear.algebraic_riccati import Double


def exact(x):
    return np.vectorize(Fraction)(np.asarray(x, float))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_products_and_sums(dtype):
    """Of numbers of all sizes that cancel: (A B - C) + C, where C is the rounded product."""
    rng = np.random.default_rng(0)
    A, B = (rng.normal(size=(4, 4)) * 10.0 ** rng.integers(-3, 4, (4, 4)) for _ in range(2))
    A, B = A.astype(dtype), B.astype(dtype)
    C = A @ B

    def f(A, B, C):
        less = Double.of(A) @ Double.of(B) - Double.of(C)
        return less, less @ Double.of(B).T

    less, more = jax.jit(f, compiler_options={})(A, B, C)  # compiled: XLA may join operations
    want = exact(A) @ exact(B) - exact(C)
    largest = float(np.abs(exact(A)).dot(np.abs(exact(B))).max())
    eps = float(jnp.finfo(dtype).eps)
    off = exact(less.hi) + exact(less.lo) - want
    assert np.abs(off).max() < 8 * eps**1.5 * largest
    off = exact(more.hi) + exact(more.lo) - want @ exact(B).T
    assert np.abs(off).max() < 32 * eps**1.5 * largest * float(np.abs(B).max())
