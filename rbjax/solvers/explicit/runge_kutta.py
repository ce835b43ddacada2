"""The classical Runge-Kutta method, which diffrax lacks, with a third-order companion.

The companion uses the rate at y1 instead of the fourth stage. The next step needs that rate anyway,
so the error estimate costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import diffrax
import numpy as np

from rbjax.solvers.common.tableau import RK4 as TABLE


class RK4(diffrax.AbstractERK):
    """Kutta's method of 1901: order 4, error estimate of order 3, Hermite dense output."""

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=tuple(np.array(row[:i]) for i, row in enumerate(TABLE.a) if i),
        b_sol=np.array(TABLE.b),
        b_error=np.array(TABLE.error[1:]),
        c=np.array(TABLE.c[1:]),
    )
    interpolation_cls: ClassVar[Callable[..., diffrax.ThirdOrderHermitePolynomialInterpolation]] = (
        diffrax.ThirdOrderHermitePolynomialInterpolation.from_k
    )

    def order(self, terms):
        return 4
