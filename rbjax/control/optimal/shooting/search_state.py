"""The state of a search and the decision of an iteration: which trial step is taken, the next
regularisation, the next penalty of the constraints, and whether the search ends.

The longest trial is taken that a method accepts. The regularisation falls tenfold after a step
longer than half. It rises tenfold after a step of a hundredth or none, or without gains (Mastalli
et al. 2020); with constraints, after a quarter of a step. A search is stuck if no regularisation
gives a step, or if many steps lower the cost by rounding only. If the expected decrease of the cost
is small relative to the cost, the constraints get new multipliers, or the search has converged.
Regularisation makes this decrease small anywhere, so under it the gradient must be small too. A
decision is one program of one sample (`rb.threads`), so one kernel on a GPU.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.control.optimal.objective import PENALTY_MOST, next_penalty
from rbjax.control.optimal.options import StoppingRule
from rbjax.control.optimal.shooting.filter_search import rounding
from rbjax.control.status import BUDGET, CONVERGED, GOING, INFEASIBLE, NOT_FINITE, STUCK

LEAST, MOST, FACTOR = 1e-9, 1e9, 10.0  # regularisation; the least counts as none
LENGTHS = 0.5 ** np.arange(10)  # of the steps that are tried
LONG, SHORT = 0.5, 0.01  # steps that lower and raise the regularisation
SHORT_CONSTRAINED = 0.3  # with constraints: their multipliers bend a cost that the model lacks
LOOSE, CLOSER = 1e-3, 0.3  # tolerance before the first multipliers; its factor at each update
FLOOR = 10.0  # the least tolerance, in units in the last place
MAX_STALLED = 50  # iterations that lower the cost by rounding only, after which a search is stuck


class SearchState(NamedTuple):
    """The state of a search between two iterations; each field ().

    feasible: whether the motion has no gaps.
    reg: the regularisation.
    cost: of the motion.
    scale: the tolerance is a share of it where the cost is less.
    expected_decrease: of the cost, by the last step.
    violation: of the constraints.
    violation_before: at the last change of the multipliers.
    inner_tolerance: of the search with the present multipliers.
    iterations: so far.
    status: of `rbjax.control.status`.
    penalty: of the augmented Lagrangian.
    reference_cost, stalled: those of `count_stalled`.
    """

    feasible: jax.Array
    reg: jax.Array
    cost: jax.Array
    scale: jax.Array
    expected_decrease: jax.Array
    violation: jax.Array
    violation_before: jax.Array
    inner_tolerance: jax.Array
    iterations: jax.Array
    status: jax.Array
    penalty: jax.Array
    reference_cost: jax.Array
    stalled: jax.Array


class IterationValues(NamedTuple):
    """The values of an iteration on which its decision depends.

    cost, gap, violation: (), of the present motion.
    slope, curvature: (), of the cost along the step.
    square: (), the squared norm of the gradient without regularisation.
    ok: (), whether the gains exist.
    costs, violations: (T,), of the trials.
    more: further values of the method.
    """

    cost: jax.Array
    gap: jax.Array
    violation: jax.Array
    slope: jax.Array
    curvature: jax.Array
    square: jax.Array
    ok: jax.Array
    costs: jax.Array
    violations: jax.Array
    more: Any


class Decision(NamedTuple):
    """search: the state after the iteration; best: the index of a trial, its length, and whether it
    is accepted; new_multipliers: whether the multipliers change. Each ()."""

    search: SearchState
    best: jax.Array
    length: jax.Array
    accepted: jax.Array
    new_multipliers: jax.Array


#: (values, lengths) -> which trials (T,) may be taken, and the expected decrease () of the cost
Accept = Callable[[IterationValues, jax.Array], tuple[jax.Array, jax.Array]]


def initial_search_state(rule: StoppingRule, constrained: bool, penalty: jax.Array) -> SearchState:
    """The state before the first iteration."""
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
    """The decision of one iteration. closes_gaps: whether a full step leaves no gap."""
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
    # gains that do not exist are computed again with more regularisation: the same iteration
    iterations = now.iterations + values.ok.astype(now.iterations.dtype)
    status = jnp.where(iterations >= rule.iterations, BUDGET, GOING)
    reference, stalled = count_stalled(
        now.reference_cost, now.stalled, cost, values.gap <= gap_tolerance(dtype)
    )
    status = jnp.where(stuck | (stalled >= MAX_STALLED), STUCK, status)
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
    status = jnp.where(hopeless, INFEASIBLE, status)
    inner = jnp.maximum(CLOSER * now.inner_tolerance, least)
    change = change & (status == GOING)  # a search that ends leaves its multipliers as they are
    after = SearchState(
        feasible, jnp.where(change, LEAST, reg).astype(dtype), cost, scale, decrease, off,
        jnp.where(change, off, now.violation_before),
        jnp.where(change, inner, now.inner_tolerance), iterations,
        jnp.where(done, CONVERGED, status), jnp.where(change, penalty, now.penalty),
        jnp.where(change, jnp.inf, reference).astype(dtype), stalled,
    )  # fmt: skip
    return Decision(after, best, length, accepted, change)


def _small(
    now: SearchState, values: IterationValues, decrease: Any, share: Any, tolerance: Any
) -> jax.Array:
    """Whether the expected decrease of the cost is small and, with regularisation, the gradient."""
    flat = jnp.sqrt(values.square) <= jnp.sqrt(tolerance) * share
    return values.ok & (decrease <= tolerance * share) & ((now.reg <= LEAST) | flat)


def count_stalled(
    reference: jax.Array, stalled: jax.Array, cost: jax.Array, closed: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The cost () at the last iteration that lowered it by more than rounding, and the number () of
    iterations since then. closed (): whether the gaps are closed: the cost may rise until then."""
    lower = ~closed | (cost < reference - rounding(reference)) | ~jnp.isfinite(reference)
    return jnp.where(lower, cost, reference), jnp.where(lower, 0, stalled + 1)


def gap_tolerance(dtype: Any) -> float:
    """The largest gap that counts as none: 4e-10 in f64."""
    return float(jnp.finfo(dtype).eps) ** 0.6
