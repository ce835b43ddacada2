"""Differential dynamic programming with multiple shooting, boxes and constraints.

Each iteration expands the problem at its knots (`knots`), finds gains (`backward_pass`), tries
steps of 1, 1/2, 1/4 ... side by side (`forward_pass`), and takes the longest that lowers the cost
as foreseen (`verdict`). States may begin anywhere: gaps close as steps are taken (Mastalli et al.
2020, *Crocoddyl*, whose rules of acceptance and regularisation these are). Around it, constraints
are held by an augmented Lagrangian (`augmented_lagrangian`).

Expansion, passes, trials and the verdict are programs of one sample (`rb.threads`): of a knot, of a
problem, of a trial. What a method tries is a `Way`: here motions along the dynamics, in `sqp` steps
of the linear model.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.optimal.constraint_rows import row_count
from rbjax.control.optimal.objective import motion_cost
from rbjax.control.optimal.options import Options
from rbjax.control.optimal.problem import Knot, Problem
from rbjax.control.optimal.shooting.augmented_lagrangian import Multipliers, no_multipliers
from rbjax.control.optimal.shooting.backward_pass import Bounds, Feedback, backward_pass
from rbjax.control.optimal.shooting.filter_search import rounding
from rbjax.control.optimal.shooting.forward_pass import Tried, forward_pass, within_bounds
from rbjax.control.optimal.shooting.knots import (
    Expanded,
    expand,
    largest_gap,
    updated,
    with_curvature,
)
from rbjax.control.optimal.shooting.verdict import (
    LEAST,
    LENGTHS,
    Limits,
    Measures,
    Rules,
    Standing,
    Verdict,
    begun,
    verdict,
)
from rbjax.control.optimal.solution import Found
from rbjax.control.status import GOING
from rbjax.threads import threads

ACCEPTED, ASCENT = 0.1, 2.0  # shares of the foreseen change


class Iterate(NamedTuple):
    """What an iteration leaves to the next: knots (N + 1, ...), ctrls (N, m), multipliers, the
    gains K (N, m, n), where it stands, and the costs (history,) of each iteration."""

    knots: Knot
    ctrls: jax.Array
    multipliers: Multipliers
    K: jax.Array
    standing: Standing
    costs: jax.Array


class Way(NamedTuple):
    """How a method steps. rules: of its verdict. tries: (problem, now, expanded, gaps, gains) ->
    what it tried, which has costs, offs and more of `Measures`. moved: (problem, now, tried,
    verdict) -> knots and controls."""

    rules: Rules
    tries: Callable[..., Any]
    moved: Callable[..., tuple[Knot, jax.Array]]


def by_ddp(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: Options, history: int,
    exact: bool = False,
) -> Found:  # fmt: skip
    """`solve` by differential dynamic programming. exact: with second derivatives of dynamics and
    residuals, where they leave the control Hessians positive definite."""
    return searched(ALONG_DYNAMICS, problem, start, knots, ctrls, options, history, exact)


def searched(
    way: Way, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: Options,
    history: int, exact: bool = False,
) -> Found:  # fmt: skip
    """`solve` in a way."""
    last = optimised(way, problem, start, knots, ctrls, options, history, exact)
    path, end = last.multipliers.path, last.multipliers.end
    if problem.constraints:  # the gradient of the augmented Lagrangian is that with these
        path, end = updated(problem, last.knots, last.ctrls, last.multipliers)
    at = last.standing
    return Found(
        last.knots, last.ctrls, motion_cost(problem, last.knots, last.ctrls), at.outcome, at.turns,
        at.stop, largest_gap(problem, start, last.knots, last.ctrls), at.violation, last.costs,
        last.K, path, end, penalty=last.multipliers.penalty,
    )  # fmt: skip


def gains_of(
    problem: Problem, knots: Knot, ctrls: jax.Array, found: Expanded, gaps: jax.Array, reg: Any,
    boxed: bool = False,
) -> Feedback:  # fmt: skip
    """The backward pass at knots. boxed: whether k obeys all bounds, or only the bounds at which
    the controls already are.

    k is the step if the state stays at its knot. If gaps or a long step move the state, a bound
    that binds k need not bind k + K dx. A bound that binds removes its row of K, so the closed loop
    may be unstable, and the bound then binds in all later iterations.
    """
    bounds = None
    if problem.bounded:
        low, high = (x.astype(ctrls.dtype) - ctrls for x in (problem.low, problem.high))
        huge = jnp.finfo(ctrls.dtype).max
        if not boxed:
            low, high = jnp.where(low < 0, -huge, low), jnp.where(high > 0, huge, high)
        bounds = Bounds(jnp.maximum(low, -huge), jnp.minimum(high, huge))
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
    way: Way, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: Options,
    history: int, exact: bool,
) -> Iterate:  # fmt: skip
    """The iterations, from states and controls."""
    constrained = bool(problem.constraints)
    limits = Limits(options.tolerance, options.violation, options.iterations, options.scale)
    judge = threads(functools.partial(verdict, way.rules, constrained))

    def gains_at(now: Iterate, found: Expanded, gaps: jax.Array) -> Feedback:
        reg = now.standing.reg
        # with second derivatives, steps along the dynamics are short: k obeys all bounds there
        boxed = exact and way.rules.closes
        plain = functools.partial(gains_of, problem, now.knots, now.ctrls, boxed=boxed)
        if not exact:
            return plain(found, gaps, reg)
        full = plain(
            with_curvature(problem, now.knots, now.ctrls, now.multipliers, found), gaps, reg
        )
        return jax.lax.cond(full.ok, lambda: full, lambda: plain(found, gaps, reg))

    def turn(now: Iterate) -> Iterate:
        at = now.standing
        found = expand(problem, start, now.knots, now.ctrls, now.multipliers)
        gaps = jnp.where(at.feasible, 0.0, found.gaps) if way.rules.closes else found.gaps
        gains = gains_at(now, found, gaps)
        tried = way.tries(problem, now, found, gaps, gains)
        decided = judge(
            at, limits,
            Measures(
                found.cost, found.gap, found.violation, gains.slope, gains.curvature, gains.square,
                gains.ok, tried.costs, tried.offs, tried.more,
            ),
        )  # fmt: skip
        knots, ctrls = way.moved(problem, now, tried, decided)
        after, multipliers = decided.standing, now.multipliers
        if constrained:
            new = updated(problem, knots, ctrls, multipliers)
            path, end = jax.tree.map(
                lambda x, old: jnp.where(decided.change, x, old), new, multipliers[:2]
            )
            multipliers = Multipliers(path, end, after.penalty)
        if options.say is not None:
            jax.debug.callback(options.say, after.turns, after.cost, after.violation)
        costs = now.costs.at[jnp.minimum(at.turns, history - 1)].set(after.cost)
        return Iterate(knots, ctrls, multipliers, gains.K, after, costs)

    begin = _begun(problem, knots, ctrls, limits, history, options.multipliers)
    return jax.lax.while_loop(lambda now: now.standing.outcome == GOING, turn, begin)


def _begun(
    problem: Problem, knots: Knot, ctrls: jax.Array, limits: Limits, history: int,
    multipliers: Multipliers | None = None,
) -> Iterate:  # fmt: skip
    dtype, N = ctrls.dtype, problem.horizon
    ctrls = within_bounds(problem, ctrls)
    if multipliers is None:
        path, end = (row_count(problem, where) for where in ("path", "end"))
        multipliers = no_multipliers(N, path, end, dtype)
    return Iterate(
        knots, ctrls, multipliers, jnp.zeros((N, problem.nu, problem.n), dtype),
        begun(limits, bool(problem.constraints), multipliers.penalty),
        jnp.full(history, jnp.nan, dtype),
    )  # fmt: skip


# ------------------------------------------------------------ along the dynamics


def _rolled(
    problem: Problem, now: Iterate, found: Expanded, gaps: jax.Array, gains: Feedback
) -> Tried:
    """The motions of all lengths."""
    lengths = jnp.asarray(LENGTHS, now.ctrls.dtype)
    run = threads(functools.partial(forward_pass, problem))
    return jax.vmap(run, (None,) * 5 + (0,))(
        now.knots, now.ctrls, gains, gaps, now.multipliers, lengths
    )


def _picked(
    problem: Problem, now: Iterate, tried: Tried, decided: Verdict
) -> tuple[Knot, jax.Array]:
    """The motion that was taken."""
    return jax.tree.map(
        lambda new, old: jnp.where(decided.accepted, new[decided.best], old),
        (tried.knots, tried.ctrls), (now.knots, now.ctrls),
    )  # fmt: skip


def _as_foreseen(seen: Measures, lengths: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whether the cost changes as foreseen."""
    cross = seen.more
    slope, curvature = seen.slope + cross, seen.curvature - 2 * cross
    foreseen = lengths * (slope + 0.5 * lengths * curvature)
    change = seen.costs - seen.cost
    change = change - rounding(seen.cost)
    falls = (foreseen <= 0) & (change <= ACCEPTED * foreseen)
    # closing the gaps may cost something: then the rise must be less than twice what is foreseen
    rises = (foreseen > 0) & (change < ASCENT * foreseen)
    return falls | rises, jnp.abs(seen.slope + 0.5 * seen.curvature)


ALONG_DYNAMICS = Way(Rules(_as_foreseen, True), _rolled, _picked)
