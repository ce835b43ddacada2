"""The linear theory of a method in one report, and its order by conditions and by measurement.

    error(h) ~ C h^p,    p = log2(error(h) / error(h / 2))
Methods for vector fields and for pairs q' = v, v' = a are measured on a driven damped pendulum,
Lie-group methods on a rigid body under a torque. The reference is SciPy's Dormand-Prince 8.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from rbjax import solvers
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.solvers import tableau as tables
from rbjax.solvers.rosenbrock import RosenbrockW, holds
from rbjax.stability.methods import Solver, fixed_step_solver, solver_of
from rbjax.stability.theory import regions
from rbjax.stability.theory.multistep_roots import Characteristic, Method, Theory, characteristic
from rbjax.stability.theory.stability_function import StabilityFunction, butcher, stability_function

VANISHES = 1e-9  # rounding of R(infinity) for coefficients of about twelve digits
HIGHEST = 8  # largest order checked by conditions: 115 trees with eight nodes


@displayed
@dataclass(frozen=True)
class LinearAnalysis:
    """The linear theory of a method on y' = lambda y with z = h lambda.

    Fields:
        method: `StabilityFunction` or `Characteristic`.
        order: by the order conditions; below 1 if not consistent. Above 8 it is the order that
            Butcher's simplifying assumptions prove.
        linear_order: order p on y' = lambda y.
        error_constant: C of y(t + h) - y1 = C h^(p + 1) y^(p + 1) on y' = lambda y.
        real_limit, imaginary_limit: stability limits on the axes, at most and at least zero.
        A_stable, L_stable, zero_stable: bool.
        alpha: angle of A(alpha)-stability in degrees; 90 if A-stable, 0 without a sector.
        stiff_D: the method is stable for Re z <= -D; inf if there is no such D.
        R_inf: |R(infinity)|, or the largest root at infinity of a multistep method.
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
    """Return the order by the order conditions: rooted trees (one-step) or phi (multistep).

    Trees are checked up to 8 nodes. Above, the result is the order, at least 8, that Butcher's
    simplifying assumptions B(p), C(eta), D(zeta) prove. A `StabilityFunction` has only an order on
    linear problems. The argument is as in `linear_analysis`.

    Args:
        solver: a name of `rb.solvers.all()`, a solver, a tableau, or a result of
            `stability_function` or `characteristic`.

    Returns:
        The order.

    Example:
        >>> import rbjax as rb
        >>> rb.stability.order_by_conditions("rk4"), rb.stability.order_by_conditions("bdf3")
        (4, 3)
    """
    if isinstance(solver, Theory):
        return characteristic(solver).order
    solver = solver_of(solver)
    table = butcher(solver)
    if table is None:
        return _method(solver)[1].order
    a, b = table
    if not isinstance(solver, RosenbrockW):
        found = tables.attained_order(a, b, HIGHEST)
        return found if found < HIGHEST else max(found, tables.proven_order(a, b))
    # order conditions of W-methods, for any Jacobian
    alpha, gamma = np.array(solver.tableau.alpha), np.array(solver.tableau.gamma)
    return next(p for p in range(HIGHEST) if not holds(alpha, gamma, b, p + 1))


def linear_analysis(solver: Method) -> LinearAnalysis:
    """Analyse a method on y' = lambda y: order, error constant, stability limits, A-, L-stability.

    Args:
        solver: a name of `rb.solvers.all()`; a Runge-Kutta, Rosenbrock or multistep solver of rbjax
            or diffrax; or a user-defined method: an `rb.solvers.Tableau`, a `StabilityFunction`, or
            a `Characteristic` (`multistep`, `adams`, ...).

    Returns:
        `LinearAnalysis`.

    Raises:
        InputError: a method only for q' = v, v' = a (`spectral_radius` measures it), or an object
            that is not a method.

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
    """Return the stability function R(z) and the characteristic polynomial phi of a method.

    A multistep method has no R(z); phi is then returned twice.
    """
    phi = characteristic(solver)
    if isinstance(solver, Characteristic):
        return phi, phi
    try:
        return stability_function(solver), phi
    except InputError:
        return phi, phi


# -------------------------------------------------------------------- the order, measured

END = 2.0
INERTIA = np.array([1.0, 2.0, 3.5])
COARSEST, FINEST = 8, 8192
SMALL, LARGE = 1e-11, 1e-2  # limits of errors: below, rounding matters; above, higher powers of h
ON_GROUPS = (
    solvers.MuntheKaas,
    solvers.CrouchGrossman3,
    solvers.CommutatorFree4,
    solvers.RigidBodySplitting,
)


@displayed
@dataclass(frozen=True)
class MeasuredOrder:
    """A measured order of convergence.

    Fields:
        order: mean over the two finest halvings of the step.
        steps: number of steps of each run.
        errors: error of each run.
    """

    order: float
    steps: tuple[int, ...]
    errors: tuple[float, ...]


def _pendulum(t: Any, y: Any, args: Any) -> Any:
    q, v = y
    return v, -2.0 * jnp.sin(q) + 0.5 * jnp.cos(t) - 0.3 * v


def _plain_pendulum(t: float, y: np.ndarray) -> np.ndarray:
    return np.array(_pendulum(t, y, None))


def _torque(t: Any, turn: Any, args: Any) -> Any:
    return 0.5 * jnp.sin(t) * jnp.array([1.0, 0.0, 0.5])


def _plain_body(t: float, y: np.ndarray) -> np.ndarray:
    w, x, y_, z = y[:4]
    a, b, c = rate = y[4:]
    turn = [-x * a - y_ * b - z * c, w * a + y_ * c - z * b, w * b + z * a - x * c,
            w * c + x * b - y_ * a]  # fmt: skip
    torque = 0.5 * np.sin(t) * np.array([1.0, 0.0, 0.5])
    return np.concatenate(
        [0.5 * np.array(turn), (np.cross(INERTIA * rate, rate) + torque) / INERTIA]
    )


@functools.cache
def _problem(on_group: bool) -> tuple[Any, Any, np.ndarray]:
    """Return term, initial state and final state of the smooth problem of `measured_order`.

    It is a rigid body if `on_group`, else a driven pendulum.
    """
    if on_group:
        start = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, 1.0, -0.7])
        term, plain = solvers.RigidBody(INERTIA, _torque), _plain_body
    else:
        start = np.array([1.0]), np.array([0.3])
        term, plain = diffrax.ODETerm(_pendulum), _plain_pendulum  # type: ignore[assignment]
    found = solve_ivp(
        plain, (0.0, END), np.concatenate(start), method="DOP853", rtol=3e-14, atol=1e-14
    )
    return term, start, found.y[:, -1]


@eqx.filter_jit
def _end(term: Any, solver: Any, start: Any, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the state after `steps` equal steps, and whether all steps succeeded."""
    found = diffrax.diffeqsolve(
        term, solver, 0.0, END, END / steps * (1 + 1e-12), start, throw=False, max_steps=None,
        stepsize_controller=diffrax.ConstantStepSize(), adjoint=diffrax.ForwardMode(),
    )  # fmt: skip
    last = jnp.concatenate([x[-1] for x in jax.tree.leaves(found.ys)])
    return last, found.result == diffrax.RESULTS.successful


def measured_order(solver: Solver) -> MeasuredOrder:
    """Measure the order of a solver on a smooth problem, over halvings of the step.

    Args:
        solver: a name of `rb.solvers.all()`; a diffrax solver of vector fields, of q' = v, v' = a,
            or on Lie groups; or an `rb.solvers.Tableau`. A root finder with a controller's
            tolerances is replaced by `rb.solvers.very_chord()`.

    Returns:
        `MeasuredOrder`: the order, with the steps and errors of all runs.

    Raises:
        UnknownName: an unknown name.
        InputError: a method without code, or fewer than two halvings with errors that are neither
            rounding nor too large.

    Source: Hairer, Norsett & Wanner, *Solving ODEs I*, II.4.

    Example:
        >>> import rbjax as rb
        >>> round(rb.stability.measured_order("rk4").order, 1)
        4.0
    """
    own = isinstance(solver, solvers.Tableau)  # a tableau is measured on a vector field
    solver = fixed_step_solver(solver)
    steps: list[int] = []
    errors: list[float] = []
    n = COARSEST
    with jax.enable_x64(True):
        term, start, truth = _problem(not own and isinstance(solver, ON_GROUPS))
        while n <= FINEST and (not errors or not errors[-1] < SMALL):
            y, ok = _end(term, solver, start, jnp.array(float(n)))
            steps.append(n)
            errors.append(float(np.abs(np.asarray(y) - truth).max()) if ok else np.inf)
            n *= 2
    good = [e for e in errors if SMALL / 100 < e < LARGE]
    if len(good) < 3:
        raise InputError(
            f"measured_order: {type(solver).__name__} has errors {errors} after {steps} steps, "
            f"expected three between {SMALL / 100:.0e} and {LARGE:.0e}"
        )
    rates = np.log2(np.divide(good[:-1], good[1:]))
    return MeasuredOrder(float(rates[-2:].mean()), tuple(steps), tuple(errors))
