"""How singular systems are regularized: eps D is added to A, and taken back by iteration.

    (A + eps D) dx = b - A x,     x <- x + dx
converges to the solution of least norm, in the norm of D, with no decision about rank. (Carpentier,
Budhiraja & Mansard, *Proximal and sparse resolution of constrained dynamics*, 2021.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from rbjax.lanes.algebra import Lane, add, inner, mul, sub, total
from rbjax.lanes.fusion_barrier import fusion_barrier
from rbjax.lanes.ldlt import ldlt

#: eps, relative to the diagonal, and how often its effect is taken back, by bytes of a number:
#: components of A above 1e-3 of the diagonal come out to rounding
PROXIMAL = {4: (1e-4, 3), 8: (1e-9, 2)}


def proximal(dtype: Any, again: int | None = None) -> tuple[float, int]:
    """eps, and the refinements: so many, or as many as bring the result to rounding."""
    eps, enough = PROXIMAL[dtype.itemsize]
    return eps, enough if again is None else again


class LeastNorm:
    """The solution of A x = b of least norm, of a symmetric A on lanes, by its lower triangle."""

    def __init__(self, A: Sequence[Sequence[Lane]], dtype: Any, again: int | None = None):
        eps, self._again = proximal(dtype, again)
        least = mul(float(jnp.finfo(dtype).eps), total(row[-1] for row in A))
        self._factors = ldlt([[*row[:-1], add(mul(1.0 + eps, row[-1]), least)] for row in A])
        many = range(len(A))
        self._rows = [[A[max(r, s)][min(r, s)] for s in many] for r in many]

    def solve(self, b: Sequence[Lane]) -> list[Lane]:
        x = fusion_barrier(self._factors.solve(b))
        for _ in range(self._again):
            off = [sub(y, inner(row, x)) for y, row in zip(b, self._rows, strict=True)]
            x = fusion_barrier([add(y, dy) for y, dy in zip(x, self._factors.solve(off), strict=True)])
        return x
