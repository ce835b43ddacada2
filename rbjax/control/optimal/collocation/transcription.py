"""A motion as polynomials: the equations of collocation at the stages of each step.

    K_i = f(t_i, x (+) xi_i, u_i),   xi_i = h sum_j a_ij K_j,   x+ = x (+) h sum_i b_i K_i
    cost = sum of h b_i L(t_i, x (+) xi_i, u_i) + Phi(x_N)

a, b and c are a collocation tableau (`rbjax.solvers.tableau`): Gauss-Legendre has order 2 s,
Radau IIA 2 s - 1, Lobatto IIIA 2 s - 2; with three stages the last is Hermite and Simpson's rule in
its separated form. Each stage has its own controls, which may jump at knots.
The increments xi are in the tangent coordinates about the knot, where attitudes are a vector
space. With positive b the costates obey a Runge-Kutta method too, so that optimal states converge
with the order of the tableau (Hager 2000, *Runge-Kutta methods in optimal control*; Betts,
*Practical Methods for Optimal Control*, ch. 4).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.optimal.objective import knot_cost
from rbjax.control.optimal.problem import BODY, NEXT, Knot, Problem
from rbjax.solvers.tableau import Tableau


class Inner(NamedTuple):
    """The unknowns within a step: us (s, m), and rates K (s, n) of the system's increments."""

    us: jax.Array
    rates: jax.Array


class Stages(NamedTuple):
    """The values of a step: miss (s, n), rates minus f; the knot after; its cost (); and the rows
    (s, c) of the constraints."""

    miss: jax.Array
    after: Knot
    cost: jax.Array
    rows: jax.Array


def constants(table: Tableau, dtype: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """a (s, s), b (s,) and c (s,)."""
    a, b, c = (jnp.asarray(x, dtype) for x in (table.a, table.b, table.c))
    return a, b, c


def combined(weights: jax.Array, rates: jax.Array) -> jax.Array:
    """sum_j w_ij K_j, or sum_j w_j K_j."""
    return (weights[..., None] * rates).sum(-2)


def at_stage(
    problem: Problem, where: Any, knot: Knot, xi: jax.Array, ctrl: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """f (n,), the running cost () and the rows (c,) at knot (+) xi. where: k + c_i."""
    system, dt = problem.at(knot.parameters)
    rates = system.rates(problem.time(where, dt), knot.state, xi, ctrl)
    point = Knot(system.plus(knot.state, xi), knot.parameters)
    cost = knot_cost(problem, "path", where, point, ctrl)
    return rates, cost, problem.rows(where, point, ctrl, "path")


def after_step(problem: Problem, table: Tableau, knot: Knot, rates: jax.Array) -> Knot:
    """x (+) h sum_i b_i K_i."""
    system, dt = problem.at(knot.parameters)
    _, b, _ = constants(table, rates.dtype)
    return Knot(system.plus(knot.state, dt * combined(b, rates)), knot.parameters)


def stages(problem: Problem, table: Tableau, k: Any, knot: Knot, inner: Inner) -> Stages:
    """The step k."""
    a, b, c = constants(table, inner.rates.dtype)
    _, dt = problem.at(knot.parameters)
    xi = dt * combined(a, inner.rates)
    rates, costs, rows = jax.vmap(lambda *x: at_stage(problem, x[0], knot, *x[1:]))(
        k + c, xi, inner.us
    )
    after = after_step(problem, table, knot, inner.rates)
    return Stages(inner.rates - rates, after, (b * costs).sum(), rows)


def stage_states(problem: Problem, table: Tableau, knot: Knot, inner: Inner) -> Any:
    """The states of the stages of a step."""
    a, _, _ = constants(table, inner.rates.dtype)
    system, dt = problem.at(knot.parameters)
    return jax.vmap(lambda xi: system.plus(knot.state, xi))(dt * combined(a, inner.rates))


def at_end(problem: Problem, knot: Knot) -> tuple[jax.Array, jax.Array]:
    """The terminal cost () and the rows (e,) at the end."""
    N, none = problem.horizon, jnp.zeros(problem.nu, problem.dt.dtype)
    return knot_cost(problem, "end", N, knot, none), problem.rows(N, knot, none, "end")


def chords(problem: Problem, table: Tableau, knots: Knot, ctrls: jax.Array) -> Inner:
    """A first guess between knots: the controls held, the states on chords."""
    s = len(table.b)

    def one(knot: Knot, following: Knot, ctrl: jax.Array) -> Inner:
        system, dt = problem.at(knot.parameters)
        slope = system.minus(following.state, knot.state) / dt
        return Inner(*(jnp.broadcast_to(x, (s, *x.shape)) for x in (ctrl, slope)))

    body, following = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, NEXT))
    return jax.vmap(one)(body, following, ctrls)
