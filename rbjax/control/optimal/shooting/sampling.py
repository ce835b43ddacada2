"""Sampling-based optimal control: predictive sampling, MPPI and the cross-entropy method.

Controls are a spline with few points z. Each round draws z_i = m + s * e_i, e_i normal, within the
bounds, rolls out every sample, and updates m from the costs J_i:

    predictive       m+ = the best z_i
    mppi             m+ = sum w_i z_i / sum w_i,   w_i = exp(-(J_i - J_min) / lambda)
    cross_entropy    m+, s+ = mean and deviation of the best tenth of z_i

The first two multiply s by a factor below 1 each round. lambda is the temperature times the cost
range of the best tenth. Constraints cost penalty / 2 times their squared violation. Design
parameters, the final time and a free start are sampled too.
Source: Howell et al. 2022; Williams et al. 2017; Rubinstein 1999; Xue et al. 2024.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, integer, real_number
from rbjax.compiler import threads
from rbjax.control.optimal.objective import (
    constraint_violations,
    merit,
    motion_cost,
    roll_out,
    row_count,
    rows_along,
)
from rbjax.control.optimal.problem import Knot, Problem, take
from rbjax.control.optimal.shooting.ddp import solve_ddp
from rbjax.control.optimal.shooting.expansion import largest_gap
from rbjax.control.optimal.solution import SearchResult, SolveOptions
from rbjax.control.status import BUDGET, FINISHED, GOING, NOT_FINITE
from rbjax.errors import InputError
from rbjax.lanes.arrays import select

UPDATES = ("predictive", "mppi", "cross_entropy")
SPLINES = ("hold", "linear", "cubic")
ELITES = 0.1  # fraction of the samples in the best group


@dataclasses.dataclass(frozen=True)
class Sampling:
    """A sampling method for `solve`.

    update: "predictive", "mppi" or "cross_entropy".
    samples: number of samples in a round.
    points: number of points of the spline, at most N.
    spline: "hold", "linear" or "cubic".
    spread: first standard deviation, relative to the width of the bounds; in the units of the
        controls without bounds.
    cooling: factor of the deviation after a round.
    temperature: of MPPI.
    smoothing: fraction of the old deviation in the update of the cross-entropy method.
    penalty: of constraint violations.
    ddp_after: number of rounds after which DDP continues from the best motion; None without DDP.

    Example:
        >>> import jax.numpy as jnp
        >>> import rbjax as rb
        >>> line = rb.control.Equations(lambda t, x, u: x + u, 1, 1, discrete=True)
        >>> problem = rb.control.Problem(line, 3, 1.0, terminal=[lambda t, x, u: x], bounds=(-1, 1))
        >>> few = rb.control.Sampling("mppi", samples=50, points=3)
        >>> found = rb.control.solve(problem, jnp.ones(1), method=few, iterations=20)
        >>> bool(found.cost < 1e-3)
        True
    """

    update: str = "cross_entropy"
    samples: int = 1024
    points: int = 16
    spline: str = "linear"
    spread: float = 0.3
    cooling: float = 0.97
    temperature: float = 0.5
    smoothing: float = 0.2
    penalty: float = 1e4
    ddp_after: int | None = None

    def __post_init__(self) -> None:
        for what, names in (("update", UPDATES), ("spline", SPLINES)):
            choice(f"{what} of Sampling", getattr(self, what), names)
        integer("Sampling", "samples", self.samples, least=10)
        if self.ddp_after is not None:
            integer("Sampling", "ddp_after", self.ddp_after, least=1)
        integer("Sampling", "points", self.points, least=1)
        for what, low, high in (
            ("cooling", 0.0, 1.0), ("smoothing", 0.0, 1.0), ("spread", 1e-12, 1e12),
            ("temperature", 1e-12, 1e12), ("penalty", 0.0, 1e300),
        ):  # fmt: skip
            value = getattr(self, what)
            if np.ndim(value):
                raise InputError(f"Sampling: {what} has shape {np.shape(value)}, expected a number")
            real_number("Sampling", what, value, least=low, most=high, traced=True)


def solve_sampled_ddp(
    how: Sampling, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array,
    options: SolveOptions, history: int,
) -> SearchResult:  # fmt: skip
    """Run the rounds of a sampling method, then DDP from its result."""
    few = options.replace(rule=options.rule._replace(iterations=jnp.asarray(how.ddp_after)))
    found = solve_sampling(how, problem, start, knots, ctrls, few, 1)
    good = jnp.isfinite(found.cost)
    pick = lambda new, old: jnp.where(good, new, old)  # noqa: E731
    knots, ctrls = jax.tree.map(pick, (found.knots, found.ctrl), (knots, ctrls))
    return solve_ddp(problem, start, knots, ctrls, options, history)


class Draw(NamedTuple):
    """A sample.

    points: of the spline, (K, m).
    parameters: of the design and the final time, (p,).
    first: tangent vector dx0 of the start, (n,).
    """

    points: jax.Array
    parameters: jax.Array
    first: jax.Array


class SamplingRound(NamedTuple):
    """The state of a sampling method between two rounds: distribution, best sample, its cost."""

    mean: Draw
    deviation: Draw
    best: Draw
    cost: jax.Array
    cost_spread: jax.Array
    iterations: jax.Array
    costs: jax.Array
    status: jax.Array


def solve_sampling(
    how: Sampling, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array,
    options: SolveOptions, history: int,
) -> SearchResult:  # fmt: skip
    """Solve a problem with a sampling method. It finishes if the costs of the best tenth agree to
    the tolerance, relative to the cost. Since their deviation shrinks everywhere, this does not
    prove optimality."""
    dtype = ctrls.dtype
    mean, first, low, high = _initial_distribution(how, problem, start, knots, ctrls)
    key = jax.random.key(options.seed)
    elites = max(2, round(ELITES * how.samples))

    def cost_of(draw: Draw, start: Any) -> jax.Array:
        cost = sampled_cost(how, problem, start, draw)
        return jnp.where(jnp.isfinite(cost), cost, jnp.inf)

    costs_of = jax.vmap(threads(cost_of), (0, None))

    def turn(now: SamplingRound) -> SamplingRound:
        drawn = _draw_samples(jax.random.fold_in(key, now.iterations), now, how.samples, low, high)
        costs = costs_of(drawn, start)
        least, order = jax.lax.top_k(-costs, elites)
        least = -least
        good = take(drawn, order)
        mean, deviation = _update_distribution(how, now, good, least, costs, drawn)
        better = least[0] < now.cost
        cost = jnp.where(better, least[0], now.cost)
        best = jax.tree.map(lambda x, old: jnp.where(better, x[0], old), good, now.best)
        iterations, cost_spread = now.iterations + 1, least[-1] - least[0]
        status = jnp.where(iterations >= options.rule.iterations, BUDGET, GOING)
        small = cost_spread <= options.rule.tolerance * jnp.maximum(1.0, jnp.abs(cost))
        status = jnp.where(small, FINISHED, status)
        status = jnp.where(jnp.isfinite(cost) | (status == GOING), status, NOT_FINITE)
        costs = now.costs.at[jnp.minimum(now.iterations, history - 1)].set(cost)
        return SamplingRound(mean, deviation, best, cost, cost_spread, iterations, costs, status)

    endless = jnp.asarray(jnp.inf, dtype)
    begin = SamplingRound(
        mean, first, mean, endless, endless, jnp.asarray(0), jnp.full(history, jnp.nan, dtype),
        jnp.asarray(GOING),
    )  # fmt: skip
    last = jax.lax.while_loop(lambda now: now.status == GOING, turn, begin)
    found, us = threads(functools.partial(sampled_motion, how, problem))(start, last.best)
    N, n, m = problem.horizon, problem.n, problem.nu
    rows = [row_count(problem, where) for where in ("path", "end")]
    off = constraint_violations(problem, *rows_along(problem, found, us)).max(initial=0.0)
    return SearchResult(
        found, us, motion_cost(problem, found, us), last.status, last.iterations, last.cost_spread,
        largest_gap(problem, take(found.state, 0), found, us),
        off, last.costs, jnp.zeros((N, m, n), dtype),
        jnp.zeros((N, rows[0]), dtype), jnp.zeros(rows[1], dtype),
    )  # fmt: skip


def _initial_distribution(
    how: Sampling, problem: Problem, start: Any, knots: Knot, ctrls: jax.Array
) -> tuple[Draw, Draw, Draw, Draw]:
    """Return the first mean and deviation of the samples, and their bounds."""
    dtype, n = ctrls.dtype, problem.system.n
    count = min(how.points, problem.horizon)
    at = np.round(np.linspace(0, problem.horizon - 1, count)).astype(int)
    parameters = knots.parameters[0]
    free = jnp.asarray(problem.free, dtype)
    there = problem.system.minus(take(knots.state, 0), start)
    mean = Draw(ctrls[at], parameters, free * there)
    edges = [
        Draw(jnp.broadcast_to(u.astype(dtype), (count, problem.nu)), p, jnp.full(n, end, dtype))
        for u, p, end in zip(
            (problem.low, problem.high), problem.parameter_bounds(dtype), (-jnp.inf, jnp.inf),
            strict=True,
        )
    ]  # fmt: skip

    def deviation(low: jax.Array, high: jax.Array, size: Any) -> jax.Array:
        width = high - low
        return how.spread * jnp.where(jnp.isfinite(width), width, size)

    one = jnp.ones((), dtype)
    sizes = Draw(one, jnp.maximum(jnp.abs(parameters), 1e-3), one)
    wide = jax.tree.map(deviation, *edges, sizes)
    mean = jax.tree.map(jnp.clip, mean, *edges)
    return mean, wide._replace(first=free * wide.first), *edges


def _draw_samples(key: jax.Array, now: SamplingRound, samples: int, low: Draw, high: Draw) -> Draw:
    """Draw the samples of a round; the first of them is the mean."""
    keys = Draw(*jax.random.split(key, 3))

    def one(key: jax.Array, mean: jax.Array, deviation: Any, low: Any, high: Any) -> jax.Array:
        e = jax.random.normal(key, (samples, *mean.shape), mean.dtype).at[0].set(0.0)
        return jnp.clip(mean + deviation * e, low, high)

    return jax.tree.map(one, keys, now.mean, now.deviation, low, high)


def _update_distribution(
    how: Sampling, now: SamplingRound, good: Draw, least: jax.Array, costs: jax.Array, drawn: Draw
) -> tuple[Draw, Draw]:
    """Return the next mean and deviation. good, least: the best samples and costs, sorted."""
    colder = jax.tree.map(lambda s: s * how.cooling, now.deviation)
    if how.update == "predictive":
        mean, deviation = take(good, 0), colder
    elif how.update == "mppi":
        scale = how.temperature * (least[-1] - least[0])
        tiny = jnp.finfo(costs.dtype).tiny
        w = jnp.exp(-(costs - least[0]) / jnp.maximum(scale, tiny))
        w = jnp.where(jnp.isfinite(w), w, 0.0)
        w = w / jnp.maximum(w.sum(), tiny)
        mean, deviation = jax.tree.map(lambda x: _weighted(w, x), drawn), colder
    else:
        w = jnp.where(jnp.isfinite(least), 1.0, 0.0)
        w = w / jnp.maximum(w.sum(), 1.0)
        mean = jax.tree.map(lambda x: _weighted(w, x), good)
        keep = how.smoothing

        def spread(x: jax.Array, m: jax.Array, old: jax.Array) -> jax.Array:
            return keep * old + (1 - keep) * jnp.sqrt(_weighted(w, (x - m) ** 2))

        deviation = jax.tree.map(spread, good, mean, now.deviation)
    some = jnp.isfinite(least[0])  # otherwise draw again from the same distribution
    return select(some, (mean, deviation), (now.mean, now.deviation))


def _weighted(w: jax.Array, x: jax.Array) -> jax.Array:
    return (w.reshape(-1, *[1] * (x.ndim - 1)) * x).sum(0)


def control_at(how: Sampling, points: jax.Array, k: jax.Array, horizon: int) -> jax.Array:
    """Return the controls (m,) at knot k of the spline with points (K, m). The first point is at
    knot 0 and the last at knot horizon - 1. "hold" changes halfway between points."""
    count = points.shape[0]
    if count == 1:
        return points[0]
    s = k * jnp.asarray((count - 1) / max(horizon - 1, 1), points.dtype)
    if how.spline == "hold":
        return points[jnp.clip(jnp.floor(s + 0.5).astype(int), 0, count - 1)]
    j = jnp.clip(jnp.floor(s).astype(int), 0, count - 2)
    t = s - j
    a, b = points[j], points[j + 1]
    if how.spline == "linear":
        return a + t * (b - a)
    # Catmull-Rom, with the end points repeated
    before, after = points[jnp.maximum(j - 1, 0)], points[jnp.minimum(j + 2, count - 1)]
    da, db = 0.5 * (b - before), 0.5 * (after - a)
    curve = a + t * (da + t * (3 * (b - a) - 2 * da - db + t * (2 * (a - b) + da + db)))
    return curve


def _first_knot(problem: Problem, start: Any, draw: Draw) -> Knot:
    state = problem.system.plus(start, draw.first) if any(problem.free) else start
    return Knot(state, draw.parameters)


def _ctrl(how: Sampling, problem: Problem, draw: Draw, k: jax.Array) -> jax.Array:
    return problem.within_bounds(control_at(how, draw.points, k, problem.horizon))


def sampled_cost(how: Sampling, problem: Problem, start: Any, draw: Draw) -> jax.Array:
    """Return the cost () of a sample, with the penalties of constraints."""
    dtype, N = draw.points.dtype, problem.horizon
    mu = jnp.asarray(how.penalty, dtype)
    rows = [jnp.zeros(row_count(problem, where), dtype) for where in ("path", "end")]

    def step(carry: tuple, k: jax.Array) -> tuple[tuple, None]:
        knot, total = carry
        u = _ctrl(how, problem, draw, k)
        total = total + merit(problem, "path", k, knot, u, rows[0], mu)
        return (problem.step(k, knot, u), total), None

    begin = (_first_knot(problem, start, draw), jnp.zeros((), dtype))
    (last, total), _ = jax.lax.scan(step, begin, jnp.arange(N, dtype=dtype))
    none = jnp.zeros(problem.nu, dtype)
    return total + merit(problem, "end", jnp.asarray(N, dtype), last, none, rows[1], mu)


def sampled_motion(
    how: Sampling, problem: Problem, start: Any, draw: Draw
) -> tuple[Knot, jax.Array]:
    """Return the knots (N + 1, ...) and controls (N, m) of a sample."""
    first = _first_knot(problem, start, draw)
    return roll_out(problem, first, lambda k, *_: _ctrl(how, problem, draw, k), ())
