"""The collocation transcription of a problem: values, expansion and Newton steps.

The unknowns are the knots, the stages and their controls, and a slack for each constraint row
(`condensing`). `Transcribed` evaluates a point, expands the problem at it, and computes Newton
steps: rows and bounds by the barrier (`barrier`), steps by the condensed problem (`condensing`).

Source: Betts, *Practical Methods for Optimal Control*, ch. 4; Waechter & Biegler 2006.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiler import threads
from rbjax.control.linear.riccati import roll_linear
from rbjax.control.optimal.collocation import barrier
from rbjax.control.optimal.collocation.barrier import BoundedVariable, Duals
from rbjax.control.optimal.collocation.condensing import (
    BarrierWeights,
    Condensed,
    ConstraintRows,
    End,
    Inner,
    at_end,
    condense,
    condense_end,
    evaluate_stages,
    row_step,
)
from rbjax.control.optimal.objective import row_bounds
from rbjax.control.optimal.problem import BODY, NEXT, Knot, Problem, take
from rbjax.control.optimal.shooting.backward_pass import Feedback, backward_pass
from rbjax.lanes.arrays import matvec
from rbjax.solvers.tableau import Tableau


class CollocationPoint(NamedTuple):
    """The unknowns: knots, values at the stages, slacks of the inequalities along the path
    (N, s, c) and at the end (e,)."""

    knots: Knot
    inner: Inner
    path: jax.Array
    end: jax.Array


class CollocationMultipliers(NamedTuple):
    """Multipliers of a transcribed problem.

    costates: (N + 1, n).
    duals: of the bounds of the controls, the parameters, and the slacks of path and end.
    y: of the equations at path and end.
    centre: multiplier estimates of the method of multipliers, at path and end.
    """

    costates: jax.Array
    duals: tuple[Duals, ...]
    y: tuple[jax.Array, jax.Array]
    centre: tuple[jax.Array, jax.Array]


class CollocationStep(NamedTuple):
    """A Newton step of the unknowns of `CollocationPoint`."""

    dx: jax.Array
    us: jax.Array
    rates: jax.Array
    path: jax.Array
    end: jax.Array


class Measured(NamedTuple):
    """The values at a point, each ().

    cost: the cost.
    barrier: the barrier for mu = 1.
    pull, square: linear and quadratic term of the augmented Lagrangian.
    theta: sum of the absolute values of all gaps.
    gap, violation: largest entry of a gap and of a constraint residual.
    """

    cost: jax.Array
    barrier: jax.Array
    pull: jax.Array
    square: jax.Array
    theta: jax.Array
    gap: jax.Array
    violation: jax.Array


class Transcribed(NamedTuple):
    """A problem, its start and its collocation tableau."""

    problem: Problem
    start: Any
    table: Tableau

    # the bounds

    def us(self, point: CollocationPoint) -> BoundedVariable:
        """Return the controls of all stages, with bounds."""
        us, problem = point.inner.us, self.problem
        low, high = (
            jnp.broadcast_to(x.astype(us.dtype), us.shape) for x in (problem.low, problem.high)
        )
        return BoundedVariable(us, low, high)

    def parameters(self, point: CollocationPoint) -> BoundedVariable:
        """Return the parameters, which are constant along the motion, with bounds."""
        parameters = point.knots.parameters[0]
        return BoundedVariable(parameters, *self.problem.parameter_bounds(parameters.dtype))

    def rows(
        self, point: CollocationPoint, l: CollocationMultipliers
    ) -> tuple[ConstraintRows, ConstraintRows]:
        """Return the constraint rows of path and end."""
        out = []
        for i, where in enumerate(("path", "end")):
            slack = (point.path, point.end)[i]
            bounds = row_bounds(self.problem, where, slack.dtype)
            low, high = (jnp.broadcast_to(x, slack.shape) for x in bounds)
            out.append(ConstraintRows(slack, l.duals[2 + i], l.y[i], l.centre[i], low, high))
        return out[0], out[1]

    def bounded(
        self, point: CollocationPoint
    ) -> tuple[BoundedVariable, BoundedVariable, BoundedVariable, BoundedVariable]:
        """Return all bounded unknowns: controls, parameters, slacks of path and end."""
        path, end = self.rows(point, self.zero_multipliers(point))
        return self.us(point), self.parameters(point), path.bounded, end.bounded

    def zero_multipliers(self, point: CollocationPoint) -> CollocationMultipliers:
        """Return multipliers that are all zero."""
        costates = jnp.zeros((self.problem.horizon + 1, self.problem.n), point.path.dtype)
        bounded = point.inner.us, point.knots.parameters[0], point.path, point.end
        zeros = jax.tree.map(jnp.zeros_like, bounded)
        return CollocationMultipliers(
            costates, tuple(Duals(x, x) for x in zeros), zeros[2:], zeros[2:]
        )

    def first_multipliers(self, point: CollocationPoint, mu: jax.Array) -> CollocationMultipliers:
        """Return first multipliers: mu over the distances to the bounds; 0 for equations."""
        duals = tuple(barrier.first_duals(x, mu) for x in self.bounded(point))
        return self.zero_multipliers(point)._replace(duals=duals)

    # functions of the unknowns

    def off_start(self, knots: Knot) -> jax.Array:
        """Return the gap start (-) first knot (n,), which is 0 for free coordinates."""
        return self.problem.off_start(self.start, take(knots, 0))

    def measure(self, point: CollocationPoint, l: CollocationMultipliers) -> Measured:
        """Evaluate cost, barrier and infeasibility."""
        problem, knots, dtype = self.problem, point.knots, point.inner.us.dtype
        body, following = take(knots, BODY), take(knots, NEXT)

        def one(k: Any, knot: Knot, inner: Inner, following: Knot) -> tuple:
            found = evaluate_stages(problem, self.table, k, knot, inner)
            _, dt = problem.at(knot.parameters)
            gap = problem.minus(found.after, following)
            return found.cost, found.rows, jnp.concatenate([gap, dt * found.miss.reshape(-1)])

        ks = jnp.arange(problem.horizon, dtype=dtype)
        costs, rows, gaps = jax.vmap(threads(one))(ks, body, point.inner, following)
        cost, end = at_end(problem, take(knots, -1))
        gaps = jnp.concatenate([gaps.reshape(-1), self.off_start(knots)])
        wall = sum(barrier.value(x, jnp.ones((), dtype)) for x in self.bounded(point))
        both = self.rows(point, l)
        off = jnp.concatenate(
            [x.off(y).reshape(-1) for x, y in zip(both, (rows, end), strict=True)]
        )
        centre = jnp.concatenate([x.reshape(-1) for x in l.centre])
        return Measured(
            costs.sum() + cost, jnp.asarray(wall), (centre * off).sum(), 0.5 * (off * off).sum(),
            jnp.abs(gaps).sum(), jnp.abs(gaps).max(), jnp.abs(off).max(initial=0.0),
        )  # fmt: skip

    def step_along(
        self, point: CollocationPoint, step: CollocationStep, a: jax.Array
    ) -> CollocationPoint:
        """Return point (+) a step."""
        knots = jax.vmap(self.problem.plus)(point.knots, a * step.dx)
        inner = Inner(point.inner.us + a * step.us, point.inner.rates + a * step.rates)
        return CollocationPoint(knots, inner, point.path + a * step.path, point.end + a * step.end)

    # an iteration

    def expand(
        self, point: CollocationPoint, l: CollocationMultipliers, w: BarrierWeights
    ) -> tuple[Condensed, End, jax.Array]:
        """Expand all steps and the end to second order; return them and the gaps (N + 1, n)."""
        problem, knots, dtype = self.problem, point.knots, point.inner.us.dtype
        body, following = take(knots, BODY), take(knots, NEXT)
        one = functools.partial(condense, problem, self.table, w)
        ks = jnp.arange(problem.horizon, dtype=dtype)
        rows, closing = self.rows(point, l)
        path = jax.vmap(threads(one))(
            ks, body, point.inner, following, l.costates[1:], self.us(point), l.duals[0], rows
        )
        last = take(knots, -1)
        end = condense_end(problem, w, last, closing)
        if problem.parameter_count:  # bounded at the first knot
            ns, parameters = problem.system.n, self.parameters(point)
            at = jnp.arange(ns, problem.n)
            cost = path.cost
            q = cost.q.at[0, ns:].add(barrier.gradient(parameters, w.mu))
            Q = cost.Q.at[0, at, at].add(barrier.hessian(parameters, l.duals[1]))
            path = path._replace(cost=cost._replace(q=q, Q=Q))
        gaps = jnp.concatenate([self.off_start(knots)[None], path.gap])
        return path, end, gaps

    def gains(self, path: Condensed, end: End, gaps: jax.Array, reg: jax.Array) -> Feedback:
        """Compute the gains of a Newton step by the backward pass of the condensed problem."""
        problem, first = self.problem, None
        if problem.free_first_knot:
            free = jnp.asarray([*problem.free, *[True] * problem.parameter_count], gaps.dtype)
            none = jnp.full_like(free, jnp.inf)
            first = (free, -none, none)
        return threads(backward_pass)(path.A, path.B, gaps, path.cost, end.cost, None, first, reg)

    def step(
        self, point: CollocationPoint, l: CollocationMultipliers, w: BarrierWeights,
        path: Condensed, end: End, gaps: jax.Array, gains: Feedback,
    ) -> tuple[CollocationStep, CollocationMultipliers]:  # fmt: skip
        """Return the Newton step of the unknowns, and of the multipliers."""
        dx, du = roll_linear(path.A, path.B, gaps[1:], gains.K, gains.k, gains.first)
        e = jnp.concatenate([dx[:-1], du], 1)
        rates = (matvec(path.Z, e) + path.offset).reshape(point.inner.rates.shape)
        d_path = (matvec(path.C, e) + path.more).reshape(point.path.shape)
        costates = gains.v + matvec(gains.V, dx - gaps)
        rows, closing = self.rows(point, l)
        d_slack, dy = row_step(path.rows, d_path, rows, w)
        d_closing, dy_end = row_step(end.rows, matvec(end.C, dx[-1]), closing, w)
        step = CollocationStep(dx, du.reshape(point.inner.us.shape), rates, d_slack, d_closing)
        duals = tuple(
            barrier.dual_step(x, dv, z, w.mu)
            for x, dv, z in zip(self.bounded(point), self.moves(step), l.duals, strict=True)
        )
        none = jnp.zeros_like(dy), jnp.zeros_like(dy_end)
        return step, CollocationMultipliers(costates - l.costates, duals, (dy, dy_end), none)

    def moves(self, step: CollocationStep) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Return the steps of bounded unknowns: controls, parameters, slacks of path and end."""
        return step.us, step.dx[0, self.problem.system.n :], step.path, step.end

    def reach(
        self,
        point: CollocationPoint,
        l: CollocationMultipliers,
        step: CollocationStep,
        by: CollocationMultipliers,
        tau: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """Return the longest feasible fractions of a primal step and of a multiplier step."""
        along = back = jnp.ones((), tau.dtype)
        for x, dv in zip(self.bounded(point), self.moves(step), strict=True):
            along = jnp.minimum(along, barrier.step_to_boundary(x, dv, tau))
        for z, dz in zip(l.duals, by.duals, strict=True):
            back = jnp.minimum(back, barrier.dual_step_to_boundary(z, dz, tau))
        return along, back

    def step_multipliers(
        self, point: CollocationPoint, l: CollocationMultipliers, by: CollocationMultipliers,
        a: jax.Array, back: jax.Array, mu: jax.Array,
    ) -> CollocationMultipliers:  # fmt: skip
        """Return the multipliers at the new point.

        a: step length of costates and equation multipliers. back: step length of bound multipliers.
        """
        duals = tuple(
            barrier.moved_duals(x, z, dz, back, mu)
            for x, z, dz in zip(self.bounded(point), l.duals, by.duals, strict=True)
        )
        costates, y = jax.tree.map(lambda x, d: x + a * d, (l.costates, l.y), (by.costates, by.y))
        return CollocationMultipliers(costates, duals, y, l.centre)


def constraint_values(t: Transcribed, point: CollocationPoint) -> tuple[jax.Array, jax.Array]:
    """Return the constraint rows at all stages (N, s, c) and at the end (e,)."""
    problem, dtype = t.problem, point.inner.us.dtype
    body = take(point.knots, BODY)
    ks = jnp.arange(problem.horizon, dtype=dtype)
    found = jax.vmap(functools.partial(evaluate_stages, problem, t.table))(ks, body, point.inner)
    return found.rows, at_end(problem, take(point.knots, -1))[1]
