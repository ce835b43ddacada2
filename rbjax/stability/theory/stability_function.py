"""The stability function of a one-step method, from its coefficients in exact arithmetic.

    y' = lambda y:  y1 = R(z) y0,    z = h lambda
    R(z) = det(I - z A + z e b') / det(I - z A) = 1 + z b' (I - z A)^-1 e
The denominator follows from the traces of powers of A (Newton's identities), the numerator from the
moments b' A^k e. For Rosenbrock methods A is alpha + gamma, because the Jacobian of this equation
is exact. (Hairer & Wanner, *Solving ODEs II*, IV.3, IV.7.)
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import diffrax
import numpy as np

from rbjax import solvers
from rbjax.errors import InputError
from rbjax.solvers import tableau as tables
from rbjax.stability.methods import Solver, solver_of
from rbjax.stability.theory.polynomials import (
    EPS,
    Poly,
    add,
    clean,
    exact,
    magnitude,
    multiply,
    poly,
    rational,
    to_text,
    total,
    value,
)

Coefficients = tuple[np.ndarray, np.ndarray]  # a, b


@dataclass(frozen=True)
class StabilityFunction:
    """A rational function R(z) = numerator / denominator with exact coefficients, constant first.

    Doubles are converted to the simple fractions near them.

    Raises:
        InputError: coefficients that are not finite, or a zero denominator.

    Example:
        >>> import rbjax as rb
        >>> print(rb.stability.stability_function("radau_iia2"))
        (1 + z/3) / (1 - 2z/3 + z^2/6)
    """

    numerator: Poly
    denominator: Poly

    def __post_init__(self) -> None:
        for name in ("numerator", "denominator"):
            object.__setattr__(self, name, exact(getattr(self, name), f"StabilityFunction: {name}"))
        if not self.denominator:
            raise InputError("StabilityFunction: the denominator is zero, expected a polynomial")

    def __call__(self, z: Any) -> Any:
        """Return R(z) for complex numbers of any shape."""
        return value(self.numerator, z) / value(self.denominator, z)

    def __str__(self) -> str:
        return f"({to_text(self.numerator)}) / ({to_text(self.denominator)})"

    def radius(self, z: Any) -> np.ndarray:
        """Return |R(z)|."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.abs(self(z))

    @property
    def at_infinity(self) -> float:
        """Limit of R as z goes to infinity; inf if R is unbounded."""
        over = len(self.numerator) - len(self.denominator)
        if over > 0:
            return math.inf
        return 0.0 if over < 0 else float(self.numerator[-1] / self.denominator[-1])


def of_tableau(a: np.ndarray, b: np.ndarray) -> StabilityFunction:
    """Return R(z) of coefficients a (s, s) and b (s,). Doubles become the simple fractions near
    them."""
    A = [[rational(x) for x in row] for row in np.asarray(a)]
    B = [rational(x) for x in np.asarray(b)]
    exact = _quotient(A, B, -1)
    # the same sums with positive terms, as a bound of the rounding
    sizes = _quotient([[abs(x) for x in row] for row in A], [abs(x) for x in B], 1)
    p, q = (
        poly(rational(c, 8 * EPS * s) for c, s in zip(x, size, strict=True))
        for x, size in zip(exact, sizes, strict=True)
    )
    return StabilityFunction(p, q)


def _quotient(A: list[list[Fraction]], b: list[Fraction], sign: int) -> tuple[list, list]:
    """Return the coefficients of the numerator and of the denominator of R(z). They are det(I - z
    A) (1 + sum_k z^k b' A^(k-1) e) and det(I - z A) for sign = -1."""
    s = len(b)
    power = [[Fraction(i == j) for j in range(s)] for i in range(s)]
    moments, traces = [Fraction(1)], [Fraction(0)]
    for _ in range(s):
        moments.append(total(w * total(row) for w, row in zip(b, power, strict=True)))
        power = [
            [total(x * y for x, y in zip(row, column, strict=True))
             for column in zip(*power, strict=True)]
            for row in A
        ]  # fmt: skip
        traces.append(total(power[i][i] for i in range(s)))
    q = [Fraction(1)]
    for k in range(1, s + 1):
        q.append(sign * total(traces[i] * q[k - i] for i in range(1, k + 1)) / k)
    p = [total(q[j] * moments[k - j] for j in range(k + 1)) for k in range(s + 1)]
    return p, q


@functools.singledispatch
def butcher(solver: Any) -> Coefficients | None:
    """Return a (s, s) and b (s,) of a Runge-Kutta or Rosenbrock method; None for other methods."""
    del solver
    return None


@butcher.register(diffrax.AbstractRungeKutta)
def _(solver) -> Coefficients | None:
    t = solver.tableau
    if not isinstance(t, diffrax.ButcherTableau):
        return None  # a solver of two fields has one tableau for each
    a = np.zeros((t.num_stages, t.num_stages))
    for i, row in enumerate(t.a_lower):
        a[i + 1, : i + 1] = row
    if t.a_diagonal is not None:
        a += np.diag(t.a_diagonal)
    return a, np.asarray(t.b_sol)


@butcher.register(solvers.ImplicitRungeKutta)
@butcher.register(solvers.MuntheKaas)
def _(solver) -> Coefficients:
    return np.array(solver.tableau.a), np.array(solver.tableau.b)


@butcher.register
def _(solver: solvers.RosenbrockW) -> Coefficients:
    t = solver.tableau
    return np.add(t.alpha, t.gamma), np.array(t.b)


@butcher.register
def _(solver: diffrax.Euler) -> Coefficients:
    return np.array(tables.EULER.a), np.array(tables.EULER.b)


@butcher.register
def _(solver: diffrax.ImplicitEuler) -> Coefficients:
    return np.ones((1, 1)), np.ones(1)


@butcher.register
def _(solver: solvers.CommutatorFree4) -> Coefficients:
    """Return the coefficients of RK4, to which the method reduces if exponentials commute."""
    return np.array(tables.RK4.a), np.array(tables.RK4.b)


@butcher.register
def _(solver: solvers.CrouchGrossman3) -> Coefficients:
    t = tables.explicit(((3 / 4,), (119 / 216, 17 / 108)), (13 / 51, -2 / 3, 24 / 17), 3)
    return np.array(t.a), np.array(t.b)


def stability_function(solver: Solver | StabilityFunction) -> StabilityFunction:
    """Derive R(z) of a one-step method, y1 = R(h lambda) y0 on y' = lambda y, in exact arithmetic.

    Args:
        solver: a name of `rb.solvers.all()`; a Runge-Kutta, Rosenbrock or Munthe-Kaas solver of
            rbjax or diffrax, also in a `diffrax.HalfSolver`; or an `rb.solvers.Tableau`.

    Returns:
        `StabilityFunction`, with numerator and denominator.

    Raises:
        InputError: a multistep method, a method only for q' = v, v' = a, or an unknown method.

    Source: Hairer & Wanner, *Solving ODEs II*, IV.3 (3.3).

    Example:
        >>> import rbjax as rb
        >>> R = rb.stability.stability_function("rk4")
        >>> print(R), complex(R(-1.0))
        (1 + z + z^2/2 + z^3/6 + z^4/24) / (1)
        (None, (0.375+0j))
    """
    if isinstance(solver, StabilityFunction):
        return solver
    solver = solver_of(solver)
    if isinstance(solver, diffrax.HalfSolver):
        whole = stability_function(solver.solver)
        halved = (poly(c / 2**k for k, c in enumerate(p)) for p in
                  (whole.numerator, whole.denominator))  # fmt: skip
        p, q = (multiply(x, x) for x in halved)
        return StabilityFunction(p, q)
    found = butcher(solver)
    if found is None:
        raise InputError(
            f"stability_function: {type(solver).__name__} has no R(z), expected a Runge-Kutta or "
            "Rosenbrock method; use characteristic(solver) for multistep methods, "
            "spectral_radius(solver, h_omega) for methods of q' = v, v' = a"
        )
    return of_tableau(*found)


def modulus_excess(R: StabilityFunction) -> Poly:
    """Return the E-polynomial |P(i y)|^2 - |Q(i y)|^2 of R = P / Q in w = y^2."""
    parts = [_squared(p) for p in (R.numerator, R.denominator)]
    sizes = [_squared(magnitude(p), signed=False) for p in (R.numerator, R.denominator)]
    return clean(add(parts[0], parts[1], -1), add(*sizes))


def _squared(p: Poly, signed: bool = True) -> Poly:
    """Return |p(i y)|^2 as a polynomial in w = y^2."""
    sign = -1 if signed else 1
    even = poly(sign**k * c for k, c in enumerate(p[::2]))
    odd = poly(sign**k * c for k, c in enumerate(p[1::2]))
    return add(multiply(even, even), multiply(poly([0, 1]), multiply(odd, odd)))
