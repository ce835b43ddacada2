"""Regions of absolute stability: limits on the axes, sector and half-plane.

    S = {z : every root of phi(zeta, z) has |zeta| <= 1}
    real limit: the least x <= 0 with [x, 0] in S
    imaginary limit: the largest y with i [0, y] in S
    A-stable: S contains the left half-plane;  A(alpha): the sector |arg(-z)| <= alpha
    stiffly stable: the half-plane Re z <= -D;  L-stable: A-stable, and R(infinity) = 0
The boundary of S lies on the curve on which a root has modulus one. For a one-step method the curve
meets the axes at roots of P^2 - Q^2 and of |P(iy)|^2 - |Q(iy)|^2. For a multistep method it is
z = rho / sigma at zeta = exp(i theta), whose parts are rational in c = cos theta, so limits, angle
and D are values at exact roots. For a predictor-corrector method the equation of z is quadratic.
Its real and imaginary parts have a common root if their resultant, a polynomial in c, vanishes.
Between such points one z is tested, in `DIGITS` digits, because |zeta| - 1 of a weakly unstable
method may be 1e-15. (Hairer & Wanner, *Solving ODEs II*, IV.3, V.1-2; Gear 1971.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from rbjax.arguments import instance, real_array
from rbjax.errors import InputError
from rbjax.stability.theory.multistep_roots import Characteristic
from rbjax.stability.theory.polynomials import (
    Poly,
    add,
    between,
    chebyshev,
    derivative,
    divide,
    multiply,
    poly,
    real_roots,
    roots,
    value,
)
from rbjax.stability.theory.stability_function import StabilityFunction, modulus_excess

Method = StabilityFunction | Characteristic
BELOW_90 = math.nextafter(90, 0)  # largest angle below 90, which means A-stable
GROWN = 1e-20  # excess of |zeta| over one that counts as growth, in `DIGITS` digits
SHARP, FARTHEST = Fraction(1, 2**40), 2**40  # relative error of D, and the largest D searched
ONE_SQUARED = poly([1, 0, -1])  # 1 - c^2


def real_limit(method: Method) -> float:
    """Return the least x <= 0 such that the method is stable on [x, 0]. -inf means no limit.

    Args:
        method: a `StabilityFunction` or a `Characteristic`, as from `characteristic(solver)`.

    Returns:
        x, no unit.

    Raises:
        InputError: not a `StabilityFunction` or a `Characteristic`.

    Example:
        >>> from rbjax.stability import real_limit
        >>> from rbjax.stability import characteristic
        >>> round(real_limit(characteristic("rk4")), 4)
        -2.7853
    """
    method = _simplest(method)
    if isinstance(method, StabilityFunction):
        p, q = (_mirrored(x) for x in (method.numerator, method.denominator))
        points = sorted({x for s in (1, -1) for x in real_roots(add(p, q, s), low=0)})
        return 0.0 - _first_end(points, lambda x: abs(value(p, x)) <= abs(value(q, x)))
    if len(method.by_power) == 2:
        N, M, S = _curve(method)
        crossings = [Fraction(-1), *_inside(M)]
        found = [value(N, c) / value(S, c) for c in crossings if value(S, c)]
    else:
        ends = (poly(value(p, Fraction(zeta)) for p in method.by_power) for zeta in (1, -1))
        found = [x for p in ends for x in real_roots(p)]
        even, odd = _on_circle(method)
        found += [x for _, x in _common_roots(even, odd)]
    points = sorted({-x for x in found if x < 0})
    return 0.0 - _first_end(points, lambda x: bool(method.largest(-x, Fraction(0)) <= 1 + GROWN))


def imaginary_limit(method: Method) -> float:
    """Return the largest y >= 0 such that the method is stable on i [0, y]. inf means no limit.

    Args:
        method: a `StabilityFunction` or a `Characteristic`, as from `characteristic(solver)`.

    Returns:
        y, no unit.

    Raises:
        InputError: not a `StabilityFunction` or a `Characteristic`.

    Example:
        >>> from rbjax.stability import imaginary_limit
        >>> from rbjax.stability import characteristic
        >>> round(imaginary_limit(characteristic("rk4")), 4)
        2.8284
    """
    method = _simplest(method)
    if isinstance(method, StabilityFunction):
        excess = modulus_excess(method)
        points = real_roots(excess, low=0)
        return math.sqrt(_first_end(points, lambda w: value(excess, w) <= 0))
    if len(method.by_power) == 2:
        N, M, S = _curve(method)
        # points at which the curve crosses the axis or turns on it: (1 - c^2) M^2 / S^2 stationary
        turning = add(multiply(_slope(M), S), multiply(ONE_SQUARED, multiply(M, derivative(S))), -1)
        found = [(c, value(M, c) / value(S, c)) for c in _inside(N or turning) if value(S, c)]
    else:
        # z = i sin(theta) x: the real part, and the imaginary part over sin(theta)
        (a, b, c), (d, e, f) = _on_circle(method)
        minus = add((), ONE_SQUARED, -1)
        found = _common_roots(
            (a, multiply(minus, e), multiply(minus, c)), (d, b, multiply(minus, f))
        )
    heights = (abs(float(x)) * math.sqrt(1 - c * c) for c, x in found)
    points = sorted({Fraction(y) for y in heights if y > 0})
    return _first_end(points, lambda y: bool(method.largest(Fraction(0), y) <= 1 + GROWN))


def alpha_degrees(method: Method) -> float:
    """Return the angle of A(alpha)-stability: 90 if A-stable, 0 if the real limit is finite.

    Args:
        method: a `StabilityFunction` or a `Characteristic`, as from `characteristic(solver)`.

    Returns:
        The angle, degrees.

    Raises:
        InputError: not a `StabilityFunction` or a `Characteristic`.

    Example:
        >>> from rbjax.stability import alpha_degrees
        >>> from rbjax.stability import characteristic
        >>> alpha_degrees(characteristic("radau_iia2"))
        90.0
    """
    method = _simplest(method)
    if real_limit(method) > -math.inf or not _bounded(method):
        return 0.0
    if isinstance(method, StabilityFunction):
        return 90.0 if _A_stable(method) else _widest_ray(method)
    N, M, _ = _curve(method)
    # tan^2 alpha = (1 - c^2) M^2 / N^2 has its minimum at an end or at a root of this polynomial
    stationary = add(multiply(_slope(M), N), multiply(ONE_SQUARED, multiply(M, derivative(N))), -1)
    angles = [90.0]
    for c in [*real_roots(stationary, -1, 1), *real_roots(M, -1, 1)]:
        n, m = value(N, c), value(M, c)
        if n < 0:
            tangent = abs(float(m / n)) * math.sqrt(1 - c * c)
            angles.append(math.degrees(math.atan(tangent)))
    return min(angles)


def stiff_stability(method: Method) -> float:
    """Return the least D such that the method is stable for Re z <= -D; inf if there is none.

    Args:
        method: a `StabilityFunction` or a `Characteristic`, as from `characteristic(solver)`.

    Returns:
        D, no unit.

    Raises:
        InputError: not a `StabilityFunction` or a `Characteristic`.

    Example:
        >>> from rbjax.stability import stiff_stability
        >>> from rbjax.stability import characteristic
        >>> stiff_stability(characteristic("radau_iia2"))
        0.0
    """
    method = _simplest(method)
    if real_limit(method) > -math.inf or not _bounded(method):
        return math.inf
    if isinstance(method, StabilityFunction):
        return _least_shift(method)
    N, _, S = _curve(method)
    turning = add(multiply(derivative(N), S), multiply(N, derivative(S)), -1)
    ends = [c for c in (Fraction(-1), Fraction(1)) if value(S, c)]
    found = (-float(value(N, c) / value(S, c)) for c in [*ends, *real_roots(turning, -1, 1)])
    return max(0.0, *found)


def at_infinity(method: Method) -> float:
    """Return the amplification as z goes to infinity; inf if it is unbounded.

    For a one-step method it is |R(infinity)|. For a multistep method it is the largest root of the
    characteristic polynomial.
    """
    if isinstance(method, StabilityFunction):
        return abs(method.at_infinity)
    last = method.by_power[-1]
    if len(last) - 1 < method.steps:
        return math.inf
    return max((float(abs(r)) for r in roots(last)), default=0.0)


def stability_region(method: Method, x: Any, y: Any) -> np.ndarray:
    """Return the modulus of the largest growth factor on a grid of z = h lambda = x + i y.

    The array is (len(y), len(x)). The method is stable at z if the value is at most one.

    Args:
        method: a `StabilityFunction` or a `Characteristic`, as from `characteristic(solver)`.
        x: (nx,), real parts of z, no unit.
        y: (ny,), imaginary parts of z, no unit.

    Returns:
        (ny, nx), no unit.

    Raises:
        InputError: a method without linear theory, or x or y that are not one-dimensional.

    Example:
        >>> from rbjax.stability import stability_region
        >>> from rbjax.stability import characteristic
        >>> stability_region(characteristic("euler"), [-1.0, 1.0], [0.0]).tolist()
        [[0.0, 2.0]]
    """
    _check(method)
    x = real_array("stability_region", "x", x, ndim=1)
    y = real_array("stability_region", "y", y, ndim=1)
    return method.radius(np.asarray(x)[None, :] + 1j * np.asarray(y)[:, None])


def _check(method: Any) -> None:
    public = "a StabilityFunction or a Characteristic: rb.stability.linear_analysis(solver).method"
    instance("regions", "method", method, (StabilityFunction, Characteristic), public)


def _simplest(method: Method) -> Method:
    """Return the stability function of a one-step polynomial; return other methods unchanged."""
    _check(method)
    if isinstance(method, StabilityFunction):
        return method
    if method.steps == 1:
        padded = [p + (Fraction(0),) * (2 - len(p)) for p in method.by_power]
        return StabilityFunction(poly(-p[0] for p in padded), poly(p[1] for p in padded))
    if len(method.by_power) > 3:
        raise InputError(
            f"regions: got a multistep method with z^{len(method.by_power) - 1}, expected at most "
            "z^2 (one corrector)"
        )
    return method


def _bounded(method: Method) -> bool:
    """Return whether all roots have modulus at most one as z goes to infinity."""
    return at_infinity(method) <= 1


def _A_stable(R: StabilityFunction) -> bool:
    """Return whether |R| <= 1 on the imaginary axis and R has no pole in the left half-plane. By
    the maximum principle |R| <= 1 then holds in the whole left half-plane."""
    return imaginary_limit(R) == math.inf and all(p.real > 0 for p in roots(R.denominator))


def _least_shift(R: StabilityFunction) -> float:
    """Return the least D for which R(z - D) is A-stable, by bisection over nested half-planes."""
    if _A_stable(R):
        return 0.0
    low, high = Fraction(0), Fraction(1)
    while not _A_stable(_shifted(R, high)):
        low, high = high, 2 * high
        if high > FARTHEST:
            return math.inf
    while high - low > high * SHARP:
        mid = (low + high) / 2
        low, high = (low, mid) if _A_stable(_shifted(R, mid)) else (mid, high)
    return float(high)


def _shifted(R: StabilityFunction, D: Fraction) -> StabilityFunction:
    """Return the function R(z - D)."""
    parts = []
    for p in (R.numerator, R.denominator):
        out: Poly = ()
        for c in reversed(p):
            out = add(multiply(out, poly([-D, 1])), poly([c]))
        parts.append(out)
    return StabilityFunction(*parts)


def _mirrored(p: Poly) -> Poly:
    """Return the polynomial p(-x)."""
    return poly((-1) ** k * c for k, c in enumerate(p))


def _first_end(points: list[Fraction], stable: Callable[[Fraction], bool]) -> float:
    """Return the end of the first run of stable intervals from zero, inf if all intervals are
    stable."""
    intervals = between(points, Fraction(0))
    reached = Fraction(0)
    for end, mid in intervals:
        if not stable(mid):
            return float(reached)
        reached = end
    return math.inf


def _curve(method: Characteristic) -> tuple[Poly, Poly, Poly]:
    """Return polynomials N, M, S in c = cos theta of the boundary of the stability region. The
    boundary rho / sigma at exp(i theta) is (N + i sin(theta) M) / S."""
    if len(method.by_power) > 2:
        raise InputError(
            "regions: got a multistep method with z^2, expected rho - z sigma for angle and strip"
        )
    rho, sigma = method.rho, method.sigma
    N, M, S = (poly([]) for _ in range(3))
    for j, b in enumerate(sigma):
        for out_of, i, a in [("r", i, a) for i, a in enumerate(rho)] + [
            ("s", i, a) for i, a in enumerate(sigma)
        ]:
            t, u = chebyshev(abs(i - j))
            if out_of == "s":
                S = add(S, t, a * b)
            else:
                N = add(N, t, a * b)
                M = add(M, u, a * b * (1 if i > j else -1))
    return N, M, S


def _slope(M: Poly) -> Poly:
    """Return (1 - c^2) M' - c M: sqrt(1 - c^2) times the derivative of sqrt(1 - c^2) M."""
    return add(multiply(ONE_SQUARED, derivative(M)), multiply(poly([0, 1]), M), -1)


def _on_circle(method: Characteristic) -> tuple[list[Poly], list[Poly]]:
    """Return the real part, and the imaginary part over sin(theta), of each coefficient c_m(exp(i
    theta)). They are polynomials in cos(theta)."""
    even, odd = [], []
    for p in method.by_power:
        parts: tuple[Poly, Poly] = ((), ())
        for j, a in enumerate(p):
            parts = (add(parts[0], chebyshev(j)[0], a), add(parts[1], chebyshev(j)[1], a))
        even.append(parts[0])
        odd.append(parts[1])
    return even, odd


def _common_roots(f: Sequence[Poly], g: Sequence[Poly]) -> list[tuple[Fraction, Fraction]]:
    """Return the (c, x), |c| < 1, at which f_0 + f_1 x + f_2 x^2 and g_0 + g_1 x + g_2 x^2 vanish.
    The coefficients are polynomials in c."""

    def minor(i: int, j: int) -> Poly:
        return add(multiply(f[i], g[j]), multiply(f[j], g[i]), -1)

    top, bottom = minor(0, 2), minor(2, 1)
    resultant = add(multiply(top, top), multiply(bottom, minor(1, 0)), -1)
    return [(c, value(top, c) / value(bottom, c)) for c in _inside(resultant) if value(bottom, c)]


def _inside(p: Poly) -> list[Fraction]:
    """Return the roots of p in the open interval (-1, 1)."""
    for end in (1, -1):
        while p and value(p, Fraction(end)) == 0:
            p = divide(p, poly([-end, 1]))[0]
    return real_roots(p, -1, 1)


def _widest_ray(R: StabilityFunction) -> float:
    """Return the largest angle of rays with |R| <= 1, by bisection, for an A(0)-stable method."""

    def stable(angle: float) -> bool:
        z = -np.exp(1j * angle) * np.logspace(-6, 8, 20_001)
        return bool((R.radius(z) <= 1 + 1e-12).all())

    low, high = 0.0, math.pi / 2
    for _ in range(55):
        mid = (low + high) / 2
        low, high = (mid, high) if stable(mid) else (low, mid)
    return min(math.degrees(low), BELOW_90)
