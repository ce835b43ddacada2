"""Reductions, cumulative sums and inverses that are loops of the program: quick ones as machine
code, against XLA. The sweeps are in test_primitives.py."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.lanes import inverse
from tests.tolerances import F64_TRANSFORM, relative_error

X = np.random.default_rng(5).normal(size=(3, 7, 200))  # more entries a sample than are unrolled


def long_sums(x):
    i = (40 * jnp.abs(x)).astype(int)
    return (
        jnp.cumsum(x, 1), jax.lax.cummax(x, 0), jax.lax.cumprod(x[0], reverse=True),
        jnp.argmax(x, 1), jnp.argmin(x, 0), jnp.argmax(i, 1), x.max(0), x.min(), (x > 0).any(1),
        (x > -9).all(), i.sum(0), jnp.prod(1 + x / 9, 1),
    )  # fmt: skip


def holes(x):
    y = x.at[3, 5].set(jnp.nan)
    return jnp.argmax(y, 1), jnp.argmin(y, 0), jnp.where(jnp.isnan(y.max(1)), 1.0, 0.0)


def inverses(x):
    a, b = x[:, :7] + 5 * jnp.eye(7), x[:, 7:14]
    pivoted = inverse(a[::-1])  # off the diagonal
    return *inverse(a), *pivoted, *inverse(a, b)


@pytest.mark.parametrize("f", [long_sums, holes, inverses])
def test_loops_are_what_xla_computes(f):
    run, want = jax.jit(jax.vmap(rb.threads(f))), jax.jit(jax.vmap(f))
    for a, b in zip(run(X), want(X), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype
        if a.dtype.kind == "f":
            assert relative_error(a, b) < F64_TRANSFORM
        else:
            np.testing.assert_array_equal(a, b)
