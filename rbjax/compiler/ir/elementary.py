"""Elementary functions in double precision, as branch-free formulas for vectors.

The argument is reduced to the range of a polynomial. The reduction subtracts a multiple of a
constant (pi / 2, ln 2) that is stored in several parts, so that the multiples are exact. Each
function also returns a mask of lanes in which its formula is not valid; C's library computes those.

Source: Sun's fdlibm (Ng, 1993) for the polynomials of sine, cosine, logarithm and arctangent; the
    exponential is its Taylor series.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rbjax.compiler.ir.statements import BOOL, F64, I32, I64, Value
from rbjax.lanes.primitives import SERIES, horner

if TYPE_CHECKING:
    from rbjax.compiler.ir.builder import Builder


def _operator(
    name: str, dtype: np.dtype | None = None
) -> Callable[[Number, Number | float], Number]:
    return lambda self, x: self.op(name, x, dtype=dtype)


def _reflected(name: str) -> Callable[[Number, float], Number]:
    return lambda self, x: self.known(x).op(name, self)


@dataclass(frozen=True, eq=False)
class Number:
    """A value with arithmetic operators, which emit operations with a builder."""

    builder: Builder
    value: Value

    def op(self, name: str, *others: Number | float, dtype: np.dtype | None = None) -> Number:
        """Emit an operation on this value and others of its dtype. dtype: dtype of the result."""
        own = self.value.dtype
        rest = [x.value if isinstance(x, Number) else own.type(x) for x in others]
        return Number(self.builder, self.builder.op(name, dtype or own, self.value, *rest))

    def cast(self, dtype: np.dtype) -> Number:
        return Number(self.builder, self.builder.cast(self.value, dtype))

    def bits(self, dtype: np.dtype) -> Number:
        """Reinterpret the bits as another dtype."""
        return self.op("bitcast", dtype=dtype)

    def known(self, x: float) -> Number:
        """Return the constant x of this value's dtype."""
        return Number(self.builder, self.value.dtype.type(x))

    def where(self, yes: Number | float, no: Number | float, dtype: type = np.float64) -> Number:
        """Return `yes` if this condition is true, else `no`."""
        values = [x.value if isinstance(x, Number) else dtype(x) for x in (yes, no)]
        return Number(self.builder, self.builder.select(self.value, *values))

    __add__, __radd__ = _operator("add"), _reflected("add")
    __sub__, __rsub__ = _operator("sub"), _reflected("sub")
    __mul__, __rmul__ = _operator("mul"), _reflected("mul")
    __truediv__, __rtruediv__ = _operator("div"), _reflected("div")
    __and__, __or__ = _operator("and"), _operator("or")
    __lshift__, __rshift__ = _operator("shl"), _operator("shr")
    __lt__, __gt__, __ge__ = (_operator(name, BOOL) for name in ("lt", "gt", "ge"))
    equals = _operator("eq", BOOL)

    def __neg__(self) -> Number:
        return self.op("neg")

    def __abs__(self) -> Number:
        return self.op("abs")


#: pi / 2 and ln 2 in parts; products of the first parts with small integers are exact
QUARTER = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624871116645580e-21,
           8.47842766036889956997e-32)  # fmt: skip
LN2 = 6.93147180369123816490e-01, 1.90821492927058770002e-10
PI_LACKS = 1.2246467991473531772e-16
#: C computes angles beyond this, because their reduction needs more digits of pi
FAR = 1e6
#: below this, sin x, tan x and similar functions equal x
SMALL = 1e-9
#: coefficients in s^2 of the series of log(1 + f), with s = f / (2 + f)
LOG = (6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01,
       2.222219843214978396e-01, 1.818357216161805012e-01, 1.531383769920937332e-01,
       1.479819860511658591e-01)  # fmt: skip
#: coefficients in x^2 of (x - atan x) / x^3, for |x| <= 7 / 16
ATAN = (3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01,
        -1.11111104054623557880e-01, 9.09088713343650656196e-02, -7.69187620504482999495e-02,
        6.66107313738753120669e-02, -5.83357013379057348645e-02, 4.97687799461593236017e-02,
        -3.65315727442169155270e-02, 1.62858201153657823623e-02)  # fmt: skip
#: atan of 1/2, 1, 3/2 and infinity, each with its rounding error
ATAN_OF = (
    (4.63647609000806093515e-01, 2.26987774529616870924e-17),
    (7.85398163397448278999e-01, 3.06161699786838301793e-17),
    (9.82793723247329054082e-01, 1.39033110312309984516e-17),
    (1.57079632679489655800e00, 6.12323399573676603587e-17),
)
#: 1 / (k + 2)!
EXP = tuple(1 / math.factorial(k) for k in range(2, 15))
#: after this is added to a small integer, the last bits of the sum are the integer
INTEGER = 1.5 * 2.0**52

# Each function returns its value, and the mask of lanes in which it is not valid (None: no lane).
Found = tuple[Number, Number | None]


def two_sum(a: Number, b: Number) -> tuple[Number, Number]:
    """Return a + b and its rounding error (Knuth)."""
    s = a + b
    c = s - a
    return s, (a - (s - c)) + (b - c)


def lifted(x: Number, power: int) -> tuple[Number, Number]:
    """Return |x| 2^power, and whether x is subnormal or zero.
    The result is exact although XLA sets the processor's flag that reads subnormal numbers as 0."""
    bits = abs(x).bits(I64)
    one = bits | int(np.float64(2.0**52).view(I64))  # 2^52 + 2^1074 |x| for a subnormal x
    subnormal = bits < 1 << 52
    y = (one.bits(F64) - 2.0**52) * 2.0 ** (power - 1074)
    return subnormal.where(y, abs(x) * 2.0**power), subnormal


def widened(x: Number) -> Number:
    """Convert to double precision, exactly also for subnormal numbers of single precision."""
    if x.value.dtype != np.float32:
        return x.cast(F64)
    bits = abs(x).bits(I32)
    one = bits | int(np.float32(2.0**23).view(I32))
    y = (one.bits(x.value.dtype) - 2.0**23).cast(F64) * 2.0**-149
    wide = x.cast(F64)
    return (bits < 1 << 23).where(y.op("copysign", wide), wide)


# ------------------------------------------------------------------- angles


def _reduced(x: Number) -> tuple[Number, Number, Number]:
    """Return the angle x reduced by the nearest multiple n of pi / 2, its rounding error, and n."""
    n = (x * (2 / math.pi)).op("rint")
    r = x - n * QUARTER[0]
    r, e = two_sum(r, -(n * QUARTER[1]))
    r, f = two_sum(r, -(n * QUARTER[2]))
    rest = (e + f) - n * QUARTER[3]
    y = r + rest
    return y, (r - y) + rest, (n + INTEGER).bits(I64)


def _sine(r: Number, e: Number) -> Number:
    first, *rest = SERIES[F64][1]
    z = r * r
    v = z * r
    return r - ((z * (e * 0.5 - v * horner(rest, z)) - e) - v * first)


def _cosine(r: Number, e: Number) -> Number:
    z = r * r
    half = z * 0.5
    w = 1.0 - half
    return w + (((1.0 - w) - half) + (z * (z * horner(SERIES[F64][2], z)) - r * e))


def _turned(x: Number, quarters: int) -> tuple[Number, Number]:
    """Return sin(x + quarters * pi / 2), and the mask of large angles."""
    r, e, n = _reduced(x)
    n = n + quarters
    y = (n & 1).equals(0).where(_sine(r, e), _cosine(r, e))
    return (n & 2).equals(0).where(y, -y), abs(x) > FAR


def sin(x: Number) -> Found:
    y, far = _turned(x, 0)
    return (abs(x) < SMALL).where(x, y), far


def cos(x: Number) -> Found:
    return _turned(x, 1)


def tan(x: Number) -> Found:
    r, e, n = _reduced(x)
    s, c, even = _sine(r, e), _cosine(r, e), (n & 1).equals(0)
    y = even.where(s, -c) / even.where(c, s)
    return (abs(x) < SMALL).where(x, y), abs(x) > FAR


def _of_ratio(a: Number, b: Number) -> Number:
    """Return atan(a / b) for nonnegative a and b that are not both zero or both infinite."""
    up, down, high, low = a, b, a.known(0.0), a.known(0.0)
    # subtract the angle whose tangent is 1/2, 1, 3/2 or infinity
    steps = (
        (7 / 16, 2.0 * a - b, 2.0 * b + a), (11 / 16, a - b, a + b),
        (19 / 16, a - 1.5 * b, b + 1.5 * a), (39 / 16, -b, a),
    )  # fmt: skip
    for (least, p, q), (angle, rest) in zip(steps, ATAN_OF, strict=True):
        here = a >= least * b
        up, down = here.where(p, up), here.where(q, down)
        high, low = here.where(angle, high), here.where(rest, low)
    t = up / down
    z = t * t
    return high - ((t * (z * horner(ATAN, z)) - low) - t)


def _behind(x: Number, angle: Number) -> Number:
    """Return pi - angle if x is negative, else angle."""
    return (x.known(1.0).op("copysign", x) < 0.0).where(math.pi - (angle - PI_LACKS), angle)


def atan2(y: Number, x: Number) -> Found:
    a, b = abs(y), abs(x)
    endless = a.equals(math.inf) & b.equals(math.inf)
    large = a.op("max", b) > 2.0**400  # then a subnormal number has no effect
    a = endless.where(1.0, large.where(a * 2.0**-100, lifted(a, 600)[0]))
    b = endless.where(1.0, large.where(b * 2.0**-100, lifted(b, 600)[0]))
    b = a.op("max", b).equals(0.0).where(1.0, b)
    return _behind(x, _of_ratio(a, b)).op("copysign", y), None


def atan(x: Number) -> Found:
    return _of_ratio(abs(x), x.known(1.0)).op("copysign", x), None


def asin(x: Number) -> Found:
    return _of_ratio(abs(x), ((1.0 - x) * (1.0 + x)).op("sqrt")).op("copysign", x), None


def acos(x: Number) -> Found:
    return _behind(x, _of_ratio(((1.0 - x) * (1.0 + x)).op("sqrt"), abs(x))), None


# ------------------------------------------------------------------- exponentials


def power_of_two(x: Number) -> tuple[Number, Number]:
    """Return p and n with exp x = 2^n (1 + p)."""
    n = (x * (1 / math.log(2))).op("rint")
    high, low = x - n * LN2[0], n * LN2[1]
    return less_one(high, low), n


def less_one(high: Number, low: Number | float) -> Number:
    """Return exp(high - low) - 1, for |high| <= 0.35."""
    r = high - low
    return high + (r * r * horner(EXP, r) - low)


def scaled(y: Number, n: Number) -> Number:
    """Return 2^n y in two steps, because 2^n may overflow or underflow."""
    half = (n * 0.5).op("rint")

    def power(k: Number) -> Number:
        return (((k + INTEGER).bits(I64) << 52) + (1023 << 52)).bits(F64)

    return y * power(half) * power(n - half)


def limited(x: Number, least: float, most: float) -> Number:
    return x.op("max", least).op("min", most)


def exp(x: Number) -> Found:
    p, n = power_of_two(limited(x, -746.0, 710.0))
    return scaled(1.0 + p, n), None


def exp2(x: Number) -> Found:
    x = limited(x, -1076.0, 1025.0)
    n = x.op("rint")
    return scaled(1.0 + less_one((x - n) * math.log(2), 0.0), n), None


def _expm1(x: Number) -> Number:
    """Return exp x - 1, for x <= 700."""
    p, n = power_of_two(x.op("max", -100.0))
    return scaled(p, n) + (scaled(x.known(1.0), n) - 1.0)


def expm1(x: Number) -> Found:
    return (abs(x) < SMALL**2).where(x, _expm1(x)), x > 700.0


def tanh(x: Number) -> Found:
    a = abs(x).op("min", 22.0)
    t = _expm1(-2.0 * a)
    near = a < 1.0
    q = near.where(-t, 2.0 * (t + 1.0)) / (t + 2.0)
    return near.where(q, 1.0 - q).op("copysign", x), None


def sinh(x: Number) -> Found:
    t = _expm1(abs(x))
    return (0.5 * (t + t / (t + 1.0))).op("copysign", x), abs(x) > 700.0


def cosh(x: Number) -> Found:
    p, n = power_of_two(abs(x))
    e = scaled(1.0 + p, n)
    return 0.5 * e + 0.5 / e, abs(x) > 700.0


# ------------------------------------------------------------------- logarithms


def is_positive(x: Number) -> Number:
    """Return whether x > 0, also for subnormal numbers."""
    return x.bits(I64) > 0


def mantissa(x: Number) -> tuple[Number, Number]:
    """Return m and k with x = 2^k m and sqrt(1/2) < m <= sqrt(2), for positive x."""
    high, small = lifted(x, 54)
    bits = small.where(high, x).bits(I64)
    one = 1023 << 52
    m = ((bits & ((1 << 52) - 1)) + one).bits(F64)
    k = ((bits >> 52) + int(np.float64(INTEGER).view(I64))).bits(F64) - (INTEGER + 1023)
    above = m > math.sqrt(2)
    m, k = above.where(m * 0.5, m), above.where(k + 1.0, k)
    return m, small.where(k - 54.0, k)


def _log(x: Number) -> Number:
    m, k = mantissa(x)
    f = m - 1.0
    s = f / (2.0 + f)
    z, half = s * s, 0.5 * f * f
    y = k * LN2[0] - ((half - (s * (half + z * horner(LOG, z)) + k * LN2[1])) - f)
    y = (x < math.inf).where(y, x)  # log of infinity or nan is x
    zero = (x.bits(I64) << 1).equals(0)
    return is_positive(x).where(y, zero.where(-math.inf, y.known(math.nan)))


def log(x: Number) -> Found:
    return _log(x), None


def _log1p(x: Number) -> Number:
    u, lost = two_sum(x.known(1.0), x)
    y = _log(u)
    y = ((u > 0.0) & (u < math.inf)).where(y + lost / u, y)
    return (abs(x) < SMALL**2).where(x, y)


def log1p(x: Number) -> Found:
    return _log1p(x), None


def atanh(x: Number) -> Found:
    a = abs(x)
    return (0.5 * _log1p(2.0 * a / (1.0 - a))).op("copysign", x), None


def asinh(x: Number) -> Found:
    a = abs(x)
    z = a * a
    return _log1p(a + z / (1.0 + (1.0 + z).op("sqrt"))).op("copysign", x), a > 1e100


def acosh(x: Number) -> Found:
    t = x - 1.0
    return _log1p(t + (t * (t + 2.0)).op("sqrt")), abs(x - 1e100) > 1e100
