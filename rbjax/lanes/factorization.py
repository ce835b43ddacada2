"""L D L^T of small symmetric matrices on lanes, and the regularization of singular ones.

    A = L D L^T,  L unit lower triangular, D diagonal                   (n^3 / 6 products)
    A x = b:      L y = b,  z = D^-1 y,  L^T x = z                      (n^2)

Structural zeros cost nothing and fill in only if elimination couples their rows. A block-diagonal
matrix costs only its blocks. A pivot that is not above `least` times its original diagonal entry
belongs to a redundant row, for which the solution and its derivative are zero.

A singular system is regularized by E = eps diag(A) + e B, whose effect iteration removes:

    (A + E) dx = b - A x,     x <- x + dx;     or (A + E) x <- b + E x

This converges to the solution of least norm, in the norm of E, without a decision about rank
(Carpentier, Budhiraja & Mansard, *Proximal and sparse resolution of constrained dynamics*, 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes.algebra import Lane, add, is_literal, is_zero, mul, sub, total
from rbjax.lanes.primitives import fusion_barrier
from rbjax.rank_tolerances import rank_tolerance

Rows = Sequence[Sequence[Lane]]


class LDLT(NamedTuple):
    """The factors of A with its rows and columns permuted to `order`."""

    order: tuple[int, ...]
    #: entries below the diagonal, row by row
    L: list[list[Lane]]
    inverse_D: list[Lane]

    def solve(self, b: Sequence[Lane]) -> list[Lane]:
        """Solve A x = b for x (n lanes)."""
        x = [b[i] for i in self.order]
        for i, row in enumerate(self.L):
            for j, l in enumerate(row):
                x[i] = sub(x[i], mul(l, x[j]))
        x = [mul(a, d) for a, d in zip(x, self.inverse_D, strict=True)]
        for i in reversed(range(len(x))):
            for j, l in enumerate(self.L[i]):
                x[j] = sub(x[j], mul(l, x[i]))
        out = list(x)
        for place, i in enumerate(self.order):
            out[i] = x[place]
        return out


def ldlt(A: Rows, *, least: float = 0.0, order: Sequence[int] | None = None) -> LDLT:
    """Factorize a symmetric positive semi-definite matrix, given by its lower triangle.

    Args:
        A: (n, n) lanes.
        least: the relative size below which a pivot counts as zero.
        order: the order of elimination of the rows; `elimination_order(A)` if None.
    """
    n = len(A)
    taken = tuple(elimination_order(A) if order is None else order)
    rows = [[A[max(i, j)][min(i, j)] for j in taken] for i in taken]
    L: list[list[Lane]] = []
    inverse_D: list[Lane] = []
    for i in range(n):
        row: list[Lane] = []  # U_ij = L_ij D_j, then L_ij
        for j in range(i):
            entry = rows[i][j]
            for k in range(j):
                entry = sub(entry, mul(row[k], L[j][k]))
            row.append(entry)
        pivot = rows[i][i]
        for j, u in enumerate(row):
            l = mul(u, inverse_D[j])
            pivot = sub(pivot, mul(u, l))
            row[j] = l
        inverse = _inverse(pivot, rows[i][i], least)
        row, inverse = fusion_barrier((row, inverse), known=rows[i])
        L.append(row)
        inverse_D.append(inverse)
    return LDLT(taken, L, inverse_D)


class LU(NamedTuple):
    """The factors A = L U of a matrix with its rows and columns permuted to `order`; L has a unit
    diagonal."""

    order: tuple[int, ...]
    #: entries of each row below and above the diagonal, by column
    L: list[dict[int, Lane]]
    U: list[dict[int, Lane]]
    inverse_D: list[Lane]

    def solve(self, b: Sequence[Lane]) -> list[Lane]:
        """Solve A x = b for x (n lanes)."""
        x = [b[i] for i in self.order]
        for i, row in enumerate(self.L):
            for j, l in row.items():
                x[i] = sub(x[i], mul(l, x[j]))
        for i in reversed(range(len(x))):
            for j, u in self.U[i].items():
                x[i] = sub(x[i], mul(u, x[j]))
            x[i] = mul(x[i], self.inverse_D[i])
        out = list(x)
        for place, i in enumerate(self.order):
            out[i] = x[place]
        return out


def lu(A: Rows) -> LU:
    """Factorize a matrix whose symmetric part is positive definite, which needs no pivoting.

    (Golub & Van Loan, *Matrix Computations*, 4.1.)

    Args:
        A: (n, n) lanes. An entry and the opposite one are both structural zeros, or none is.
    """
    n = len(A)
    lower = [[A[i][j] if not is_zero(A[i][j]) else A[j][i] for j in range(i + 1)] for i in range(n)]
    order = tuple(elimination_order(lower))
    rows = [{j: A[i][k] for j, k in enumerate(order) if not is_zero(A[i][k])} for i in order]
    L: list[dict[int, Lane]] = []
    U: list[dict[int, Lane]] = []
    inverse_D: list[Lane] = []
    for i, row in enumerate(rows):
        below: dict[int, Lane] = {}
        for j in range(i):
            if j in row:
                below[j] = l = mul(row.pop(j), inverse_D[j])
                for k, u in U[j].items():
                    row[k] = sub(row.get(k, 0.0), mul(l, u))
        inverse = 1.0 / row.pop(i)
        below, row, inverse = fusion_barrier((below, row, inverse))
        L.append(below)
        U.append(row)
        inverse_D.append(inverse)
    return LU(order, L, U, inverse_D)


def _inverse(pivot: Lane, entry: Lane, least: float) -> Lane:
    if is_literal(pivot):
        return 1.0 / pivot if pivot > least * entry else 0.0
    sound = pivot > mul(least, entry)
    return jnp.where(sound, 1.0 / jnp.where(sound, pivot, 1.0), 0.0)


def elimination_order(A: Rows) -> list[int]:
    """Return a minimum-degree order of elimination, which causes little fill-in.
    (Tinney & Walker 1967; George & Liu 1989.)"""
    n = len(A)
    near = [
        {j for j in range(n) if j != i and not is_zero(A[max(i, j)][min(i, j)])} for i in range(n)
    ]
    left, order = set(range(n)), []
    while left:
        first = min(sorted(left), key=lambda i: len(near[i]))
        left.remove(first)
        order.append(first)
        for i in near[first]:
            near[i] |= near[first] - {i}
            near[i].discard(first)
    return order


#: bytes of a number -> refinements after which components of the solution along eigenvalues of A
#: above 1e-3 of the diagonal are exact to rounding
REFINEMENTS = {4: 3, 8: 2}


def regularization(dtype: Any, damping: float | None = None) -> tuple[float, float, int]:
    """Return eps and e of the regularization E = eps diag(A) + e B, and the number of refinements.
    damping: value of eps and e, with one refinement; None uses the values of the dtype."""
    if damping is not None:
        return damping, damping, 1
    eps, e = (rank_tolerance(name, dtype) for name in ("regularization", "vanishing row"))
    return eps, e, REFINEMENTS[dtype.itemsize]


def diagonal_floor(
    diagonal: jax.Array, usual: jax.Array | float, factor: float, unknown: float | None = None
) -> jax.Array:
    """Return a lower bound (n,) of the diagonal of a matrix: `factor * usual`.

    Args:
        diagonal: (n,) the diagonal in the current configuration.
        usual: the diagonal in a configuration without vanishing rows, 0 if it is not known.
        factor: the bound relative to `usual`.
        unknown: the bound relative to the sum of the diagonal if `usual` is 0; None is the machine
            epsilon.
    """
    unknown = float(jnp.finfo(diagonal.dtype).eps) if unknown is None else unknown
    usual = jnp.asarray(usual, diagonal.dtype)
    return jnp.where(usual > 0, factor * usual, unknown * diagonal.sum())


class LeastNorm:
    """A solver of A x = b for the solution of least norm, with a symmetric A on lanes.

    Args:
        A: the lower triangle of A, row by row.
        usual: the diagonal of A in a configuration without vanishing rows, 0 if it is not known.
        damping: the value of eps and e, with one refinement; None uses the values of the dtype.
    """

    def __init__(
        self,
        A: Sequence[Sequence[Lane]],
        usual: Sequence[Lane],
        dtype: Any,
        damping: float | None = None,
    ):
        eps, vanishing, self._refinements = regularization(dtype, damping)
        diagonal = [row[-1] for row in A]
        floor = mul(float(jnp.finfo(dtype).eps), total(diagonal))
        more = [floor if is_zero(x) else mul(vanishing, x) for x in usual]
        self._added = [add(mul(eps, x), e) for x, e in zip(diagonal, more, strict=True)]
        self._factors = ldlt(
            [[*row[:-1], add(row[-1], e)] for row, e in zip(A, self._added, strict=True)]
        )

    def solve(self, b: Sequence[Lane]) -> list[Lane]:
        x = fusion_barrier(self._factors.solve(b))
        for _ in range(self._refinements):
            known = [add(y, mul(e, z)) for y, e, z in zip(b, self._added, x, strict=True)]
            x = fusion_barrier(self._factors.solve(known))
        return x
