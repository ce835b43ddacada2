"""How singular systems are regularized: eps D is added to A, and taken back by iteration.

    (A + eps D) dx = b - A x,     x <- x + dx;     or (A + eps D) x <- b + eps D x
converges to the solution of least norm, in the norm of D, with no decision about rank. (Carpentier,
Budhiraja & Mansard, *Proximal and sparse resolution of constrained dynamics*, 2021.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from rbjax.lanes.algebra import Lane, add, mul, total
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
        diagonal = [row[-1] for row in A]
        least = mul(float(jnp.finfo(dtype).eps), total(diagonal))
        self._added = [add(mul(eps, x), least) for x in diagonal]
        self._factors = ldlt(
            [[*row[:-1], add(row[-1], e)] for row, e in zip(A, self._added, strict=True)]
        )

    def solve(self, b: Sequence[Lane]) -> list[Lane]:
        x = fusion_barrier(self._factors.solve(b))
        for _ in range(self._again):
            known = [add(y, mul(e, z)) for y, e, z in zip(b, self._added, x, strict=True)]
            x = fusion_barrier(self._factors.solve(known))
        return x
