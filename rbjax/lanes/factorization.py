"""L D L^T of small symmetric matrices on lanes, for one sample a GPU thread.

    A = L D L^T,  L unit lower triangular, D diagonal                   (n^3 / 6 products)
    A x = b:      L y = b,  z = D^-1 y,  L^T x = z                      (n^2)

Entries are lanes. Structural zeros cost nothing and fill in only where elimination couples them.
So a matrix of separate blocks (separate loops of a robot, separate robots of a scene) costs only
its blocks. The order of elimination decides the fill-in: `elimination_order` takes the row with the
fewest neighbours first (minimum degree).

A pivot that is not above `least` times its original diagonal entry belongs to a redundant row. Its
solution and its derivative are zero (the row is dropped, the others are solved).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from rbjax.lanes.algebra import Lane, is_literal, is_zero, mul, sub
from rbjax.lanes.barriers import fusion_barrier

Rows = Sequence[Sequence[Lane]]


class LDLT(NamedTuple):
    """The factors of A after its rows and columns are taken in `order`."""

    order: tuple[int, ...]
    #: below the diagonal, row by row
    L: list[list[Lane]]
    inverse_D: list[Lane]

    def solve(self, b: Sequence[Lane]) -> list[Lane]:
        """x (n lanes) of A x = b."""
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
    """The factors of a symmetric positive semi-definite matrix; its lower triangle is read.

    Args:
        A: (n, n) lanes.
        least: the relative size below which a pivot counts as zero.
        order: the order of elimination of the rows; that of `elimination_order` if None.
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


def _inverse(pivot: Lane, entry: Lane, least: float) -> Lane:
    if is_literal(pivot):
        return 1.0 / pivot if pivot > least * entry else 0.0
    sound = pivot > mul(least, entry)
    return jnp.where(sound, 1.0 / jnp.where(sound, pivot, 1.0), 0.0)


def elimination_order(A: Rows) -> list[int]:
    """An order of rows with little fill-in: the row with the fewest neighbours first.

    Source: Tinney & Walker 1967; George & Liu 1989 (minimum degree).
    """
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
