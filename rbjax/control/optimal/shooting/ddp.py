"""Differential dynamic programming with multiple shooting, control bounds and constraints.

Each iteration of `search` expands the problem at its knots (`expansion`), computes gains
(`backward_pass`), rolls out steps of length a = 1, 1/2, 1/4 ... in parallel, and applies the
longest that lowers the cost as expected:

    x_0 = xs_0 (+) a dx_0,   u_k = us_k + a k_k + K_k (x_k (-) xs_k),   within the bounds
    x_{k+1} = f(x_k, u_k) (+) (a - 1) gap_{k+1}

With a = 1 the motion obeys the dynamics. With a < 1 the gaps shrink by the factor 1 - a. The states
of the guess need not obey the dynamics.

Source: Mastalli et al., *Crocoddyl*, 2020, for the rules of acceptance and regularisation.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiler import threads
from rbjax.control.optimal.objective import ConstraintMultipliers, knot_violation, merit
from rbjax.control.optimal.problem import BODY, Knot, Problem, append, take
from rbjax.control.optimal.shooting.backward_pass import Feedback
from rbjax.control.optimal.shooting.expansion import Expanded
from rbjax.control.optimal.shooting.filter_search import rounding
from rbjax.control.optimal.shooting.search import (
    LENGTHS,
    Decision,
    IterationValues,
    SearchIterate,
    StepPolicy,
    search,
)
from rbjax.control.optimal.solution import SearchResult, SolveOptions
from rbjax.control.products import product

ACCEPTED, ASCENT = 0.1, 2.0  # fractions of the expected change


def solve_ddp(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: SolveOptions,
    history: int, exact: bool = False,
) -> SearchResult:  # fmt: skip
    """Solve a problem by differential dynamic programming.

    exact: use second derivatives of dynamics and residuals if the control Hessians stay positive
        definite.
    """
    return search(ROLLOUTS, problem, start, knots, ctrls, options, history, exact)


class Rollout(NamedTuple):
    """The rollout of a trial step.

    knots, ctrl: the motion, (N + 1, ...) and (N, m).
    costs, violations: its cost and largest constraint violation, ().
    more: (), sum of gap' V dx over the knots, with the value's Hessian V and the change dx.
    """

    knots: Knot
    ctrl: jax.Array
    costs: jax.Array
    violations: jax.Array
    more: jax.Array


def forward_pass(
    problem: Problem, knots: Knot, ctrls: jax.Array, gains: Feedback, gaps: jax.Array,
    multipliers: ConstraintMultipliers, a: jax.Array,
) -> Rollout:  # fmt: skip
    """Roll out the controls u + a k + K dx, and sum cost, violation and gaps along the motion."""
    first = take(knots, 0)
    now = problem.plus(first, a * gains.first)
    mu = multipliers.penalty

    def forth(carry: tuple, x: tuple) -> tuple:
        now, total, off, cross = carry
        k, knot, ctrl, K, du, gap, V, rows, closing = x
        dx = problem.minus(now, knot)
        u = problem.within_bounds(ctrl + a * du + product(K, dx))
        total = total + merit(problem, "path", k, now, u, rows, mu)
        off = jnp.maximum(off, knot_violation(problem, "path", k, now, u))
        cross = cross + (gap * product(V, dx)).sum()
        after = problem.plus(problem.step(k, now, u), (a - 1) * closing)
        return (after, total, off, cross), (now, u)

    N, dtype = problem.horizon, ctrls.dtype
    body = take(knots, BODY)
    ks = jnp.arange(N, dtype=dtype)
    given = (ks, body, ctrls, gains.K, gains.k, gaps[:-1], gains.V[:-1], multipliers.path, gaps[1:])
    zero = jnp.zeros((), dtype)
    tried: Any = jax.lax.scan(forth, (now, zero, zero, zero), given)
    (last, total, off, cross), (before, us) = tried
    none = jnp.zeros(problem.nu, dtype)
    total = total + merit(problem, "end", N, last, none, multipliers.end, mu)
    off = jnp.maximum(off, knot_violation(problem, "end", N, last, none))
    end = take(knots, -1)
    cross = cross + (gaps[-1] * product(gains.V[-1], problem.minus(last, end))).sum()
    found = append(before, last)
    return Rollout(found, us, total, off, cross)


def _rollouts(
    problem: Problem, now: SearchIterate, found: Expanded, gaps: jax.Array, gains: Feedback
) -> Rollout:
    """Roll out trial steps of all step lengths."""
    lengths = jnp.asarray(LENGTHS, now.ctrl.dtype)
    run = threads(functools.partial(forward_pass, problem))
    return jax.vmap(run, (None,) * 5 + (0,))(
        now.knots, now.ctrl, gains, gaps, now.multipliers, lengths
    )


def _take_rollout(
    problem: Problem, now: SearchIterate, trials: Rollout, decided: Decision
) -> tuple[Knot, jax.Array]:
    """Return the knots and controls of the accepted trial."""
    return jax.tree.map(
        lambda new, old: jnp.where(decided.accepted, new[decided.best], old),
        (trials.knots, trials.ctrl), (now.knots, now.ctrl),
    )  # fmt: skip


def _decreases_as_expected(
    values: IterationValues, lengths: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return a mask of the trials whose change of the cost agrees with the prediction, and the
    predicted change of the full step."""
    cross = values.more
    slope, curvature = values.slope + cross, values.curvature - 2 * cross
    expected = lengths * (slope + 0.5 * lengths * curvature)
    change = values.costs - values.cost
    change = change - rounding(values.cost)
    falls = (expected <= 0) & (change <= ACCEPTED * expected)
    # a step that closes gaps may raise the cost, by less than twice the expected rise
    rises = (expected > 0) & (change < ASCENT * expected)
    return falls | rises, jnp.abs(values.slope + 0.5 * values.curvature)


ROLLOUTS = StepPolicy(_decreases_as_expected, True, _rollouts, _take_rollout)
