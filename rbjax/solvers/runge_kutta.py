"""Runge-Kutta methods that diffrax lacks: classical RK4, fully implicit methods, Alexander's SDIRK.

    k_i = h f(t0 + c_i h, y0 + sum_j a_ij k_j),    y1 = y0 + sum_i b_i k_i
The Newton matrix of the stage equations is 1 - h (a_ij J_i), with Jacobians J_i of the field. The
chord iteration uses 1 - h A (x) J with one J at the start of the step, which needs n columns of
derivatives per step instead of s n. The error estimate is the difference from the quadrature that
also uses f(t0, y0), multiplied by (1 - h gamma J)^-1, so that it does not grow with the stiffness.
The dense output is the collocation polynomial. A step of BDF or Adams-Moulton has one such stage.

Source: Hairer & Wanner, *Solving Ordinary Differential Equations II*, IV.5 and IV.8.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from rbjax.arguments import integer
from rbjax.lanes import batch_first, matvec
from rbjax.solvers import tableau as tables
from rbjax.solvers.field import SolverField, evaluate_stages, flatten, linearize
from rbjax.solvers.root_finding import (
    MAX_STEPS,
    chord,
    linear_solver,
    mark_failed,
    matrix_free,
    root,
    step_result,
    very_chord,
)
from rbjax.solvers.steps import (
    AbstractPolynomialSolver,
    Polynomial,
    hermite_coefficients,
    weighted_sums,
)
from rbjax.solvers.tableau import RK4 as TABLE
from rbjax.solvers.tableau import Tableau


class RK4(diffrax.AbstractERK):
    """The classical Runge-Kutta method of order 4. Its error estimate of order 3 uses the rate at
    y1."""

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=tuple(np.array(row[:i]) for i, row in enumerate(TABLE.a) if i),
        b_sol=np.array(TABLE.b),
        b_error=np.array(TABLE.error[1:]),
        c=np.array(TABLE.c[1:]),
    )
    interpolation_cls: ClassVar[Callable[..., diffrax.ThirdOrderHermitePolynomialInterpolation]] = (
        diffrax.ThirdOrderHermitePolynomialInterpolation.from_k
    )

    def order(self, terms):
        return 4


class Start(NamedTuple):
    """Time, state, rate and Jacobian at the start of a step. The Jacobian is None if
    matrix-free."""

    t: Any
    y: jax.Array  # (n,)
    rate: jax.Array  # (n,)
    jacobian: jax.Array | None  # (n, n), held constant by derivatives of the step


def start(f: SolverField, t: Any, y: jax.Array, finder: Any) -> Start:
    """Evaluate the rate and, unless the root finder is matrix-free, the Jacobian at (t, y)."""
    return Start(t, y, *((f(t, y), None) if matrix_free(finder) else _rate_and_jacobian(f, t, y)))


@eqx.filter_custom_jvp
def _rate_and_jacobian(f: SolverField, t: Any, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    return batch_first(linearize(f, t, y))


@_rate_and_jacobian.def_jvp
def _(primals: Any, tangents: Any) -> Any:
    """Derivative rule of rate and Jacobian: the rate is differentiated, the Jacobian is constant. A
    root does not depend on the Jacobian of its Newton iteration."""
    rate, jacobian = _rate_and_jacobian(*primals)
    _, moving = eqx.filter_jvp(lambda f, t, y: f(t, y), primals, tangents)
    return (rate, jacobian), batch_first((moving, jnp.zeros_like(jacobian)))


class StageResidual(eqx.Module):
    """Residual of implicit stage equations, as a function of the increments k (s, n)."""

    f: SolverField
    h: Any
    t: jax.Array  # (s,)
    y: jax.Array  # (n,) or (s, n)
    a: jax.Array  # (s, s)
    matrix_free: bool = eqx.field(static=True)

    def __call__(self, k: jax.Array) -> jax.Array:
        at = self.y + weighted_sums(self.a, k)
        rates = jax.vmap(self.f) if self.matrix_free else partial(evaluate_stages, self.f)
        return k - self.h * rates(self.t, at)


class Chord(eqx.Module):
    """The linear map k - h (A (x) J) k, whose derivative a chord iteration uses."""

    h: Any
    a: jax.Array
    jacobian: jax.Array

    def __call__(self, k: jax.Array, args: Any) -> tuple[jax.Array, None]:
        return k - self.h * matvec(self.jacobian, weighted_sums(self.a, k)), None


def solve(
    f: SolverField, h: Any, t: jax.Array, y: jax.Array, a: jax.Array, start: Start,
    guess: jax.Array, finder: Any, max_steps: int,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """Solve the stage equations. Return the increments (s, n) and whether the solution
    succeeded."""
    residual = StageResidual(f, h, t, y, a, matrix_free(finder))
    near = None if start.jacobian is None else Chord(h, a, start.jacobian)
    return root(residual, finder, guess, start.y, max_steps, near)


def damped(f: SolverField, gamma_h: Any, start: Start, raw: jax.Array, finder: Any) -> jax.Array:
    """Return (1 - gamma h J)^-1 raw: an error estimate without its stiff components."""
    if start.jacobian is None:
        _, push = jax.linearize(lambda y: f(start.t, y), start.y)
        operator: Any = lx.FunctionLinearOperator(
            lambda x: x - gamma_h * push(x), jax.eval_shape(lambda: raw)
        )
    else:
        one = jnp.eye(raw.size, dtype=raw.dtype)
        operator = lx.MatrixLinearOperator(one - gamma_h * start.jacobian)
    return lx.linear_solve(operator, raw, linear_solver(finder), throw=False).value


MOST_STAGES = 9  # with more stages, rounding spoils the coefficients computed from the nodes


class ImplicitRungeKutta(AbstractPolynomialSolver, diffrax.AbstractAdaptiveSolver):
    """A fully implicit Runge-Kutta method. Its stage equations are solved to rounding.

    Fields:
        tableau: coefficients of the method. Steps are constant if it has no error weights.
        root_finder: an optimistix root finder, e.g. `rb.solvers.newton(linear_solver)` or
            `chord()`.
        root_find_max_steps: largest number of iterations.
    """

    tableau: Tableau = eqx.field(static=True)
    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    def order(self, terms):
        return self.tableau.order

    def error_order(self, terms):
        return self.tableau.error_order

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        f, y = flatten(terms, args, t0, y0)
        h, here = t1 - t0, start(f, t0, y, self.root_finder)
        u, k, ok = self.solve(f, h, here)
        error = None
        if self.tableau.error:
            error = f.unravel(mark_failed(ok, self.estimate(f, h, here, k)))
        if self.tableau.dense:
            coefficients = self.polynomial(k)
        else:
            coefficients = hermite_coefficients(u, h * here.rate, h * f(t1, y + u))
        dense = {"y0": y0, "coefficients": jax.vmap(f.unravel)(coefficients)}
        return f.unravel(y + u), error, dense, solver_state, step_result(ok)

    def solve(self, f: SolverField, h: Any, here: Start) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return y1 - y0 (n,), the stages (s, n), and whether the solution succeeded."""
        a, c, b = (jnp.asarray(x, here.y.dtype) for x in
                   (self.tableau.a, self.tableau.c, self.tableau.b))  # fmt: skip
        # zero initial guess: the first correction is a linearly implicit step
        guess = jnp.zeros((self.tableau.stages, here.y.size), here.y.dtype)
        k, ok = solve(
            f, h, here.t + c.astype(jnp.result_type(h)) * h, here.y, a, here, guess,
            self.root_finder, self.root_find_max_steps,
        )  # fmt: skip
        return weighted_sums(b, k), k, ok

    def estimate(self, f: SolverField, h: Any, here: Start, k: jax.Array) -> jax.Array:
        """Estimate the error (n,) of y1."""
        at_start, *others = self.tableau.error
        raw = weighted_sums(others, k) + at_start * h * here.rate
        return damped(f, self.tableau.filter * h, here, raw, self.root_finder)

    def polynomial(self, k: jax.Array) -> jax.Array:
        """Return the coefficients of theta, theta^2, ... of the dense output sum_i b_i(theta)
        k_i."""
        return weighted_sums(tuple(zip(*self.tableau.dense, strict=True)), k)


def implicit_midpoint(**options: Any) -> ImplicitRungeKutta:
    """Return the implicit midpoint rule y1 = y0 + h f((y0 + y1) / 2). It has order 2 and is
    A-stable, symplectic and symmetric.

    Args:
        options: fields of `ImplicitRungeKutta`, such as `root_finder`.

    See `gauss_legendre` for an example.
    """
    return ImplicitRungeKutta(tables.gauss(1), **options)


def trapezoid(**options: Any) -> ImplicitRungeKutta:
    """Return the trapezoidal rule (Crank-Nicolson): order 2, A-stable, symmetric.

    Args:
        options: fields of `ImplicitRungeKutta`, such as `root_finder`.

    See `gauss_legendre` for an example.
    """
    return ImplicitRungeKutta(tables.lobatto_iiia(2), **options)


def gauss_legendre(stages: int = 2, **options: Any) -> ImplicitRungeKutta:
    """Return the Gauss-Legendre method of s stages: order 2 s, A-stable, symplectic.

    Args:
        stages: number of stages.
        options: fields of `ImplicitRungeKutta`, such as `root_finder`.

    Raises:
        InputError: a number of stages that is not available.

    Example:
        >>> import rbjax as rb
        >>> rb.solvers.gauss_legendre(3).order(None)
        6
    """
    integer("gauss_legendre", "stages", stages, least=1, most=MOST_STAGES)
    return ImplicitRungeKutta(tables.gauss(stages), **options)


def radau_iia(stages: int = 3, **options: Any) -> ImplicitRungeKutta:
    """Return the Radau IIA method of s stages: order 2 s - 1, L-stable. One stage is backward
    Euler.

    Args:
        stages: number of stages.
        options: fields of `ImplicitRungeKutta`, such as `root_finder`.

    Raises:
        InputError: a number of stages that is not available.

    See `gauss_legendre` for an example.
    """
    integer("radau_iia", "stages", stages, least=1, most=MOST_STAGES)
    return ImplicitRungeKutta(tables.radau_iia(stages), **options)


def lobatto_iiia(stages: int = 3, **options: Any) -> ImplicitRungeKutta:
    """Return the Lobatto IIIA method of s stages: order 2 s - 2, A-stable, symmetric.

    Args:
        stages: number of stages.
        options: fields of `ImplicitRungeKutta`, such as `root_finder`.

    Raises:
        InputError: a number of stages that is not available.

    See `gauss_legendre` for an example.
    """
    integer("lobatto_iiia", "stages", stages, least=2, most=MOST_STAGES)
    return ImplicitRungeKutta(tables.lobatto_iiia(stages), **options)


def lobatto_iiic(stages: int = 3, **options: Any) -> ImplicitRungeKutta:
    """Return the Lobatto IIIC method of s stages: order 2 s - 2, L-stable.

    Args:
        stages: number of stages.
        options: fields of `ImplicitRungeKutta`, such as `root_finder`.

    Raises:
        InputError: a number of stages that is not available.

    See `gauss_legendre` for an example.
    """
    integer("lobatto_iiic", "stages", stages, least=2, most=MOST_STAGES)
    return ImplicitRungeKutta(tables.lobatto_iiic(stages), **options)


G = 1 - 0.5**0.5
#: coefficients of theta, theta^2 in the integrals of (1 - theta) / (1 - G), (theta - G) / (1 - G)
DENSE = ((1 / (1 - G), -G / (1 - G)), (-0.5 / (1 - G), 0.5 / (1 - G)))


def _collocation(*, t0: Any, t1: Any, y0: Any, y1: Any, k: Any) -> Polynomial:
    del y1
    return Polynomial(t0, t1, y0, weighted_sums(DENSE, k))


class SDIRK2(diffrax.AbstractSDIRK):
    """Alexander's diagonally implicit method of two stages: order 2, L-stable, stiffly accurate.

        gamma = 1 - 1 / sqrt 2,    c = (gamma, 1),    a_21 = b_1 = 1 - gamma,    b_2 = gamma

    The embedded method has order 1. For order 3, 4 and 5 use Kvaerno's methods of diffrax.

    Fields:
        root_finder: of optimistix, for the implicit stages.
        root_find_max_steps: largest number of its iterations.

    Source: Alexander, *SIAM Journal on Numerical Analysis* 14, 1977.
    """

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=(np.array([1 - G]),),
        a_predictor=(np.array([1.0]),),
        a_diagonal=np.array([G, G]),
        b_sol=np.array([1 - G, G]),
        b_error=np.array([-G, G]),
        c=np.array([1.0]),
        c1=G,
    )
    interpolation_cls: ClassVar[Callable[..., Polynomial]] = staticmethod(_collocation)
    root_finder: optx.AbstractRootFinder = very_chord()  # type: ignore[misc]
    root_find_max_steps: int = MAX_STEPS  # type: ignore[misc]

    def order(self, terms):
        return 2
