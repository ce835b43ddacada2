"""Powers, cube roots and the error function, as formulas for vectors.

x^y = exp(y log x). The logarithm has twice the precision (Dekker, 1971), because the product with y
multiplies its error by up to 700.

erf x = x p(x^2), |x| < 1
erfc a = exp(-a^2) q((a - 4) / (a + 4)) / (1 + 2 a), a >= 0

Source: Shepherd & Laframboise, *Mathematics of Computation* 36, 1981, for the variable of q. The
    coefficients are Chebyshev interpolations, computed with 400 bits.
"""

from __future__ import annotations

import math

from rbjax.compiler.ir.elementary import (
    LN2,
    Found,
    Number,
    exp,
    is_positive,
    less_one,
    lifted,
    limited,
    log,
    mantissa,
    power_of_two,
    scaled,
    two_sum,
)
from rbjax.compiler.ir.statements import BOOL, I64
from rbjax.lanes.primitives import horner

#: an unevaluated sum of two numbers that do not overlap (double-double)
Double = tuple[Number, Number]

#: 2/3 and its rounding error
TWO_THIRDS = 2 / 3, 3.70074341541718826e-17
#: coefficients in s^2 of (log((1 + s) / (1 - s)) - 2 s - 2/3 s^3) / s^5, for |s| <= 0.172
SERIES = tuple(2 / (2 * k + 5) for k in range(13))
#: an approximate cube root is rounded to a multiple of this in its last bits: its square is exact
ROUGH = 1 << 30


def _split(x: Number) -> Double:
    t = x * (2.0**27 + 1)
    high = t - (t - x)
    return high, x - high


def product(x: Number, y: Number) -> Double:
    """Return x y and its rounding error."""
    p = x * y
    (a, b), (c, d) = _split(x), _split(y)
    return p, ((a * c - p) + a * d + b * c) + b * d


def _log_of_mantissa(m: Number) -> Double:
    """Return log m = 2 artanh((m - 1) / (m + 1)) as a sum of two numbers."""
    d, d_low = two_sum(m, m.known(1.0))
    f = m - 1.0
    s = f / d
    p, e = product(s, d)
    s_low = ((f - p) - e - s * d_low) / d
    z, z_low = product(s, s)
    z_low = z_low + 2.0 * s * s_low
    u, u_low = two_sum(z.known(TWO_THIRDS[0]), z * horner(SERIES, z))
    u_low = u_low + TWO_THIRDS[1]
    v, e = product(z, u)
    v_low = e + z * u_low + z_low * u
    v, e = two_sum(v.known(2.0), v)
    v_low = v_low + e
    y, e = product(s, v)
    return y, e + s * v_low + s_low * v


def pow(x: Number, y: Number) -> Found:
    m, k = mantissa(x)
    high, low = _log_of_mantissa(m)
    high, e = two_sum(k * LN2[0], high)
    high, low = two_sum(high, e + (low + k * LN2[1]))
    w, e = product(y, high)
    near = abs(w) < 745.0
    w_low = near.where(e + y * low, 0.0)
    w = limited(w, -746.0, 710.0)
    n = (w * (1 / math.log(2))).op("rint")
    power = scaled(1.0 + less_one(w - n * LN2[0], n * LN2[1] - w_low), n)
    usual = is_positive(x) & (x < math.inf) & (abs(y) < 1e300)
    return power, usual.op("not", dtype=BOOL)


def cbrt(x: Number) -> Found:
    high, small = lifted(x, 54)
    a = small.where(high, abs(x))
    t = exp(log(a)[0] / 3.0)[0]
    t = ((t.bits(I64) + ROUGH // 2) & -ROUGH).bits(a.value.dtype)
    r = a / (t * t)
    y = t + t * ((r - t) / (t + t + r))
    y = ((a > 0.0) & (a < math.inf)).where(y, a)
    return small.where(y * 2.0**-18, y).op("copysign", x), None


#: coefficients in x^2 of erf x / x, for |x| <= 1
NEAR = (
    1.1283791670955126, -0.37612638903183754, 0.1128379167095512, -0.026866170645129854,
    0.005223977625423455, -0.0008548327021945428, 0.00012055332903350668, -1.4925647581008593e-05,
    1.6462045711013026e-06, -1.6364645854816389e-07, 1.479243542696247e-08,
    -1.2164764337224506e-09, 8.709755232851789e-11, -4.2320376764874594e-12,
)  # fmt: skip
#: coefficients in (a - 4) / (a + 4) of (1 + 2 a) exp(a^2) erfc a
SCALED = (
    1.2329951186255526, -0.1396211168405623, 0.015379652102619604, 0.06809705425466908,
    -0.10103906603630056, 0.0937328349990944, -0.06633036581218697, 0.03716751552655567,
    -0.016197734059799265, 0.005031970067657489, -0.0007577732613730956, -0.00019925714661091188,
    0.0001506214900124047, -2.4397746422436416e-05, -1.1221287012353486e-05, 5.706604414895734e-06,
    2.919733377963012e-07, -8.210939042560568e-07, 7.746992727017941e-08, 1.0633855618594884e-07,
    -2.05606492756992e-08, -1.234686604382353e-08, 3.1695881915648173e-09, 9.311744978232572e-10,
    -2.659599690242689e-10,
)  # fmt: skip
#: beyond this, erfc is below the smallest number
FAR = 27.3


def _complement(a: Number) -> Number:
    """Return erfc a, for nonnegative a."""
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
