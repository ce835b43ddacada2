"""Loops of independent turns, whose number depends on values, against sums of arrays."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.compiler.jax.turns import Turns
from tests.tolerances import F64_IDENTITY


def turn(x, y):
    return jnp.sin(x) * y.sum()


def loop(visit, carry, counters):
    length, rows = counters
    return jax.lax.fori_loop(0, length, lambda k, carry: visit(rows[k], carry), carry)


def summed(x, y, rows, length):
    """Add sin(x_i) (y_0 + y_1) to row i of (3, 2) for the first rows."""
    turns = Turns(
        loop,
        reads=lambda i: [[(i, 1)], None],
        writes=lambda i: [[(i, 1)]],
        term=lambda i, x, y: [turn(x, y)],
    )
    return turns([x, y], [length, rows], [(3, 2)])[0]


def want(x, y, rows, length):
    count = np.bincount(rows[:length], minlength=3)
    return jnp.asarray(count)[:, None] * turn(x, y)


X, Y = jnp.asarray(np.random.default_rng(0).normal(size=(3, 2))), jnp.array([0.3, -1.2])
ROWS = np.array([2, 0, 2, 1], np.int32)


def test_values_and_derivatives_are_those_of_the_sum():
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(3, 2)))
    dx, dy = 0.7 * X[::-1], jnp.array([0.1, 0.4])

    def every(f, length):
        given = lambda x, y: f(x, y, ROWS, length)  # noqa: E731
        value, rate = jax.jvp(given, (X, Y), (dx, dy))
        slopes = jax.grad(lambda *at: (weights * given(*at)).sum(), (0, 1))(X, Y)
        return value, rate, *slopes

    for length in (0, 1, 3, 4):
        found = jax.jit(lambda n: every(summed, n))(jnp.int32(length))
        for a, b in zip(found, every(want, length), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=F64_IDENTITY)


def test_batches_and_kernels():
    lengths = jnp.array([0, 2, 4], jnp.int32)
    xs = jnp.stack([X, 2.0 * X, -X])

    def slope(x, n):
        return jax.grad(lambda x: (summed(x, Y, ROWS, n) ** 2).sum())(x)

    expected = [
        jax.grad(lambda x: (want(x, Y, ROWS, int(n)) ** 2).sum())(x)  # noqa: B023
        for x, n in zip(xs, lengths, strict=True)
    ]
    for f in (slope, rb.threads(slope)):
        np.testing.assert_allclose(
            jax.jit(jax.vmap(f))(xs, lengths), jnp.stack(expected), rtol=0, atol=10 * F64_IDENTITY
        )
