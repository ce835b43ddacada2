"""Differential dynamic programming with multiple shooting, boxes and constraints.

Each iteration expands the problem at its knots (`knots`), computes gains (`backward_pass`), rolls
out steps of 1, 1/2, 1/4 ... side by side (`forward_pass`), and takes the longest that lowers the
cost as expected (`search_state`). The states of the guess need not obey the dynamics: gaps close as
steps are taken (Mastalli et al. 2020, *Crocoddyl*, whose rules of acceptance and regularisation
these are). An augmented Lagrangian around it holds constraints (`augmented_lagrangian`).

Expansion, passes, trials and the decision are programs of one sample (`rb.threads`): of a knot, of
a problem, of a trial. A `StepPolicy` makes the trials: here rollouts of the dynamics, in `sqp`
steps of the linear model.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiler import threads
from rbjax.control.optimal.objective import Multipliers, motion_cost, no_multipliers, row_count
from rbjax.control.optimal.options import Options, StoppingRule
from rbjax.control.optimal.problem import Knot, Problem
from rbjax.control.optimal.shooting.backward_pass import Bounds, Feedback, backward_pass
from rbjax.control.optimal.shooting.filter_search import rounding
from rbjax.control.optimal.shooting.forward_pass import Rollout, forward_pass
from rbjax.control.optimal.shooting.knots import (
    Expanded,
    add_curvature,
    expand,
    largest_gap,
    updated_multipliers,
)
from rbjax.control.optimal.shooting.search_state import (
    LEAST,
    LENGTHS,
    Accept,
    Decision,
    IterationValues,
    SearchState,
    decide,
    initial_search_state,
)
from rbjax.control.optimal.solution import SearchResult
from rbjax.control.status import GOING

ACCEPTED, ASCENT = 0.1, 2.0  # shares of the expected change


class Iterate(NamedTuple):
    """The iterate of a search: knots (N + 1, ...), ctrls (N, m), multipliers, the gains K
    (N, m, n), the state of the search, and the costs (history,) of its iterations."""

    knots: Knot
    ctrls: jax.Array
    multipliers: Multipliers
    K: jax.Array
    search: SearchState
    costs: jax.Array


class StepPolicy(NamedTuple):
    """How a method steps.

    accept: which trials may be taken.
    closes_gaps: whether a full step leaves no gap.
    trials: (problem, now, expanded, gaps, gains) -> trials with the costs, violations and more of
        `IterationValues`.
    apply: (problem, now, trials, decision) -> knots and controls.
    """

    accept: Accept
    closes_gaps: bool
    trials: Callable[..., Any]
    apply: Callable[..., tuple[Knot, jax.Array]]


def by_ddp(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: Options, history: int,
    exact: bool = False,
) -> SearchResult:  # fmt: skip
    """`solve` by differential dynamic programming. exact: with second derivatives of dynamics and
    residuals, where they leave the control Hessians positive definite."""
    return search(ROLLOUTS, problem, start, knots, ctrls, options, history, exact)


def search(
    policy: StepPolicy, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array,
    options: Options, history: int, exact: bool = False,
) -> SearchResult:  # fmt: skip
    """`solve` by the steps of a policy."""
    last = iterate(policy, problem, start, knots, ctrls, options, history, exact)
    path, end = last.multipliers.path, last.multipliers.end
    if problem.constraints:  # the gradient of the augmented Lagrangian is that with these
        path, end = updated_multipliers(problem, last.knots, last.ctrls, last.multipliers)
    at, cost = last.search, motion_cost(problem, last.knots, last.ctrls)
    return SearchResult(
        last.knots, last.ctrls, cost, at.status, at.iterations, at.expected_decrease,
        largest_gap(problem, start, last.knots, last.ctrls), at.violation, last.costs,
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
    if problem.free_first_knot:
        free = jnp.asarray([*problem.free, *[True] * problem.parameter_count], ctrls.dtype)
        low, high = problem.start_bounds(ctrls.dtype)
        zero = jnp.zeros(problem.system.n, ctrls.dtype)
        parameters = jnp.concatenate([zero, knots.parameters[0]])
        first = (free, low - parameters, high - parameters)
    reg = jnp.where(reg > LEAST, reg, 0.0)
    return threads(backward_pass, team=True)(
        found.path.A, found.path.B, gaps, found.path.cost, found.end, bounds, first, reg,
        problem.at(knots.parameters[0])[1] if problem.by_velocities else None,
    )  # fmt: skip


def iterate(
    policy: StepPolicy, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array,
    options: Options, history: int, exact: bool,
) -> Iterate:  # fmt: skip
    """The iterations, from states and controls."""
    constrained = bool(problem.constraints)
    decision = threads(functools.partial(decide, policy.accept, policy.closes_gaps, constrained))

    def gains_at(now: Iterate, found: Expanded, gaps: jax.Array) -> Feedback:
        reg = now.search.reg
        # with second derivatives, steps along the dynamics are short: k obeys all bounds there
        boxed = exact and policy.closes_gaps
        plain = functools.partial(gains_of, problem, now.knots, now.ctrls, boxed=boxed)
        if not exact:
            return plain(found, gaps, reg)
        full = plain(
            add_curvature(problem, now.knots, now.ctrls, now.multipliers, found), gaps, reg
        )
        return jax.lax.cond(full.ok, lambda: full, lambda: plain(found, gaps, reg))

    def turn(now: Iterate) -> Iterate:
        at = now.search
        found = expand(problem, start, now.knots, now.ctrls, now.multipliers)
        gaps = jnp.where(at.feasible, 0.0, found.gaps) if policy.closes_gaps else found.gaps
        gains = gains_at(now, found, gaps)
        trials = policy.trials(problem, now, found, gaps, gains)
        decided = decision(
            at, options.rule,
            IterationValues(
                found.cost, found.gap, found.violation, gains.slope, gains.curvature, gains.square,
                gains.ok, trials.costs, trials.violations, trials.more,
            ),
        )  # fmt: skip
        knots, ctrls = policy.apply(problem, now, trials, decided)
        after, multipliers = decided.search, now.multipliers
        if constrained:
            new = updated_multipliers(problem, knots, ctrls, multipliers)
            path, end = jax.tree.map(
                lambda x, old: jnp.where(decided.new_multipliers, x, old), new, multipliers[:2]
            )
            multipliers = Multipliers(path, end, after.penalty)
        if options.report is not None:
            jax.debug.callback(options.report, after.iterations, after.cost, after.violation)
        costs = now.costs.at[jnp.minimum(at.iterations, history - 1)].set(after.cost)
        return Iterate(knots, ctrls, multipliers, gains.K, after, costs)

    begin = initial_iterate(problem, knots, ctrls, options.rule, history, options.multipliers)
    return jax.lax.while_loop(lambda now: now.search.status == GOING, turn, begin)


def initial_iterate(
    problem: Problem, knots: Knot, ctrls: jax.Array, rule: StoppingRule, history: int,
    multipliers: Multipliers | None = None,
) -> Iterate:  # fmt: skip
    """The iterate from which a search starts."""
    dtype, N = ctrls.dtype, problem.horizon
    ctrls = problem.within_bounds(ctrls)
    if multipliers is None:
        path, end = (row_count(problem, where) for where in ("path", "end"))
        multipliers = no_multipliers(N, path, end, dtype)
    return Iterate(
        knots, ctrls, multipliers, jnp.zeros((N, problem.nu, problem.n), dtype),
        initial_search_state(rule, bool(problem.constraints), multipliers.penalty),
        jnp.full(history, jnp.nan, dtype),
    )  # fmt: skip


# ------------------------------------------------------------ rollouts of the dynamics


def _rollouts(
    problem: Problem, now: Iterate, found: Expanded, gaps: jax.Array, gains: Feedback
) -> Rollout:
    """The motions of all lengths."""
    lengths = jnp.asarray(LENGTHS, now.ctrls.dtype)
    run = threads(functools.partial(forward_pass, problem))
    return jax.vmap(run, (None,) * 5 + (0,))(
        now.knots, now.ctrls, gains, gaps, now.multipliers, lengths
    )


def _take_rollout(
    problem: Problem, now: Iterate, trials: Rollout, decided: Decision
) -> tuple[Knot, jax.Array]:
    """The motion of the accepted trial."""
    return jax.tree.map(
        lambda new, old: jnp.where(decided.accepted, new[decided.best], old),
        (trials.knots, trials.ctrls), (now.knots, now.ctrls),
    )  # fmt: skip


def _decreases_as_expected(
    values: IterationValues, lengths: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Whether the cost changes as its quadratic model predicts."""
    cross = values.more
    slope, curvature = values.slope + cross, values.curvature - 2 * cross
    expected = lengths * (slope + 0.5 * lengths * curvature)
    change = values.costs - values.cost
    change = change - rounding(values.cost)
    falls = (expected <= 0) & (change <= ACCEPTED * expected)
    # closing the gaps may raise the cost: then by less than twice the expected rise
    rises = (expected > 0) & (change < ASCENT * expected)
    return falls | rises, jnp.abs(values.slope + 0.5 * values.curvature)


ROLLOUTS = StepPolicy(_decreases_as_expected, True, _rollouts, _take_rollout)
