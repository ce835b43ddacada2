"""The constraints of a problem as rows of numbers: their bounds, values and violations.

    low <= c <= high,      violation = |c - clip(c, low, high)|
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.control.optimal.objective import over_knots
from rbjax.control.optimal.problem import Knot, Problem
from rbjax.errors import InputError


def example(problem: Problem) -> tuple[Knot, jax.Array]:
    """A knot and controls, of which only shapes count."""
    dtype = problem.dt.dtype
    state = problem.system.example(dtype)
    return Knot(state, problem.first_parameters(dtype)), jnp.zeros(problem.nu, dtype)


def row_sizes(problem: Problem, where: str) -> list[tuple[Any, int]]:
    """Each constraint at "path" or "end" with the number of its rows."""
    knot, ctrl = example(problem)
    out = []
    for c in problem.constraints_at(where):

        def value(knot: Knot, ctrl: jax.Array, c: Any = c) -> jax.Array:
            system, _ = problem.at(knot.parameters)
            return jnp.ravel(c.term(system.model, 0.0, knot.state, ctrl))

        size = jax.eval_shape(value, knot, ctrl).shape[0]
        for name, end in (("low", c.low), ("high", c.high)):
            if jnp.size(end) not in (1, size):
                raise InputError(
                    f"Constraint({c.name}): bounds and term differ in size: {name} has "
                    f"{jnp.size(end)} numbers, the term {size}; give one, or one for each"
                )
        out.append((c, size))
    return out


def row_count(problem: Problem, where: str) -> int:
    """The number of rows of the constraints at "path" or "end"."""
    return sum(size for _, size in row_sizes(problem, where))


def limits(problem: Problem, where: str, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """The bounds (c,) of the rows at "path" or "end"."""
    lows, highs = [jnp.zeros(0, dtype)], [jnp.zeros(0, dtype)]
    for c, size in row_sizes(problem, where):
        lows.append(jnp.broadcast_to(jnp.ravel(c.low), (size,)))
        highs.append(jnp.broadcast_to(jnp.ravel(c.high), (size,)))
    return jnp.concatenate(lows).astype(dtype), jnp.concatenate(highs).astype(dtype)


def violation(c: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """By how much values lie outside their bounds, entry by entry."""
    return jnp.abs(c - jnp.clip(c, low, high))


def knot_violation(problem: Problem, k: Any, knot: Knot, ctrl: jax.Array, where: str) -> jax.Array:
    """The largest violation () of the constraints of a knot."""
    if not problem.constraints:
        return jnp.zeros((), ctrl.dtype)
    c = problem.rows(k, knot, ctrl, where)
    return violation(c, *limits(problem, where, c.dtype)).max(initial=0.0)


def rows_along(problem: Problem, knots: Knot, ctrls: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The rows of a motion: (N, c) of the knots with controls, (e,) of the end."""

    def rows(where: str, k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
        return problem.rows(k, knot, ctrl, where)

    return over_knots(rows, problem, knots, ctrls)


def constraint_violations(problem: Problem, path: jax.Array, end: jax.Array) -> jax.Array:
    """The largest violation of each constraint: path (..., c) and end (e,), the rows."""
    worst = {id(c): jnp.zeros((), path.dtype) for c in problem.constraints}
    for where, rows in (("path", path), ("end", end)):
        off = violation(rows, *limits(problem, where, rows.dtype))
        at = 0
        for c, size in row_sizes(problem, where):
            worst[id(c)] = jnp.maximum(worst[id(c)], off[..., at : at + size].max(initial=0.0))
            at += size
    return jnp.stack([*worst.values()]) if worst else jnp.zeros(0, path.dtype)
