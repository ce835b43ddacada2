"""Products of stacks of matrices and vectors without `dot`, so that f32 is f32 on every device."""

from __future__ import annotations

from typing import Any

Array = Any  # of numpy, of JAX, or an object array of cells


def matmat(A: Array, B: Array) -> Array:
    """A B for stacks of matrices (..., m, n) and (..., n, k)."""
    return (A[..., :, :, None] * B[..., None, :, :]).sum(-2)


def matvec(A: Array, x: Array) -> Array:
    """A x for stacks of matrices (..., m, n) and vectors (..., n)."""
    return (A * x[..., None, :]).sum(-1)


def matrix_transpose(A: Array) -> Array:
    """A^T for stacks of matrices."""
    return A.swapaxes(-1, -2)


def outer(a: Array, b: Array) -> Array:
    """a b^T for stacks of vectors (..., m) and (..., n)."""
    return a[..., :, None] * b[..., None, :]
