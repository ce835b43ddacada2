"""Operations on arrays: packing of lanes, products without `dot`, extreme entries, maps over rows.

Products of stacks of matrices and vectors do not use `dot`, so that float32 products have full
float32 precision on every device. The derivative of an extreme entry is the derivative of one of
the equal entries. The derivative of `jnp.min` divides by their number, which XLA may compute as 0.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.lanes.algebra import Lane
from rbjax.lanes.primitives import fusion_barrier

Array = Any  # a numpy array, a JAX array, or an object array of cells


def matmat(A: Array, B: Array) -> Array:
    """Compute A B for stacks of matrices (..., m, n) and (..., n, k)."""
    return (A[..., :, :, None] * B[..., None, :, :]).sum(-2)


def matvec(A: Array, x: Array) -> Array:
    """Compute A x for stacks of matrices (..., m, n) and vectors (..., n)."""
    return (A * x[..., None, :]).sum(-1)


def matrix_transpose(A: Array) -> Array:
    """Transpose stacks of matrices."""
    return A.swapaxes(-1, -2)


def outer(a: Array, b: Array) -> Array:
    """Compute a b^T for stacks of vectors (..., m) and (..., n)."""
    return a[..., :, None] * b[..., None, :]


def select(condition: Any, a: Any, b: Any) -> Any:
    """Return a if the condition is true, else b, leaf by leaf."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


Pair = tuple[jax.Array, jax.Array]


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def smallest(x: jax.Array, axis: int = -1) -> jax.Array:
    """Return the minimum along an axis that is not empty."""
    return x.min(axis)


@smallest.defjvp
def _smallest_jvp(axis: int, primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> Pair:
    return _picked(jnp.argmin(*primals, axis, keepdims=True), axis, *primals, *tangents)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def largest(x: jax.Array, axis: int = -1) -> jax.Array:
    """Return the maximum along an axis that is not empty."""
    return x.max(axis)


@largest.defjvp
def _largest_jvp(axis: int, primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> Pair:
    return _picked(jnp.argmax(*primals, axis, keepdims=True), axis, *primals, *tangents)


def unpack(x: jax.Array) -> list[Lane]:
    """Return the rows of an array (n, ...) as lanes (...)."""
    return [x[i] for i in range(x.shape[0])]


def pack(lanes: Sequence[Lane], like: jax.Array) -> jax.Array:
    """Stack lanes as the rows of an array, with the dtype and the row shape of `like`.
    A fusion barrier computes each lane once."""
    if not lanes:
        return jnp.zeros((0, *like.shape[1:]), like.dtype)
    rows = [jnp.broadcast_to(jnp.asarray(x, like.dtype), like.shape[1:]) for x in lanes]
    return jnp.stack(fusion_barrier(rows))


def _picked(index: jax.Array, axis: int, x: jax.Array, dx: jax.Array) -> Pair:
    one, other = (jnp.take_along_axis(y, index, axis).squeeze(axis) for y in (x, dx))
    return one, other


def each(f: Callable, *xs: Any) -> Any:
    """Map f over the rows of the arguments and stack the results.

    On a CPU this is `vmap`. On a GPU it is a loop over the rows, so that the program of a thread
    contains f once and stores the intermediate values of one row.
    """

    def loop(*xs: Any) -> Any:
        return jax.lax.map(jax.checkpoint(lambda x: f(*x)), xs)

    return jax.lax.platform_dependent(*xs, cuda=loop, default=jax.vmap(f))
