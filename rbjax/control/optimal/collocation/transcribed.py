"""The collocation transcription of a problem: values, expansion and steps.

Unknown are the knots, the stages and their controls, and a slack for each constraint
(`transcription`). `Transcribed` measures a point, expands it, and steps from it: rows and bounds by
the barrier (`barrier`), steps by the condensed problem (`condensing`).

Source: Betts, *Practical Methods for Optimal Control*, ch. 4; Waechter & Biegler 2006.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiler import threads
from rbjax.control.optimal.collocation import barrier
from rbjax.control.optimal.collocation.barrier import Bounded, Duals
from rbjax.control.optimal.collocation.condensing import (
    Condensed,
    End,
    Rows,
    Weights,
    condensed,
    end_condensed,
    row_step,
)
from rbjax.control.optimal.collocation.transcription import (
    Inner,
    at_end,
    stages,
)
from rbjax.control.optimal.constraint_rows import limits
from rbjax.control.optimal.problem import BODY, NEXT, Knot, Problem
from rbjax.control.optimal.shooting.backward_pass import Feedback, backward_pass
from rbjax.lanes.arrays import matvec
from rbjax.solvers.common.tableau import Tableau


class Point(NamedTuple):
    """The unknowns: knots, stages (inner), slacks (N, s, c) of the path, (e,) of the end."""

    knots: Knot
    inner: Inner
    path: jax.Array
    end: jax.Array


class Multipliers(NamedTuple):
    """costates (N + 1, n); of the bounds of controls, numbers and slacks; y of equations; centre,
    about which those of constraints are found. Slacks, y and centre: a pair, of path and end."""

    costates: jax.Array
    us: Duals
    parameters: Duals
    slacks: tuple[Duals, Duals]
    y: tuple[jax.Array, jax.Array]
    centre: tuple[jax.Array, jax.Array]


class Step(NamedTuple):
    """A change of the unknowns."""

    dx: jax.Array
    us: jax.Array
    rates: jax.Array
    path: jax.Array
    end: jax.Array


class Measured(NamedTuple):
    """cost (); barrier () for mu = 1; pull () and square () of the constraints' multipliers;
    theta (), the sum of all gaps; gap () and violation () of constraints, the largest."""

    cost: jax.Array
    barrier: jax.Array
    pull: jax.Array
    square: jax.Array
    theta: jax.Array
    gap: jax.Array
    violation: jax.Array


class Transcribed(NamedTuple):
    """A problem, its start and its scheme."""

    problem: Problem
    start: Any
    table: Tableau

    # the bounds

    def us(self, point: Point) -> Bounded:
        """Controls of all stages."""
        us, problem = point.inner.us, self.problem
        low, high = (
            jnp.broadcast_to(x.astype(us.dtype), us.shape) for x in (problem.low, problem.high)
        )
        return Bounded(us, low, high)

    def parameters(self, point: Point) -> Bounded:
        """The parameters, which are constant along the motion."""
        parameters = point.knots.parameters[0]
        bounds = self.problem.start_bounds(parameters.dtype)
        low, high = (x[self.problem.system.n :] for x in bounds)
        return Bounded(parameters, low, high)

    def rows(self, point: Point, l: Multipliers) -> tuple[Rows, Rows]:
        """The rows of constraints of path and end."""
        out = []
        for i, where in enumerate(("path", "end")):
            slack = (point.path, point.end)[i]
            low, high = (
                jnp.broadcast_to(x, slack.shape) for x in limits(self.problem, where, slack.dtype)
            )
            out.append(Rows(slack, l.slacks[i], l.y[i], l.centre[i], low, high))
        return out[0], out[1]

    def bounded(self, point: Point) -> tuple[Bounded, Bounded, Bounded, Bounded]:
        """Controls, numbers, slacks of path and end."""
        path, end = self.rows(point, self.none(point))
        return self.us(point), self.parameters(point), path.bounded, end.bounded

    def none(self, point: Point) -> Multipliers:
        """No multipliers."""
        costates = jnp.zeros((self.problem.horizon + 1, self.problem.n), point.path.dtype)
        pair = jnp.zeros_like(point.path), jnp.zeros_like(point.end)
        alike = point.inner.us, point.knots.parameters[0], *pair
        us, parameters, *slacks = (Duals(x, x) for x in map(jnp.zeros_like, alike))
        return Multipliers(costates, us, parameters, (slacks[0], slacks[1]), pair, pair)

    def first_multipliers(self, point: Point, mu: jax.Array) -> Multipliers:
        """mu over the distances, and nothing of equations."""
        us, parameters, path, end = (barrier.first_duals(x, mu) for x in self.bounded(point))
        return self.none(point)._replace(us=us, parameters=parameters, slacks=(path, end))

    # functions of the unknowns

    def off_start(self, knots: Knot) -> jax.Array:
        """start (-) first knot (n,), 0 in free coordinates."""
        return self.problem.off_start(self.start, jax.tree.map(lambda x: x[0], knots))

    def measured(self, point: Point, l: Multipliers) -> Measured:
        """Cost, barrier and infeasibility."""
        problem, knots, dtype = self.problem, point.knots, point.inner.us.dtype
        body, following = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, NEXT))

        def one(k: Any, knot: Knot, inner: Inner, following: Knot) -> tuple:
            found = stages(problem, self.table, k, knot, inner)
            _, dt = problem.at(knot.parameters)
            gap = problem.minus(found.after, following)
            return found.cost, found.rows, jnp.concatenate([gap, dt * found.miss.reshape(-1)])

        ks = jnp.arange(problem.horizon, dtype=dtype)
        costs, rows, gaps = jax.vmap(threads(one))(ks, body, point.inner, following)
        cost, end = at_end(problem, jax.tree.map(lambda x: x[-1], knots))
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

    def moved(self, point: Point, step: Step, a: jax.Array) -> Point:
        """point (+) a step."""
        knots = jax.vmap(self.problem.plus)(point.knots, a * step.dx)
        inner = Inner(point.inner.us + a * step.us, point.inner.rates + a * step.rates)
        return Point(knots, inner, point.path + a * step.path, point.end + a * step.end)

    # an iteration

    def expanded(
        self, point: Point, l: Multipliers, w: Weights
    ) -> tuple[Condensed, End, jax.Array]:
        """All steps and the end to second order, and the gaps (N + 1, n)."""
        problem, knots, dtype = self.problem, point.knots, point.inner.us.dtype
        body, following = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, NEXT))
        one = functools.partial(condensed, problem, self.table, w)
        ks = jnp.arange(problem.horizon, dtype=dtype)
        rows, closing = self.rows(point, l)
        path = jax.vmap(threads(one))(
            ks, body, point.inner, following, l.costates[1:], self.us(point), l.us, rows
        )
        last = jax.tree.map(lambda x: x[-1], knots)
        end = end_condensed(problem, w, last, closing)
        if problem.parameter_count:  # bounded at the first knot
            ns, parameters = problem.system.n, self.parameters(point)
            at = jnp.arange(ns, problem.n)
            cost = path.cost
            q = cost.q.at[0, ns:].add(barrier.gradient(parameters, w.mu))
            Q = cost.Q.at[0, at, at].add(barrier.hessian(parameters, l.parameters))
            path = path._replace(cost=cost._replace(q=q, Q=Q))
        gaps = jnp.concatenate([self.off_start(knots)[None], path.gap])
        return path, end, gaps

    def gains(self, path: Condensed, end: End, gaps: jax.Array, reg: jax.Array) -> Feedback:
        """The backward pass."""
        problem, first = self.problem, None
        if problem.free_first_knot:
            free = jnp.asarray([*problem.free, *[True] * problem.parameter_count], gaps.dtype)
            none = jnp.full_like(free, jnp.inf)
            first = (free, -none, none)
        return threads(backward_pass)(path.A, path.B, gaps, path.cost, end.cost, None, first, reg)

    def step(
        self, point: Point, l: Multipliers, w: Weights, path: Condensed, end: End,
        gaps: jax.Array, gains: Feedback,
    ) -> tuple[Step, Multipliers]:  # fmt: skip
        """Newton's step of the unknowns, and of the multipliers."""
        N, s, m = point.inner.us.shape

        def forth(dx: jax.Array, x: tuple) -> tuple:
            A, B, gap, K, k = x
            du = k + matvec(K, dx)
            return matvec(A, dx) + matvec(B, du) + gap, (dx, du)

        found: Any = jax.lax.scan(forth, gains.first, (path.A, path.B, gaps[1:], gains.K, gains.k))
        last, (dx, du) = found
        e = jnp.concatenate([dx, du], 1)
        rates = (matvec(path.Z, e) + path.offset).reshape(point.inner.rates.shape)
        d_path = (matvec(path.C, e) + path.more).reshape(point.path.shape)
        dx = jnp.concatenate([dx, last[None]])
        d_end = matvec(end.C, last)
        costates = gains.v + matvec(gains.V, dx - gaps)
        rows, closing = self.rows(point, l)
        d_slack, dy = row_step(path.rows, d_path, rows, w)
        d_closing, dy_end = row_step(end.rows, d_end, closing, w)
        step = Step(dx, du.reshape(N, s, m), rates, d_slack, d_closing)
        us, parameters, *slacks = (
            barrier.dual_step(x, dv, z, w.mu)
            for x, dv, z in zip(
                self.bounded(point), self.moves(step), (l.us, l.parameters, *l.slacks), strict=True
            )
        )
        none = jnp.zeros_like(dy), jnp.zeros_like(dy_end)
        by = Multipliers(
            costates - l.costates, us, parameters, (slacks[0], slacks[1]), (dy, dy_end), none
        )
        return step, by

    def moves(self, step: Step) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """The steps of all that is bounded."""
        return step.us, step.dx[0, self.problem.system.n :], step.path, step.end

    def reach(
        self, point: Point, l: Multipliers, step: Step, by: Multipliers, tau: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The longest parts of a step of the unknowns, and of the multipliers."""
        along = back = jnp.ones((), tau.dtype)
        for x, dv in zip(self.bounded(point), self.moves(step), strict=True):
            along = jnp.minimum(along, barrier.step_to_boundary(x, dv, tau))
        duals = (l.us, l.parameters, *l.slacks), (by.us, by.parameters, *by.slacks)
        for z, dz in zip(*duals, strict=True):
            back = jnp.minimum(back, barrier.dual_step_to_boundary(z, dz, tau))
        return along, back

    def moved_multipliers(
        self, point: Point, l: Multipliers, by: Multipliers, a: jax.Array, back: jax.Array,
        mu: jax.Array,
    ) -> Multipliers:  # fmt: skip
        """At the new point."""
        us, parameters, *slacks = (
            barrier.moved_duals(x, z, dz, back, mu)
            for x, z, dz in zip(
                self.bounded(point), (l.us, l.parameters, *l.slacks),
                (by.us, by.parameters, *by.slacks), strict=True,
            )
        )  # fmt: skip
        y = tuple(old + a * new for old, new in zip(l.y, by.y, strict=True))
        return Multipliers(
            l.costates + a * by.costates, us, parameters, (slacks[0], slacks[1]), (y[0], y[1]),
            l.centre,
        )  # fmt: skip


def constraint_values(t: Transcribed, point: Point) -> tuple[jax.Array, jax.Array]:
    """The rows of constraints at all stages (N, s, c) and at the end (e,)."""
    problem, dtype = t.problem, point.inner.us.dtype
    body = jax.tree.map(lambda x: x[BODY], point.knots)
    ks = jnp.arange(problem.horizon, dtype=dtype)
    rows = jax.vmap(functools.partial(stages, problem, t.table))(ks, body, point.inner).rows
    return rows, at_end(problem, jax.tree.map(lambda x: x[-1], point.knots))[1]
