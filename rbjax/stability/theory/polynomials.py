"""Polynomials with exact coefficients, and their roots to all digits of a double.

    p(x) = p_0 + p_1 x + ... + p_n x^n,    coefficients `fractions.Fraction`, constant first
Stability depends on signs of polynomials that often vanish exactly. With rounding the sign would be
random. A coefficient from a tableau of doubles is converted to the simple fraction near it
(`rational`), if rounding explains the difference.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from rbjax.errors import InputError
from rbjax.optional import require
from rbjax.solvers.tableau import TOLERANCE

if TYPE_CHECKING:
    import mpmath

Poly = tuple[Fraction, ...]

EPS = Fraction(np.finfo(np.float64).eps)
PRINTED = Fraction(TOLERANCE)  # tolerance of printed coefficients, as for tableaus
SIMPLE = 50_000  # largest denominator: 8! is 40,320
DIGITS = 60  # digits of computed roots
ZERO: Poly = ()
ONE: Poly = (Fraction(1),)


def poly(coefficients: Iterable[Any]) -> Poly:
    """Return the polynomial of coefficients, constant first, without trailing zeros.

    >>> poly([1, 0.5, 0])
    (Fraction(1, 1), Fraction(1, 2))
    """
    out = [Fraction(c) for c in coefficients]
    while out and out[-1] == 0:
        out.pop()
    return tuple(out)


def rational(x: Any, noise: Any = 0) -> Fraction:
    """Return the simple fraction within `noise` (or two units in the last place) of x, else x.

    >>> rational(1 / 3)
    Fraction(1, 3)
    >>> rational(2**0.5) == Fraction(2**0.5)
    True
    """
    exact = Fraction(x)
    if abs(exact) <= noise:
        return Fraction(0)
    simple = exact.limit_denominator(SIMPLE)
    return simple if abs(simple - exact) <= max(noise, 2 * EPS * abs(exact)) else exact


def exact(coefficients: Iterable[Any], where: str) -> Poly:
    """Return the polynomial of numbers of any type. Doubles become the simple fractions near them.

    >>> exact(np.array([1 / 3, 1.0]), "rho")
    (Fraction(1, 3), Fraction(1, 1))
    """
    try:
        return poly(
            c if isinstance(c, Fraction) else rational(np.asarray(c).item()) for c in coefficients
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{where} is {coefficients}, expected finite numbers, the constant first"
        ) from error


def total(terms: Iterable[Fraction]) -> Fraction:
    return sum(terms, Fraction(0))


def add(p: Poly, q: Poly, weight: Any = 1) -> Poly:
    """Return the sum p + weight q."""
    n = max(len(p), len(q))
    p, q = p + (Fraction(0),) * (n - len(p)), q + (Fraction(0),) * (n - len(q))
    return poly(a + weight * b for a, b in zip(p, q, strict=True))


def multiply(p: Poly, q: Poly) -> Poly:
    """Return the product p q."""
    out = [Fraction(0)] * max(len(p) + len(q) - 1, 0)
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            out[i + j] += a * b
    return poly(out)


def magnitude(p: Poly) -> Poly:
    """Return the polynomial of absolute coefficients, which bound the terms of a sum."""
    return tuple(abs(c) for c in p)


def clean(p: Poly, size: Poly) -> Poly:
    """Set coefficients of p to zero that are at most a rounding error, or an error of the last
    printed digit, of the coefficients of `size`."""
    return poly(0 if abs(c) <= PRINTED * s else c for c, s in zip(p, size, strict=False))


def derivative(p: Poly) -> Poly:
    return poly(k * c for k, c in enumerate(p))[1:]


def value(p: Poly, x: Any) -> Any:
    """Return p(x), exact for a fraction and in complex doubles for numbers and arrays."""
    exact = isinstance(x, Fraction)
    out: Any = Fraction(0) if exact else np.zeros_like(np.asarray(x), dtype=complex)
    for c in reversed(p):
        out = out * x + (c if exact else float(c))
    return out


def divide(p: Poly, q: Poly) -> tuple[Poly, Poly]:
    """Return the quotient and the remainder of p by q."""
    rest, out = list(p), [Fraction(0)] * max(len(p) - len(q) + 1, 0)
    for i in reversed(range(len(out))):
        out[i] = rest[i + len(q) - 1] / q[-1]
        for j, c in enumerate(q):
            rest[i + j] -= out[i] * c
    return poly(out), poly(rest[: len(q) - 1])


def gcd(p: Poly, q: Poly) -> Poly:
    """Return the greatest common divisor, with leading coefficient one."""
    while q:
        p, q = q, divide(p, q)[1]
    return tuple(c / p[-1] for c in p)


def multiprecision() -> Any:
    """Return mpmath.

    >>> multiprecision().mpf(2)
    mpf('2.0')
    """
    return require("rb.stability", "mpmath")


def roots(p: Poly) -> list[mpmath.mpc]:
    """Return the distinct complex roots to `DIGITS` digits.

    >>> [complex(r) for r in roots(poly([1, 2, 1]))]
    [(-1+0j)]
    """
    if len(p) > 2:
        p = divide(p, gcd(p, derivative(p)))[0]
    if len(p) < 2:
        return []
    mp = multiprecision()
    with mp.workdps(DIGITS):
        exact = [mp.mpf(c.numerator) / c.denominator for c in p]
        return numeric_roots(exact)


def numeric_roots(coefficients: Sequence[Any]) -> list[mpmath.mpc]:
    """Return the roots of a polynomial with mpmath's numbers, in its precision.

    >>> import mpmath
    >>> [complex(r) for r in numeric_roots([mpmath.mpf(-2), mpmath.mpf(1)])]
    [(2+0j)]
    """
    mp = multiprecision()
    # mpmath 1.3, which PyTorch requires, knows descending order only and has no argument for it
    order = {"asc": False} if "asc" in inspect.signature(mp.polyroots).parameters else {}
    return list(mp.polyroots(coefficients[::-1], maxsteps=500, extraprec=200, **order))


def real_roots(p: Poly, low: Any = None, high: Any = None) -> list[Fraction]:
    """Return the sorted distinct real roots between low and high, as fractions of `DIGITS` digits.

    >>> [float(r) for r in real_roots(poly([-2, 0, 1]), low=0)]
    [1.4142135623730951]
    """
    mp, out = multiprecision(), []
    for root in roots(p):
        if abs(root.imag) < mp.mpf(10) ** (-DIGITS // 2):
            man, exp = root.real.man_exp  # the mantissa has no sign
            x = Fraction(int(mp.sign(root.real)) * man) * Fraction(2) ** exp
            if (low is None or x > low) and (high is None or x < high):
                out.append(x)
    return sorted(out)


def between(points: Sequence[Fraction], start: Fraction) -> list[tuple[Fraction, Fraction]]:
    """Return (end, inner point) of each interval of increasing points, from `start` to infinity.
    The end of the last interval is `start`, which means infinity."""
    ends = [start, *points]
    inside = [((a + b) / 2, b) for a, b in itertools.pairwise(ends)]
    return [(b, mid) for mid, b in inside] + [(start, 2 * ends[-1] + 1)]


def chebyshev(n: int) -> tuple[Poly, Poly]:
    """Return T_n and U_(n-1): cos(n x) and sin(n x) / sin(x) as polynomials in cos(x)."""
    t: list[Poly] = [ONE, poly([0, 1])]
    u: list[Poly] = [ZERO, ONE]
    for _ in range(2, n + 1):
        for series in (t, u):
            series.append(add(multiply(poly([0, 2]), series[-1]), series[-2], -1))
    return t[n], u[n]


def to_text(p: Poly, x: str = "z") -> str:
    """Return the polynomial in textbook notation.

    >>> to_text(poly([1, Fraction(-2, 3), Fraction(1, 6)]))
    '1 - 2z/3 + z^2/6'
    """
    out = ""
    for k, c in enumerate(p):
        if c == 0:
            continue
        power = "" if k == 0 else x if k == 1 else f"{x}^{k}"
        top, bottom = abs(c).numerator, abs(c).denominator
        if bottom > SIMPLE:
            size = f"{float(abs(c)):.6g} {power}".strip()
        else:
            size = f"{top if top != 1 or not power else ''}{power}"
            size += "" if bottom == 1 else f"/{bottom}"
        sign = "-" if c < 0 else "+"
        out += f" {sign} {size}" if out else f"{'-' * (c < 0)}{size}"
    return out or "0"
