"""Fully implicit Runge-Kutta methods: all stages in one system.

    k_i = h f(t0 + c_i h, y0 + sum_j a_ij k_j),    y1 = y0 + sum_i b_i k_i
Error: the difference to the quadrature that also uses f(t0, y0), damped by (I - h gamma df/dy)^-1
so that it does not grow with the stiffness. Dense output: the collocation polynomial
(Hairer & Wanner, *Solving Ordinary Differential Equations II*, IV.5 and IV.8).
"""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx

from rbjax.solvers import tableau as tables
from rbjax.solvers.newton import MAX_STEPS, chord, refused, root, verdict
from rbjax.solvers.steps import AbstractPolynomialSolver, Field, combine, field, mixed, scaled
from rbjax.solvers.tableau import Tableau


class ImplicitRungeKutta(AbstractPolynomialSolver, diffrax.AbstractAdaptiveSolver):
    """The method of a tableau.

    Fields: tableau; root_finder, any of optimistix (`rb.solvers.newton()`, `chord()`, which take a
    linear solver of lineax); root_find_max_steps.

    It is not diffrax' `AbstractImplicitSolver`, which stands for tolerances taken from the step
    size controller and which `diffrax.HalfSolver` cannot wrap: roots here are exact to rounding.
    """

    tableau: Tableau = eqx.field(static=True)
    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    def order(self, terms):
        return self.tableau.order

    def error_order(self, terms):
        return self.tableau.error_order

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        f, h = field(terms, args), t1 - t0
        first = scaled(h, f(t0, y0))
        y1, k, ok = self.solve(f, t0, h, y0, first)
        error = refused(ok, self.estimate(f, t0, h, y0, first, k))
        dense = {"y0": y0, "coefficients": self.polynomial(k)}
        return y1, error, dense, solver_state, verdict(ok)

    def solve(self, f: Field, t0: Any, h: Any, y0: Any, first: Any) -> tuple[Any, Any, jax.Array]:
        """y1, the stages (s, ...), and whether they were found; `first` is h f(t0, y0)."""
        s = self.tableau.stages
        ts = t0 + jnp.asarray(self.tableau.c, jnp.result_type(h)) * h

        def residual(k):
            at = jax.tree.map(lambda y, dy: y + dy, y0, mixed(self.tableau.a, k))
            rates = jax.vmap(f)(ts, at)
            return jax.tree.map(lambda k, rate: k - h * rate, k, rates)

        guess = jax.tree.map(lambda x: jnp.broadcast_to(x, (s, *x.shape)), first)
        k, ok = root(residual, self.root_finder, guess, y0, self.root_find_max_steps)
        return jax.tree.map(lambda y, dy: y + dy, y0, mixed(self.tableau.b, k)), k, ok

    def estimate(self, f: Field, t0: Any, h: Any, y0: Any, first: Any, k: Any) -> Any:
        """The damped estimate of the error of y1."""
        at_start, *others = self.tableau.error
        raw = combine((1.0, at_start), (mixed(others, k), first))
        gamma = self.tableau.filter * h

        def damped(y, _):
            return jax.tree.map(lambda y, rate: y - gamma * rate, y, f(t0, y))

        return lx.linear_solve(
            lx.JacobianLinearOperator(damped, y0),
            raw,
            getattr(getattr(self.root_finder, "inner", None), "linear_solver", lx.LU()),
            throw=False,
        ).value

    def polynomial(self, k: Any) -> Any:
        """Coefficients of theta, theta^2, ... of sum_i b_i(theta) k_i."""
        return mixed(tuple(zip(*self.tableau.dense, strict=True)), k)


def implicit_midpoint(**options) -> ImplicitRungeKutta:
    """y1 = y0 + h f((y0 + y1) / 2): order 2, A-stable, symplectic, symmetric."""
    return ImplicitRungeKutta(tables.gauss(1), **options)


def trapezoid(**options) -> ImplicitRungeKutta:
    """The trapezoidal rule, Crank-Nicolson: order 2, A-stable, symmetric."""
    return ImplicitRungeKutta(tables.lobatto_iiia(2), **options)


def gauss_legendre(stages: int = 2, **options) -> ImplicitRungeKutta:
    """Gauss-Legendre: order 2 s, A-stable, symplectic."""
    return ImplicitRungeKutta(tables.gauss(stages), **options)


def radau_iia(stages: int = 3, **options) -> ImplicitRungeKutta:
    """Radau IIA: order 2 s - 1, L-stable, for stiff equations; one stage is backward Euler."""
    return ImplicitRungeKutta(tables.radau_iia(stages), **options)


def lobatto_iiia(stages: int = 3, **options) -> ImplicitRungeKutta:
    """Lobatto IIIA: order 2 s - 2, A-stable, symmetric."""
    return ImplicitRungeKutta(tables.lobatto_iiia(stages), **options)


def lobatto_iiic(stages: int = 3, **options) -> ImplicitRungeKutta:
    """Lobatto IIIC: order 2 s - 2, L-stable."""
    return ImplicitRungeKutta(tables.lobatto_iiic(stages), **options)
