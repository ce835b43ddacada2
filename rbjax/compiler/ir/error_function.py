"""The error function of vectors.

    erf x = x p(x^2)                                      |x| < 1
    erfc a = exp(-a^2) q((a - 4) / (a + 4)) / (1 + 2 a)   a >= 0

Source: Shepherd & Laframboise, *Mathematics of Computation* 36, 1981, for the variable of q. The
coefficients are Chebyshev's interpolation in 400 bits.
"""

from __future__ import annotations

from rbjax.compiler.ir.elementary import Found, limited, power_of_two, scaled
from rbjax.compiler.ir.expressions import Number
from rbjax.compiler.ir.powers import product
from rbjax.lanes.primitives import horner

#: erf x / x in x^2, up to 1
NEAR = (
    1.1283791670955126, -0.37612638903183754, 0.1128379167095512, -0.026866170645129854,
    0.005223977625423455, -0.0008548327021945428, 0.00012055332903350668, -1.4925647581008593e-05,
    1.6462045711013026e-06, -1.6364645854816389e-07, 1.479243542696247e-08,
    -1.2164764337224506e-09, 8.709755232851789e-11, -4.2320376764874594e-12,
)  # fmt: skip
#: (1 + 2 a) exp(a^2) erfc a in (a - 4) / (a + 4)
SCALED = (
    1.2329951186255526, -0.1396211168405623, 0.015379652102619604, 0.06809705425466908,
    -0.10103906603630056, 0.0937328349990944, -0.06633036581218697, 0.03716751552655567,
    -0.016197734059799265, 0.005031970067657489, -0.0007577732613730956, -0.00019925714661091188,
    0.0001506214900124047, -2.4397746422436416e-05, -1.1221287012353486e-05, 5.706604414895734e-06,
    2.919733377963012e-07, -8.210939042560568e-07, 7.746992727017941e-08, 1.0633855618594884e-07,
    -2.05606492756992e-08, -1.234686604382353e-08, 3.1695881915648173e-09, 9.311744978232572e-10,
    -2.659599690242689e-10,
)  # fmt: skip
#: beyond, erfc is below the smallest number
FAR = 27.3


def _complement(a: Number) -> Number:
    """erfc a, for a that is not negative."""
    a = limited(a, 0.0, FAR)
    square, low = product(a, a)
    p, n = power_of_two(-square)
    q = horner(SCALED, (a - 4.0) / (a + 4.0)) / (1.0 + 2.0 * a)
    e = 1.0 + p
    return scaled((e - low * e) * q, n)


def erf(x: Number) -> Found:
    a = abs(x)
    near = x * horner(NEAR, x * x)
    return (a < 1.0).where(near, (1.0 - _complement(a)).op("copysign", x)), None


def erfc(x: Number) -> Found:
    a = abs(x)
    tail = _complement(a)
    tail = (x < 0.0).where(2.0 - tail, tail)
    return (a < 0.5).where(1.0 - x * horner(NEAR, x * x), tail), None
