"""Differential dynamic programming with multiple shooting, boxes and constraints.

Each iteration expands the problem at its knots (`expansion`), finds gains (`backward_pass`), tries
steps of 1, 1/2, 1/4 ... side by side (`forward_pass`), and takes the longest that lowers the cost
as foreseen. States may begin anywhere: gaps close as steps are taken (Mastalli et al. 2020,
*Crocoddyl*, whose rules of acceptance and regularisation these are). Around it, constraints are
held by an augmented Lagrangian:

    lambda <- mu (s - clip(s, low, high)),     mu <- 10 mu where the violation did not fall

Expansion, passes and trials are programs of one sample (`rb.threads`): of a knot, of a problem, of
a trial.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.backward_pass import Bounds, Gains, backward_pass
from rbjax.control.expansion import (
    Local,
    Multipliers,
    Quadratic,
    costates,
    limits,
    local,
    quadratic,
    row_count,
    second_order,
)
from rbjax.control.forward_pass import Tried, forward_pass
from rbjax.control.options import Options
from rbjax.control.outcome import BUDGET, CONVERGED, GOING, INFEASIBLE, NOT_FINITE, STUCK
from rbjax.control.problem import Knot, Problem
from rbjax.control.solution import Found, plain_cost
from rbjax.threads import threads

LEAST, MOST, FACTOR = 1e-9, 1e9, 10.0  # regularisation; the least counts as none
TRIALS = 10  # steps of 1 to 2^-9
ACCEPTED, ASCENT = 0.1, 2.0  # shares of the foreseen change
LONG, SHORT = 0.5, 0.01  # steps that lower and raise the regularisation
PENALTY, HARDER, PENALTY_MOST = 10.0, 10.0, 1e8


class Iterate(NamedTuple):
    """What an iteration leaves to the next."""

    knots: Knot
    ctrls: jax.Array
    feasible: jax.Array
    multipliers: Multipliers
    reg: jax.Array
    cost: jax.Array
    stop: jax.Array
    violation: jax.Array
    before: jax.Array  # the violation at the last change of multipliers
    inner: jax.Array  # tolerance of this turn of multipliers
    turns: jax.Array
    outcome: jax.Array
    gains: Gains
    costs: jax.Array  # (history,) of each iteration


class Expanded(NamedTuple):
    """All knots to second order, and the gaps (N + 1, n)."""

    path: Local
    end: Quadratic
    gaps: jax.Array
    cost: jax.Array


def by_ddp(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: Options, history: int,
    exact: bool = False,
) -> Found:  # fmt: skip
    """`solve` by differential dynamic programming. exact: with second derivatives of dynamics and
    residuals, where they leave the control Hessians positive definite."""
    last = optimised(problem, start, knots, ctrls, options, history, exact)
    path, end = last.multipliers.path, last.multipliers.end
    if problem.constraints:  # the gradient of the augmented Lagrangian is that with these
        path, end, _ = threads(functools.partial(updated, problem))(
            last.knots, last.ctrls, last.multipliers
        )
    return Found(
        last.knots, last.ctrls, plain_cost(problem, last.knots, last.ctrls), last.outcome,
        last.turns, last.stop, largest_gap(problem, start, last.knots, last.ctrls),
        last.violation, last.costs, last.gains.K, path, end,
    )  # fmt: skip


def largest_gap(problem: Problem, start: Any, knots: Knot, ctrls: jax.Array) -> jax.Array:
    """The largest entry of a gap between a step and the next state, and of the start's."""
    body = jax.tree.map(lambda x: x[:-1], knots)
    following = jax.tree.map(lambda x: x[1:], knots)

    def one(k: Any, knot: Knot, ctrl: jax.Array, after: Knot) -> jax.Array:
        return jnp.abs(problem.minus(problem.step(k, knot, ctrl), after)).max()

    ks = jnp.arange(problem.horizon, dtype=ctrls.dtype)
    gap = jax.vmap(threads(one))(ks, body, ctrls, following).max()
    first = problem.system.minus(start, jax.tree.map(lambda x: x[0], knots.state))
    return jnp.maximum(gap, jnp.abs(jnp.where(jnp.asarray(problem.free), 0.0, first)).max())


def expand(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, multipliers: Multipliers
) -> Expanded:
    """All knots to second order, side by side."""
    N, dtype = problem.horizon, ctrls.dtype
    body = jax.tree.map(lambda x: x[:-1], knots)
    end = jax.tree.map(lambda x: x[-1], knots)

    def one(k, knot, ctrl, rows, mu, following):
        found = local(problem, k, knot, ctrl, rows, mu)
        return found, problem.minus(found.after, following)

    def last(knot, rows, mu):
        none = jnp.zeros(problem.nu, dtype)
        return quadratic(problem, jnp.asarray(N, dtype), knot, none, rows, mu, "end")

    def opening(start, knot):
        return problem.system.minus(start, knot.state)

    ks = jnp.arange(N, dtype=dtype)
    following = jax.tree.map(lambda x: x[1:], knots)
    path, gaps = jax.vmap(threads(one), (0, 0, 0, 0, None, 0))(
        ks, body, ctrls, multipliers.path, multipliers.penalty, following
    )
    terminal = threads(last)(end, multipliers.end, multipliers.penalty)
    free = jnp.asarray(problem.free)
    first = threads(opening)(start, jax.tree.map(lambda x: x[0], knots))
    first = jnp.where(free, 0.0, first)
    first = jnp.concatenate([first, jnp.zeros(problem.numbers, dtype)])
    return Expanded(
        path, terminal, jnp.concatenate([first[None], gaps]), path.cost.c.sum() + terminal.c
    )


def with_curvature(
    problem: Problem, knots: Knot, ctrls: jax.Array, multipliers: Multipliers, found: Expanded
) -> Expanded:
    """All knots with what Gauss and Newton leave out."""
    N, dtype, mu = problem.horizon, ctrls.dtype, multipliers.penalty
    body = jax.tree.map(lambda x: x[:-1], knots)
    last = jax.tree.map(lambda x: x[-1], knots)

    def one(k, knot, ctrl, rows, costate):
        return second_order(problem, k, knot, ctrl, rows, mu, "path", costate)

    def closing(knot, rows):
        none = jnp.zeros(problem.nu, dtype)
        return second_order(problem, jnp.asarray(N, dtype), knot, none, rows, mu, "end")

    def added(cost: Quadratic, more: tuple) -> Quadratic:
        Q, R, S = more
        return cost._replace(Q=cost.Q + Q, R=cost.R + R, S=cost.S + S)

    l = threads(costates)(found.path, found.end)
    ks = jnp.arange(N, dtype=dtype)
    more = jax.vmap(threads(one))(ks, body, ctrls, multipliers.path, l)
    path = found.path._replace(cost=added(found.path.cost, more))
    end = added(found.end, threads(closing)(last, multipliers.end))
    return found._replace(path=path, end=end)


def gains_of(
    problem: Problem, knots: Knot, ctrls: jax.Array, found: Expanded, gaps: jax.Array, reg: Any
) -> Gains:
    """The backward pass at knots."""
    bounds = None
    if problem.bounded:
        low, high = (x.astype(ctrls.dtype) for x in (problem.low, problem.high))
        huge = jnp.finfo(ctrls.dtype).max
        bounds = Bounds(jnp.maximum(low - ctrls, -huge), jnp.minimum(high - ctrls, huge))
    first = None
    if problem.opens:
        free = jnp.asarray([*problem.free, *[True] * problem.numbers], ctrls.dtype)
        low, high = problem.start_bounds(ctrls.dtype)
        numbers = jnp.concatenate([jnp.zeros(problem.system.n, ctrls.dtype), knots.numbers[0]])
        first = (free, low - numbers, high - numbers)
    reg = jnp.where(reg > LEAST, reg, 0.0)
    return threads(backward_pass, team=True)(
        found.path.A, found.path.B, gaps, found.path.cost, found.end, bounds, first, reg,
        problem.at(knots.numbers[0])[1] if problem.by_velocities else None,
    )  # fmt: skip


def optimised(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: Options, history: int,
    exact: bool,
) -> Iterate:  # fmt: skip
    """The iterations, from states and controls."""
    dtype = ctrls.dtype
    lengths = jnp.asarray([0.5**k for k in range(TRIALS)], dtype)
    if problem.bounded:
        ctrls = jnp.clip(ctrls, problem.low.astype(dtype), problem.high.astype(dtype))

    def direction(now: Iterate, found: Expanded, gaps: jax.Array) -> tuple[Gains, jax.Array]:
        """The gains, with as much regularisation as they need."""

        def harder(state):
            _, reg = state
            reg = jnp.minimum(reg * FACTOR, MOST)
            return gains_of(problem, now.knots, now.ctrls, found, gaps, reg), reg

        def fails(state):
            return ~state[0].ok & (state[1] < MOST)

        begin = gains_of(problem, now.knots, now.ctrls, found, gaps, now.reg), now.reg
        return jax.lax.while_loop(fails, harder, begin)

    def turn(now: Iterate) -> Iterate:
        found = expand(problem, start, now.knots, now.ctrls, now.multipliers)
        gaps = jnp.where(now.feasible, 0.0, found.gaps)
        if exact:
            full = with_curvature(problem, now.knots, now.ctrls, now.multipliers, found)
            gains, reg = gains_of(problem, now.knots, now.ctrls, full, gaps, now.reg), now.reg
            gains, reg = jax.lax.cond(
                gains.ok, lambda: (gains, reg), lambda: direction(now, found, gaps)
            )
        else:
            gains, reg = direction(now, found, gaps)
        tried = jax.vmap(threads(functools.partial(forward_pass, problem)), (None,) * 5 + (0,))(
            now.knots, now.ctrls, gains, gaps, now.multipliers, lengths
        )
        best, accepted = _chosen(found.cost, gains, tried, lengths)
        a = lengths[best]
        step = jax.tree.map(lambda x: x[best], tried)
        knots, ctrls = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old),
            (step.knots, step.ctrls), (now.knots, now.ctrls),
        )  # fmt: skip
        cost = jnp.where(accepted, step.cost, found.cost)
        stop = jnp.abs(gains.slope + 0.5 * gains.curvature)
        eased = jnp.maximum(reg / FACTOR, LEAST)
        reg = jnp.where(accepted & (a > LONG), eased, reg)
        raised = ~accepted | (a <= SHORT)
        stuck = ~gains.ok | (raised & (reg >= MOST))
        reg = jnp.where(raised, jnp.minimum(reg * FACTOR, MOST), reg)
        still = now.feasible & (stop < now.inner)
        turns = now.turns + 1
        outcome = jnp.where(turns >= options.iterations, BUDGET, GOING)
        outcome = jnp.where(stuck, STUCK, outcome)
        known = jnp.isfinite(found.cost) & jnp.isfinite(found.gaps).all()
        outcome = jnp.where(known, outcome, NOT_FINITE)
        after = now._replace(
            knots=knots, ctrls=ctrls, reg=reg, cost=cost, stop=stop, turns=turns,
            feasible=now.feasible | (accepted & (best == 0)), gains=gains,
            costs=now.costs.at[jnp.minimum(now.turns, history - 1)].set(cost),
            outcome=outcome,
        )  # fmt: skip
        if options.say is not None:
            jax.debug.callback(options.say, turns, cost, now.violation)
        return _judged(problem, after, still, options)

    begin = _begun(problem, knots, ctrls, options, history)
    return jax.lax.while_loop(lambda now: now.outcome == GOING, turn, begin)


def _chosen(
    cost: jax.Array, gains: Gains, tried: Tried, lengths: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The longest step whose change of the cost is as foreseen, and whether there is one."""
    slope, curvature = gains.slope + tried.cross, gains.curvature - 2 * tried.cross
    foreseen = lengths * (slope + 0.5 * lengths * curvature)
    change = tried.cost - cost
    tiny = 1e-12
    falls = (foreseen <= 0) & ((jnp.abs(slope) < tiny) | (change < ACCEPTED * foreseen))
    rises = (foreseen > 0) & (change < ASCENT * foreseen)
    # closing the gaps may cost something: then the rise must be less than twice what is foreseen
    good = jnp.isfinite(tried.cost) & gains.ok & (falls | rises)
    return jnp.argmax(good), good.any()


def _judged(problem: Problem, now: Iterate, still: jax.Array, options: Options) -> Iterate:
    """Whether an iterate ends the search; else, where it is still, with new multipliers."""
    if not problem.constraints:
        return now._replace(outcome=jnp.where(still, CONVERGED, now.outcome))

    look = threads(functools.partial(updated, problem))
    path, end, violation = look(now.knots, now.ctrls, now.multipliers)
    held = violation <= options.violation
    done = still & held & (now.inner <= options.tolerance)
    mu = now.multipliers.penalty
    change = still & ~done
    failing = (violation > 0.25 * now.before) & ~held
    hopeless = change & failing & (mu >= PENALTY_MOST)
    pick = lambda new, old: jnp.where(change, new, old)  # noqa: E731
    harder = jnp.where(failing, jnp.minimum(mu * HARDER, PENALTY_MOST), mu)
    multipliers = Multipliers(
        pick(path, now.multipliers.path), pick(end, now.multipliers.end), pick(harder, mu)
    )
    outcome = jnp.where(hopeless, INFEASIBLE, now.outcome)
    return now._replace(
        multipliers=multipliers, violation=violation, before=pick(violation, now.before),
        inner=pick(jnp.maximum(0.03 * now.inner, options.tolerance), now.inner),
        reg=pick(jnp.asarray(LEAST, now.reg.dtype), now.reg),
        outcome=jnp.where(done, CONVERGED, outcome),
    )  # fmt: skip


def updated(
    problem: Problem, knots: Knot, ctrls: jax.Array, multipliers: Multipliers
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The next multipliers of path and end, and the largest violation."""
    N, dtype, mu = problem.horizon, ctrls.dtype, multipliers.penalty

    def one(c: jax.Array, rows: jax.Array, where: str) -> tuple[jax.Array, jax.Array]:
        low, high = limits(problem, where, c)
        s = c + rows / mu
        off = jnp.abs(c - jnp.clip(c, low, high))
        return mu * (s - jnp.clip(s, low, high)), off.max(initial=0.0)

    def look(worst: jax.Array, x: tuple) -> tuple:
        k, knot, ctrl, rows = x
        new, off = one(problem.rows(k, knot, ctrl, "path"), rows, "path")
        return jnp.maximum(worst, off), new

    body = jax.tree.map(lambda x: x[:-1], knots)
    last = jax.tree.map(lambda x: x[-1], knots)
    ks = jnp.arange(N, dtype=dtype)
    found: Any = jax.lax.scan(look, jnp.zeros((), dtype), (ks, body, ctrls, multipliers.path))
    worst, path = found
    none = jnp.zeros(problem.nu, dtype)
    end, off = one(problem.rows(N, last, none, "end"), multipliers.end, "end")
    return path, end, jnp.maximum(worst, off)


def _begun(
    problem: Problem, knots: Knot, ctrls: jax.Array, options: Options, history: int
) -> Iterate:
    dtype = ctrls.dtype
    N, n, m = problem.horizon, problem.n, problem.nu
    sizes = [row_count(problem, where) for where in ("path", "end")]
    number = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    none = Gains(
        jnp.zeros((N, m, n), dtype), jnp.zeros((N, m), dtype), jnp.zeros((N + 1, n, n), dtype),
        jnp.zeros((N + 1, n), dtype), jnp.zeros(n, dtype), number(0), number(0), jnp.asarray(True),
    )  # fmt: skip
    first = options.tolerance if not problem.constraints else jnp.maximum(
        options.tolerance, 1e-3
    )
    return Iterate(
        knots, ctrls, jnp.asarray(False),
        Multipliers(jnp.zeros((N, sizes[0]), dtype), jnp.zeros(sizes[1], dtype), number(PENALTY)),
        number(LEAST), number(jnp.inf), number(jnp.inf), number(0), number(jnp.inf),
        first.astype(dtype), jnp.asarray(0), jnp.asarray(GOING), none,
        jnp.full(history, jnp.nan, dtype),
    )  # fmt: skip
