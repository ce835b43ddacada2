"""The linear theory of a method, in one report."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from rbjax.errors import InputError
from rbjax.solvers import tableau as tables
from rbjax.solvers.rosenbrock import RosenbrockW, holds
from rbjax.stability.methods import made
from rbjax.stability.theory import regions
from rbjax.stability.theory.multistep_roots import Characteristic, Method, Theory, characteristic
from rbjax.stability.theory.stability_function import StabilityFunction, butcher, stability_function

VANISHES = 1e-9  # R(infinity) from coefficients that are printed to about twelve digits
HIGHEST = 8  # largest order of the conditions: 115 trees with eight nodes


@dataclass(frozen=True)
class LinearAnalysis:
    """A method on y' = lambda y, z = h lambda, and the order by its conditions.

    Fields: method, `StabilityFunction` or `Characteristic`; order, below 1 if not consistent, above
    8 the order that Butcher's simplifying assumptions prove; linear_order, on y' = lambda y;
    error_constant C, of y(t + h) - y1 = C h^(p + 1) y^(p + 1) there; real_limit <= 0 and
    imaginary_limit >= 0 of stability; A_stable; alpha in degrees (90: A-stable, 0: no sector);
    stiff_D, stable for Re z <= -D (inf: for no D); R_inf = |R(infinity)|, for multistep methods
    the largest root; L_stable; zero_stable.
    """

    method: StabilityFunction | Characteristic
    order: int
    linear_order: int
    error_constant: Fraction | float
    real_limit: float
    imaginary_limit: float
    A_stable: bool
    alpha: float
    stiff_D: float
    R_inf: float
    L_stable: bool
    zero_stable: bool


def order_by_conditions(solver: Method) -> int:
    """The order by the order conditions: rooted trees up to 8 nodes (one-step), phi (multistep).

    The argument is as for `linear_analysis`. A `StabilityFunction` gives the order on linear
    problems only. Above 8 the result is the order that Butcher's simplifying assumptions B(p),
    C(eta), D(zeta) prove, at least 8.

    Example:
        >>> import rbjax as rb
        >>> rb.stability.order_by_conditions("rk4"), rb.stability.order_by_conditions("bdf3")
        (4, 3)
    """
    if isinstance(solver, Theory):
        return characteristic(solver).order
    solver = made(solver)
    table = butcher(solver)
    if table is None:
        return _method(solver)[1].order
    a, b = table
    if not isinstance(solver, RosenbrockW):
        found = tables.attained_order(a, b, HIGHEST)
        return found if found < HIGHEST else max(found, tables.proven_order(a, b))
    # conditions of W-methods: any Jacobian
    alpha, gamma = np.array(solver.tableau.alpha), np.array(solver.tableau.gamma)
    return next(p for p in range(HIGHEST) if not holds(alpha, gamma, b, p + 1))


def linear_analysis(solver: Method) -> LinearAnalysis:
    """The linear theory of a method: order, error constant, stability limits and verdicts.

    Args:
        solver: a name of `rb.solvers.all()`, any Runge-Kutta, Rosenbrock or multistep solver of
            rbjax or diffrax, or your own method: an `rb.solvers.Tableau`, a `StabilityFunction`,
            or a `Characteristic` (`multistep`, `adams`, ...).

    Returns:
        `LinearAnalysis`.

    Raises:
        InputError: methods only for q' = v, v' = a (`spectral_radius` measures these), or no
            method.

    Source: Hairer & Wanner, *Solving ODEs II*, IV.3, V.1.

    Example:
        >>> import rbjax as rb
        >>> report = rb.stability.linear_analysis("rk4")
        >>> round(report.real_limit, 6), round(report.imaginary_limit, 6), report.A_stable
        (-2.785294, 2.828427, False)
        >>> round(rb.stability.linear_analysis("bdf3").alpha, 4)
        86.0324
        >>> rb.stability.linear_analysis(rb.stability.backward_differentiation(7)).zero_stable
        False
    """
    method, phi = _method(solver)
    alpha = regions.alpha_degrees(method) if phi.zero_stable else 0.0
    R_inf = regions.at_infinity(method)
    return LinearAnalysis(
        method=method,
        order=order_by_conditions(solver),
        linear_order=phi.order,
        error_constant=phi.error_constant,
        real_limit=regions.real_limit(method) if phi.zero_stable else 0.0,
        imaginary_limit=regions.imaginary_limit(method) if phi.zero_stable else 0.0,
        A_stable=alpha == 90,
        alpha=alpha,
        stiff_D=regions.stiff_stability(method) if phi.zero_stable else math.inf,
        R_inf=R_inf,
        L_stable=alpha == 90 and R_inf < VANISHES,
        zero_stable=phi.zero_stable,
    )


def _method(solver: Method) -> tuple[StabilityFunction | Characteristic, Characteristic]:
    """The stability function if there is one, else the polynomial; and the polynomial."""
    phi = characteristic(solver)
    if isinstance(solver, Characteristic):
        return phi, phi
    try:
        return stability_function(solver), phi
    except InputError:
        return phi, phi
