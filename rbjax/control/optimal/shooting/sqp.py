"""Sequential quadratic programming with multiple shooting, in parallel over the knots.

An iteration of `search` uses the step of the linear model,

    du_k = k_k + K_k dx_k,     dx_{k+1} = A dx_k + B du_k + gap_{k+1}

The trials x (+) a dx, u + a du of all lengths a, with u projected onto its bounds, are evaluated at
all knots at once, without a rollout. Gaps shrink by the factor 1 - a. The trial with the smallest

    phi(a) = J(a) + sum over k of  l_k'gap_k(a) + rho/2 gap_k(a)'V_k gap_k(a)

is accepted if it satisfies the Armijo condition. l_k = v_k + V_k dx_k are the costates of the step,
and V_k are the Hessians of the value function. phi is an augmented Lagrangian (Gill, Murray,
Saunders & Wright 1992). An L1 penalty mu |gap| would shorten the steps near an optimum (Maratos
1978). Source: Bock & Plitt, *A multiple shooting algorithm for direct solution of optimal control
problems*, IFAC 1984; Nocedal & Wright, *Numerical Optimization*, 18.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiler import threads, with_multi_kernel
from rbjax.control.linear.riccati import roll_linear
from rbjax.control.optimal.objective import knot_violation, merit
from rbjax.control.optimal.problem import BODY, NEXT, Knot, Problem, take
from rbjax.control.optimal.shooting.backward_pass import Feedback
from rbjax.control.optimal.shooting.expansion import FEW, Expanded, Local, knot_indices, knots_at
from rbjax.control.optimal.shooting.filter_search import ARMIJO, rounding
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

RHO = 3.0


class LinearStep(NamedTuple):
    """The step of the linear model.

    dx, du: (N + 1, n) and (N, m).
    opening: (2,), the terms l'g and rho g'V g of the merit function for the gap g of the start,
        with its multipliers l and the Hessian V of the value function.
    """

    dx: jax.Array
    du: jax.Array
    opening: jax.Array


class LinearTrials(NamedTuple):
    """Values of T trials along the linear step.

    costs, violations: (T,).
    more: change of phi without the gap of the start (T,), its slope (), and `opening` of the step.
    step: the step of length 1.
    """

    costs: jax.Array
    violations: jax.Array
    more: tuple[jax.Array, jax.Array, jax.Array]
    step: LinearStep


def solve_sqp(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: SolveOptions,
    history: int, exact: bool = False,
) -> SearchResult:  # fmt: skip
    """Solve a problem by sequential quadratic programming. exact: as in `solve_ddp`."""
    return search(LINEAR_STEPS, problem, start, knots, ctrls, options, history, exact)


def linear_step(path: Local, gaps: jax.Array, gains: Feedback) -> LinearStep:
    """Compute the step of the linear model. The gains keep active bounds of controls."""

    dx, du = roll_linear(path.A, path.B, gaps[1:], gains.K, gains.k, gains.first)
    V, first = gains.V[0], gaps[0]
    l = gains.v[0] + product(V, gains.first - first)
    opening = jnp.stack([(l * first).sum(), RHO * (first * product(V, first)).sum()])
    return LinearStep(dx, du, opening)


def _trials(
    problem: Problem, now: SearchIterate, found: Expanded, gaps: jax.Array, gains: Feedback
) -> LinearTrials:
    """Evaluate trial steps of all step lengths at all knots."""
    dtype, N = now.ctrl.dtype, problem.horizon
    step = threads(linear_step, team=True)(found.path, gaps, gains)
    lengths = jnp.asarray(LENGTHS, dtype)

    def one(
        k: Any, knot: Knot, ctrl: jax.Array, y: jax.Array, dx: jax.Array, du: jax.Array,
        following: Knot, ahead: jax.Array, gap: jax.Array, V: jax.Array, v: jax.Array,
        cost: tuple, y_end: jax.Array, end: tuple, mu: jax.Array, a: jax.Array,
    ) -> tuple:  # fmt: skip
        there, u = problem.plus(knot, a * dx), problem.within_bounds(ctrl + a * du)
        after = problem.plus(following, a * ahead)
        c, q, r = cost
        change = merit(problem, "path", k, there, u, y, mu) - c
        off = knot_violation(problem, "path", k, there, u)
        slope = (q * dx).sum() + (r * du).sum()

        def closing() -> tuple:
            none = jnp.zeros(problem.nu, dtype)
            c, q = end
            more = merit(problem, "end", k + 1, after, none, y_end, mu) - c
            return more, (q * ahead).sum(), knot_violation(problem, "end", k + 1, after, none)

        def nothing() -> tuple:
            zero = jnp.zeros((), dtype)
            return zero, zero, zero

        last = jax.lax.cond(k >= N - 1, closing, nothing)
        left = problem.minus(problem.step(k, there, u), after)
        l = v + product(V, ahead - gap)
        square = RHO * (gap * product(V, gap)).sum()
        lift = (l * (left - gap)).sum() + 0.5 * (RHO * (left * product(V, left)).sum() - square)
        slope = slope + last[1] - (l * gap).sum() - square
        return jnp.stack([change + last[0], lift, slope]), jnp.maximum(off, last[2])

    def in_place(
        k: Any, knot: Knot, ctrl: jax.Array, y: jax.Array, dx: jax.Array, du: jax.Array,
        following: Knot, ahead: jax.Array, gap: jax.Array, V: jax.Array, v: jax.Array, *rest: Any,
    ) -> tuple:  # fmt: skip
        def read(k: Any, ctrl: jax.Array, y: jax.Array, du: jax.Array, *rest: Any) -> tuple:
            (knot, following), (dx, ahead) = (knots_at(x, k) for x in (now.knots, step.dx))
            gap, V, v = (knots_at(x, k)[1] for x in (gaps, gains.V, gains.v))
            return one(k, knot, ctrl, y, dx, du, following, ahead, gap, V, v, *rest)

        return threads(read)(k, ctrl, y, du, *rest)

    each = jax.vmap(with_multi_kernel(one, in_place, FEW * len(LENGTHS)), (0,) * 12 + (None,) * 4)
    body, following = take(now.knots, BODY), take(now.knots, NEXT)
    path, l = found.path.cost, now.multipliers
    sums, offs = jax.vmap(each, (None,) * 15 + (0,))(
        knot_indices(N, dtype), body, now.ctrl, l.path, step.dx[:-1], step.du,
        following, step.dx[1:], gaps[1:], gains.V[1:], gains.v[1:],
        (path.c, path.q, path.r), l.end, (found.end.c, found.end.q), l.penalty, lengths,
    )  # fmt: skip
    costs, lift, slope = jnp.moveaxis(sums.sum(1), 1, 0)
    offs = offs.max(1) if problem.constraints else jnp.zeros_like(costs)
    return LinearTrials(found.cost + costs, offs, (costs + lift, slope[0], step.opening), step)


def _take_linear_step(
    problem: Problem, now: SearchIterate, trials: LinearTrials, decided: Decision
) -> tuple[Knot, jax.Array]:
    """Apply the accepted step to the knots and controls."""

    def one(knot: Knot, dx: jax.Array, a: jax.Array, accepted: jax.Array) -> Knot:
        return problem.plus(knot, jnp.where(accepted, a * dx, 0.0))

    a, accepted = decided.length, decided.accepted
    knots = jax.vmap(threads(one), (0, 0, None, None))(now.knots, trials.step.dx, a, accepted)
    ctrls = now.ctrl + jnp.where(accepted, a * trials.step.du, 0.0)
    return knots, problem.within_bounds(ctrls)


def _decreases_merit(values: IterationValues, lengths: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return a mask of the acceptable trials of least merit phi, and half the slope's absolute
    value: the expected decrease."""
    change, slope, opening = values.more
    pull, square = opening[0], opening[1]
    change = change - lengths * pull + 0.5 * ((1 - lengths) ** 2 - 1) * square
    slope = slope - pull - square
    slack = rounding(values.cost)
    good = (change - slack <= ARMIJO * lengths * slope) & (slope <= slack)
    change = jnp.where(good & jnp.isfinite(change), change, jnp.inf)
    return good & (change <= change.min() + slack), 0.5 * jnp.abs(slope)


LINEAR_STEPS = StepPolicy(_decreases_merit, False, _trials, _take_linear_step)
