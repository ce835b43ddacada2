"""The equations of a collocation step, and the elimination of its stages.

    K_i = f(t_i, x (+) xi_i, u_i),   xi_i = h sum_j a_ij K_j,   x+ = x (+) h sum_i b_i K_i
    cost = sum of h b_i L(t_i, x (+) xi_i, u_i) + Phi(x_N)

a, b and c are a tableau (`rbjax.solvers.tableau`): Gauss-Legendre has order 2 s, Radau IIA 2 s - 1,
Lobatto IIIA 2 s - 2. Each stage has its own controls. The stages are eliminated:

    E dK = -miss - e_x dx - e_u du       gives   dK = Z (dx, du) + offset
    dx+ = A dx + B du + gap,      Z' H Z the Hessian of the Lagrangian in (dx, du)

The multipliers of the stages follow from E' lambda = -(cost + y.rows + p.x+)_K. Inequality
constraints enter by their slacks and multipliers (`row_terms`), equations by the method of
multipliers. Source: Hager, *Runge-Kutta methods in optimal control*, 2000; Betts, *Practical
Methods for Optimal Control*, ch. 4.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.optimal.collocation import barrier
from rbjax.control.optimal.collocation.barrier import BoundedVariable, Duals
from rbjax.control.optimal.objective import knot_cost
from rbjax.control.optimal.problem import BODY, NEXT, Knot, Problem, take
from rbjax.control.optimal.shooting.expansion import Quadratic
from rbjax.lanes.arrays import matmat, matvec
from rbjax.solvers.tableau import Tableau


class Inner(NamedTuple):
    """The unknowns within a step.

    us: controls of the stages, (s, m).
    K: rates of the state at the stages, (s, n).
    """

    us: jax.Array
    rates: jax.Array


class StepStages(NamedTuple):
    """The values of a step.

    miss: rates minus f, (s, n).
    after: the knot after the step.
    cost: ().
    rows: constraint rows at the stages, (s, c).
    """

    miss: jax.Array
    after: Knot
    cost: jax.Array
    rows: jax.Array


def tableau_arrays(table: Tableau, dtype: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the tableau as arrays a (s, s), b (s,) and c (s,)."""
    a, b, c = (jnp.asarray(x, dtype) for x in (table.a, table.b, table.c))
    return a, b, c


def combine(weights: jax.Array, rates: jax.Array) -> jax.Array:
    """Return the weighted sums sum_j w_ij K_j of the rates K_j, for weights (s, s) or (s,)."""
    return (weights[..., None] * rates).sum(-2)


def at_stage(
    problem: Problem, where: Any, knot: Knot, xi: jax.Array, ctrl: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the state rate f (n,), running cost () and constraint rows (c,) at the state knot (+)
    xi. where: k + c_i, the fractional index of the stage.
    """
    system, dt = problem.at(knot.parameters)
    rates = system.rates(problem.time(where, dt), knot.state, xi, ctrl)
    point = Knot(system.plus(knot.state, xi), knot.parameters)
    cost = knot_cost(problem, "path", where, point, ctrl)
    return rates, cost, problem.rows("path", where, point, ctrl)


def after_step(problem: Problem, table: Tableau, knot: Knot, rates: jax.Array) -> Knot:
    """Return the knot after a step: x (+) h sum_i b_i K_i, from the rates K_i of the stages."""
    system, dt = problem.at(knot.parameters)
    _, b, _ = tableau_arrays(table, rates.dtype)
    return Knot(system.plus(knot.state, dt * combine(b, rates)), knot.parameters)


def evaluate_stages(
    problem: Problem, table: Tableau, k: Any, knot: Knot, inner: Inner
) -> StepStages:
    """Evaluate rates, costs and constraint rows at the stages of step k."""
    a, b, c = tableau_arrays(table, inner.rates.dtype)
    _, dt = problem.at(knot.parameters)
    xi = dt * combine(a, inner.rates)
    rates, costs, rows = jax.vmap(lambda *x: at_stage(problem, x[0], knot, *x[1:]))(
        k + c, xi, inner.us
    )
    after = after_step(problem, table, knot, inner.rates)
    return StepStages(inner.rates - rates, after, (b * costs).sum(), rows)


def stage_states(problem: Problem, table: Tableau, knot: Knot, inner: Inner) -> Any:
    """Return the states of the stages of a step."""
    a, _, _ = tableau_arrays(table, inner.rates.dtype)
    system, dt = problem.at(knot.parameters)
    return jax.vmap(lambda xi: system.plus(knot.state, xi))(dt * combine(a, inner.rates))


def at_end(problem: Problem, knot: Knot) -> tuple[jax.Array, jax.Array]:
    """Return the terminal cost () and the constraint rows (e,) at the end."""
    N, none = problem.horizon, jnp.zeros(problem.nu, problem.dt.dtype)
    return knot_cost(problem, "end", N, knot, none), problem.rows("end", N, knot, none)


def straight_guess(problem: Problem, table: Tableau, knots: Knot, ctrls: jax.Array) -> Inner:
    """Return a first guess of the stages: constant controls, and states on straight lines."""
    s = len(table.b)

    def one(knot: Knot, following: Knot, ctrl: jax.Array) -> Inner:
        system, dt = problem.at(knot.parameters)
        slope = system.minus(following.state, knot.state) / dt
        return Inner(*(jnp.broadcast_to(x, (s, *x.shape)) for x in (ctrl, slope)))

    body, following = take(knots, BODY), take(knots, NEXT)
    return jax.vmap(one)(body, following, ctrls)


class ConstraintRows(NamedTuple):
    """Constraint rows with their slacks and multipliers.

    slack: slacks of inequalities.
    duals: multipliers of the bounds of the slacks.
    y: multipliers of equations.
    centre: multiplier estimates of the method of multipliers.
    low, high: bounds; equal for equations.
    """

    slack: jax.Array
    duals: Duals
    y: jax.Array
    centre: jax.Array
    low: jax.Array
    high: jax.Array

    @property
    def equal(self) -> jax.Array:
        """Mask of the rows that are equations."""
        return self.low == self.high

    @property
    def bounded(self) -> BoundedVariable:
        """The slacks with their bounds. The slacks of equations have no bounds."""
        low = jnp.where(self.equal, -jnp.inf, self.low)
        return BoundedVariable(self.slack, low, jnp.where(self.equal, jnp.inf, self.high))

    @property
    def multipliers(self) -> jax.Array:
        """Multipliers of the rows: y of equations, zu - zl of inequalities."""
        return jnp.where(self.equal, self.y, self.duals.zu - self.duals.zl)

    def off(self, values: jax.Array) -> jax.Array:
        """Return the residuals of the rows: values minus slacks, or minus bounds for equations."""
        return values - jnp.where(self.equal, self.low, self.slack)


class BarrierWeights(NamedTuple):
    """The weights of the barrier and of the constraints, each ().

    mu: the barrier parameter. soft: the inverse penalty of the constraints.
    """

    mu: jax.Array
    soft: jax.Array


class Condensed(NamedTuple):
    """A step whose stages are eliminated, with e = (dx, du).

    dK = Z e + offset,   d rows = C e + more
    """

    A: jax.Array
    B: jax.Array
    gap: jax.Array
    cost: Quadratic
    Z: jax.Array
    offset: jax.Array
    C: jax.Array
    more: jax.Array
    rows: jax.Array


class End(NamedTuple):
    """The end of the horizon: second-order cost, constraint rows, and their Jacobian C."""

    cost: Quadratic
    C: jax.Array
    rows: jax.Array


def row_terms(
    values: jax.Array, rows: ConstraintRows, w: BarrierWeights
) -> tuple[jax.Array, jax.Array]:
    """Return y and weight: the multipliers of the rows after a Newton step are y + weight * dc. dc
    is the change of the row values by the step."""
    wall, stiff, share = _springs(rows, w)
    off = rows.off(values)
    y = wall + share * (stiff * w.soft * (rows.centre - wall) + stiff * off)
    soft = jnp.where(rows.equal, rows.centre + off / w.soft, y)
    return soft, jnp.where(rows.equal, 1 / w.soft, share * stiff)


def row_step(
    values: jax.Array, d: jax.Array, rows: ConstraintRows, w: BarrierWeights
) -> tuple[jax.Array, jax.Array]:
    """Compute the Newton steps of the slacks and of the multipliers of equations. d is the change
    of the row values by the step."""
    wall, _, share = _springs(rows, w)
    off = rows.off(values) + d
    ds = share * (w.soft * (rows.centre - wall) + off)
    dy = rows.centre + off / w.soft - rows.y
    return jnp.where(rows.equal, 0.0, ds), jnp.where(rows.equal, dy, 0.0)


def _springs(rows: ConstraintRows, w: BarrierWeights) -> tuple[jax.Array, jax.Array, jax.Array]:
    x = rows.bounded
    stiff = barrier.hessian(x, rows.duals)
    return barrier.gradient(x, w.mu), stiff, 1 / (1 + stiff * w.soft)


def condense(
    problem: Problem, table: Tableau, w: BarrierWeights, k: Any, knot: Knot, inner: Inner,
    following: Knot, costate: jax.Array, us: BoundedVariable, us_duals: Duals, rows: ConstraintRows,
) -> Condensed:  # fmt: skip
    """Linearise step k and eliminate its stages. costate (n,): of the next knot."""
    (s, m), ns, n = inner.us.shape, problem.system.n, problem.n
    dtype = inner.us.dtype
    a, b, c = tableau_arrays(table, dtype)
    _, dt = problem.at(knot.parameters)
    by_numbers = jax.grad(lambda p: problem.at(p)[1])(knot.parameters)
    dt_x = jnp.concatenate([jnp.zeros(ns, dtype), by_numbers])
    inside = combine(a, inner.rates)  # xi = h inside
    whole = combine(b, inner.rates)

    def stage(where, xi, u):
        def near(d):
            f, cost, found = at_stage(
                problem, where, problem.plus(knot, d[:n]), xi + d[n : n + ns], u + d[n + ns :]
            )
            values = jnp.concatenate([f, cost[None], found])
            return values, values

        return jax.jacfwd(near, has_aux=True)(jnp.zeros(n + ns + m, dtype))

    J, values = jax.vmap(stage)(k + c, dt * inside, inner.us)
    J_xi = J[:, :, n : n + ns]
    # derivatives of the stage values by (dx, du, dK)
    by_x = J[:, :, :n] + (J_xi * inside[:, None]).sum(-1, keepdims=True) * dt_x
    by_u = jnp.eye(s, dtype=dtype)[:, None, :, None] * J[:, :, None, n + ns :]
    by_k = dt * a[:, None, :, None] * J_xi[:, :, None]
    r = values.shape[1]
    by_e = jnp.concatenate([by_x, by_u.reshape(s, r, s * m)], -1)
    by_k = by_k.reshape(s, r, s * ns)
    miss = (inner.rates - values[:, :ns]).reshape(s * ns)
    E = jnp.eye(s * ns, dtype=dtype) - by_k[:, :ns].reshape(s * ns, s * ns)
    right = jnp.concatenate([by_e[:, :ns].reshape(s * ns, -1), -miss[:, None]], 1)
    solved = jnp.linalg.solve(E, right)
    Z, offset = solved[:, :-1], solved[:, -1]

    # the knot after
    def end(d):
        there = problem.plus(knot, d[:n])
        z = dt * whole + d[n:]
        state = problem.system.plus(there.state, z)
        gap = problem.minus(Knot(state, there.parameters), following)
        return gap, gap

    G, gap = jax.jacfwd(end, has_aux=True)(jnp.zeros(n + ns, dtype))
    G_z = G[:, n:]
    after_x = G[:, :n] + (G_z * whole).sum(-1, keepdims=True) * dt_x
    after_k = (dt * b[:, None] * G_z[:, None]).reshape(n, s * ns)
    after_e = jnp.concatenate([after_x, jnp.zeros((n, s * m), dtype)], 1) + matmat(after_k, Z)

    # the cost and the rows
    cost_e = (b[:, None] * by_e[:, ns]).sum(0)
    cost_k = (b[:, None] * by_k[:, ns]).sum(0)
    found = values[:, ns + 1 :]
    rows_e = by_e[:, ns + 1 :].reshape(found.size, n + s * m)
    rows_k = by_k[:, ns + 1 :].reshape(found.size, s * ns)
    C, more = rows_e + matmat(rows_k, Z), matvec(rows_k, offset)
    y = rows.multipliers
    pull = cost_k + matvec(after_k.T, costate) + matvec(rows_k.T, y.reshape(-1))
    lam = -jnp.linalg.solve(E.T, pull)

    def lagrangian(e):
        d, along = e[:-1], e[-1]
        du, dk = d[n:].reshape(s, m), matvec(Z, d) + along * offset
        there = Inner(inner.us + du, inner.rates + dk.reshape(s, ns))
        at = evaluate_stages(problem, table, k, problem.plus(knot, d[:n]), there)
        total = at.cost + (lam.reshape(s, ns) * at.miss).sum() + (y * at.rows).sum()
        return total + (costate * problem.minus(at.after, following)).sum()

    H = jax.jacfwd(jax.grad(lagrangian))(jnp.zeros(n + s * m + 1, dtype))
    base, stiff = row_terms(found, rows, w)
    stiff, base = stiff.reshape(-1), base.reshape(-1) + stiff.reshape(-1) * more
    wall, spring = barrier.gradient(us, w.mu), barrier.hessian(us, us_duals)
    g = cost_e + matvec(Z.T, cost_k) + H[:-1, -1] + matvec(C.T, base)
    g = g.at[n:].add(wall.reshape(-1))
    H = H[:-1, :-1] + matmat(C.T, stiff[:, None] * C)
    H = H.at[jnp.arange(n, n + s * m), jnp.arange(n, n + s * m)].add(spring.reshape(-1))
    cost = Quadratic(
        (b * values[:, ns]).sum(), g[:n], H[:n, :n], g[n:], H[n:, n:], H[:n, n:]
    )  # fmt: skip
    return Condensed(
        after_e[:, :n], after_e[:, n:], gap + matvec(after_k, offset), cost, Z, offset, C, more,
        found,
    )  # fmt: skip


def condense_end(problem: Problem, w: BarrierWeights, knot: Knot, rows: ConstraintRows) -> End:
    """Expand the terminal cost and constraint rows to second order."""
    n, m, dtype = problem.n, problem.nu, problem.dt.dtype

    def near(d):
        cost, found = at_end(problem, problem.plus(knot, d))
        return jnp.concatenate([cost[None], found])

    zero = jnp.zeros(n, dtype)
    values, J = near(zero), jax.jacfwd(near)(zero)
    y = rows.multipliers

    def lagrangian(d):
        cost, found = at_end(problem, problem.plus(knot, d))
        return cost + (y * found).sum()

    H = jax.jacfwd(jax.grad(lagrangian))(zero)
    C, found = J[1:], values[1:]
    base, stiff = row_terms(found, rows, w)
    none = jnp.zeros((m, m), dtype)
    cost = Quadratic(
        values[0], J[0] + matvec(C.T, base), H + matmat(C.T, stiff[:, None] * C), none[0], none,
        jnp.zeros((n, m), dtype),
    )  # fmt: skip
    return End(cost, C, found)
