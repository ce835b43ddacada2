"""What an iteration decides once its trials are measured: which of them is taken, the next
regularisation, the next penalty of the constraints, and whether the search ends.

The longest trial is taken that a method accepts. The regularisation falls tenfold after a step
longer than half. It rises tenfold after a step of a hundredth or none, or without gains (Mastalli
et al. 2020); with constraints, after a quarter of a step. A search is stuck if no regularisation
gives a step, or if many steps lower the cost by rounding only. If the foreseen change of the cost
is small relative to the cost, the constraints get new multipliers, or the search has converged.
Regularisation makes this change small anywhere, so under it the gradient must be small too. All of
it is one program of one sample (`rb.threads`), so one kernel on a GPU.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.control.optimal.shooting.augmented_lagrangian import PENALTY_MOST, next_penalty
from rbjax.control.optimal.shooting.filter_search import rounding
from rbjax.control.status import BUDGET, CONVERGED, GOING, INFEASIBLE, NOT_FINITE, STUCK

LEAST, MOST, FACTOR = 1e-9, 1e9, 10.0  # regularisation; the least counts as none
LENGTHS = 0.5 ** np.arange(10)  # of the steps that are tried
LONG, SHORT = 0.5, 0.01  # steps that lower and raise the regularisation
SHORT_HELD = 0.3  # the second with constraints: their multipliers bend a cost that the model lacks
LOOSE, CLOSER = 1e-3, 0.3  # tolerance before the first multipliers; its factor at each update
FLOOR = 10.0  # the least tolerance, in units in the last place
VAIN = 50  # iterations that lower the cost by no more than rounding, after which a search is stuck


class Standing(NamedTuple):
    """Where a search stands, numbers (): whether the motion is free of gaps; the regularisation;
    cost; scale, of which the tolerance is a share where the cost is less; stop, the change that was
    foreseen; violation; before, that at the last change of
    multipliers; inner, the tolerance of this turn of multipliers; iterations; outcome; penalty;
    mark and vain, those of `in_vain`."""

    feasible: jax.Array
    reg: jax.Array
    cost: jax.Array
    scale: jax.Array
    stop: jax.Array
    violation: jax.Array
    before: jax.Array
    inner: jax.Array
    turns: jax.Array
    outcome: jax.Array
    penalty: jax.Array
    mark: jax.Array
    vain: jax.Array


class Limits(NamedTuple):
    """tolerance, violation, iterations and scale of `Options`; each ()."""

    tolerance: jax.Array
    violation: jax.Array
    iterations: jax.Array
    scale: jax.Array | None = None


class Measures(NamedTuple):
    """The values of an iteration from which its verdict follows.

    cost, gap, violation: (), of the present motion.
    slope, curvature: (), of the cost along the step.
    square: (), the squared norm of the gradient without regularisation.
    ok: (), whether the gains exist.
    costs, offs: (T,), costs and violations of the trials.
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
    offs: jax.Array
    more: Any


class Verdict(NamedTuple):
    """standing after the iteration; best, the trial, its length a, and whether it is accepted;
    change, whether multipliers are to change; each ()."""

    standing: Standing
    best: jax.Array
    a: jax.Array
    accepted: jax.Array
    change: jax.Array


class Rules(NamedTuple):
    """Of a method. accepts: (measures, lengths) -> which trials (T,) may be taken, and the foreseen
    change of the cost (). closes: whether a full step of a trial leaves no gap."""

    accepts: Callable[[Measures, jax.Array], tuple[jax.Array, jax.Array]]
    closes: bool


def begun(limits: Limits, constrained: bool, penalty: jax.Array) -> Standing:
    """Before the first iteration."""
    dtype = penalty.dtype
    number = lambda x: jnp.asarray(x, dtype)  # noqa: E731
    least = jnp.maximum(limits.tolerance, FLOOR * jnp.finfo(dtype).eps)
    inner = jnp.maximum(least, LOOSE) if constrained else least
    scale = number(-1) if limits.scale is None else number(limits.scale)
    return Standing(
        jnp.asarray(False), number(LEAST), number(jnp.inf), scale, number(jnp.inf), number(0),
        number(jnp.inf), inner.astype(dtype), jnp.asarray(0), jnp.asarray(GOING), penalty,
        number(jnp.inf), jnp.asarray(0),
    )  # fmt: skip


def verdict(
    rules: Rules, constrained: bool, now: Standing, limits: Limits, seen: Measures
) -> Verdict:
    """The verdict on one iteration."""
    dtype = seen.cost.dtype
    lengths = jnp.asarray(LENGTHS, dtype)
    good, stop = rules.accepts(seen, lengths)
    good = good & jnp.isfinite(seen.costs) & seen.ok
    stop = jnp.where(seen.ok, stop, now.stop)
    best, accepted = jnp.argmax(good), good.any()
    a = lengths[best]
    cost = jnp.where(accepted, seen.costs[best], seen.cost)
    off = jnp.where(accepted, seen.offs[best], seen.violation)

    reg = jnp.where(accepted & (a > LONG), jnp.maximum(now.reg / FACTOR, LEAST), now.reg)
    raised = ~accepted | (a <= (SHORT_HELD if constrained else SHORT))
    stuck = raised & (reg >= MOST)
    reg = jnp.where(raised, jnp.minimum(reg * FACTOR, MOST), reg)

    if rules.closes:
        here, feasible = now.feasible, now.feasible | (accepted & (best == 0))
    else:
        feasible = seen.gap <= closed(dtype)
        here = feasible | (constrained & (seen.gap <= now.inner))
    first = jnp.minimum(jnp.abs(seen.cost), 1.0)
    scale = jnp.where(now.scale < 0, first, now.scale)
    share = jnp.maximum(scale, jnp.abs(seen.cost))
    small = functools.partial(_small, now, seen, stop, share)
    still = here & small(now.inner)
    # gains that do not exist are asked for again with more regularisation: the same iteration
    turns = now.turns + seen.ok.astype(now.turns.dtype)
    outcome = jnp.where(turns >= limits.iterations, BUDGET, GOING)
    mark, vain = in_vain(now.mark, now.vain, cost, seen.gap <= closed(dtype))
    outcome = jnp.where(stuck | (vain >= VAIN), STUCK, outcome)
    finite = jnp.isfinite(seen.cost) & jnp.isfinite(seen.gap)
    outcome = jnp.where(finite, outcome, NOT_FINITE)
    if not constrained:
        outcome = jnp.where(still, CONVERGED, outcome)
        after = now._replace(
            feasible=feasible, reg=reg, cost=cost, scale=scale, stop=stop, turns=turns,
            outcome=outcome, mark=mark, vain=vain,
        )  # fmt: skip
        return Verdict(after, best, a, accepted, jnp.asarray(False))

    held = off <= limits.violation
    least = jnp.maximum(limits.tolerance.astype(dtype), FLOOR * jnp.finfo(dtype).eps)
    done = still & small(least) & held & (feasible if not rules.closes else True)
    change = still & ~done
    penalty, failing = next_penalty(now.penalty, off, now.before, held)
    hopeless = change & failing & (now.penalty >= PENALTY_MOST)
    outcome = jnp.where(hopeless, INFEASIBLE, outcome)
    inner = jnp.maximum(CLOSER * now.inner, least)
    change = change & (outcome == GOING)  # a search that ends leaves its multipliers as they are
    after = Standing(
        feasible, jnp.where(change, LEAST, reg).astype(dtype), cost, scale, stop, off,
        jnp.where(change, off, now.before), jnp.where(change, inner, now.inner), turns,
        jnp.where(done, CONVERGED, outcome), jnp.where(change, penalty, now.penalty),
        jnp.where(change, jnp.inf, mark).astype(dtype), vain,
    )  # fmt: skip
    return Verdict(after, best, a, accepted, change)


def _small(now: Standing, seen: Measures, stop: Any, share: Any, tolerance: Any) -> jax.Array:
    """Whether the predicted change of the cost is small and, with regularisation, the gradient."""
    flat = jnp.sqrt(seen.square) <= jnp.sqrt(tolerance) * share
    return seen.ok & (stop <= tolerance * share) & ((now.reg <= LEAST) | flat)


def in_vain(
    mark: jax.Array, vain: jax.Array, cost: jax.Array, whole: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The cost () at the last iteration that lowered it by more than rounding, and the number () of
    iterations since then. whole (): whether the gaps are closed: the cost may rise until they
    are."""
    lower = ~whole | (cost < mark - rounding(mark)) | ~jnp.isfinite(mark)
    return jnp.where(lower, cost, mark), jnp.where(lower, 0, vain + 1)


def closed(dtype: Any) -> float:
    """The largest gap that counts as none: 4e-10 in f64."""
    return float(jnp.finfo(dtype).eps) ** 0.6
