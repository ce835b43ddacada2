"""Single shooting: only the controls are unknowns; states follow from the steps of the system.

    min over us of  J(us) = sum l_k(x_k, u_k) + Phi(x_N),    x_{k+1} = f(x_k, u_k)
    u = middle + half sin(w)          with bounds, for unbounded unknowns w
    J + mu/2 sum |s - clip(s, low, high)|^2,   s = c + lambda / mu     with constraints

Parameters and the free part of the start are unknowns too. A search converges if the gradient with
respect to w is small, scaled by the unknowns and the cost. For unstable motions J is
ill-conditioned; use multiple shooting or collocation for them. Source: Betts, *Practical Methods
for Optimal Control*, 3.3; Kingma & Ba 2015 (Adam).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix as optx

from rbjax.control.optimal import objective
from rbjax.control.optimal.objective import ConstraintMultipliers
from rbjax.control.optimal.problem import Knot, Problem, take
from rbjax.control.optimal.shooting.expansion import largest_gap
from rbjax.control.optimal.shooting.search import CLOSER, FLOOR, LOOSE
from rbjax.control.optimal.solution import SearchResult, SolveOptions
from rbjax.control.status import BUDGET, CONVERGED, GOING, INFEASIBLE, NOT_FINITE, STUCK
from rbjax.errors import InputError
from rbjax.lanes.arrays import select

PERSISTS = 0.9  # infeasible if, at the largest penalty, a violation does not fall to this share
EDGE = 0.98  # a first guess is clipped to this fraction of the range of its bounds
RATE = 0.03  # learning rate of Adam
PATIENCE = 20  # iterations within which a gradient method must lower the cost
SHORTER, SHORTEST = 0.25, 1e-6  # otherwise, the factor of its steps, and the smallest step


class ShootingUnknowns(NamedTuple):
    """Unknowns of single shooting.

    us: unbounded coordinates of the controls, (N, m).
    dx: tangent vector of the first knot, and unbounded coordinates of the parameters, (n,).
    """

    us: jax.Array
    dx: jax.Array


class ShootingProblem(NamedTuple):
    """A problem and the first knot of the guess. The unknowns are the controls, the parameters and
    the free coordinates of the first state."""

    problem: Problem
    first: Knot

    def knots(self, w: ShootingUnknowns) -> tuple[Knot, jax.Array]:
        """Simulate the motion of unknowns w. Return its knots and controls."""
        problem = self.problem
        us = from_unbounded(w.us, problem.low, problem.high)
        ns = problem.system.n
        low, high = problem.parameter_bounds(us.dtype)
        free = jnp.asarray(problem.free)
        state = problem.system.plus(self.first.state, jnp.where(free, w.dx[:ns], 0.0))
        first = Knot(state, from_unbounded(w.dx[ns:], low, high))

        return objective.roll_out(problem, first, lambda k, knot, u: u, us)


def from_unbounded(w: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Map w to the range of its bounds: by a sine for two bounds, by a hyperbola for one."""
    low, high = low.astype(w.dtype), high.astype(w.dtype)
    has_low, has_high = jnp.isfinite(low), jnp.isfinite(high)
    a, b = jnp.where(has_low, low, -1.0), jnp.where(has_high, high, 1.0)
    between = 0.5 * (a + b) + 0.5 * (b - a) * jnp.sin(w)
    hyperbola = jnp.sqrt(w * w + 1) - 1
    one = jnp.where(has_low, a + hyperbola, jnp.where(has_high, b - hyperbola, w))
    return jnp.where(has_low & has_high, between, one)


def to_unbounded(u: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Invert `from_unbounded`; a u at a bound is first moved into the range."""
    low, high = low.astype(u.dtype), high.astype(u.dtype)
    has_low, has_high = jnp.isfinite(low), jnp.isfinite(high)
    a, b = jnp.where(has_low, low, -1.0), jnp.where(has_high, high, 1.0)
    share = (2 * u - a - b) / (b - a)
    between = jnp.arcsin(jnp.clip(share, -EDGE, EDGE))
    away = jnp.maximum(jnp.where(has_low, u - a, b - u), 1e-3)
    hyperbola = jnp.sqrt((away + 1) ** 2 - 1)
    return jnp.where(has_low & has_high, between, jnp.where(has_low | has_high, hyperbola, u))


def lagrangian_residuals(
    s: ShootingProblem, w: ShootingUnknowns, l: ConstraintMultipliers
) -> tuple[list[jax.Array], jax.Array]:
    """Return the residuals of the augmented Lagrangian, and the sum of its other terms."""

    def at(where: str, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array) -> tuple:
        terms = objective.merit_terms(s.problem, where, rows, l.penalty)
        return objective.residuals(terms, k, knot, ctrl)

    (path, rest), (end, last) = objective.over_knots(at, s.problem, *s.knots(w), l[:2])
    return [path.reshape(-1), end], rest.sum() + last


def lagrangian_value(
    s: ShootingProblem, w: ShootingUnknowns, l: ConstraintMultipliers
) -> jax.Array:
    """Return the augmented Lagrangian ()."""
    found, rest = lagrangian_residuals(s, w, l)
    return rest + sum(map(objective.half_square, found), jnp.zeros_like(rest))


class Target(NamedTuple):
    """The stopping criterion of an inner search.

    tolerance: relative to max(|cost|, scale), ().
    scale: ().
    iterations: maximum number of iterations, ().
    """

    tolerance: jax.Array
    scale: jax.Array
    iterations: jax.Array

    def stationarity(
        self, w: ShootingUnknowns, cost: jax.Array, slope: ShootingUnknowns
    ) -> tuple[jax.Array, jax.Array]:
        """Return the squared scaled gradient divided by the cost, and whether the gradient is
        small.

        slope: gradient of the cost by the unknowns w.
        """
        parts = jax.tree.map(lambda x, g: ((g * jnp.maximum(1, jnp.abs(x))) ** 2).sum(), w, slope)
        square, share = sum(parts), jnp.maximum(self.scale, jnp.abs(cost))
        small = square <= self.tolerance * share**2
        return square / jnp.maximum(share, jnp.finfo(share.dtype).tiny), small


class InnerResult(NamedTuple):
    """The result of an inner search: unknowns, status, iterations, stationarity, costs."""

    w: ShootingUnknowns
    status: jax.Array
    iterations: jax.Array
    stationarity: jax.Array
    costs: jax.Array


class Best(NamedTuple):
    """The unknowns of lowest cost, with their cost and gradient norm, and whether the norm is
    small."""

    w: ShootingUnknowns
    cost: jax.Array
    stationarity: jax.Array
    small: jax.Array


Inner = Callable[
    [ShootingProblem, ShootingUnknowns, ConstraintMultipliers, Target, jax.Array, jax.Array],
    InnerResult,
]


def optax_search(optimiser: optax.GradientTransformation) -> Inner:
    """Build a search with an optimiser of optax, which returns the best point. If the best cost
    does not fall within `PATIENCE` iterations, the search restarts from the best point with shorter
    steps."""

    def search(
        s: ShootingProblem, w: ShootingUnknowns, l: ConstraintMultipliers, target: Target,
        used: jax.Array, costs: jax.Array,
    ) -> InnerResult:  # fmt: skip
        value = jax.value_and_grad(lambda w: lagrangian_value(s, w, l))
        dtype, history = w.us.dtype, costs.shape[0]

        def turn(now: tuple) -> tuple:
            w, state, rate, best, mark, count, costs, _ = now
            cost, slope = value(w)
            costs = costs.at[jnp.minimum(count, history - 1)].set(cost)
            fine = jnp.isfinite(cost) & jnp.isfinite(slope.us).all()
            here = Best(w, cost, *target.stationarity(w, cost, slope))
            best = select(fine & (cost < best.cost), here, best)
            change, after = optimiser.update(slope, state, w)
            count = count + 1
            look = (count - used) % PATIENCE == 0
            least = target.tolerance * jnp.maximum(target.scale, jnp.abs(best.cost))
            again = ~fine | (look & (mark - best.cost <= least))
            mark = jnp.where(look, best.cost, mark)
            w = jax.tree.map(lambda x, d, b: jnp.where(again, b, x + rate * d), w, change, best.w)
            state = select(again, optimiser.init(w), after)
            rate = jnp.where(again, SHORTER * rate, rate)
            status = jnp.where(count >= target.iterations, BUDGET, GOING)
            status = jnp.where(rate < SHORTEST, STUCK, status)
            status = jnp.where(best.small, CONVERGED, status)
            status = jnp.where(jnp.isfinite(best.cost), status, NOT_FINITE)
            return w, state, rate, best, mark, count, costs, status

        big, one = jnp.asarray(jnp.inf, dtype), jnp.ones((), dtype)
        best = Best(w, big, big, jnp.asarray(False))
        begin = w, optimiser.init(w), one, best, big, used, costs, jnp.asarray(GOING)
        end: Any = jax.lax.while_loop(lambda now: now[-1] == GOING, turn, begin)
        best = end[3]
        return InnerResult(best.w, end[-1], end[5], best.stationarity, end[6])

    return search


def optimistix_search(squares: bool) -> Inner:
    """Build a search by BFGS, or by Levenberg-Marquardt (squares) if all costs are residuals."""

    def search(
        s: ShootingProblem, w: ShootingUnknowns, l: ConstraintMultipliers, target: Target,
        used: jax.Array, costs: jax.Array,
    ) -> InnerResult:  # fmt: skip
        dtype, history = w.us.dtype, costs.shape[0]
        least = 10 * float(jnp.finfo(dtype).eps)  # shorter steps end a search as stuck
        solver: Any = (optx.LevenbergMarquardt if squares else optx.BFGS)(least, least)

        def fn(w: ShootingUnknowns, _: Any) -> tuple[jax.Array, None]:
            if squares:
                return jnp.concatenate(lagrangian_residuals(s, w, l)[0]), None
            return lagrangian_value(s, w, l), None

        like = jax.eval_shape(lambda w: fn(w, None)[0], w)
        begin: Any = solver.init(fn, w, None, {}, like, None, frozenset())
        numeric, static = eqx.partition(begin, eqx.is_array)

        def turn(now: tuple) -> tuple:
            w, numeric, count, costs, before, fall, *_ = now
            state = eqx.combine(numeric, static)
            w, state, _ = solver.step(fn, w, None, {}, state, frozenset())
            seen = state.f_info
            cost = seen.as_min()
            slope = seen.compute_grad() if squares else seen.grad
            stationarity, small = target.stationarity(w, cost, slope)
            # a rejected step keeps the decrease of the last accepted one
            fall = jnp.where((cost == before) | (count == used), fall, before - cost)
            near = fall <= target.tolerance * jnp.maximum(target.scale, jnp.abs(cost))
            costs = costs.at[jnp.minimum(count, history - 1)].set(cost)
            count = count + 1
            rests = jax.tree.map(
                lambda x, y: (jnp.abs(x - y) <= least * jnp.maximum(1, jnp.abs(y))).all(),
                state.y_eval, w,
            )  # fmt: skip
            status = jnp.where(count >= target.iterations, BUDGET, GOING)
            rest = rests.us & rests.dx
            status = jnp.where(rest, STUCK, status)
            status = jnp.where(small & (near | rest), CONVERGED, status)
            status = jnp.where(jnp.isfinite(cost + stationarity), status, NOT_FINITE)
            numeric = eqx.filter(state, eqx.is_array)
            return w, numeric, count, costs, cost, fall, stationarity, status

        zero = jnp.zeros((), dtype)
        first = w, numeric, used, costs, zero, zero, zero, jnp.asarray(GOING)
        end: Any = jax.lax.while_loop(lambda now: now[-1] == GOING, turn, first)
        return InnerResult(end[0], end[-1], end[2], end[-2], end[3])

    return search


def solve_single_shooting(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, options: SolveOptions,
    history: int, inner: Callable[[Problem], Inner],
) -> SearchResult:  # fmt: skip
    """Solve a problem by single shooting. A guess of the states is used only for a free start."""
    dtype, n = ctrls.dtype, problem.n
    search = inner(problem)
    first = take(knots, 0)
    state = first.state if any(problem.free) else start
    s = ShootingProblem(problem, Knot(state, first.parameters))
    low, high = problem.parameter_bounds(dtype)
    dx = jnp.zeros(n, dtype).at[problem.system.n :].set(to_unbounded(first.parameters, low, high))
    w = ShootingUnknowns(to_unbounded(ctrls, problem.low, problem.high), dx)
    path, closing = (objective.row_count(problem, at) for at in ("path", "end"))
    l = objective.no_multipliers(problem.horizon, path, closing, dtype)
    costs = jnp.full(history, jnp.nan, dtype)
    rule = options.rule
    scale = rule.scale
    if scale is None:
        scale = jnp.minimum(jnp.abs(lagrangian_value(s, w, l)), 1.0)
    least = jnp.maximum(rule.tolerance, FLOOR * jnp.finfo(dtype).eps).astype(dtype)
    target = Target(least, scale.astype(dtype), rule.iterations)
    if not problem.constraints:
        end = search(s, w, l, target, jnp.asarray(0), costs)
        status = end.status
    else:
        end, l, status = _multiplier_iterations(s, w, l, target, rule.violation, costs, search)
    knots, us = s.knots(end.w)
    off, _ = next_multipliers_of(s, knots, us, l)
    return SearchResult(
        knots, us, objective.motion_cost(problem, knots, us), status, end.iterations,
        end.stationarity,
        largest_gap(problem, take(knots.state, 0), knots, us), off,
        end.costs, jnp.zeros((problem.horizon, problem.nu, n), dtype), l.path, l.end,
    )  # fmt: skip


def next_multipliers_of(
    s: ShootingProblem, knots: Knot, us: jax.Array, l: ConstraintMultipliers
) -> tuple[jax.Array, ConstraintMultipliers]:
    """Return the largest violation, and the next multipliers."""
    both = objective.rows_along(s.problem, knots, us)
    ys = []
    for rows, y, where in zip(both, l[:2], ("path", "end"), strict=True):
        bounds = objective.row_bounds(s.problem, where, us.dtype)
        ys.append(l.penalty * objective.shifted_excess(rows, y, l.penalty, *bounds))
    off = objective.constraint_violations(s.problem, *both).max(initial=0.0)
    return off, ConstraintMultipliers(ys[0], ys[1], l.penalty)


def _multiplier_iterations(
    s: ShootingProblem, w: ShootingUnknowns, l: ConstraintMultipliers, target: Target,
    violation: jax.Array, costs: jax.Array, search: Inner,
) -> tuple[InnerResult, ConstraintMultipliers, jax.Array]:  # fmt: skip
    """Run searches in sequence, with updated multipliers and a smaller tolerance after each of
    them. Return the last search, the multipliers and the largest constraint violation."""
    big, least = jnp.asarray(jnp.inf, w.us.dtype), target.tolerance

    def turn(now: tuple) -> tuple:
        end, l, before, inner, _ = now
        end = search(s, end.w, l, target._replace(tolerance=inner), end.iterations, end.costs)
        off, after = next_multipliers_of(s, *s.knots(end.w), l)
        held = off <= violation
        penalty, failing = objective.next_penalty(l.penalty, off, before, held)
        after = after._replace(penalty=penalty)
        hopeless = failing & (off > PERSISTS * before) & (l.penalty >= objective.PENALTY_MOST)
        rests = (end.status == CONVERGED) & (inner <= least)
        status = jnp.where((end.status == STUCK) & held & (before <= violation), STUCK, GOING)
        status = jnp.where(end.iterations >= target.iterations, BUDGET, status)
        status = jnp.where(hopeless, INFEASIBLE, status)
        status = jnp.where(held & rests, CONVERGED, status)
        status = jnp.where(end.status == NOT_FINITE, NOT_FINITE, status)
        return end, after, off, jnp.maximum(CLOSER * inner, least), status

    begin = (
        InnerResult(w, jnp.asarray(GOING), jnp.asarray(0), big, costs), l, big,
        jnp.maximum(least, LOOSE), jnp.asarray(GOING),
    )  # fmt: skip
    last: Any = jax.lax.while_loop(lambda now: now[-1] == GOING, turn, begin)
    end, l, _, _, status = last
    return end, l, status


def adam_search(problem: Problem) -> Inner:
    """Build the search with Adam of optax."""
    return optax_search(optax.adam(RATE))


def bfgs_search(problem: Problem) -> Inner:
    """Build the search with BFGS of optimistix."""
    return optimistix_search(False)


def levenberg_marquardt_search(problem: Problem) -> Inner:
    """Build the search with Levenberg-Marquardt of optimistix, which requires residuals."""
    knot, ctrl = objective.example_knot(problem)
    for where in ("path", "end"):
        terms = objective.cost_terms(problem, where)
        for cost, term in zip(problem.costs(where), terms, strict=True):
            if jax.eval_shape(functools.partial(term, 0.0), knot, ctrl).ndim == 0:
                raise InputError(
                    f"solve: method 'levenberg_marquardt' needs residuals, and the cost "
                    f"{cost.term.label} is a scalar; return a vector, or use 'bfgs'"
                )
    return optimistix_search(True)
