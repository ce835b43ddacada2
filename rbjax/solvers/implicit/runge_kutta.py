"""Fully implicit Runge-Kutta methods: all stages in one system.

    k_i = h f(t0 + c_i h, y0 + sum_j a_ij k_j),    y1 = y0 + sum_i b_i k_i
Error: the difference from the quadrature that also uses f(t0, y0), damped by (I - h gamma df/dy)^-1
so that it does not grow with the stiffness. Dense output: the collocation polynomial
(Hairer & Wanner, *Solving Ordinary Differential Equations II*, IV.5 and IV.8).
"""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from rbjax.arguments import integer
from rbjax.solvers.common import tableau as tables
from rbjax.solvers.common.field import Field, flattened
from rbjax.solvers.common.newton import MAX_STEPS, chord, refused, verdict
from rbjax.solvers.common.stages import Start, damped, solve, start
from rbjax.solvers.common.steps import AbstractPolynomialSolver, hermite, mixed
from rbjax.solvers.common.tableau import Tableau

MOST_STAGES = 9  # with more, rounding spoils the coefficients computed from the nodes


class ImplicitRungeKutta(AbstractPolynomialSolver, diffrax.AbstractAdaptiveSolver):
    """The method of a tableau. A tableau without error weights takes constant steps.

    Fields: tableau; root_finder, any of optimistix (`rb.solvers.newton()`, `chord()`, which take a
    linear solver of lineax); root_find_max_steps.

    It is not a `diffrax.AbstractImplicitSolver`: that class takes its tolerances from the step size
    controller, and `diffrax.HalfSolver` cannot wrap it. Roots here are exact to rounding.
    """

    tableau: Tableau = eqx.field(static=True)
    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    def order(self, terms):
        return self.tableau.order

    def error_order(self, terms):
        return self.tableau.error_order

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        f, y = flattened(terms, args, t0, y0)
        h, here = t1 - t0, start(f, t0, y, self.root_finder)
        u, k, ok = self.solve(f, h, here)
        error = None
        if self.tableau.error:
            error = f.unravel(refused(ok, self.estimate(f, h, here, k)))
        if self.tableau.dense:
            coefficients = self.polynomial(k)
        else:
            coefficients = hermite(u, h * here.rate, h * f(t1, y + u))
        dense = {"y0": y0, "coefficients": jax.vmap(f.unravel)(coefficients)}
        return f.unravel(y + u), error, dense, solver_state, verdict(ok)

    def solve(self, f: Field, h: Any, here: Start) -> tuple[jax.Array, jax.Array, jax.Array]:
        """y1 - y0 (n,), the stages (s, n), and whether they were found."""
        a, c, b = (jnp.asarray(x, here.y.dtype) for x in
                   (self.tableau.a, self.tableau.c, self.tableau.b))  # fmt: skip
        # With the guess zero, the first correction is a linearly implicit step, however stiff.
        guess = jnp.zeros((self.tableau.stages, here.y.size), here.y.dtype)
        k, ok = solve(
            f, h, here.t + c.astype(jnp.result_type(h)) * h, here.y, a, here, guess,
            self.root_finder, self.root_find_max_steps,
        )  # fmt: skip
        return mixed(b, k), k, ok

    def estimate(self, f: Field, h: Any, here: Start, k: jax.Array) -> jax.Array:
        """The damped estimate of the error of y1."""
        at_start, *others = self.tableau.error
        raw = mixed(others, k) + at_start * h * here.rate
        return damped(f, self.tableau.filter * h, here, raw, self.root_finder)

    def polynomial(self, k: jax.Array) -> jax.Array:
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
    integer("gauss_legendre", "stages", stages, least=1, most=MOST_STAGES)
    return ImplicitRungeKutta(tables.gauss(stages), **options)


def radau_iia(stages: int = 3, **options) -> ImplicitRungeKutta:
    """Radau IIA: order 2 s - 1, L-stable, for stiff equations; one stage is backward Euler."""
    integer("radau_iia", "stages", stages, least=1, most=MOST_STAGES)
    return ImplicitRungeKutta(tables.radau_iia(stages), **options)


def lobatto_iiia(stages: int = 3, **options) -> ImplicitRungeKutta:
    """Lobatto IIIA: order 2 s - 2, A-stable, symmetric."""
    integer("lobatto_iiia", "stages", stages, least=2, most=MOST_STAGES)
    return ImplicitRungeKutta(tables.lobatto_iiia(stages), **options)


def lobatto_iiic(stages: int = 3, **options) -> ImplicitRungeKutta:
    """Lobatto IIIC: order 2 s - 2, L-stable."""
    integer("lobatto_iiic", "stages", stages, least=2, most=MOST_STAGES)
    return ImplicitRungeKutta(tables.lobatto_iiic(stages), **options)
