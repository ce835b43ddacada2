"""The characteristic polynomial of a method on y' = lambda y, and its roots.

    linear multistep:  rho(zeta) - z sigma(zeta) = 0,    y_n ~ zeta^n,    z = h lambda
    PECE:              rho(zeta) - z sigma(zeta) - z^2 b_0 sigma*(zeta) = 0
    one-step:          Q(z) zeta - P(z) = 0
sigma* belongs to the predictor. All have the form sum_m z^m c_m(zeta). With zeta = exp(z), the
first power of z that remains is order + 1. Its coefficient over rho'(1) is the error constant C:
y(t + h) - y1 = C h^(order + 1) y^(order + 1) + ...
A method is zero-stable if the roots of rho lie in the unit disc and the roots on the circle are
simple (Dahlquist). (Hairer, Norsett & Wanner, *Solving ODEs I*, III.2-3.)
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import diffrax
import numpy as np

from rbjax import solvers
from rbjax.arguments import flag, integer, shown
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.stability.methods import Solver, solver_of
from rbjax.stability.theory.polynomials import (
    DIGITS,
    EPS,
    PRINTED,
    Poly,
    add,
    derivative,
    divide,
    exact,
    gcd,
    multiply,
    multiprecision,
    numeric_roots,
    poly,
    rational,
    roots,
    total,
    value,
)
from rbjax.stability.theory.stability_function import StabilityFunction, stability_function

if TYPE_CHECKING:
    import mpmath

RIM = 1e-14  # a root within this distance of the unit circle is on it


@displayed
@dataclass(frozen=True)
class Characteristic:
    """A characteristic polynomial phi(zeta, z) = sum_m z^m c_m(zeta), in exact arithmetic.

    `multistep(rho, sigma)` makes one from two polynomials. Doubles are converted to the simple
    fractions near them.

    Fields:
        by_power: the polynomials c_0 = rho, c_1 = -sigma, ..., each with the constant first.

    Raises:
        InputError: coefficients that are not finite; rho is zero, or all other polynomials are.

    Example:
        >>> import rbjax as rb
        >>> phi = rb.stability.characteristic("bdf2")
        >>> phi.order, phi.error_constant, phi.zero_stable
        (2, Fraction(-1, 3), True)
    """

    by_power: tuple[Poly, ...]

    def __post_init__(self) -> None:
        powers = tuple(exact(p, "Characteristic: a polynomial") for p in self.by_power)
        if not (powers and powers[0] and any(powers[1:])):
            raise InputError(f"Characteristic: got {powers}, expected (rho, -sigma), neither zero")
        object.__setattr__(self, "by_power", powers)

    @property
    def rho(self) -> Poly:
        return self.by_power[0]

    @property
    def sigma(self) -> Poly:
        return tuple(-c for c in self.by_power[1])

    @property
    def steps(self) -> int:
        """The number k of a k-step method."""
        return max(map(len, self.by_power)) - 1

    @functools.cached_property
    def _defect(self) -> tuple[int, Fraction]:
        """First power of z in the expansion of phi(exp z, z), and its coefficient."""
        for n in range(2 * sum(map(len, self.by_power)) + 2):
            terms = [
                c * Fraction(j) ** (n - m) / math.factorial(n - m)
                for m, p in enumerate(self.by_power[: n + 1])
                for j, c in enumerate(p)
            ]
            left, size = total(terms), total(map(abs, terms))
            if abs(left) > PRINTED * size:
                return n, rational(left, 8 * EPS * size)
        raise AssertionError("zeta = exp(z) solves no polynomial")

    @property
    def order(self) -> int:
        """Order of the method, at least 1 if it is consistent. It is -1 if rho(1) is not 0, and 0
        if rho(1) = 0 but rho'(1) is not sigma(1)."""
        return self._defect[0] - 1

    @property
    def error_constant(self) -> Fraction | float:
        """Error constant C, with the factor 1 / rho'(1); inf if rho'(1) is zero."""
        slope = value(derivative(self.rho), Fraction(1))
        return self._defect[1] / slope if slope else math.inf

    @functools.cached_property
    def spurious_roots(self) -> np.ndarray:
        """Complex roots of rho except zeta = 1, largest first."""
        rest = add(self.rho, ())
        while rest and value(rest, Fraction(1)) == 0:
            rest = divide(rest, poly([-1, 1]))[0]
        found = np.array([complex(r) for r in roots(rest)])
        return found[np.argsort(-np.abs(found), kind="stable")]

    @functools.cached_property
    def zero_stable(self) -> bool:
        """Whether the method satisfies Dahlquist's root condition."""
        inside = max((float(abs(r)) for r in roots(self.rho)), default=0.0) <= 1 + RIM
        double = roots(gcd(self.rho, derivative(self.rho)))
        return inside and all(float(abs(r)) < 1 - RIM for r in double)

    def roots(self, z: Any) -> np.ndarray:
        """Return the complex roots zeta (..., k) at z (...)."""
        z = np.asarray(z, dtype=complex)
        k = self.steps
        rows = np.zeros((*z.shape, k + 1), complex)
        for m, p in enumerate(self.by_power):
            rows[..., : len(p)] += z[..., None] ** m * np.array([float(c) for c in p])
        companion = np.zeros((*z.shape, k, k), complex)
        companion[..., np.arange(1, k), np.arange(k - 1)] = 1
        with np.errstate(divide="ignore", invalid="ignore"):
            companion[..., :, -1] = -rows[..., :-1] / rows[..., -1:]
        broken = ~np.isfinite(companion).all((-2, -1))  # a root is at infinity
        companion[broken] = 0
        out = np.linalg.eigvals(companion)
        out[broken] = np.inf
        return out

    def radius(self, z: Any) -> np.ndarray:
        """Return the largest |zeta| (...) at z (...)."""
        return np.abs(self.roots(z)).max(-1)

    def largest(self, x: Fraction, y: Fraction) -> mpmath.mpf:
        """Return the largest |zeta| at z = x + i y, to `DIGITS` digits."""
        mp = multiprecision()
        with mp.workdps(DIGITS):
            z = mp.mpc(*(mp.mpf(w.numerator) / w.denominator for w in (x, y)))
            row = [mp.mpc(0)] * (self.steps + 1)
            for m, p in enumerate(self.by_power):
                for j, c in enumerate(p):
                    row[j] += z**m * c.numerator / c.denominator
            if row[-1] == 0:
                return mp.inf
            while row[0] == 0:
                row.pop(0)
            found = numeric_roots(row)
            return max(map(abs, found), default=mp.mpf(0))


Theory = (StabilityFunction, Characteristic)  # methods given by their polynomials, without code
Method = Solver | StabilityFunction | Characteristic


def multistep(rho: Any, sigma: Any) -> Characteristic:
    """Return the linear multistep method of two polynomials, with exact coefficients.

    sum_j rho_j y_(n+j) = h sum_j sigma_j f_(n+j), j = 0 ... k from the oldest to the newest.

    Args:
        rho: (k + 1,) numbers, doubles or fractions. The last one, for the newest y, is not zero.
        sigma: at most k + 1 numbers. For an explicit method the last one is 0 or omitted.

    Returns:
        `Characteristic`. The method is consistent if its order is at least 1. The order is -1 if
        rho(1) is not 0, and 0 if rho'(1) is not sigma(1).

    Raises:
        InputError: wrong lengths, numbers that are not finite, a zero last rho, or a zero sigma.

    Source: Hairer, Norsett & Wanner, *Solving ODEs I*, III.2 (2.1).

    Example:
        >>> import rbjax as rb
        >>> leapfrog = rb.stability.multistep([-1, 0, 1], [0, 2])
        >>> leapfrog.order, leapfrog.error_constant, leapfrog.zero_stable
        (2, Fraction(1, 6), True)
    """
    try:
        sizes = np.shape(rho), np.shape(sigma)
    except ValueError as error:
        raise InputError(
            f"multistep: rho and sigma are {shown(rho)} and {shown(sigma)}, expected one row of "
            "coefficients each"
        ) from error
    if not (len(sizes[0]) == len(sizes[1]) == 1 and 1 <= sizes[1][0] <= sizes[0][0] > 1):
        raise InputError(
            f"multistep: got rho {sizes[0]} and sigma {sizes[1]}, expected (k + 1,), k >= 1, and "
            "at most as many"
        )
    a, b = exact(rho, "multistep: rho"), exact(sigma, "multistep: sigma")
    if len(a) < sizes[0][0]:
        raise InputError(
            "multistep: the last coefficient of rho is zero, expected the coefficient of the "
            "newest y; coefficients are in order from the oldest to the newest"
        )
    if not b:
        raise InputError("multistep: sigma is zero, expected the weights of the rates")
    return Characteristic((a, poly(-c for c in b)))


#: highest order of a formula, far above the orders of stable ones
HIGHEST = 1000


def adams(order: int, implicit: bool) -> Characteristic:
    """Return Adams-Bashforth, or Adams-Moulton if `implicit`, with the last `order` rates.

    The implicit methods of order 1 and 2 are backward Euler and the trapezoidal rule.

    Args:
        order: from 1.
        implicit: whether it is Adams-Moulton.

    Returns:
        A `Characteristic`.

    Raises:
        InputError: an order below 1.

    Example:
        >>> from rbjax.stability import adams
        >>> adams(2, implicit=False).error_constant, adams(2, implicit=True).error_constant
        (Fraction(5, 12), Fraction(-1, 12))
    """
    integer("adams", "order", order, least=1, most=HIGHEST)
    implicit = flag("adams", "implicit", implicit)
    steps = max(order - 1, 1) if implicit else order
    last = steps if implicit else steps - 1
    nodes = list(range(last, last - order, -1))  # times of the rates, latest first
    sigma = [Fraction(0)] * (steps + 1)
    for j in nodes:
        l = poly([1])
        for m in nodes:
            if m != j:
                l = multiply(l, poly([Fraction(-m, j - m), Fraction(1, j - m)]))
        whole = poly([0, *(c / (k + 1) for k, c in enumerate(l))])  # integral from steps - 1
        sigma[j] = value(whole, Fraction(steps)) - value(whole, Fraction(steps - 1))
    rho = poly([0] * (steps - 1) + [-1, 1])
    return Characteristic((rho, poly(-c for c in sigma)))


def backward_differentiation(order: int) -> Characteristic:
    """Return the BDF sum_j (1/j) nabla^j y = h f of an order from 1. Orders above 6 are unstable.

    Args:
        order: from 1.

    Returns:
        A `Characteristic`.

    Raises:
        InputError: an order below 1.

    Example:
        >>> from rbjax.stability import backward_differentiation
        >>> bool(abs(backward_differentiation(7).spurious_roots[0]) > 1.02)
        True
    """
    integer("backward_differentiation", "order", order, least=1, most=HIGHEST)
    rho, difference = poly([]), poly([1])
    for j in range(1, order + 1):
        difference = multiply(difference, poly([-1, 1]))
        shifted = poly([0] * (order - j) + list(difference))
        rho = add(rho, shifted, Fraction(1, j))
    return Characteristic((rho, poly([0] * order + [-1])))


def pece(order: int) -> Characteristic:
    """Return the PECE method: predictor Adams-Bashforth of order - 1, corrector Adams-Moulton.

    Args:
        order: from 2.

    Returns:
        A `Characteristic`.

    Raises:
        InputError: an order below 2.

    Example:
        >>> from rbjax.stability import pece
        >>> pece(2).by_power[2]  # h^2 lambda^2 y_n / 2: Heun's method
        (Fraction(-1, 2),)
    """
    integer("pece", "order", order, least=2, most=HIGHEST)
    corrector, predictor = adams(order, implicit=True), adams(order - 1, implicit=False)
    k = corrector.steps
    shift = poly([0] * (k - predictor.steps) + [1])
    newest = corrector.by_power[1][k]  # -b_0
    older = poly(corrector.by_power[1][:k])
    at_predicted = poly([0] * (k - 1) + [newest])
    twice = multiply(shift, poly(newest * c for c in predictor.sigma))
    return Characteristic((corrector.rho, add(older, at_predicted), twice))


def of_one_step(R: StabilityFunction) -> Characteristic:
    """Return the polynomial Q(z) zeta - P(z) of R = P / Q."""
    n = max(len(R.numerator), len(R.denominator))
    p, q = (tuple(x) + (Fraction(0),) * (n - len(x)) for x in (R.numerator, R.denominator))
    return Characteristic(tuple(poly([-a, b]) for a, b in zip(p, q, strict=True)))


def characteristic(solver: Method) -> Characteristic:
    """Derive phi(zeta, z), whose roots are the growth factors of a method on y' = lambda y.

    Args:
        solver: a name of `rb.solvers.all()`; a multistep, Runge-Kutta or Rosenbrock solver of rbjax
            or diffrax, with equal steps; an `rb.solvers.Tableau`, a `StabilityFunction` or a
            `Characteristic`.

    Returns:
        `Characteristic`: order, error_constant, zero_stable, spurious_roots, roots(z), radius(z).

    Raises:
        InputError: a method only for q' = v, v' = a, or an unknown method.

    Source: Hairer, Norsett & Wanner, *Solving ODEs I*, III.2.

    Example:
        >>> import rbjax as rb
        >>> phi = rb.stability.characteristic("adams_moulton2")  # the trapezoidal rule
        >>> phi.order, phi.error_constant
        (2, Fraction(-1, 12))
    """
    if isinstance(solver, Characteristic):
        return solver
    if isinstance(solver, StabilityFunction):
        return of_one_step(solver)
    one = solver_of(solver)
    if isinstance(one, solvers.BDF):
        return backward_differentiation(one.formula_order)
    if isinstance(one, solvers.Adams):
        if one.corrector == "once":
            return pece(one.formula_order)
        return adams(one.formula_order, implicit=one.corrector == "root")
    if isinstance(one, diffrax.LeapfrogMidpoint):
        return Characteristic((poly([-1, 0, 1]), poly([0, -2])))
    try:
        return of_one_step(stability_function(one))
    except InputError as error:
        raise InputError(
            f"characteristic: {type(one).__name__} has no linear theory here, expected a "
            "multistep, Runge-Kutta or Rosenbrock method; spectral_radius(solver, h_omega) "
            "measures the growth factors of q' = v, v' = a"
        ) from error
