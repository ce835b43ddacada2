"""Single shooting: only the controls are unknowns, the states follow by the system's steps.

    min over us of  J(us) = sum l_k(x_k, u_k) + Phi(x_N),    x_{k+1} = f(x_k, u_k)
    u = middle + half sin(w)          within bounds, of unknowns w that have none
    J + mu/2 sum |s - clip(s, low, high)|^2,   s = c + lambda / mu     with constraints

Free numbers and the free part of the start are unknowns too. `by_optax` follows the gradient with
an optimiser of optax; `by_optimistix` takes BFGS, or Levenberg and Marquardt where all costs are
residuals. Gradients come from reverse mode through the scan of the steps. Unstable motions make J
steep: a state after N steps depends on the first control through a product of N matrices, which
multiple shooting ("ddp") and collocation avoid.

Source: Betts, *Practical Methods for Optimal Control*, 3.3; Kingma & Ba 2015 (Adam).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
import optimistix as optx

from rbjax.control.augmented_lagrangian import (
    PENALTY_MOST,
    Multipliers,
    next_multipliers,
    next_penalty,
    no_multipliers,
    penalised,
    violated,
)
from rbjax.control.expansion import example, limits, row_count
from rbjax.control.knots import largest_gap
from rbjax.control.options import Options
from rbjax.control.outcome import BUDGET, CONVERGED, GOING, INFEASIBLE, NOT_FINITE, STUCK
from rbjax.control.problem import Knot, Problem
from rbjax.control.solution import Found, plain_cost
from rbjax.errors import InputError

VAIN = 0.9  # a violation that does not fall to this share at the last penalty stays
EDGE = 0.98  # a first guess lies within this share of its bounds
RATE = 0.03  # of Adam
PATIENCE = 20  # iterations over which a gradient method must lower the cost


class Unknowns(NamedTuple):
    """us (N, m) in the coordinates without bounds; dx (n,) of the first knot, numbers likewise."""

    us: jax.Array
    dx: jax.Array


class Shooting(NamedTuple):
    """A problem and the first knot of the guess."""

    problem: Problem
    first: Knot

    def knots(self, w: Unknowns) -> tuple[Knot, jax.Array]:
        """The motion and its controls."""
        problem = self.problem
        us = inside(w.us, problem.low, problem.high)
        ns = problem.system.n
        low, high = (x[ns:] for x in problem.start_bounds(us.dtype))
        free = jnp.asarray(problem.free)
        state = problem.system.plus(self.first.state, jnp.where(free, w.dx[:ns], 0.0))
        first = Knot(state, inside(w.dx[ns:], low, high))

        def step(knot: Knot, x: tuple) -> tuple[Knot, Knot]:
            k, u = x
            return problem.step(k, knot, u), knot

        ks = jnp.arange(problem.horizon, dtype=us.dtype)
        last, body = jax.lax.scan(step, first, (ks, us))
        return jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), body, last), us

    def rows(self, knots: Knot, us: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The constraints at the knots with controls (N, c) and at the end (e,)."""
        problem = self.problem
        ks = jnp.arange(problem.horizon, dtype=us.dtype)
        body = jax.tree.map(lambda x: x[:-1], knots)
        path = jax.vmap(lambda k, x, u: problem.rows(k, x, u, "path"))(ks, body, us)
        last = jax.tree.map(lambda x: x[-1], knots)
        none = jnp.zeros(problem.nu, us.dtype)
        return path, problem.rows(problem.horizon, last, none, "end")

    def residuals(self, knots: Knot, us: jax.Array) -> tuple[list[jax.Array], jax.Array]:
        """All residuals, and the sum of the costs that are numbers."""
        problem, rest = self.problem, jnp.zeros((), us.dtype)
        N = problem.horizon
        body, last = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (slice(-1), -1))
        ks = jnp.arange(N, dtype=us.dtype)
        found = []
        for cost in problem.running:
            value = jax.vmap(lambda *x, cost=cost: problem.value(cost, "path", *x))(ks, body, us)
            if value.ndim > 1:
                found.append(value.reshape(-1))
            else:
                rest = rest + value.sum()
        for cost in problem.terminal:
            value = problem.value(cost, "end", N, last, jnp.zeros(problem.nu, us.dtype))
            if value.ndim:
                found.append(value)
            else:
                rest = rest + value
        return found, rest


def inside(w: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """A number within its bounds: a sine between two, a hyperbola above or below one."""
    low, high = low.astype(w.dtype), high.astype(w.dtype)
    has_low, has_high = jnp.isfinite(low), jnp.isfinite(high)
    a, b = jnp.where(has_low, low, -1.0), jnp.where(has_high, high, 1.0)
    between = 0.5 * (a + b) + 0.5 * (b - a) * jnp.sin(w)
    beside = jnp.sqrt(w * w + 1) - 1
    one = jnp.where(has_low, a + beside, jnp.where(has_high, b - beside, w))
    return jnp.where(has_low & has_high, between, one)


def outside(u: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """w whose `inside` is u, or near it where u is at a bound."""
    low, high = low.astype(u.dtype), high.astype(u.dtype)
    has_low, has_high = jnp.isfinite(low), jnp.isfinite(high)
    a, b = jnp.where(has_low, low, -1.0), jnp.where(has_high, high, 1.0)
    share = (2 * u - a - b) / (b - a)
    between = jnp.arcsin(jnp.clip(share, -EDGE, EDGE))
    away = jnp.maximum(jnp.where(has_low, u - a, b - u), 1e-3)
    beside = jnp.sqrt((away + 1) ** 2 - 1)
    return jnp.where(has_low & has_high, between, jnp.where(has_low | has_high, beside, u))


def augmented(s: Shooting, w: Unknowns, l: Multipliers) -> tuple[list[jax.Array], jax.Array]:
    """Residuals and the rest of the augmented Lagrangian."""
    knots, us = s.knots(w)
    found, rest = s.residuals(knots, us)
    if s.problem.constraints:
        for rows, y, where in zip(s.rows(knots, us), l[:2], ("path", "end"), strict=True):
            low, high = limits(s.problem, where, jnp.zeros(rows.shape[-1], us.dtype))
            found.append(penalised(rows, y, l.penalty, low, high).reshape(-1))
    return found, rest


def total(s: Shooting, w: Unknowns, l: Multipliers) -> jax.Array:
    """The augmented Lagrangian ()."""
    found, rest = augmented(s, w, l)
    return rest + sum((0.5 * (r * r).sum() for r in found), jnp.zeros_like(rest))


class Ended(NamedTuple):
    """Unknowns; outcome; iterations; stop, the last relative fall of the cost; costs (history,)."""

    w: Unknowns
    outcome: jax.Array
    iterations: jax.Array
    stop: jax.Array
    costs: jax.Array


Inner = Callable[[Shooting, Unknowns, Multipliers, Options, jax.Array, jax.Array], Ended]


def descended(optimiser: optax.GradientTransformation) -> Inner:
    """A search by an optimiser of optax; the best point is kept."""

    def search(
        s: Shooting, w: Unknowns, l: Multipliers, options: Options, used: jax.Array,
        costs: jax.Array,
    ) -> Ended:  # fmt: skip
        value = jax.value_and_grad(lambda w: total(s, w, l))
        dtype, history = w.us.dtype, costs.shape[0]

        def turn(now: tuple) -> tuple:
            w, state, best, best_cost, mark, count, costs, _ = now
            cost, slope = value(w)
            costs = costs.at[jnp.minimum(count, history - 1)].set(cost)
            better = cost < best_cost
            best = jax.tree.map(lambda new, old: jnp.where(better, new, old), w, best)
            best_cost = jnp.where(better, cost, best_cost)
            change, state = optimiser.update(slope, state, w)
            w = optax.apply_updates(w, change)
            count = count + 1
            look = (count - used) % PATIENCE == 0
            still = look & (mark - best_cost <= options.tolerance * jnp.maximum(1, best_cost))
            mark = jnp.where(look, best_cost, mark)
            fine = jnp.isfinite(cost) & jnp.isfinite(slope.us).all()
            outcome = jnp.where(still, CONVERGED, GOING)
            outcome = jnp.where(count >= options.iterations, BUDGET, outcome)
            outcome = jnp.where(fine, outcome, NOT_FINITE)
            return w, state, best, best_cost, mark, count, costs, outcome

        big = jnp.asarray(jnp.inf, dtype)
        begin = w, optimiser.init(w), w, big, big, used, costs, jnp.asarray(GOING)
        end = jax.lax.while_loop(lambda now: now[-1] == GOING, turn, begin)
        fell = jnp.where(jnp.isfinite(end[4]), jnp.abs(end[4] - end[3]), jnp.inf)
        # a step into what is not finite ends the search, not what was found before
        lost = jnp.where(jnp.isfinite(end[3]), STUCK, NOT_FINITE)
        outcome = jnp.where(end[-1] == NOT_FINITE, lost, end[-1])
        return Ended(end[2], outcome, end[5], fell, end[6])

    return search


def minimised(squares: bool) -> Inner:
    """A search by BFGS, or by Levenberg and Marquardt's method where all costs are residuals."""

    def search(
        s: Shooting, w: Unknowns, l: Multipliers, options: Options, used: jax.Array,
        costs: jax.Array,
    ) -> Ended:  # fmt: skip
        tol = 1e-6 if w.us.dtype == jnp.float64 else 1e-3
        found: Any
        begin = total(s, w, l)
        budget = costs.shape[0]
        if squares:

            def residuals(w: Unknowns, _: Any) -> jax.Array:
                return jnp.concatenate(augmented(s, w, l)[0])

            solver: Any = optx.LevenbergMarquardt(tol, tol)
            found = optx.least_squares(residuals, solver, w, max_steps=budget, throw=False)
        else:
            solver = optx.BFGS(tol, tol)
            found = optx.minimise(
                lambda w, _: total(s, w, l), solver, w, max_steps=budget, throw=False
            )
        taken = used + found.stats["num_steps"]
        end = total(s, found.value, l)
        good = jnp.isfinite(end) & (end <= begin)
        value = jax.tree.map(lambda new, old: jnp.where(good, new, old), found.value, w)
        right = found.result == optx.RESULTS.successful
        outcome = jnp.where(right, CONVERGED, BUDGET)
        outcome = jnp.where(good, outcome, STUCK)
        outcome = jnp.where(jnp.isfinite(begin), outcome, NOT_FINITE)
        costs = costs.at[jnp.minimum(taken, budget) - 1].set(jnp.where(good, end, begin))
        return Ended(value, outcome, taken, jnp.abs(begin - end), costs)

    return search


def by_shooting(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: Options, history: int,
    inner: Callable[[Problem], Inner],
) -> Found:  # fmt: skip
    """`solve` by single shooting. The guess of the states is not used, but for a free start."""
    dtype, n = ctrls.dtype, problem.n
    search = inner(problem)
    first = jax.tree.map(lambda x: x[0], knots)
    state = first.state if any(problem.free) else start
    s = Shooting(problem, Knot(state, first.numbers))
    low, high = (x[problem.system.n :] for x in problem.start_bounds(dtype))
    dx = jnp.zeros(n, dtype).at[problem.system.n :].set(outside(first.numbers, low, high))
    w = Unknowns(outside(ctrls, problem.low, problem.high), dx)
    path, closing = (row_count(problem, at) for at in ("path", "end"))
    l = no_multipliers(problem.horizon, path, closing, dtype)
    costs = jnp.full(history, jnp.nan, dtype)
    if not problem.constraints:
        end = search(s, w, l, options, jnp.asarray(0), costs)
        outcome = end.outcome
    else:
        end, l, outcome = _turns(s, w, l, options, costs, search)
    knots, us = s.knots(end.w)
    off, _ = violation_of(s, knots, us, l)
    return Found(
        knots, us, plain_cost(problem, knots, us), outcome, end.iterations, end.stop,
        largest_gap(problem, jax.tree.map(lambda x: x[0], knots.state), knots, us), off,
        end.costs, jnp.zeros((problem.horizon, problem.nu, n), dtype), l.path, l.end,
    )  # fmt: skip


def violation_of(
    s: Shooting, knots: Knot, us: jax.Array, l: Multipliers
) -> tuple[jax.Array, Multipliers]:
    """The largest violation, and the next multipliers."""
    worst, ys = jnp.zeros((), us.dtype), []
    for rows, y, where in zip(s.rows(knots, us), l[:2], ("path", "end"), strict=True):
        low, high = limits(s.problem, where, jnp.zeros(rows.shape[-1], us.dtype))
        worst = jnp.maximum(worst, violated(rows, low, high))
        ys.append(next_multipliers(rows, y, l.penalty, low, high))
    return worst, Multipliers(ys[0], ys[1], l.penalty)


def _turns(
    s: Shooting, w: Unknowns, l: Multipliers, options: Options, costs: jax.Array, search: Inner
) -> tuple[Ended, Multipliers, jax.Array]:
    """Searches with better and better multipliers."""
    big = jnp.asarray(jnp.inf, w.us.dtype)

    def turn(now: tuple) -> tuple:
        end, l, before, _ = now
        end = search(s, end.w, l, options, end.iterations, end.costs)
        off, after = violation_of(s, *s.knots(end.w), l)
        held = off <= options.violation
        penalty, failing = next_penalty(l.penalty, off, before, held)
        after = after._replace(penalty=penalty)
        hopeless = failing & (off > VAIN * before) & (l.penalty >= PENALTY_MOST)
        outcome = jnp.where(held & (end.outcome == CONVERGED), CONVERGED, GOING)
        outcome = jnp.where(hopeless, INFEASIBLE, outcome)
        spent = (end.iterations >= options.iterations) & (outcome == GOING)
        outcome = jnp.where(spent, BUDGET, outcome)
        outcome = jnp.where(end.outcome == NOT_FINITE, NOT_FINITE, outcome)
        return end, after, off, outcome

    begin = Ended(w, jnp.asarray(GOING), jnp.asarray(0), big, costs), l, big, jnp.asarray(GOING)
    end, l, _, outcome = jax.lax.while_loop(lambda now: now[3] == GOING, turn, begin)
    return end, l, outcome


def by_adam(problem: Problem) -> Inner:
    """Adam of optax."""
    return descended(optax.adam(RATE))


def by_bfgs(problem: Problem) -> Inner:
    """BFGS of optimistix."""
    return minimised(False)


def by_squares(problem: Problem) -> Inner:
    """Levenberg and Marquardt's method of optimistix; refuses costs that are numbers."""
    knot, ctrl = example(problem)
    for where, costs in (("path", problem.running), ("end", problem.terminal)):
        for cost in costs:
            value = jax.eval_shape(
                lambda x, u, cost=cost, where=where: problem.value(cost, where, 0.0, x, u),
                knot, ctrl,
            )  # fmt: skip
            if value.ndim == 0:
                raise InputError(
                    f"solve: method 'levenberg_marquardt' needs residuals, and the cost "
                    f"{cost.term.label} is a number; return a vector, or take 'bfgs'"
                )
    return minimised(True)
