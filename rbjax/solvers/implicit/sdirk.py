"""Alexander's diagonally implicit method; diffrax has Kvaerno's methods of order 3, 4 and 5.

    gamma = 1 - 1 / sqrt 2,    c = (gamma, 1),    a_21 = b_1 = 1 - gamma,    b_2 = gamma
Order 2, L-stable, stiffly accurate (Alexander, *SIAM J. Numer. Anal.* 14, 1977). Its companion uses
only the first stage and has order 1. Dense output: the collocation polynomial of its two nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import numpy as np
import optimistix as optx

from rbjax.solvers.common.newton import MAX_STEPS, very_chord
from rbjax.solvers.common.steps import Polynomial, mixed

G = 1 - 0.5**0.5
# theta, theta^2 in the integrals of (1 - theta) / (1 - G) and (theta - G) / (1 - G)
DENSE = ((1 / (1 - G), -G / (1 - G)), (-0.5 / (1 - G), 0.5 / (1 - G)))


def _collocation(*, t0: Any, t1: Any, y0: Any, y1: Any, k: Any) -> Polynomial:
    del y1
    return Polynomial(t0, t1, y0, mixed(DENSE, k))


class SDIRK2(diffrax.AbstractSDIRK):
    """Two implicit stages with one matrix."""

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=(np.array([1 - G]),),
        a_predictor=(np.array([1.0]),),
        a_diagonal=np.array([G, G]),
        b_sol=np.array([1 - G, G]),
        b_error=np.array([-G, G]),
        c=np.array([1.0]),
        c1=G,
    )
    interpolation_cls: ClassVar[Callable[..., Polynomial]] = staticmethod(_collocation)
    root_finder: optx.AbstractRootFinder = very_chord()  # type: ignore[misc]
    root_find_max_steps: int = MAX_STEPS  # type: ignore[misc]

    def order(self, terms):
        return 2
