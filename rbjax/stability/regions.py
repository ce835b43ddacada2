"""Regions of absolute stability: their limits on the axes, their angle, their strip.

    S = {z : every root of phi(zeta, z) has |zeta| <= 1}
    real limit: the least x <= 0 with [x, 0] in S
    imaginary limit: the largest y with i [0, y] in S
    A-stable: S holds the left half-plane;  A(alpha): the sector |arg(-z)| <= alpha
    stiffly stable: the half-plane Re z <= -D;  L-stable: A-stable, and R(infinity) = 0
The rim of S lies on the curve where a root has modulus one. For a one-step method it meets the axes
at roots of P^2 - Q^2 and of |P(iy)|^2 - |Q(iy)|^2; for a multistep method it is
z = rho / sigma at zeta = exp(i theta), whose parts are rational in c = cos theta: limits, angle and
D are then values at exact roots. (Hairer & Wanner, *Solving ODEs II*, IV.3, V.1-2; Gear 1971.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np

from rbjax.stability.multistep_roots import Characteristic
from rbjax.stability.polynomials import (
    Poly,
    between,
    chebyshev,
    derivative,
    plus,
    poly,
    real_roots,
    roots,
    times,
    value,
)
from rbjax.stability.stability_function import StabilityFunction, modulus_excess

Method = StabilityFunction | Characteristic
GROWN = 1e-9  # of a root's modulus over one, where only doubles decide
ONE_SQUARED = poly([1, 0, -1])  # 1 - c^2


def real_limit(method: Method) -> float:
    """The least x <= 0 such that the method is stable on [x, 0]; -inf, or 0 for none."""
    if isinstance(method, StabilityFunction):
        p, q = (_mirrored(x) for x in (method.numerator, method.denominator))
        points = sorted({x for s in (1, -1) for x in real_roots(plus(p, q, s), low=0)})
        end = _first_end(points, lambda x: abs(value(p, x)) <= abs(value(q, x)))
    elif len(method.by_power) == 2:
        _, M, S = _curve(method)
        crossings = [Fraction(-1), *real_roots(M, -1, 1)]
        points = sorted({-_on_real_axis(method, c, S) for c in crossings if value(S, c)} - {0})
        points = [x for x in points if x > 0]
        end = _first_end(points, lambda x: bool(method.radius(-float(x)) <= 1 + GROWN))
    else:
        end = _scanned(lambda x: method.radius(-x))
    return 0.0 - end


def imaginary_limit(method: Method) -> float:
    """The largest y such that the method is stable on i [0, y]; inf, or 0 for none."""
    if isinstance(method, StabilityFunction):
        excess = modulus_excess(method)
        points = real_roots(excess, low=0)
        return math.sqrt(_first_end(points, lambda w: value(excess, w) <= 0))
    if len(method.by_power) == 2:
        N, M, S = _curve(method)
        # where the curve crosses the axis, or, all on it, turns: (1 - c^2) M^2 / S^2 is stationary
        turning = plus(times(_slope(M), S), times(ONE_SQUARED, times(M, derivative(S))), -1)
        curve = [(c, value(S, c)) for c in real_roots(N or turning, -1, 1)]
        heights = [abs(float(value(M, c) / s)) * math.sqrt(1 - c * c) for c, s in curve if s]
        points = sorted({Fraction(y) for y in heights if y > 0})
        return _first_end(points, lambda y: bool(method.radius(1j * float(y)) <= 1 + GROWN))
    return _scanned(lambda y: method.radius(1j * y))


def alpha_degrees(method: Method) -> float:
    """The angle of A(alpha)-stability: 90 if A-stable, 0 where the real limit is finite."""
    if real_limit(method) > -math.inf or not _bounded(method):
        return 0.0
    if isinstance(method, StabilityFunction):
        poles = roots(method.denominator)
        excess = modulus_excess(method)
        inside = _first_end(real_roots(excess, low=0), lambda w: value(excess, w) <= 0) == math.inf
        # |R| <= 1 all along, so that every interval between roots must hold, not the first alone
        inside = inside and all(
            value(excess, mid) <= 0 for _, mid in between(real_roots(excess, low=0), Fraction(0))
        )
        if inside and all(pole.real > 0 for pole in poles):
            return 90.0
        return _widest_ray(method)
    N, M, _ = _curve(method)
    # tan^2 alpha = (1 - c^2) M^2 / N^2 is least at an end or where this vanishes:
    stationary = plus(times(_slope(M), N), times(ONE_SQUARED, times(M, derivative(N))), -1)
    angles = [90.0]
    for c in [*real_roots(stationary, -1, 1), *real_roots(M, -1, 1)]:
        n, m = value(N, c), value(M, c)
        if n < 0:
            tangent = abs(float(m / n)) * math.sqrt(1 - c * c)
            angles.append(math.degrees(math.atan(tangent)))
    return min(angles)


def stiff_stability(method: Method) -> float:
    """D of stiff stability: the method is stable where Re z <= -D; inf where for no D."""
    if real_limit(method) > -math.inf or not _bounded(method):
        return math.inf
    if isinstance(method, StabilityFunction):
        return 0.0 if alpha_degrees(method) == 90 else math.nan
    N, _, S = _curve(method)
    turning = plus(times(derivative(N), S), times(N, derivative(S)), -1)
    ends = [c for c in (Fraction(-1), Fraction(1)) if value(S, c)]
    found = (-float(value(N, c) / value(S, c)) for c in [*ends, *real_roots(turning, -1, 1)])
    return max(0.0, *found)


def at_infinity(method: Method) -> float:
    """|R(infinity)|, the largest root in the limit of stiffness; inf where it is not bounded."""
    if isinstance(method, StabilityFunction):
        return abs(method.at_infinity)
    last = method.by_power[-1]
    if len(last) - 1 < method.steps:
        return math.inf
    return max((float(abs(r)) for r in roots(last)), default=0.0)


def stability_region(method: Method, x: Any, y: Any) -> np.ndarray:
    """The largest |zeta| (len(y), len(x)) over a grid x + i y of z: stable where at most one."""
    return method.radius(np.asarray(x)[None, :] + 1j * np.asarray(y)[:, None])


def _bounded(method: Method) -> bool:
    """Whether no root passes one where z goes to infinity."""
    return at_infinity(method) <= 1


def _mirrored(p: Poly) -> Poly:
    """p(-x)."""
    return poly((-1) ** k * c for k, c in enumerate(p))


def _first_end(points: list[Fraction], stable: Callable[[Fraction], bool]) -> float:
    """Where the intervals between points, from zero on, stop being stable; inf for nowhere."""
    intervals = between(points, Fraction(0))
    reached = Fraction(0)
    for end, mid in intervals:
        if not stable(mid):
            return float(reached)
        reached = end
    return math.inf


def _curve(method: Characteristic) -> tuple[Poly, Poly, Poly]:
    """N, M, S in c = cos theta: rho / sigma at exp(i theta) is (N + i sin(theta) M) / S."""
    rho, sigma = method.rho, method.sigma
    N, M, S = (poly([]) for _ in range(3))
    for j, b in enumerate(sigma):
        for out_of, i, a in [("r", i, a) for i, a in enumerate(rho)] + [
            ("s", i, a) for i, a in enumerate(sigma)
        ]:
            t, u = chebyshev(abs(i - j))
            if out_of == "s":
                S = plus(S, t, a * b)
            else:
                N = plus(N, t, a * b)
                M = plus(M, u, a * b * (1 if i > j else -1))
    return N, M, S


def _slope(M: Poly) -> Poly:
    """(1 - c^2) M' - c M: the derivative of sqrt(1 - c^2) M, times that root."""
    return plus(times(ONE_SQUARED, derivative(M)), times(poly([0, 1]), M), -1)


def _on_real_axis(method: Characteristic, c: Fraction, S: Poly) -> Fraction:
    N, _, _ = _curve(method)
    return value(N, c) / value(S, c)


def _scanned(radius: Callable[[Any], np.ndarray]) -> float:
    """Where the radius first passes one, from zero on, by halving; for predictor-correctors."""
    start, end, n = 0.02, 20.0, 4000  # nearer to zero all roots are one, or small, to rounding
    grid = np.linspace(start, end, n)
    unstable = radius(grid) > 1 + 1e-12
    if unstable[0]:
        return 0.0
    if not unstable.any():
        return math.inf
    low, high = grid[unstable.argmax() - 1], grid[unstable.argmax()]
    for _ in range(60):
        mid = (low + high) / 2
        low, high = (low, mid) if radius(mid) > 1 else (mid, high)
    return float(low)


def _widest_ray(R: StabilityFunction) -> float:
    """Of an A(0)-stable one-step method: the rays on which |R| <= 1, by halving the angle."""

    def stable(angle: float) -> bool:
        z = -np.exp(1j * angle) * np.logspace(-6, 8, 20_001)
        return bool((R.radius(z) <= 1 + 1e-12).all())

    low, high = 0.0, math.pi / 2
    for _ in range(55):
        mid = (low + high) / 2
        low, high = (mid, high) if stable(mid) else (low, mid)
    return math.degrees(low)
