"""Lowering rules for matrix factorizations and triangular systems.

Each rule traces a JAX function that works column by column, and lowers it. Small matrices are
unrolled; larger ones use a loop over the columns.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from rbjax.compiler.ir.statements import I32, Block, Value, Var
from rbjax.compiler.lower import arrays
from rbjax.compiler.lower.arrays import ThreadArray, View
from rbjax.compiler.lower.elementwise import source
from rbjax.compiler.lower.lowering import Equation, Lowering, accepts_delayed, dtype_of, rule

#: matrices of more columns are factorized by a loop
UNROLL_UP_TO = 8
#: larger triangular systems are not divided among the threads of a team
ROWS_UP_TO = 16


def _columns(n: int, step: Callable, *state: jax.Array, reverse: bool = False) -> Any:
    """Run step(k, *state) for each column k. k is a Python int if there are few columns."""
    if n <= UNROLL_UP_TO:
        for k in reversed(range(n)) if reverse else range(n):
            state = step(k, *state)
        return state
    turn = lambda k, x: step(n - 1 - k if reverse else k, *x)  # noqa: E731
    return lax.fori_loop(0, n, turn, state)


def _row(a: jax.Array, k: ArrayLike, first: int = 0) -> jax.Array:
    """Return row a[k], for k >= first. If k is not constant and a is small, use selections."""
    if isinstance(k, int) or len(a) > UNROLL_UP_TO:
        return a[k]
    out = a[-1]
    for i in reversed(range(first, len(a) - 1)):
        out = jnp.where(k == i, a[i], out)
    return out


def _exchange_rows(x: jax.Array, k: ArrayLike, p: ArrayLike, first: int = 0) -> jax.Array:
    """Exchange rows k and p of x. `first` is a lower bound of p."""
    rows = np.arange(len(x))
    here = (rows == p).reshape(-1, *[1] * (x.ndim - 1))
    there = (rows == k).reshape(here.shape)
    return jnp.where(there, _row(x, p, first), jnp.where(here, x[k], x))


def cholesky(a: jax.Array) -> jax.Array:
    """Compute the Cholesky factor L, A = L L^T, from the lower triangle; nan unless A > 0."""
    return _cholesky_by(a, False)[0]


def _cholesky_by(a: jax.Array, inverse: bool) -> tuple[jax.Array, jax.Array]:
    """Compute the Cholesky factor L. If `inverse`, compute also the inverses (n,) of its diagonal,
    by inverse square roots, which are faster on a GPU than square roots and divisions."""
    n = len(a)
    rows = np.arange(n)

    def step(k: ArrayLike, a: jax.Array, factors: jax.Array, bad: jax.Array) -> tuple:
        pivot = a[k, k]
        bad = bad | ~(pivot > 0)
        factor = lax.rsqrt(pivot) if inverse else jnp.ones_like(pivot)
        factors = jnp.where(rows == k, factor, factors) if inverse else factors
        root = pivot * factor if inverse else jnp.sqrt(pivot)
        scaled = a[:, k] * factor if inverse else a[:, k] / root
        column = jnp.where(rows == k, root, jnp.where(rows > k, scaled, 0))
        below = (rows[:, None] > k) & (rows > k) & (rows[:, None] >= rows)
        a = jnp.where(below, a - column[:, None] * column, a)
        return jnp.where(rows == k, column[:, None], a), factors, bad

    a, factors, bad = _columns(n, step, a, jnp.ones(n, a.dtype), jnp.asarray(False))
    lower = rows[:, None] >= rows
    return jnp.where(lower, jnp.where(bad, jnp.nan, a), 0), jnp.where(bad, jnp.nan, factors)


def lu(a: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the LU factorization with partial pivoting, as `jax.lax.linalg.lu`.
    Returns L and U in one matrix, the row that is exchanged at each column, and the permutation."""
    m, n = a.shape
    rows, columns, count = np.arange(m), np.arange(n), min(m, n)

    def step(k: ArrayLike, a: jax.Array, pivots: jax.Array, order: jax.Array) -> tuple:
        size = jnp.where(rows < k, -1, jnp.abs(a[:, k]))
        size = jnp.where(jnp.isnan(size), jnp.inf, size)
        p = jnp.argmax(size[k:] if isinstance(k, int) else size).astype(jnp.int32)
        p = p + k if isinstance(k, int) else p
        first = k if isinstance(k, int) else 0

        a, order = _exchange_rows(a, k, p, first), _exchange_rows(order, k, p, first)
        pivots = jnp.where(np.arange(count) == k, p, pivots)
        below = rows > k
        pivot = a[k, k]
        factor = jnp.where(pivot == 0, a[:, k], a[:, k] / pivot)
        right = below[:, None] & (columns > k)
        a = jnp.where(right, a - factor[:, None] * a[k], a)
        return jnp.where(below[:, None] & (columns == k), factor[:, None], a), pivots, order

    start = a, jnp.zeros(count, jnp.int32), jnp.arange(m, dtype=jnp.int32)
    return _columns(count, step, *start)


def permutation(pivots: jax.Array, *, permutation_size: int) -> jax.Array:
    """Return the permutation (permutation_size,) that a sequence of row exchanges makes."""
    rows = np.arange(permutation_size)

    def step(k: ArrayLike, order: jax.Array) -> tuple:
        p = pivots[k]
        return (jnp.where(rows == k, _row(order, p), jnp.where(rows == p, order[k], order)),)

    return _columns(len(pivots), step, jnp.arange(permutation_size, dtype=jnp.int32))[0]


def triangular_solve(
    a: jax.Array, b: jax.Array, *, left_side: bool, lower: bool, transpose_a: bool,
    unit_diagonal: bool,
) -> jax.Array:  # fmt: skip
    """Solve a x = b, or x a = b unless `left_side`. If `transpose_a`, a^T replaces a."""
    if not left_side:
        a, b = a.T, b.T
        lower = not lower
    if transpose_a:
        a = a.T
        lower = not lower
    n = len(a)
    rows = np.arange(n)

    def step(k: ArrayLike, b: jax.Array) -> tuple:
        x = b[k] if unit_diagonal else b[k] / a[k, k]
        later = rows > k if lower else rows < k
        b = jnp.where(later[:, None], b - a[:, k][:, None] * x, b)
        return (jnp.where((rows == k)[:, None], x, b),)

    (x,) = _columns(n, step, b, reverse=not lower)
    return x if left_side else x.T


def geqrf(a: jax.Array, pivoting: bool = False) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the QR factorization by Householder reflections, as LAPACK's geqrf (geqp3).

    Returns a matrix with R above and the reflection vectors below the diagonal, the factors tau of
    the reflections, and the order of the columns. With `pivoting`, the longest remaining column is
    eliminated next.
    """
    m, n = a.shape
    rows, columns, count = np.arange(m), np.arange(n), min(m, n)

    def step(k: ArrayLike, a: jax.Array, taus: jax.Array, order: jax.Array) -> tuple:
        if pivoting:
            left = jnp.where((rows >= k)[:, None], a, 0)
            p = jnp.where(columns >= k, (left * left).sum(0), -1).argmax().astype(jnp.int32)
            a, order = _exchange_rows(a.T, k, p).T, _exchange_rows(order, k, p)
        below, alpha = rows > k, a[k, k]
        rest = jnp.where(below, a[:, k] ** 2, 0).sum()
        length = jnp.sqrt(alpha**2 + rest)
        beta = jnp.where(alpha >= 0, -length, length)
        flat = rest == 0
        tau = jnp.where(flat, 0, (beta - alpha) / jnp.where(flat, 1, beta))
        scale = jnp.where(flat, 1, alpha - beta)
        v = jnp.where(rows == k, 1, jnp.where(below, a[:, k] / scale, 0))
        right = (rows >= k)[:, None] & (columns > k)
        a = jnp.where(right, a - tau * v[:, None] * (v @ a), a)
        mine = columns == k
        a = jnp.where(below[:, None] & mine, v[:, None], a)
        a = jnp.where((rows == k)[:, None] & mine, jnp.where(flat, alpha, beta), a)
        return a, jnp.where(np.arange(count) == k, tau, taus), order

    return _columns(count, step, a, jnp.zeros(count, a.dtype), jnp.arange(n, dtype=jnp.int32))


def householder_product(a: jax.Array, taus: jax.Array) -> jax.Array:
    """Return Q, the first columns of the product of Householder reflections, as LAPACK's orgqr."""
    rows = np.arange(a.shape[0])

    def step(k: ArrayLike, q: jax.Array) -> tuple:
        v = jnp.where(rows == k, 1, jnp.where(rows > k, a[:, k], 0))
        return (q - taus[k] * v[:, None] * (v @ q),)

    start = jnp.eye(a.shape[0], a.shape[1], dtype=a.dtype)
    return _columns(len(taus), step, start, reverse=True)[0]


def qr(a: jax.Array, *, full_matrices: bool, pivoting: bool = False) -> tuple[jax.Array, ...]:
    """Compute the QR factorization. Returns Q, R and, with `pivoting`, the order of the columns."""
    m, n = a.shape
    r, taus, order = geqrf(a, pivoting)
    k = m if full_matrices else min(m, n)
    wide = jnp.concatenate([r, jnp.zeros((m, max(k - n, 0)), a.dtype)], 1)[:, :k]
    found = householder_product(wide, taus), jnp.triu(r[:k])
    return (*found, order) if pivoting else found


def lower_mapped(low: Lowering, eqn: Equation, ins: list, f: Callable, rank: int = 2) -> list:
    """Lower f, mapped over leading axes. rank: number of axes of f's first argument."""
    for _ in range(eqn.invars[0].aval.ndim - rank):
        f = jax.vmap(f)
    return low.evaluate(f, *ins, avals=[v.aval for v in eqn.invars])


def matrix_rule(name: str, f: Callable, *params: str, rank: int = 2) -> None:
    """Register f(*arrays, **params of the equation) as the rule of a primitive (`lower_mapped`)."""

    def lower(low: Lowering, eqn: Equation, ins: list) -> list:
        given = {name: eqn.params[name] for name in params if name in eqn.params}
        return lower_mapped(low, eqn, ins, functools.partial(f, **given), rank)

    rule(name)(lower)


@rule("cholesky")
def _cholesky(low: Lowering, eqn: Equation, ins: list) -> list:
    if low.b.in_team and ins[0].ndim == 2 and ins[0].shape[0] <= UNROLL_UP_TO:
        a = low.to_scalars(ins[0])
        with low.b.per_thread():  # each thread computes the whole factor in its registers
            f = functools.partial(_cholesky_by, inverse=True)
            L, inverses = lower_mapped(low, eqn, [a], f)
        for root, inverse in zip(np.diagonal(L), inverses, strict=True):
            low.b.inverses[root] = inverse
        return [L]
    return lower_mapped(low, eqn, ins, cholesky)


matrix_rule("lu", lu)
matrix_rule("lu_pivots_to_permutation", permutation, "permutation_size", rank=1)
matrix_rule("geqrf", lambda a: geqrf(a)[:2])
matrix_rule("householder_product", householder_product)
matrix_rule("qr", qr, "full_matrices", "pivoting")


@rule("triangular_solve")
def _triangular_solve(low: Lowering, eqn: Equation, ins: list) -> list:
    names = "left_side", "lower", "transpose_a", "unit_diagonal"
    if low.b.in_team and ins[0].ndim == 2 and ins[0].shape[0] <= ROWS_UP_TO:
        return [_solved_by_team(low, eqn, *ins)]
    ins = [arrays.materialize(low.b, x) for x in ins]
    f = functools.partial(triangular_solve, **{name: eqn.params[name] for name in names})
    return lower_mapped(low, eqn, ins, f)


accepts_delayed("triangular_solve")


@dataclass(frozen=True, eq=False)
class Solved:
    """A loop in which each thread of a team solves a triangular system for one right-hand side.

    solution: view of all solutions in memory.
    version: version of the array of `solution` after they were stored.
    block: the statements of the loop.
    left: whether the matrix is on the left, a x = b.
    column: index of the right-hand side (column if `left`, else row) of a thread.
    x: entries of a thread's solution, in registers.
    """

    solution: View
    version: int
    block: Block
    left: bool
    column: Value
    x: list[Value]

    def goes_on(self, left: bool, used: Sequence[View | Value | None], right: View) -> bool:
        """Return whether a second solve may be fused into this loop.

        The second solve must read only values from before the loop (`used`). Its right-hand side
        `right` must be the unchanged solution of this loop.
        """
        column = self.column.id if isinstance(self.column, Var) else 0
        there = all(not isinstance(v, Var) or v.id < column for v in used)
        known = not any(isinstance(v, View) for v in used)
        whole = self.solution.is_same_view(right) and right.array.version == self.version
        return self.left == left and there and known and whole


def _solved_by_team(
    low: Lowering, eqn: Equation, a: ThreadArray, right: ThreadArray
) -> ThreadArray:
    """Emit a triangular solve in which each thread has one right-hand side in registers."""
    b, P, dtype, n = low.b, eqn.params, dtype_of(eqn.outvars[0].aval), a.shape[0]
    left, turned = P["left_side"], P["transpose_a"] == P["left_side"]
    forwards = P["lower"] != turned
    a = arrays.materialize(b, a)
    a = low.to_scalars(a) if n <= UNROLL_UP_TO else arrays.to_memory(b, a, dtype)

    def entry(j: int, k: int) -> Value:
        j, k = (k, j) if turned else (j, k)
        return (
            arrays.load_entry(b, a, (I32.type(j), I32.type(k))) if isinstance(a, View) else a[j, k]
        )

    def inverted(x: Value) -> Value:
        return b.inverses[x] if x in b.inverses else b.op("div", dtype, dtype.type(1), x)

    inverse = [None if P["unit_diagonal"] else inverted(entry(k, k)) for k in range(n)]

    def solve(x: list[Value]) -> list[Value]:
        for k in range(n) if forwards else reversed(range(n)):
            by = inverse[k]
            if by is not None:
                x[k] = b.op("mul", dtype, x[k], by)
            for j in range(k + 1, n) if forwards else range(k):
                x[j] = b.op("sub", dtype, x[j], b.op("mul", dtype, entry(j, k), x[k]))
        return x

    if right.shape[1 if left else 0] == 1:
        found = solve(list(low.to_scalars(right).reshape(-1)))
        out = np.empty(right.shape, object)
        out.reshape(-1)[:] = found
        return out
    view = View.of(b.local(dtype, right.size), right.shape)

    def write(c: Value, x: list[Value]) -> None:
        for k in range(n):
            arrays.store_entry(b, view, (I32.type(k), c) if left else (c, I32.type(k)), x[k])
        b.solved[view.array] = Solved(view, view.array.version, b.block, left, c, x)

    before = b.solved.get(right.array) if isinstance(right, View) else None
    used = [*inverse, *np.ravel(a)] if isinstance(a, np.ndarray) else [a]
    if before is not None and before.goes_on(left, used, right):
        with b.inside(before.block), b.per_thread():
            write(before.column, solve(list(before.x)))
        return view
    s = source(b, right, right.shape)

    def column(c: Value) -> None:
        write(c, solve([s.entry(*((I32.type(k), c) if left else (c, I32.type(k))))
                        for k in range(n)]))  # fmt: skip

    arrays.for_each_index(b, (right.shape[1 if left else 0],), column)
    return view


@rule("custom_linear_solve")
def _custom_linear_solve(low: Lowering, eqn: Equation, ins: list) -> list:
    counts, jaxprs = eqn.params["const_lengths"], eqn.params["jaxprs"]
    sizes = [counts.matvec, counts.vecmat, counts.solve, counts.transpose_solve]
    start = sum(sizes[:2])
    solve = ins[start : start + counts.solve]
    return low.closed(jaxprs.solve, [*solve, *ins[sum(sizes) :]])
