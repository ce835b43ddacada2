"""Tolerances of all rank decisions, by precision.

A rank decision compares a number with the largest one, or with a scaled unit. A number below the
tolerance is rounding error. f32 has 7 digits and f64 has 16. Each row of `TABLE` has the tolerance
of a decision in both precisions, and the reason.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class RankTolerance(NamedTuple):
    """A tolerance in both precisions, and its reason."""

    f32: float
    f64: float
    why: str


TABLE = {
    # constraints and the stages of implicit methods
    "regularization": RankTolerance(
        1e-4, 1e-9, "added to a diagonal, relative to it; refinement removes its effect"
    ),
    "vanishing row": RankTolerance(
        1e-4, 1e-10, "added to a diagonal, relative to the one of free bodies: at a singular "
        "position the diagonal vanishes too, and rounding u grows to u / sigma^3 without it"
    ),
    "projection": RankTolerance(
        1e-3, 1e-6, "as the two above, in projections: rounding u moves a state by u / sqrt(1e-6)"
    ),
    "constraint rows": RankTolerance(
        1e-2, float(np.sqrt(np.finfo(float).eps)),
        "singular values of rows of unit length; squares of these are factored, so half the digits "
        "count, and in f32 fewer: rows are scaled by free bodies",
    ),
    "short row": RankTolerance(
        1.0, 1e-10, "added to the square of a row's length, relative to the one of free bodies"
    ),
    "stages": RankTolerance(
        1e-2, 1e-8, "weight of the last multipliers in the least squares of a step's stages"
    ),
    "mobility": RankTolerance(
        1e-4, 1e-7, "part of a row of unit length that is orthogonal to the rows before it"
    ),
    "assembly": RankTolerance(1e-5, 1e-9, "singular values that a Gauss-Newton step uses"),
    # identification
    "unknowns": RankTolerance(
        1e-4, 1e-9, "singular values of a Jacobian with columns of unit length"
    ),
    "unknown without effect": RankTolerance(
        1e-5, 1e-12, "length of a Jacobian's column, relative to the longest"
    ),
    # robots and their control
    "actuators": RankTolerance(
        1e-5, 1e-11, "a pivot of B^T B or B B^T, relative to its diagonal"
    ),
    "goals": RankTolerance(
        1e3 * float(np.finfo(np.float32).eps), 1e3 * float(np.finfo(float).eps),
        "a pivot of J J^T of an exact solution, relative to its diagonal",
    ),
    "wheels": RankTolerance(
        16 * float(np.finfo(np.float32).eps), 1e-9,
        "singular values of rows of unit length; a heading of pi is wrong by 1e-7 in f32",
    ),
    "equilibrium": RankTolerance(
        1e-5, 1e-10, "singular values of the slope of the accelerations"
    ),
}  # fmt: skip


def rank_tolerance(decision: str, dtype: Any) -> float:
    """Return the tolerance of a decision (a name of `TABLE`) in a dtype.

    >>> rank_tolerance("unknowns", "float64"), rank_tolerance("unknowns", "float32")
    (1e-09, 0.0001)
    """
    found = TABLE[decision]
    return found.f64 if np.dtype(dtype).itemsize >= 8 else found.f32
