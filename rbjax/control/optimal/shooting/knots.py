"""A problem to second order at all of its knots, and the gaps between its steps.

    gap_0 = start (-) x_0,      gap_{k+1} = f(x_k, u_k) (-) x_{k+1}

States and controls are unknowns (multiple shooting, Bock & Plitt 1984), so a step need not end at
the next knot. Each knot is a program of one sample (`rb.threads`).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler import map_threads, threads, with_multi_kernel
from rbjax.control.optimal.constraint_rows import knot_violation, limits
from rbjax.control.optimal.problem import BODY, NEXT, Knot, Problem
from rbjax.control.optimal.shooting.augmented_lagrangian import (
    Multipliers,
    next_multipliers,
)
from rbjax.control.optimal.shooting.expansion import (
    Local,
    Quadratic,
    costates,
    quadratic,
    second_order,
)

#: knots, of all problems together, up to which a GPU has a thread a column
FEW = 2048


class Expanded(NamedTuple):
    """All knots to second order; gaps (N + 1, n), the first from the first knot to the start;
    cost (), with the augmented Lagrangian; gap () and violation (), the largest."""

    path: Local
    end: Quadratic
    gaps: jax.Array
    cost: jax.Array
    gap: jax.Array
    violation: jax.Array


def expand(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, multipliers: Multipliers
) -> Expanded:
    """All knots to second order, side by side."""
    N, dtype = problem.horizon, ctrls.dtype
    body, following = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, NEXT))

    def cost_of(k, knot, ctrl, rows, mu):
        cost = quadratic(problem, k, knot, ctrl, rows, mu, "path")
        return cost, knot_violation(problem, k, knot, ctrl, "path")

    def one(k, knot, ctrl, rows, mu, following):
        after, A, B = problem.linear(k, knot, ctrl)
        cost, off = cost_of(k, knot, ctrl, rows, mu)
        return Local(A, B, cost), problem.minus(after, following), off

    def by_columns(k, knot, ctrl, rows, mu, following):
        def of_whole(k, ctrl, rows, mu):
            return cost_of(k, knots_at(knots, k)[0], ctrl, rows, mu)

        A, B, gap = columns(problem, k, knots, ctrl)
        cost, off = threads(of_whole)(k, ctrl, rows, mu)
        return Local(A, B, cost), gap, off

    def ends(start, knots, rows, mu):
        """The gap of the start, and the end."""
        first, last = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (0, -1))
        gap = problem.off_start(start, first)
        none = jnp.zeros(problem.nu, dtype)
        cost = quadratic(problem, jnp.asarray(N, dtype), last, none, rows, mu, "end")
        return gap, cost, knot_violation(problem, jnp.asarray(N, dtype), last, none, "end")

    ks, mu = knot_indices(N, dtype), multipliers.penalty
    path, gaps, off = jax.vmap(with_multi_kernel(one, by_columns, FEW), (0, 0, 0, 0, None, 0))(
        ks, body, ctrls, multipliers.path, mu, following
    )
    gap, end, off_end = threads(ends)(start, knots, multipliers.end, mu)
    gaps = jnp.concatenate([gap[None], gaps])
    off = jnp.maximum(off.max(), off_end) if problem.constraints else jnp.zeros((), dtype)
    return Expanded(path, end, gaps, path.cost.c.sum() + end.c, jnp.abs(gaps).max(), off)


def columns(
    problem: Problem, k: jax.Array, knots: Knot, ctrl: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A, B and the gap of knot k, a thread a column."""
    n, none = problem.n, np.zeros(problem.n + problem.nu, ctrl.dtype)

    def column(direction: jax.Array) -> tuple[jax.Array, jax.Array]:
        knot, following = knots_at(knots, k)
        after = problem.step(k, knot, ctrl)

        def moved(d: jax.Array) -> jax.Array:
            there = problem.step(k, problem.plus(knot, d[:n]), ctrl + d[n:])
            return problem.minus(there, after)

        return jax.jvp(moved, (jnp.asarray(none),), (direction,))[1], problem.minus(
            after, following
        )

    both, gap = map_threads(column, [jnp.asarray(np.eye(len(none), dtype=none.dtype))], [1])
    return both[:, :n], both[:, n:], gap[:, 0]


def knot_indices(N: int, dtype: Any) -> jax.Array:
    """The indices of the knots with controls, as a constant of the program."""
    return jnp.asarray(np.arange(N, dtype=dtype))


def knots_at(knots: Any, k: jax.Array) -> tuple[Any, Any]:
    """Knot k and the next one, read in a program of one sample: slices of arrays outside of it are
    copies, and each copy is a kernel."""
    k = k.astype(np.uint32)
    here, following = (
        jax.tree.map(lambda x, i=i: jax.lax.dynamic_index_in_dim(x, i, keepdims=False), knots)
        for i in (k, k + np.uint32(1))
    )
    return here, following


def add_curvature(
    problem: Problem, knots: Knot, ctrls: jax.Array, multipliers: Multipliers, found: Expanded
) -> Expanded:
    """All knots with the second derivatives that Gauss-Newton omits."""
    N, dtype, mu = problem.horizon, ctrls.dtype, multipliers.penalty
    body, last = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, -1))

    def one(k, knot, ctrl, rows, costate):
        return second_order(problem, k, knot, ctrl, rows, mu, "path", costate)

    def closing(knot, rows):
        none = jnp.zeros(problem.nu, dtype)
        return second_order(problem, jnp.asarray(N, dtype), knot, none, rows, mu, "end")

    def added(cost: Quadratic, more: tuple) -> Quadratic:
        Q, R, S = more
        return cost._replace(Q=cost.Q + Q, R=cost.R + R, S=cost.S + S)

    l = threads(costates)(found.path, found.end)
    ks = jnp.arange(N, dtype=dtype)
    more = jax.vmap(threads(one))(ks, body, ctrls, multipliers.path, l)
    path = found.path._replace(cost=added(found.path.cost, more))
    end = added(found.end, threads(closing)(last, multipliers.end))
    return found._replace(path=path, end=end)


def updated_multipliers(
    problem: Problem, knots: Knot, ctrls: jax.Array, multipliers: Multipliers
) -> tuple[jax.Array, jax.Array]:
    """The next multipliers of path and end, side by side."""
    N, dtype = problem.horizon, ctrls.dtype

    def one(where, k, knot, ctrl, y, mu):
        c = problem.rows(k, knot, ctrl, where)
        return next_multipliers(c, y, mu, *limits(problem, where, c.dtype))

    body, last = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, -1))
    ks, mu = jnp.arange(N, dtype=dtype), multipliers.penalty
    path = multipliers.path
    if path.size:
        along = threads(functools.partial(one, "path"))
        path = jax.vmap(along, (0, 0, 0, 0, None))(ks, body, ctrls, path, mu)
    none = jnp.zeros(problem.nu, dtype)
    closing = threads(functools.partial(one, "end"))
    end = closing(jnp.asarray(N, dtype), last, none, multipliers.end, mu)
    return path, end


def largest_gap(problem: Problem, start: Any, knots: Knot, ctrls: jax.Array) -> jax.Array:
    """The largest entry of a gap between a step and the next state, and of the start's."""
    body, following = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, NEXT))

    def one(k: Any, knot: Knot, ctrl: jax.Array, after: Knot) -> jax.Array:
        return jnp.abs(problem.minus(problem.step(k, knot, ctrl), after)).max()

    ks = jnp.arange(problem.horizon, dtype=ctrls.dtype)
    gap = jax.vmap(threads(one))(ks, body, ctrls, following).max()
    first = jax.tree.map(lambda x: x[0], knots)
    return jnp.maximum(gap, jnp.abs(problem.off_start(start, first)).max())
