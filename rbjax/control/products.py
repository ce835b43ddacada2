"""Matrix products in full precision; by default a GPU multiplies f32 matrices in TF32."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
"""A B, or A x."""

#: largest number of entries of a matrix that a GPU reads row by row
ENTRIES = 400


def in_registers(A: jax.Array) -> jax.Array:
    """Return A, read row by row to keep it in registers of a GPU thread (`rb.threads`).

    On a CPU, which has fewer registers, A is returned unchanged.
    """
    if A.ndim < 2 or A.size > ENTRIES:
        return A
    rows = lambda A: jnp.stack([A[i] for i in range(A.shape[0])])  # noqa: E731
    return jax.lax.platform_dependent(A, cuda=rows, default=lambda A: A)
