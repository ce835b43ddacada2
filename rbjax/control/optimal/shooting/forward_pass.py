"""The forward pass of differential dynamic programming: a motion tried along a step.

    x_0 = xs_0 (+) a dx_0,   u_k = us_k + a k_k + K_k (x_k (-) xs_k),   within the bounds
    x_{k+1} = f(x_k, u_k) (+) (a - 1) gap_{k+1}

With a = 1 the motion obeys the dynamics; with less, gaps close in proportion (Mastalli et al.
2020).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.optimal.objective import Multipliers, knot_violation, merit
from rbjax.control.optimal.problem import Knot, Problem
from rbjax.control.optimal.shooting.backward_pass import Feedback
from rbjax.control.products import product


class Rollout(NamedTuple):
    """knots (N + 1, ...), ctrls (N, m), costs (), violations (), the largest of a constraint, and
    more (): sum of gap' V dx."""

    knots: Knot
    ctrls: jax.Array
    costs: jax.Array
    violations: jax.Array
    more: jax.Array


def forward_pass(
    problem: Problem, knots: Knot, ctrls: jax.Array, gains: Feedback, gaps: jax.Array,
    multipliers: Multipliers, a: jax.Array,
) -> Rollout:  # fmt: skip
    """The motion of a step of length a."""
    first = jax.tree.map(lambda x: x[0], knots)
    now = problem.plus(first, a * gains.first)
    mu = multipliers.penalty

    def forth(carry: tuple, x: tuple) -> tuple:
        now, total, off, cross = carry
        k, knot, ctrl, K, du, gap, V, rows, closing = x
        dx = problem.minus(now, knot)
        u = problem.within_bounds(ctrl + a * du + product(K, dx))
        total = total + merit(problem, k, now, u, rows, mu, "path")
        off = jnp.maximum(off, knot_violation(problem, k, now, u, "path"))
        cross = cross + (gap * product(V, dx)).sum()
        after = problem.plus(problem.step(k, now, u), (a - 1) * closing)
        return (after, total, off, cross), (now, u)

    N, dtype = problem.horizon, ctrls.dtype
    body = jax.tree.map(lambda x: x[:-1], knots)
    ks = jnp.arange(N, dtype=dtype)
    given = (ks, body, ctrls, gains.K, gains.k, gaps[:-1], gains.V[:-1], multipliers.path, gaps[1:])
    zero = jnp.zeros((), dtype)
    tried: Any = jax.lax.scan(forth, (now, zero, zero, zero), given)
    (last, total, off, cross), (before, us) = tried
    none = jnp.zeros(problem.nu, dtype)
    total = total + merit(problem, N, last, none, multipliers.end, mu, "end")
    off = jnp.maximum(off, knot_violation(problem, N, last, none, "end"))
    end = jax.tree.map(lambda x: x[-1], knots)
    cross = cross + (gaps[-1] * product(gains.V[-1], problem.minus(last, end))).sum()
    found = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), before, last)
    return Rollout(found, us, total, off, cross)
