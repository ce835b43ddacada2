"""Products of matrices in full precision: by default a GPU multiplies f32 matrices in TF32."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
"""A B, or A x."""

#: matrices of at most so many entries are taken out of memory row by row
ENTRIES = 400


def in_registers(A: jax.Array) -> jax.Array:
    """A matrix, its rows one by one: in a program of one sample (`rb.threads`) what follows works
    on values, and not on memory in loops."""
    if A.ndim < 2 or A.size > ENTRIES:
        return A
    return jnp.stack([A[i] for i in range(A.shape[0])])
