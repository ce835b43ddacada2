"""A knot of a problem to second order: dynamics, costs, constraints.

    dx+ = A dx + B du + gap,      cost = c + q.dx + r.du + dx'Q dx/2 + du'R du/2 + dx'S du

Costs of residuals by Gauss and Newton, costs that are numbers by their Hessians. Constraints are
in the augmented Lagrangian, a residual too:

    mu/2 |s - clip(s, low, high)|^2,     s = c(x, u) + lambda / mu
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.problem import Knot, Problem
from rbjax.control.products import times
from rbjax.control.terms import Cost
from rbjax.lanes.products import matmat


class Multipliers(NamedTuple):
    """Of constraints: path (N, c) and end (e,), and the penalty mu ()."""

    path: jax.Array
    end: jax.Array
    penalty: jax.Array


class Quadratic(NamedTuple):
    """A cost to second order: c (), q (n,), Q (n, n), r (m,), R (m, m), S (n, m)."""

    c: jax.Array
    q: jax.Array
    Q: jax.Array
    r: jax.Array
    R: jax.Array
    S: jax.Array


class Local(NamedTuple):
    """A knot with controls: the next one by the dynamics, A, B, and its cost."""

    after: Knot
    A: jax.Array
    B: jax.Array
    cost: Quadratic


def limits(problem: Problem, where: str, like: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The bounds (c,) of the constraints at "path" or "end", for values `like`."""
    lows, highs = [], []
    at, n = 0, like.shape[0]
    sizes = row_sizes(problem, where)
    for c, size in sizes:
        lows.append(jnp.broadcast_to(jnp.ravel(c.low), (size,)))
        highs.append(jnp.broadcast_to(jnp.ravel(c.high), (size,)))
        at += size
    assert at == n
    none = jnp.zeros(0, like.dtype)
    low = jnp.concatenate([none, *lows]).astype(like.dtype)
    return low, jnp.concatenate([none, *highs]).astype(like.dtype)


def row_sizes(problem: Problem, where: str) -> list[tuple[Any, int]]:
    """Each constraint at "path" or "end" with the number of its rows."""
    knot, ctrl = example(problem)
    out = []
    for c in problem.constraints:
        if c.where in (where, "all"):

            def value(knot: Knot, ctrl: jax.Array, c: Any = c) -> jax.Array:
                system, _ = problem.at(knot.numbers)
                return jnp.ravel(c.term(system.model, 0.0, knot.state, ctrl))

            out.append((c, jax.eval_shape(value, knot, ctrl).shape[0]))
    return out


def example(problem: Problem) -> tuple[Knot, jax.Array]:
    """A knot and controls, of which only shapes count."""
    dtype = problem.dt.dtype
    state = problem.system.example(dtype)
    return Knot(state, problem.first_numbers(dtype)), jnp.zeros(problem.nu, dtype)


def penalised(
    problem: Problem, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array, mu: jax.Array,
    where: str,
) -> tuple[jax.Array, jax.Array]:  # fmt: skip
    """All residuals of a knot, those of the augmented Lagrangian too, and what costs beside them.
    rows: the multipliers (c,)."""
    costs = problem.running if where == "path" else problem.terminal
    r, rest = problem.values(costs, k, knot, ctrl)
    if rows.shape[0]:
        s = problem.rows(k, knot, ctrl, where) + rows / mu
        low, high = limits(problem, where, s)
        r = jnp.concatenate([r, jnp.sqrt(mu) * (s - jnp.clip(s, low, high))])
    return r, rest


def merit(
    problem: Problem, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array, mu: jax.Array,
    where: str,
) -> jax.Array:  # fmt: skip
    """The cost () of a knot with its part of the augmented Lagrangian."""
    r, rest = penalised(problem, k, knot, ctrl, rows, mu, where)
    return 0.5 * (r * r).sum() + rest


def quadratic(
    problem: Problem, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array, mu: jax.Array,
    where: str,
) -> Quadratic:  # fmt: skip
    """The cost of a knot to second order."""
    n, m, dtype = problem.n, problem.nu, ctrl.dtype
    costs = problem.running if where == "path" else problem.terminal

    def near(d: jax.Array) -> tuple[jax.Array, jax.Array]:
        there = problem.plus(knot, d[:n])
        return penalised(problem, k, there, ctrl + d[n:], rows, mu, where)

    zero = jnp.zeros(n + m, dtype)
    r, rest = near(zero)
    J = jax.jacfwd(lambda d: near(d)[0])(zero)
    gradient = (J * r[:, None]).sum(0)
    H = matmat(J.T, J)
    if any(is_number(problem, cost) for cost in costs):
        scalar = lambda d: near(d)[1]  # noqa: E731
        gradient = gradient + jax.grad(scalar)(zero)
        H = H + jax.hessian(scalar)(zero)
    c = 0.5 * (r * r).sum() + rest
    return Quadratic(c, gradient[:n], H[:n, :n], gradient[n:], H[n:, n:], H[:n, n:])


def is_number(problem: Problem, cost: Cost) -> bool:
    """Whether a term gives a number, and not residuals."""
    knot, ctrl = example(problem)

    def value(knot: Knot, ctrl: jax.Array) -> jax.Array:
        system, _ = problem.at(knot.numbers)
        return jnp.asarray(cost.term(system.model, 0.0, knot.state, ctrl))

    return jax.eval_shape(value, knot, ctrl).ndim == 0


def local(
    problem: Problem, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array, mu: jax.Array
) -> Local:
    """A knot with controls to second order."""
    after, A, B = problem.linear(k, knot, ctrl)
    return Local(after, A, B, quadratic(problem, k, knot, ctrl, rows, mu, "path"))


def second_order(
    problem: Problem, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array, mu: jax.Array,
    where: str, costate: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array]:  # fmt: skip
    """What Gauss and Newton leave out of Q, R and S: sum of r_i r_i'' of the residuals, and of
    costate_i f_i'' of the step."""
    n, m = problem.n, problem.nu
    zero = jnp.zeros(n + m, ctrl.dtype)
    r, _ = penalised(problem, k, knot, ctrl, rows, mu, where)
    after = None if costate is None else problem.step(k, knot, ctrl)

    def curved(d: jax.Array) -> jax.Array:
        there, u = problem.plus(knot, d[:n]), ctrl + d[n:]
        total = (r * penalised(problem, k, there, u, rows, mu, where)[0]).sum()
        if costate is not None:
            total = total + (costate * problem.minus(problem.step(k, there, u), after)).sum()
        return total

    H = jax.jacfwd(jax.grad(curved))(zero)
    return H[:n, :n], H[n:, n:], H[:n, n:]


def costates(path: Local, end: Quadratic) -> jax.Array:
    """The derivatives (N, n) of the cost by the state after each step: l_N = q_N,
    l_k = q_k + A_k' l_{k+1}."""

    def back(l: jax.Array, knot: tuple) -> tuple[jax.Array, jax.Array]:
        A, q = knot
        return q + times(A.T, l), l

    return jax.lax.scan(back, end.q, (path.A, path.cost.q), reverse=True)[1]
