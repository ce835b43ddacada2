"""The vectorial parametrizations of rotation, row by row, derived by hand and kept in mpmath.

What Masarati tabulates (appendix A, Table A.1), after Bauchau & Trainelli (Nonlinear Dynamics 32,
2003): a vector p = p(phi) n of the angle phi and the unit axis n, with p ~ phi at zero, and

    R    = 1 + zeta1 [p] + zeta2 [p]^2
    H    = mu 1 + zeta2 [p] + zeta3 [p]^2            omega_space = H p'
    H^-1 = (1/mu) 1 - [p]/2 + gamma [p]^2

Rodrigues' formula gives zeta1 = sin phi / p and zeta2 = (1 - cos phi) / p^2. Along the axis phi' =
p' / p'(phi), so mu = 1/p'(phi); across it omega = sin phi n' + (1 - cos phi) n x n' with p n' the
rate of p, so zeta1 = mu - p^2 zeta3 there, zeta3 = (mu - zeta1) / p^2. In the plane across n, H is
the complex number zeta1 + i p zeta2 = (2 sin(phi/2) / p) exp(i phi/2), whose inverse
(p/2) (cot(phi/2) - i) has gamma = (1/mu - (p/2) cot(phi/2)) / p^2.

Each row follows with the half angle: c = cos(phi/2), or cos(phi/4) for Wiener and Milenkovic.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

from mpmath import asin, atan, cos, cot, mpf, sin, tan


class Row(NamedTuple):
    """Functions of the angle, and the angle of the length of p; `end` is where the map is lost."""

    p: Callable
    angle: Callable
    mu: Callable
    zeta1: Callable
    zeta2: Callable
    zeta3: Callable
    gamma: Callable
    end: float


TABLE = {
    "euler_vector": Row(
        p=lambda t: t,
        angle=lambda p: p,
        mu=lambda t: mpf(1),
        zeta1=lambda t: sin(t) / t,
        zeta2=lambda t: (1 - cos(t)) / t**2,
        zeta3=lambda t: (t - sin(t)) / t**3,
        gamma=lambda t: (1 - t / 2 * cot(t / 2)) / t**2,
        end=2 * math.pi,
    ),
    "linear": Row(
        p=sin,
        angle=asin,
        mu=lambda t: 1 / cos(t),
        zeta1=lambda t: mpf(1),
        zeta2=lambda t: 1 / (2 * cos(t / 2) ** 2),
        zeta3=lambda t: 1 / (2 * cos(t) * cos(t / 2) ** 2),
        gamma=lambda t: -1 / (4 * cos(t / 2) ** 2),
        end=math.pi / 2,
    ),
    "cayley": Row(  # Cayley, Gibbs, Rodrigues
        p=lambda t: 2 * tan(t / 2),
        angle=lambda p: 2 * atan(p / 2),
        mu=lambda t: cos(t / 2) ** 2,
        zeta1=lambda t: cos(t / 2) ** 2,
        zeta2=lambda t: cos(t / 2) ** 2 / 2,
        zeta3=lambda t: mpf(0),
        gamma=lambda t: mpf(1) / 4,
        end=math.pi,
    ),
    "wiener_milenkovic": Row(  # the conformal rotation vector
        p=lambda t: 4 * tan(t / 4),
        angle=lambda p: 4 * atan(p / 4),
        mu=lambda t: cos(t / 4) ** 2,
        zeta1=lambda t: cos(t / 4) ** 2 * cos(t / 2),
        zeta2=lambda t: cos(t / 4) ** 4 / 2,
        zeta3=lambda t: cos(t / 4) ** 4 / 8,
        gamma=lambda t: mpf(1) / 8,
        end=2 * math.pi,
    ),
    "reduced_euler_rodrigues": Row(
        p=lambda t: 2 * sin(t / 2),
        angle=lambda p: 2 * asin(p / 2),
        mu=lambda t: 1 / cos(t / 2),
        zeta1=lambda t: cos(t / 2),
        zeta2=lambda t: mpf(1) / 2,
        zeta3=lambda t: 1 / (4 * cos(t / 2)),
        gamma=lambda t: mpf(0),
        end=math.pi,
    ),
}
