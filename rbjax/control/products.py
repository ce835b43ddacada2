"""Products of small matrices, column by column.

In a program of one sample (`rb.threads`) a large `dot` is a loop over memory, one multiplication
after the other. A sum of rows scaled by entries is straight code on whole rows, which a compiler
orders as it likes; and f32 stays f32.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def product(A: jax.Array, B: jax.Array) -> jax.Array:
    """A B, of (m, n) and (n, k)."""
    total = A[:, :1] * B[:1]
    for i in range(1, B.shape[0]):
        total = total + A[:, i : i + 1] * B[i : i + 1]
    return total


def congruence(A: jax.Array, B: jax.Array) -> jax.Array:
    """A' B, of (m, n) and (m, k); where it is symmetric only by its meaning it is not made so."""
    return product(A.T, B)


def times(A: jax.Array, x: jax.Array) -> jax.Array:
    """A x."""
    total = A[:, 0] * x[0]
    for i in range(1, x.shape[0]):
        total = total + A[:, i] * x[i]
    return jnp.asarray(total)
