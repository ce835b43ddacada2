"""How singular systems are regularized: eps D is added to A, and taken back by iteration.

    (A + eps D) dx = b - A x,     x <- x + dx
converges to the solution of least norm, in the norm of D, with no decision about rank. (Carpentier,
Budhiraja & Mansard, *Proximal and sparse resolution of constrained dynamics*, 2021.)
"""

from __future__ import annotations

from typing import Any

#: eps, relative to the diagonal, and how often its effect is taken back, by bytes of a number:
#: components of A above 1e-3 of the diagonal come out to rounding
PROXIMAL = {4: (1e-4, 3), 8: (1e-9, 2)}


def proximal(dtype: Any) -> tuple[float, int]:
    """eps, and the refinements that bring the result to rounding."""
    return PROXIMAL[dtype.itemsize]
