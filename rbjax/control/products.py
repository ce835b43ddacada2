"""Matrix products in full precision, where a GPU takes TF32 by default, and Cholesky factors."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

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


@jax.custom_jvp
def definite_factor(H: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return L of H = L L' and whether H is positive definite; if not, L is the identity matrix."""
    L = jax.lax.linalg.cholesky(H, symmetrize_input=False)
    ok = jnp.isfinite(L).all()
    return jnp.where(ok, L, jnp.eye(H.shape[-1], dtype=H.dtype)), ok


@definite_factor.defjvp
def _definite_factor_jvp(primals, tangents):
    (H,), (dH,) = primals, tangents
    L, ok = definite_factor(H)
    half = solve_triangular(L, (dH + dH.T) / 2, lower=True)
    W = solve_triangular(L, half.T, lower=True)
    dL = product(L, jnp.tril(W) - jnp.diag(jnp.diag(W)) / 2)
    return (L, ok), (jnp.where(ok, dL, 0.0), jnp.zeros(ok.shape, jax.dtypes.float0))
