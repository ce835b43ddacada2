"""The cost of a problem: at a knot, along a motion, and split into residuals and numbers."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.control.optimal.problem import BODY, Knot, Problem


def half_square(value: jax.Array) -> jax.Array:
    """The cost () of a term's value: a number itself, of residuals r.r / 2."""
    return 0.5 * (value * value).sum() if value.ndim else value


def knot_cost(problem: Problem, where: str, k: Any, knot: Knot, ctrl: jax.Array) -> jax.Array:
    """The sum () of the costs of a knot with controls ("path") or of the "end"."""
    total = jnp.zeros((), ctrl.dtype)
    for cost in problem.costs(where):
        total = total + half_square(problem.value(cost, where, k, knot, ctrl))
    return total


def motion_cost(problem: Problem, knots: Knot, ctrls: jax.Array) -> jax.Array:
    """The cost () of a motion, without penalties."""
    path, end = over_knots(functools.partial(knot_cost, problem), problem, knots, ctrls)
    return path.sum() + end


def residuals(
    problem: Problem, where: str, k: Any, knot: Knot, ctrl: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """All residuals (r,) of a knot, and the sum () of the costs that are numbers."""
    vectors, rest = [jnp.zeros(0, ctrl.dtype)], jnp.zeros((), ctrl.dtype)
    for cost in problem.costs(where):
        value = problem.value(cost, where, k, knot, ctrl)
        if value.ndim:
            vectors.append(value)
        else:
            rest = rest + value
    return jnp.concatenate(vectors), rest


def over_knots(f: Any, problem: Problem, knots: Knot, ctrls: jax.Array) -> tuple[Any, Any]:
    """f("path", k, knot, ctrl) of all knots with controls, and f("end", N, knot, 0) of the last."""
    body, last = (jax.tree.map(lambda x, at=at: x[at], knots) for at in (BODY, -1))
    ks = jnp.arange(problem.horizon, dtype=ctrls.dtype)
    path = jax.vmap(functools.partial(f, "path"))(ks, body, ctrls)
    return path, f("end", problem.horizon, last, jnp.zeros(problem.nu, ctrls.dtype))
