"""How singular systems are regularized: E is added to A, and taken back by iteration.

    (A + E) dx = b - A x,     x <- x + dx;     or (A + E) x <- b + E x
converges to the solution of least norm, in the norm of E, with no decision about rank. E is
eps diag(A) + e B, B what the diagonal is where no row vanishes. (Carpentier, Budhiraja & Mansard,
*Proximal and sparse resolution of constrained dynamics*, 2021.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.lanes.algebra import Lane, add, is_zero, mul, total
from rbjax.lanes.barriers import fusion_barrier
from rbjax.lanes.factorization import ldlt

#: eps, relative to the diagonal, and how often its effect is taken back, by bytes of a number:
#: components of A above 1e-3 of the diagonal come out to rounding
PROXIMAL = {4: (1e-4, 3), 8: (1e-9, 2)}
#: e, relative to B
VANISHING = {4: 1e-4, 8: 1e-10}


def proximal(dtype: Any) -> tuple[float, int]:
    """eps, and the refinements that bring the result to rounding."""
    return PROXIMAL[dtype.itemsize]


def damped(dtype: Any, damping: float | None = None) -> tuple[float, float, int]:
    """eps, e, and how often they are taken back: `damping` is both, once."""
    if damping is not None:
        return damping, damping, 1
    eps, again = proximal(dtype)
    return eps, VANISHING[dtype.itemsize], again


def least(
    diagonal: jax.Array, usual: jax.Array | float, factor: float, unknown: float | None = None
) -> jax.Array:
    """`factor` times what a diagonal is where no row vanishes. Where that is not known (0): the sum
    of the diagonal, times `unknown`, which is the rounding unit if None."""
    unknown = float(jnp.finfo(diagonal.dtype).eps) if unknown is None else unknown
    usual = jnp.asarray(usual, diagonal.dtype)
    return jnp.where(usual > 0, factor * usual, unknown * diagonal.sum())


class LeastNorm:
    """The solution of A x = b of least norm, of a symmetric A on lanes.

    Args:
        A: its lower triangle, row by row.
        usual: what its diagonal is where no row vanishes; 0 where that is not known.
        damping: eps and e, taken back once; None: those of the dtype, to rounding.
    """

    def __init__(
        self,
        A: Sequence[Sequence[Lane]],
        usual: Sequence[Lane],
        dtype: Any,
        damping: float | None = None,
    ):
        eps, vanishing, self._again = damped(dtype, damping)
        diagonal = [row[-1] for row in A]
        least = mul(float(jnp.finfo(dtype).eps), total(diagonal))
        more = [least if is_zero(x) else mul(vanishing, x) for x in usual]
        self._added = [add(mul(eps, x), e) for x, e in zip(diagonal, more, strict=True)]
        self._factors = ldlt(
            [[*row[:-1], add(row[-1], e)] for row, e in zip(A, self._added, strict=True)]
        )

    def solve(self, b: Sequence[Lane]) -> list[Lane]:
        x = fusion_barrier(self._factors.solve(b))
        for _ in range(self._again):
            known = [add(y, mul(e, z)) for y, e, z in zip(b, self._added, x, strict=True)]
            x = fusion_barrier(self._factors.solve(known))
        return x
