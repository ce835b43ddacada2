"""The cost and the constraints of a problem, at a knot and along a motion.

    violation = |c - clip(c, low, high)|
    L = cost + mu/2 |s - clip(s, low, high)|^2,     s = c + lambda / mu
    lambda <- mu (s - clip(s, low, high)),     mu <- 10 mu if the violation did not fall

L is the augmented Lagrangian of the constraints low <= c <= high.
Source: Hestenes 1969, Powell 1969; Bertsekas, *Constrained Optimization and Lagrange Multiplier
Methods*, 2.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.optimal.problem import BODY, Knot, Problem, append, take
from rbjax.display import displayed
from rbjax.errors import InputError


def example_knot(problem: Problem) -> tuple[Knot, jax.Array]:
    """Return a knot and controls with the right shapes; their values are arbitrary."""
    dtype = problem.dt.dtype
    state = problem.system.example(dtype)
    return Knot(state, problem.first_parameters(dtype)), jnp.zeros(problem.nu, dtype)


def row_sizes(problem: Problem, where: str) -> list[tuple[Any, int]]:
    """Return each constraint at "path" or "end" with its number of rows."""
    knot, ctrl = example_knot(problem)
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
                    f"{jnp.size(end)} entries, the term has {size}; give one entry, or {size}"
                )
        out.append((c, size))
    return out


def row_count(problem: Problem, where: str) -> int:
    """Return the number of constraint rows at "path" or "end"."""
    return sum(size for _, size in row_sizes(problem, where))


def row_bounds(problem: Problem, where: str, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """Return the bounds of the constraint rows at "path" or "end", (c,) each."""
    lows, highs = [jnp.zeros(0, dtype)], [jnp.zeros(0, dtype)]
    for c, size in row_sizes(problem, where):
        lows.append(jnp.broadcast_to(jnp.ravel(c.low), (size,)))
        highs.append(jnp.broadcast_to(jnp.ravel(c.high), (size,)))
    return jnp.concatenate(lows).astype(dtype), jnp.concatenate(highs).astype(dtype)


def violation(c: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Return the distance of each value from its bounds, 0 within them."""
    return jnp.abs(c - jnp.clip(c, low, high))


def knot_violation(problem: Problem, where: str, k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
    """Return the largest constraint violation () at a knot."""
    if not problem.constraints:
        return jnp.zeros((), ctrl.dtype)
    c = problem.rows(where, k, knot, ctrl)
    return violation(c, *row_bounds(problem, where, c.dtype)).max(initial=0.0)


def rows_along(problem: Problem, knots: Knot, ctrls: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the constraint rows of a motion: path (N, c) and end (e,)."""
    return over_knots(problem.rows, problem, knots, ctrls)


def constraint_violations(problem: Problem, path: jax.Array, end: jax.Array) -> jax.Array:
    """Return the largest violation of each constraint, from the rows path (..., c) and end (e,)."""
    worst = {id(c): jnp.zeros((), path.dtype) for c in problem.constraints}
    for where, rows in (("path", path), ("end", end)):
        off = violation(rows, *row_bounds(problem, where, rows.dtype))
        at = 0
        for c, size in row_sizes(problem, where):
            worst[id(c)] = jnp.maximum(worst[id(c)], off[..., at : at + size].max(initial=0.0))
            at += size
    return jnp.stack([*worst.values()]) if worst else jnp.zeros(0, path.dtype)


PENALTY, HARDER, PENALTY_MOST = 10.0, 10.0, 1e8
FALLS = 0.25  # the penalty rises if the violation does not fall to this fraction


@displayed
class ConstraintMultipliers(NamedTuple):
    """Multipliers of the constraints: path (N, c), end (e,); and the penalty mu ()."""

    path: jax.Array
    end: jax.Array
    penalty: jax.Array


def no_multipliers(
    N: int, path: int, end: int, dtype: jax.typing.DTypeLike
) -> ConstraintMultipliers:
    """Return zero multipliers of `path` and `end` rows, and the first penalty."""
    zero = jnp.zeros((N, path), dtype), jnp.zeros(end, dtype)
    return ConstraintMultipliers(*zero, jnp.asarray(PENALTY, dtype))


def shift_multipliers(
    multipliers: ConstraintMultipliers | None, at: jax.Array
) -> ConstraintMultipliers | None:
    """Shift the multipliers to a later motion. at (N,): its knot indices in the earlier one."""
    if multipliers is None:
        return None
    return multipliers._replace(path=multipliers.path[at])


def shifted_excess(
    c: jax.Array, y: jax.Array, mu: jax.Array, low: jax.Array, high: jax.Array
) -> jax.Array:
    """Return s - clip(s, low, high), s = c + y / mu. Times sqrt(mu) it is the residual of L. Times
    mu it is the next multiplier."""
    s = c + y / mu
    return s - jnp.clip(s, low, high)


def next_penalty(
    mu: jax.Array, violation: jax.Array, before: jax.Array, held: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the next penalty, and whether the violation has not fallen enough.

    before: violation at the last update of the multipliers.
    held: true if the violation is within the tolerance.
    """
    failing = ~held & (violation > FALLS * before)
    return jnp.where(failing, jnp.minimum(HARDER * mu, PENALTY_MOST), mu), failing


def half_square(value: jax.Array) -> jax.Array:
    """Return the cost () of a term's value: the number itself, or r.r / 2 of residuals r."""
    return 0.5 * (value * value).sum() if value.ndim else value


def cost_terms(problem: Problem, where: str) -> list[Any]:
    """Return a function (k, knot, ctrl) -> weighted residuals or a number, for each cost."""
    return [functools.partial(problem.value, cost, where) for cost in problem.costs(where)]


def merit_terms(problem: Problem, where: str, rows: jax.Array, mu: jax.Array) -> list[Any]:
    """Return the terms of the merit function: costs, and augmented Lagrangian residuals."""
    found = cost_terms(problem, where)
    at = 0
    for c, size in row_sizes(problem, where):
        own = rows[at : at + size]
        at += size

        def penalty(k: Any, knot: Knot, ctrl: jax.Array, c: Any = c, own: Any = own) -> jax.Array:
            value = problem.row(c, k, knot, ctrl)
            low, high = (jnp.ravel(jnp.asarray(x, value.dtype)) for x in (c.low, c.high))
            return jnp.sqrt(mu) * shifted_excess(value, own, mu, low, high)

        found.append(penalty)
    return found


def sum_terms(terms: list[Any], k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
    """Return the sum () of the costs of terms."""
    total = jnp.zeros((), ctrl.dtype)
    for term in terms:
        total = total + half_square(term(k, knot, ctrl))
    return total


def knot_cost(problem: Problem, where: str, k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
    """Return the cost () of a knot with controls ("path") or of the "end"."""
    return sum_terms(cost_terms(problem, where), k, knot, ctrl)


def merit(
    problem: Problem, where: str, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array,
    mu: jax.Array,
) -> jax.Array:  # fmt: skip
    """Return the cost () of a knot, including its terms of the augmented Lagrangian."""
    return sum_terms(merit_terms(problem, where, rows, mu), k, knot, ctrl)


def residuals(terms: list[Any], k: Any, knot: Knot, ctrl: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return all residuals (r,) of terms, and the sum () of the terms that are numbers."""
    vectors, rest = [jnp.zeros(0, ctrl.dtype)], jnp.zeros((), ctrl.dtype)
    for term in terms:
        value = term(k, knot, ctrl)
        if value.ndim:
            vectors.append(value)
        else:
            rest = rest + value
    return jnp.concatenate(vectors), rest


def over_knots(
    f: Any, problem: Problem, knots: Knot, ctrls: jax.Array, rows: tuple = ()
) -> tuple[Any, Any]:
    """Evaluate f("path", k, knot, ctrl) at knots with controls, f("end", N, knot, 0) at the last.

    rows: empty, or the values of a last argument of f, at the path (N, ...) and at the end.
    """
    body, last = take(knots, BODY), take(knots, -1)
    ks = jnp.arange(problem.horizon, dtype=ctrls.dtype)
    path = jax.vmap(functools.partial(f, "path"))(ks, body, ctrls, *rows[:1])
    return path, f("end", problem.horizon, last, jnp.zeros(problem.nu, ctrls.dtype), *rows[1:])


def motion_cost(problem: Problem, knots: Knot, ctrls: jax.Array) -> jax.Array:
    """Return the cost () of a motion, without penalties."""
    path, end = over_knots(functools.partial(knot_cost, problem), problem, knots, ctrls)
    return path.sum() + end


def roll_out(problem: Problem, first: Knot, policy: Any, given: Any) -> tuple[Knot, jax.Array]:
    """Roll out a policy (k, knot, entry k of `given`) -> ctrl; return knots and controls."""

    def step(knot: Knot, x: tuple) -> tuple[Knot, tuple[Knot, jax.Array]]:
        u = policy(x[0], knot, x[1])
        return problem.step(x[0], knot, u), (knot, u)

    ks = jnp.arange(problem.horizon, dtype=first.parameters.dtype)
    last, (knots, ctrls) = jax.lax.scan(step, first, (ks, given))
    return append(knots, last), ctrls
