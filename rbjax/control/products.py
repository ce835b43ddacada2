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
    """Read a matrix row by row on a GPU, so that a program of one sample (`rb.threads`) works on
    registers. A CPU has too few of them."""
    if A.ndim < 2 or A.size > ENTRIES:
        return A
    rows = lambda A: jnp.stack([A[i] for i in range(A.shape[0])])  # noqa: E731
    return jax.lax.platform_dependent(A, cuda=rows, default=lambda A: A)
