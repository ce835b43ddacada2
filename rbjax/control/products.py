"""Products of matrices in full precision: by default a GPU multiplies f32 matrices in TF32."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
"""A B, or A x."""

#: matrices of at most so many entries are taken out of memory row by row on a GPU
ENTRIES = 400


def in_registers(A: jax.Array) -> jax.Array:
    """A matrix, on a GPU its rows one by one: in a program of one sample (`rb.threads`) what
    follows works on values, and not on memory in loops. A CPU has fewer registers, and it reads
    vectors from memory: there an iteration of a quadrotor's problem takes twice as long on values.
    """
    if A.ndim < 2 or A.size > ENTRIES:
        return A
    rows = lambda A: jnp.stack([A[i] for i in range(A.shape[0])])  # noqa: E731
    return jax.lax.platform_dependent(A, cuda=rows, default=lambda A: A)
