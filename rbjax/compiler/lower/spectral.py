"""Lowering rules for eigenvalues and singular values, by Jacobi rotations.

    eigenvalues       A <- J^T A J until A is diagonal             (V is the product of all J)
    singular values   A <- A J until the columns are orthogonal    (A V = U S)

Each rotation makes one entry, or one product of columns, zero. Sweeps over all pairs converge
quadratically. (Golub & Van Loan, *Matrix Computations*, 8.5, 8.6; Demmel & Veselic 1992.)
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from rbjax.compiler.ir.statements import Unsupported
from rbjax.compiler.lower.factorise import UNROLL_UP_TO, lower_mapped, qr
from rbjax.compiler.lower.lowering import Equation, Lowering, rule

#: the most sweeps; 4 to 8 are usual
MOST_SWEEPS = 20


def _sweep(n: int, rotate: Callable, *state: jax.Array) -> Any:
    """Run rotate(i, j, *state) of Jacobi's method for each pair i < j. i and j are Python ints if n
    is small."""
    pairs = np.array([(i, j) for i in range(n) for j in range(i + 1, n)], np.int32)
    if n <= UNROLL_UP_TO:
        for i, j in pairs.tolist():
            state = rotate(i, j, *state)
        return state
    table = jnp.asarray(pairs)
    return lax.fori_loop(0, len(pairs), lambda k, x: rotate(table[k, 0], table[k, 1], *x), state)


def _rotation(
    a: jax.Array, b: jax.Array, c: jax.Array, off: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return cosine and sine of the rotation that makes [[a, c], [c, b]] diagonal.
    Unless `off`, the rotation is the identity."""
    half = (b - a) / jnp.where(off, 2 * c, 1)
    t = jnp.where(half >= 0, 1.0, -1.0) / (jnp.abs(half) + jnp.sqrt(half * half + 1))
    t = jnp.where(off, t, 0.0).astype(c.dtype)
    cosine = 1 / jnp.sqrt(t * t + 1)
    return cosine, t * cosine


def _rotated(x: jax.Array, i: jax.Array, j: jax.Array, c: jax.Array, s: jax.Array) -> jax.Array:
    """Rotate rows i and j of x by the angle with cosine c and sine s."""
    first, second = x[i], x[j]
    return x.at[i].set(c * first - s * second).at[j].set(s * first + c * second)


def eigh(a: jax.Array, *, lower: bool) -> tuple[jax.Array, jax.Array]:
    """Compute the eigenvectors and the ascending eigenvalues of a symmetric matrix.

    Only the lower triangle is read if `lower`, else only the upper. If an entry is not finite, the
    eigenvalues are nan.
    """
    n, rows = len(a), np.arange(len(a))
    kept = rows[:, None] >= rows if lower else rows[:, None] <= rows
    a = jnp.where(kept, a, a.T)
    size = jnp.abs(a).max()
    a = a / jnp.where(size > 0, size, 1)
    outside = rows[:, None] != rows
    least = jnp.finfo(a.dtype).eps ** 2

    def rotate(
        i: jax.Array, j: jax.Array, a: jax.Array, vt: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        c, s = _rotation(a[i, i], a[j, j], a[i, j], a[i, j] != 0)
        a = _rotated(_rotated(a, i, j, c, s).T, i, j, c, s)
        return a, _rotated(vt, i, j, c, s)

    def more(x: tuple) -> jax.Array:
        count, a, _ = x
        square = a * a
        return (jnp.where(outside, square, 0).sum() > least * square.sum()) & (count < MOST_SWEEPS)

    start = jnp.int32(0), a, jnp.eye(n, dtype=a.dtype)
    _, a, vt = lax.while_loop(more, lambda x: (x[0] + 1, *_sweep(n, rotate, *x[1:])), start)
    w = jnp.diagonal(a)
    order = jnp.argsort(w)
    return vt[order].T, jnp.where(jnp.isfinite(size), size * w[order], jnp.nan)


def svd(a: jax.Array, *, full_matrices: bool) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the singular values, in descending order, U and V^T.
    An entry that is not finite makes the singular values nan."""
    if a.shape[0] < a.shape[1]:
        s, u, vt = svd(a.T, full_matrices=full_matrices)
        return s, vt.T, u.T
    n = a.shape[1]
    size = jnp.abs(a).max()
    eps = jnp.finfo(a.dtype).eps
    at = a.T / jnp.where(size > 0, size, 1)
    zero = eps * eps * (at * at).sum()  # a shorter row is zero up to rounding

    def rotate(
        i: jax.Array, j: jax.Array, at: jax.Array, vt: jax.Array, turned: jax.Array
    ) -> tuple:
        x, y = at[i], at[j]
        xx, yy, xy = (x * x).sum(), (y * y).sum(), (x * y).sum()
        off = (jnp.abs(xy) > eps * jnp.sqrt(xx * yy)) & (jnp.minimum(xx, yy) > zero)
        c, s = _rotation(xx, yy, xy, off)
        return _rotated(at, i, j, c, s), _rotated(vt, i, j, c, s), turned | off

    def sweep(x: tuple) -> tuple:
        count, _, at, vt = x
        at, vt, turned = _sweep(n, rotate, at, vt, jnp.asarray(False))
        return count + 1, turned, at, vt

    start = jnp.int32(0), jnp.asarray(True), at, jnp.eye(n, dtype=a.dtype)
    more = lambda x: x[1] & (x[0] < MOST_SWEEPS)  # noqa: E731
    _, _, at, vt = lax.while_loop(more, sweep, start)
    s = jnp.sqrt((at * at).sum(1))
    order = jnp.argsort(-s)
    s, at, vt = s[order], at[order], vt[order]
    # QR completes U by columns that are orthogonal to the known ones
    q, r = qr((at / jnp.where(s > 0, s, 1)[:, None]).T, full_matrices=full_matrices)
    signs = jnp.where(jnp.diagonal(r) < 0, -1.0, 1.0).astype(a.dtype)
    u = q * jnp.concatenate([signs, jnp.ones(q.shape[1] - n, a.dtype)])
    return jnp.where(jnp.isfinite(size), size * s, jnp.nan), u, vt


def _whole(eqn: Equation) -> None:
    if eqn.params.get("subset_by_index") is not None:
        raise Unsupported(f"{eqn.primitive.name} of a subset")


@rule("eigh")
def _eigh(low: Lowering, eqn: Equation, ins: list) -> list:
    _whole(eqn)
    return lower_mapped(low, eqn, ins, functools.partial(eigh, lower=eqn.params["lower"]))


@rule("svd")
def _svd(low: Lowering, eqn: Equation, ins: list) -> list:
    _whole(eqn)
    if not eqn.params["compute_uv"]:
        return lower_mapped(low, eqn, ins, lambda a: svd(a, full_matrices=False)[:1])
    f = functools.partial(svd, full_matrices=eqn.params.get("full_matrices", False))
    return lower_mapped(low, eqn, ins, f)
