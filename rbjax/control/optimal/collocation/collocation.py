"""Direct collocation by a primal-dual interior point: Gauss-Legendre, Radau, Hermite-Simpson.

Each iteration is a step of sequential quadratic programming on all states, controls and stages: the
second-order Lagrangian with its stages eliminated (`condensing`), a barrier for bounds and
constraints (`barrier`), a Riccati recursion (`backward_pass`), and a filter line search.

    mu <- min(0.2 mu, mu^1.5)   if the problem with the barrier mu is solved; then also
    centre <- y,  soft <- mu    of the constraints, down to the square root of rounding
    reg <- 8 reg                if a control Hessian is not definite, or no step is accepted
    if the filter accepts no step and there are gaps, the next steps close them

Source: Betts, *Practical Methods for Optimal Control*, chs. 2 and 4; Waechter & Biegler 2006
(*Ipopt*), for the rules of barrier and filter.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.optimal.collocation import barrier
from rbjax.control.optimal.collocation.condensing import (
    BarrierWeights,
    Condensed,
    End,
    at_end,
    combine,
    evaluate_stages,
    stage_states,
    straight_guess,
    tableau_arrays,
)
from rbjax.control.optimal.collocation.transcribed import (
    CollocationMultipliers,
    CollocationPoint,
    Measured,
    Transcribed,
    constraint_values,
)
from rbjax.control.optimal.objective import constraint_violations, row_bounds
from rbjax.control.optimal.problem import BODY, Knot, Problem, take
from rbjax.control.optimal.shooting import filter_search
from rbjax.control.optimal.shooting.filter_search import CostFilter, FilterPair
from rbjax.control.optimal.shooting.search import MAX_STALLED, count_stalled
from rbjax.control.optimal.solution import SearchResult, SolveOptions, StageValues
from rbjax.control.status import BUDGET, CONVERGED, GOING, INFEASIBLE, NOT_FINITE, STUCK
from rbjax.lanes.arrays import select
from rbjax.solvers.tableau import Tableau

FIRST_MU = 0.1
LEAST_REG, MOST_REG, HARDER, EASIER = 1e-4, 1e10, 8.0, 3.0
TRIALS = 16  # maximum number of halvings of a step
STIFF = 1e-3  # inverse penalty of constraints, relative to mu
CLOSED, CLOSING_REG = 0.1, 1.0  # gaps are closed to this fraction, with this regularisation
FALLS, OFTEN = 0.5, 4  # infeasible if the violation fails this often to fall to this fraction
SOLVED = 0.5  # expected cost change, relative to mu, at which mu falls
GAP = 0.57  # largest gap of a solution: eps^0.57, 1e-9 in f64
SOFT = 0.5  # equations hold to eps^0.5 times the change of their multipliers


class CollocationIterate(NamedTuple):
    """The state of the interior point method between two iterations."""

    point: CollocationPoint
    multipliers: CollocationMultipliers
    measured: Measured
    mu: jax.Array
    reg: jax.Array  # the last one that was needed
    floor: jax.Array  # the least to try next
    filter: CostFilter
    expected_decrease: jax.Array
    iterations: jax.Array
    status: jax.Array
    costs: jax.Array
    K: jax.Array
    violation: jax.Array  # violation at the last change of the centre
    vain: jax.Array  # changes in a row that did not lower it
    closing: jax.Array  # gaps to close to before the filter decides again; infinite: it decides
    reference_cost: jax.Array  # the cost at its last fall by more than rounding
    stalled: jax.Array


def solve_collocation(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: SolveOptions,
    history: int, table: Tableau,
) -> SearchResult:  # fmt: skip
    """Solve a problem by direct collocation."""
    t = Transcribed(problem, start, table)
    last = iterate(t, initial_iterate(t, knots, ctrls, history), options)
    return search_result(t, last)


def initial_iterate(
    t: Transcribed, knots: Knot, ctrls: jax.Array, history: int
) -> CollocationIterate:
    """Return the first iterate, in the interior of all bounds."""
    problem, dtype = t.problem, ctrls.dtype
    N, n = problem.horizon, problem.n
    mu = jnp.asarray(FIRST_MU, dtype)
    low, high = problem.parameter_bounds(dtype)
    knots = Knot(knots.state, barrier.push_inside(knots.parameters, low, high))
    inner = straight_guess(problem, t.table, knots, ctrls)
    us = t.us(
        CollocationPoint(knots, inner, inner.us, inner.us)
    )  # the slacks of this point are not read
    inner = inner._replace(us=barrier.push_inside(us.v, us.low, us.high))
    body = take(knots, BODY)
    ks = jnp.arange(N, dtype=dtype)
    rows = jax.vmap(functools.partial(evaluate_stages, problem, t.table))(ks, body, inner).rows
    _, end = at_end(problem, take(knots, -1))
    slacks = []
    for where, values in (("path", rows), ("end", end)):
        low, high = row_bounds(problem, where, dtype)
        slacks.append(jnp.where(low == high, low, barrier.push_inside(values, low, high)))
    point = CollocationPoint(knots, inner, *slacks)
    bounds = sum(barrier.bound_count(x) for x in t.bounded(point)) + rows.size + end.size
    mu = jnp.where(bounds > 0, mu, 0.0)
    multipliers = t.first_multipliers(point, mu)
    measured = t.measure(point, multipliers)
    total = measured.cost + measured.theta + measured.square
    number = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    return CollocationIterate(
        point, multipliers, measured, mu, number(0), number(0),
        filter_search.empty_filter(measured.theta), number(jnp.inf), jnp.asarray(0),
        jnp.where(jnp.isfinite(total), GOING, NOT_FINITE), jnp.full(history, jnp.nan, dtype),
        jnp.zeros((N, problem.nu, n), dtype), number(jnp.inf), jnp.asarray(0), number(jnp.inf),
        number(jnp.inf), jnp.asarray(0),
    )  # fmt: skip


def iterate(t: Transcribed, begin: CollocationIterate, options: SolveOptions) -> CollocationIterate:
    """Iterate the interior point method until the stopping rule holds."""
    dtype = begin.mu.dtype
    eps = jnp.finfo(dtype).eps
    soft = jnp.asarray(eps**SOFT, dtype)
    bounds = sum(barrier.bound_count(x) for x in t.bounded(begin.point))
    tolerance = jnp.maximum(options.rule.tolerance.astype(dtype), 10 * eps)
    least = tolerance / jnp.maximum(bounds, 1)
    scale = options.rule.scale
    if scale is None:
        scale = jnp.minimum(jnp.abs(begin.measured.cost), 1.0)
    _, b, _ = tableau_arrays(t.table, dtype)
    history = begin.costs.shape[0]

    def direction(path: Condensed, end: End, gaps: jax.Array, now: CollocationIterate) -> tuple:
        """Compute the Riccati gains of a Newton step, and the smallest regularisation that makes it
        exist."""

        def harder(x: tuple) -> tuple:
            again = jnp.maximum(LEAST_REG, now.reg / EASIER)
            reg = jnp.where(x[1] == 0, again, HARDER * x[1])
            return t.gains(path, end, gaps, reg), reg

        def fails(x: tuple) -> jax.Array:
            return ~x[0].ok & (x[1] < MOST_REG)

        return jax.lax.while_loop(fails, harder, (t.gains(path, end, gaps, now.floor), now.floor))

    def turn(now: CollocationIterate) -> CollocationIterate:
        l, mu = now.multipliers, now.mu
        w = BarrierWeights(mu, jnp.maximum(STIFF * mu, soft))
        before = t.measure(now.point, l)
        path, end, gaps = t.expand(now.point, l, w)
        gains, reg = direction(path, end, gaps, now)
        step, by = t.step(now.point, l, w, path, end, gaps, gains)
        decrease = jnp.abs(gains.slope + 0.5 * gains.curvature)
        along, back = t.reach(now.point, l, step, by, jnp.maximum(0.99, 1 - mu))

        def phi(m: Measured) -> FilterPair:
            return FilterPair(m.theta, m.cost + mu * m.barrier + m.pull + m.square / w.soft)

        def total(a: jax.Array) -> jax.Array:
            return phi(t.measure(t.step_along(now.point, step, a), l)).phi

        zero = jnp.zeros((), dtype)
        slope = jax.jvp(total, (zero,), (jnp.ones((), dtype),))[1]
        pair, closing = phi(before), jnp.isfinite(now.closing)

        def tries(x: tuple) -> tuple:
            a, _, _, count = x
            a = jnp.where(count == 0, a, 0.5 * a)
            m = t.measure(t.step_along(now.point, step, a), l)
            good = filter_search.accepts(now.filter, pair, phi(m), slope, a)
            nearer = (m.theta <= (1 - filter_search.ARMIJO * a) * pair.theta) & jnp.isfinite(m.cost)
            nearer = nearer & jnp.isfinite(m.barrier)
            return a, m, gains.ok & jnp.where(closing, nearer, good), count + 1

        def goes_on(x: tuple) -> jax.Array:
            return ~x[2] & (x[3] < TRIALS)

        a, m, taken, _ = jax.lax.while_loop(
            goes_on, tries, (along, before, jnp.asarray(False), jnp.asarray(0))
        )
        point = t.step_along(now.point, step, a)
        kept = filter_search.updated_filter(now.filter, pair, phi(m), slope, a)
        moved = point, t.step_multipliers(point, l, by, a, back, mu), m, kept
        point, l, m, kept = select(taken, moved, (now.point, l, before, now.filter))

        # stopping criteria
        gap = jnp.maximum(before.gap, m.gap)
        solved = gains.ok & (decrease <= jnp.maximum(SOLVED * mu, tolerance))
        solved = solved & (gap <= jnp.maximum(mu, eps**GAP))
        held = m.violation <= options.rule.violation
        share = jnp.maximum(scale, jnp.abs(before.cost))
        # with regularisation the expected change is small everywhere, so test the gradient too
        flat = (reg <= 0) | (jnp.sqrt(gains.square) <= jnp.sqrt(tolerance) * share)
        done = solved & (mu <= least) & (decrease <= tolerance * share) & flat & held
        done = done & (gap <= eps**GAP)
        vain = (m.violation > FALLS * now.violation) & ~held
        vain = jnp.where(solved, jnp.where(vain, now.vain + 1, 0), now.vain)
        less = jnp.maximum(least, jnp.minimum(0.2 * mu, mu**1.5))
        less = jnp.where(solved, jnp.minimum(less, mu), mu)
        both = tuple(x.multipliers for x in t.rows(point, l))
        l = select(solved, l._replace(centre=both), l)
        kept = select(solved, filter_search.without_pairs(kept), kept)
        floor = jnp.where(taken, 0.0, jnp.maximum(LEAST_REG, HARDER * reg))
        begins = ~taken & ~closing & gains.ok & (before.gap > jnp.maximum(mu, eps**GAP))
        goal = jnp.where(begins, CLOSED * before.theta, now.closing)
        ends = closing & (m.theta <= now.closing)
        goal = jnp.where(ends, jnp.inf, goal)
        kept = select(ends, filter_search.without_pairs(kept), kept)
        floor = jnp.where(begins | (closing & taken & ~ends), CLOSING_REG, floor)

        iterations = now.iterations + 1
        whole = ~closing & (gap <= jnp.maximum(mu, eps**GAP)) & ~(solved & (mu > least))
        reference, stalled = count_stalled(now.reference_cost, now.stalled, phi(m).phi, whole)
        lost = (~taken & (reg >= MOST_REG / HARDER)) | (stalled >= MAX_STALLED)
        status = jnp.where(iterations >= options.rule.iterations, BUDGET, GOING)
        status = jnp.where(lost, jnp.where(held | (gap > eps**GAP), STUCK, INFEASIBLE), status)
        status = jnp.where(vain >= OFTEN, INFEASIBLE, status)
        status = jnp.where(done, CONVERGED, status)
        N, s, nu = point.inner.us.shape
        K = (b[:, None, None] * gains.K.reshape(N, s, nu, -1)).sum(1)
        return CollocationIterate(
            point, l, m, less, jnp.where(reg > 0, reg, now.reg), floor.astype(dtype), kept,
            decrease, iterations, status,
            now.costs.at[jnp.minimum(now.iterations, history - 1)].set(m.cost), K,
            jnp.where(solved, m.violation, now.violation), vain, goal, reference, stalled,
        )  # fmt: skip

    return jax.lax.while_loop(lambda now: now.status == GOING, turn, begin)


def search_result(t: Transcribed, last: CollocationIterate) -> SearchResult:
    """Convert the last iterate to a `SearchResult`."""
    point, l = last.point, last.multipliers
    _, b, c = tableau_arrays(t.table, point.inner.us.dtype)
    body = take(point.knots, BODY)
    states = jax.vmap(functools.partial(stage_states, t.problem, t.table))(body, point.inner)
    ctrls = jax.vmap(functools.partial(combine, b))(point.inner.us)
    path, end = (x.multipliers for x in t.rows(point, l))
    m, off = last.measured, constraint_violations(t.problem, *constraint_values(t, point))
    return SearchResult(
        point.knots, ctrls, m.cost, last.status, last.iterations, last.expected_decrease, m.gap,
        off.max(initial=0.0), last.costs, last.K, path.sum(1), end,
        StageValues(c, states, point.inner.us), off,
    )  # fmt: skip
