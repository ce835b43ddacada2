"""The iterations of differential dynamic programming and of sequential quadratic programming.

An iteration expands the problem at its knots, computes gains, evaluates trial steps of a
`StepPolicy`, and applies the longest trial that the policy accepts. The regularisation falls
tenfold after a step longer than 0.5. It rises tenfold after a step of at most 0.01, after a
rejected step, or if the gains do not exist (Mastalli et al. 2020). The search is stuck if the
largest regularisation gives no step, or if many steps lower the cost only by rounding; with
constraints it first gets new multipliers (`renews`). If the expected decrease of the cost is
small, the multipliers of the constraints are updated, or the search has converged. With
regularisation, the gradient must be small too.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler import threads
from rbjax.control.optimal.objective import (
    HARDER,
    PENALTY,
    PENALTY_MOST,
    ConstraintMultipliers,
    motion_cost,
    next_penalty,
    no_multipliers,
    row_count,
)
from rbjax.control.optimal.problem import Knot, Problem
from rbjax.control.optimal.shooting.backward_pass import Bounds, Feedback, backward_pass
from rbjax.control.optimal.shooting.expansion import (
    Expanded,
    add_curvature,
    expand,
    largest_gap,
    updated_multipliers,
)
from rbjax.control.optimal.shooting.filter_search import rounding
from rbjax.control.optimal.solution import SearchResult, SolveOptions, StoppingRule
from rbjax.control.status import BUDGET, CONVERGED, GOING, INFEASIBLE, NOT_FINITE, STUCK
from rbjax.lanes.arrays import select

LEAST, MOST, FACTOR = 1e-9, 1e9, 10.0  # of the regularisation; LEAST means none
LENGTHS = 0.5 ** np.arange(10)  # lengths of the trial steps
LONG, SHORT = 0.5, 0.01  # step lengths that lower and raise the regularisation
SHORT_CONSTRAINED = 0.3  # with constraints, which add curvature that the model omits
LOOSE, CLOSER = 1e-3, 0.3  # tolerance before the first multipliers; its factor at each
FLOOR = 10.0  # smallest tolerance, in units in the last place
SOFTEST_AT_REST, HARDEST_AT_REST = 1e3, 1e6  # range of the penalty, see `renews`
MAX_STALLED = 50  # maximum number of consecutive iterations that lower the cost only by rounding


class SearchState(NamedTuple):
    """The state of a search between two iterations: costs, tolerances, counters, each ()."""

    feasible: jax.Array  # true if the motion has no gaps
    reg: jax.Array  # the regularisation
    cost: jax.Array  # cost of the motion
    scale: jax.Array  # the tolerance is relative to it if the cost is less
    expected_decrease: jax.Array  # expected decrease of the cost by the last step
    violation: jax.Array  # largest constraint violation
    violation_before: jax.Array  # violation at the last change of the multipliers
    inner_tolerance: jax.Array  # tolerance of the search with the present multipliers
    iterations: jax.Array  # so far
    status: jax.Array  # a value of `rbjax.control.status`
    penalty: jax.Array  # penalty of the augmented Lagrangian
    reference_cost: jax.Array  # the cost at its last fall by more than rounding
    stalled: jax.Array  # iterations since then


class IterationValues(NamedTuple):
    """Cost, gap, violation and slopes of an iteration, and the costs of its trial steps."""

    cost: jax.Array  # (), of the present motion
    gap: jax.Array  # ()
    violation: jax.Array  # ()
    slope: jax.Array  # (), of the cost along the step
    curvature: jax.Array  # ()
    square: jax.Array  # (), the squared norm of the gradient without regularisation
    ok: jax.Array  # (), whether the gains exist
    costs: jax.Array  # (T,), of the trials
    violations: jax.Array  # (T,)
    more: Any  # further values of the method
    noise: jax.Array | None = None  # (), of the cost, by the rounding of the constraints


class Decision(NamedTuple):
    """The trial step that an iteration accepts, and the next state of the search."""

    search: SearchState  # the state after the iteration
    best: jax.Array  # the index of a trial
    length: jax.Array
    accepted: jax.Array
    new_multipliers: jax.Array  # true if the multipliers change


#: (values, lengths) -> mask (T,) of acceptable trials, and the expected decrease () of the cost
Accept = Callable[[IterationValues, jax.Array], tuple[jax.Array, jax.Array]]


def initial_search_state(rule: StoppingRule, constrained: bool, penalty: jax.Array) -> SearchState:
    """Return the state before the first iteration."""
    dtype = penalty.dtype
    number = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    least = jnp.maximum(rule.tolerance, FLOOR * jnp.finfo(dtype).eps)
    inner = jnp.maximum(least, LOOSE) if constrained else least
    scale = number(-1) if rule.scale is None else number(rule.scale)
    return SearchState(
        jnp.asarray(False), number(LEAST), number(jnp.inf), scale, number(jnp.inf), number(0),
        number(jnp.inf), inner.astype(dtype), jnp.asarray(0), jnp.asarray(GOING), penalty,
        number(jnp.inf), jnp.asarray(0),
    )  # fmt: skip


def decide(
    accept: Accept, closes_gaps: bool, constrained: bool, now: SearchState, rule: StoppingRule,
    values: IterationValues,
) -> Decision:  # fmt: skip
    """Decide on the step and the state after an iteration.

    closes_gaps: true if a full step leaves no gap.
    """
    dtype = values.cost.dtype
    lengths = jnp.asarray(LENGTHS, dtype)
    good, decrease = accept(values, lengths)
    good = good & jnp.isfinite(values.costs) & values.ok
    decrease = jnp.where(values.ok, decrease, now.expected_decrease)
    best, accepted = jnp.argmax(good), good.any()
    length = lengths[best]
    cost = jnp.where(accepted, values.costs[best], values.cost)
    off = jnp.where(accepted, values.violations[best], values.violation)

    reg = jnp.where(accepted & (length > LONG), jnp.maximum(now.reg / FACTOR, LEAST), now.reg)
    raised = ~accepted | (length <= (SHORT_CONSTRAINED if constrained else SHORT))
    stuck = raised & (reg >= MOST)
    reg = jnp.where(raised, jnp.minimum(reg * FACTOR, MOST), reg)

    if closes_gaps:
        here, feasible = now.feasible, now.feasible | (accepted & (best == 0))
    else:
        feasible = values.gap <= gap_tolerance(dtype)
        here = feasible | (constrained & (values.gap <= now.inner_tolerance))
    first = jnp.minimum(jnp.abs(values.cost), 1.0)
    scale = jnp.where(now.scale < 0, first, now.scale)
    share = jnp.maximum(scale, jnp.abs(values.cost))
    small = functools.partial(_small, now, values, decrease, share)
    stationary = here & small(now.inner_tolerance)
    # gains that do not exist are computed again with more regularisation, as the same iteration
    iterations = now.iterations + values.ok.astype(now.iterations.dtype)
    status = jnp.where(iterations >= rule.iterations, BUDGET, GOING)
    reference, stalled = count_stalled(
        now.reference_cost, now.stalled, cost, values.gap <= gap_tolerance(dtype)
    )
    rests = stuck | (stalled >= MAX_STALLED)
    status = jnp.where(rests, STUCK, status)
    finite = jnp.isfinite(values.cost) & jnp.isfinite(values.gap)
    status = jnp.where(finite, status, NOT_FINITE)
    if not constrained:
        status = jnp.where(stationary, CONVERGED, status)
        after = now._replace(
            feasible=feasible, reg=reg, cost=cost, scale=scale, expected_decrease=decrease,
            iterations=iterations, status=status, reference_cost=reference, stalled=stalled,
        )  # fmt: skip
        return Decision(after, best, length, accepted, jnp.asarray(False))

    satisfied = off <= rule.violation
    least = jnp.maximum(rule.tolerance.astype(dtype), FLOOR * jnp.finfo(dtype).eps)
    done = stationary & small(least) & satisfied & (True if closes_gaps else feasible)
    change = stationary & ~done
    penalty, failing = next_penalty(now.penalty, off, now.violation_before, satisfied)
    hopeless = change & failing & (now.penalty >= PENALTY_MOST)
    renewed = rests & here & renews(now, cost, off, satisfied)
    softer = jnp.maximum(now.penalty / HARDER, PENALTY)
    softens = renewed & satisfied
    penalty = jnp.where(softens, softer, penalty)
    # multipliers of a harder penalty carry its rounding, which violates the constraints more with
    # a softer one: the next violation has nothing to compare with
    before = jnp.where(softens, jnp.inf, off)
    status = jnp.where(renewed & (status == STUCK), GOING, status)
    change = change | renewed
    status = jnp.where(hopeless, INFEASIBLE, status)
    inner = jnp.maximum(CLOSER * now.inner_tolerance, least)
    change = change & (status == GOING)  # a search that ends keeps its multipliers
    after = SearchState(
        feasible, jnp.where(change, LEAST, reg).astype(dtype), cost, scale, decrease, off,
        jnp.where(change, before, now.violation_before).astype(dtype),
        jnp.where(change, inner, now.inner_tolerance), iterations,
        jnp.where(done, CONVERGED, status), jnp.where(change, penalty, now.penalty),
        jnp.where(change, jnp.inf, reference).astype(dtype), jnp.where(change, 0, stalled),
    )  # fmt: skip
    return Decision(after, best, length, accepted, change)


def renews(
    now: SearchState, cost: jax.Array, violation: jax.Array, satisfied: jax.Array
) -> jax.Array:
    """Return whether a search at rest gets new multipliers instead of ending as stuck.

    A search is at rest if the merit function changes only by rounding. New multipliers help while
    they reduce the violation c. A larger penalty helps while its term, penalty c^2 / 2, is smaller
    than the rounding error of the cost. If the constraints are satisfied, a smaller penalty helps:
    the optimum is the same, and the rounding error of the gradient is smaller.
    """
    hidden = 0.5 * now.penalty * violation * violation <= rounding(cost)
    hardest = jnp.where(hidden, PENALTY_MOST, HARDEST_AT_REST)
    falls = (violation < now.violation_before) | (now.penalty < hardest)
    return jnp.where(satisfied, now.penalty > SOFTEST_AT_REST, falls)


def _small(
    now: SearchState, values: IterationValues, decrease: Any, share: Any, tolerance: Any
) -> jax.Array:
    """Return whether the search has converged, by the expected decrease of the cost and the
    gradient.

    The gradient has to be small only if the control Hessians are regularised. With constraints, a
    decrease below `cost_noise` counts as zero.

    tolerance: relative to `share`, the scale of the cost.
    """
    flat = jnp.sqrt(values.square) <= jnp.sqrt(tolerance) * share
    least = tolerance * share
    if values.noise is not None:
        least = jnp.maximum(least, values.noise)
    return values.ok & (decrease <= least) & ((now.reg <= LEAST) | flat)


def cost_noise(multipliers: ConstraintMultipliers) -> jax.Array:
    """Return the error () of the cost by constraints that are met to `FLOOR` units in the last
    place of 1. The multipliers are the derivatives of the cost with respect to the constraints."""
    squares = (multipliers.path**2).sum() + (multipliers.end**2).sum()
    return FLOOR * jnp.finfo(squares.dtype).eps * jnp.sqrt(squares)


def count_stalled(
    reference: jax.Array, stalled: jax.Array, cost: jax.Array, closed: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the cost () at its last decrease beyond rounding, and the iterations () since then.

    closed: true if the gaps are closed; before that the cost may rise.
    """
    lower = ~closed | (cost < reference - rounding(reference)) | ~jnp.isfinite(reference)
    return jnp.where(lower, cost, reference), jnp.where(lower, 0, stalled + 1)


def gap_tolerance(dtype: Any) -> float:
    """Return the largest gap that counts as closed: 4e-10 in f64."""
    return float(jnp.finfo(dtype).eps) ** 0.6


class SearchIterate(NamedTuple):
    """The iterate of a search.

    knots, ctrl: the motion, (N + 1, ...) and (N, m).
    multipliers: of the constraints.
    K: gains, (N, m, n).
    search: the state of the search.
    costs: cost after each iteration, (history,).
    """

    knots: Knot
    ctrl: jax.Array
    multipliers: ConstraintMultipliers
    K: jax.Array
    search: SearchState
    costs: jax.Array


class StepPolicy(NamedTuple):
    """The step rule of a method.

    accept: see `Accept`.
    closes_gaps: true if a full step leaves no gap.
    trials: (problem, now, expanded, gaps, gains) -> trials, with the fields costs, violations and
        more of `IterationValues`.
    apply: (problem, now, trials, decision) -> knots and controls.
    """

    accept: Accept  # which trials may be taken
    closes_gaps: bool  # true if a full step leaves no gap
    trials: Callable[..., Any]
    apply: Callable[..., tuple[Knot, jax.Array]]


def search(
    policy: StepPolicy, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array,
    options: SolveOptions, history: int, exact: bool = False,
) -> SearchResult:  # fmt: skip
    """Solve a problem by iterations whose steps a `StepPolicy` tries and accepts."""
    last = iterate(policy, problem, start, knots, ctrls, options, history, exact)
    path, end = last.multipliers.path, last.multipliers.end
    if problem.constraints:  # L then has the augmented gradient
        path, end = updated_multipliers(problem, last.knots, last.ctrl, last.multipliers)
    at, cost = last.search, motion_cost(problem, last.knots, last.ctrl)
    return SearchResult(
        last.knots, last.ctrl, cost, at.status, at.iterations, at.expected_decrease,
        largest_gap(problem, start, last.knots, last.ctrl), at.violation, last.costs,
        last.K, path, end, penalty=last.multipliers.penalty,
    )  # fmt: skip


def compute_gains(
    problem: Problem, knots: Knot, ctrls: jax.Array, found: Expanded, gaps: jax.Array, reg: Any,
    boxed: bool = False,
) -> Feedback:  # fmt: skip
    """Run the backward pass at the knots. boxed: if true, k obeys all bounds, else only the active
    ones. A newly active bound removes its row of K, which may make the closed loop unstable."""
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
        endless = jnp.full(problem.system.n, jnp.inf, ctrls.dtype)
        low, high = (x - knots.parameters[0] for x in problem.parameter_bounds(ctrls.dtype))
        first = (free, jnp.concatenate([-endless, low]), jnp.concatenate([endless, high]))
    reg = jnp.where(reg > LEAST, reg, 0.0)
    return threads(backward_pass, team=True)(
        found.path.A, found.path.B, gaps, found.path.cost, found.end, bounds, first, reg,
        problem.at(knots.parameters[0])[1] if problem.by_velocities else None,
    )  # fmt: skip


def iterate(
    policy: StepPolicy, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array,
    options: SolveOptions, history: int, exact: bool,
) -> SearchIterate:  # fmt: skip
    """Iterate from the knots and controls of the first guess until the stopping rule holds."""
    constrained = bool(problem.constraints)
    decision = threads(functools.partial(decide, policy.accept, policy.closes_gaps, constrained))

    def gains_at(now: SearchIterate, found: Expanded, gaps: jax.Array) -> Feedback:
        reg = now.search.reg
        # with second derivatives, steps along the dynamics are short, so k obeys all bounds
        boxed = exact and policy.closes_gaps
        plain = functools.partial(compute_gains, problem, now.knots, now.ctrl, boxed=boxed)
        if not exact:
            return plain(found, gaps, reg)
        full = plain(add_curvature(problem, now.knots, now.ctrl, now.multipliers, found), gaps, reg)
        return jax.lax.cond(full.ok, lambda: full, lambda: plain(found, gaps, reg))

    def turn(now: SearchIterate) -> SearchIterate:
        at = now.search
        found = expand(problem, start, now.knots, now.ctrl, now.multipliers)
        gaps = jnp.where(at.feasible, 0.0, found.gaps) if policy.closes_gaps else found.gaps
        gains = gains_at(now, found, gaps)
        trials = policy.trials(problem, now, found, gaps, gains)
        decided = decision(
            at, options.rule,
            IterationValues(
                found.cost, found.gap, found.violation, gains.slope, gains.curvature, gains.square,
                gains.ok, trials.costs, trials.violations, trials.more,
                cost_noise(now.multipliers) if constrained else None,
            ),
        )  # fmt: skip
        knots, ctrls = policy.apply(problem, now, trials, decided)
        after, multipliers = decided.search, now.multipliers
        if constrained:
            new = updated_multipliers(problem, knots, ctrls, multipliers)
            path, end = select(decided.new_multipliers, new, multipliers[:2])
            multipliers = ConstraintMultipliers(path, end, after.penalty)
        if options.report is not None:
            jax.debug.callback(options.report, after.iterations, after.cost, after.violation)
        costs = now.costs.at[jnp.minimum(at.iterations, history - 1)].set(after.cost)
        return SearchIterate(knots, ctrls, multipliers, gains.K, after, costs)

    begin = initial_iterate(problem, knots, ctrls, options.rule, history, options.multipliers)
    return jax.lax.while_loop(lambda now: now.search.status == GOING, turn, begin)


def initial_iterate(
    problem: Problem, knots: Knot, ctrls: jax.Array, rule: StoppingRule, history: int,
    multipliers: ConstraintMultipliers | None = None,
) -> SearchIterate:  # fmt: skip
    """Return the first iterate of a search."""
    dtype, N = ctrls.dtype, problem.horizon
    ctrls = problem.within_bounds(ctrls)
    if multipliers is None:
        path, end = (row_count(problem, where) for where in ("path", "end"))
        multipliers = no_multipliers(N, path, end, dtype)
    return SearchIterate(
        knots, ctrls, multipliers, jnp.zeros((N, problem.nu, problem.n), dtype),
        initial_search_state(rule, bool(problem.constraints), multipliers.penalty),
        jnp.full(history, jnp.nan, dtype),
    )  # fmt: skip
