"""Second-order expansion of a problem at all of its knots, and the gaps between its steps.

    dx+ = A dx + B du + gap,      cost = c + q.dx + r.du + dx'Q dx/2 + du'R du/2 + dx'S du
    gap_0 = start (-) x_0,        gap_{k+1} = f(x_k, u_k) (-) x_{k+1}

Costs of residuals are expanded by Gauss-Newton, costs that are numbers by their Hessians.
Constraints are residuals of the augmented Lagrangian. States and controls are unknowns (multiple
shooting, Bock & Plitt 1984), so a step need not end at the next knot. Each knot is one sample of a
batched kernel (`rb.threads`).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Var

from rbjax.compiler import map_threads, threads, with_multi_kernel
from rbjax.control.optimal.objective import (
    ConstraintMultipliers,
    example_knot,
    half_square,
    knot_violation,
    merit_terms,
    row_bounds,
    shifted_excess,
)
from rbjax.control.optimal.problem import BODY, NEXT, Knot, Problem, take
from rbjax.control.products import product


class Quadratic(NamedTuple):
    """A second-order expansion of a cost, with dx (n,) and du (m,).

    c + q.dx + r.du + dx'Q dx/2 + du'R du/2 + dx'S du
    """

    c: jax.Array
    q: jax.Array
    Q: jax.Array
    r: jax.Array
    R: jax.Array
    S: jax.Array


class Local(NamedTuple):
    """The expansion at a knot with controls: A and B of its step, and its cost."""

    A: jax.Array
    B: jax.Array
    cost: Quadratic


def quadratic(
    problem: Problem, where: str, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array,
    mu: jax.Array,
) -> Quadratic:  # fmt: skip
    """Expand the cost of a knot to second order. Each term is differentiated only with respect to
    the coordinates on which it depends."""
    n, m, dtype = problem.n, problem.nu, ctrl.dtype
    total = jnp.zeros((), dtype)
    gradient, H = jnp.zeros(n + m, dtype), jnp.zeros((n + m, n + m), dtype)
    zero = jnp.zeros(n + m, dtype)
    for term in merit_terms(problem, where, rows, mu):

        def near(d: jax.Array, term: Any = term) -> jax.Array:
            return term(k, problem.plus(knot, d[:n]), ctrl + d[n:])

        at = read_columns(problem, term)
        value, slope, curvature = _second_order_in(near, zero, jnp.eye(n + m, dtype=dtype)[at])
        total = total + value
        gradient = gradient.at[at].add(slope)
        H = H.at[np.ix_(at, at)].add(curvature)
    return Quadratic(total, gradient[:n], H[:n, :n], gradient[n:], H[n:, n:], H[:n, n:])


def _second_order_in(
    f: Any, zero: jax.Array, basis: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the cost f(0) of a term, and its gradient and Hessian along the rows of `basis`. A
    term with residuals r has the cost r.r / 2 and a Gauss-Newton Hessian."""
    value = f(zero)
    if value.ndim:
        J = jax.vmap(lambda e: jax.jvp(f, (zero,), (e,))[1])(basis)
        return half_square(value), product(J, value), product(J, J.T)
    gradient = jax.grad(f)
    turned = jax.vmap(lambda e: jax.jvp(gradient, (zero,), (e,))[1])(basis)
    return value, product(basis, gradient(zero)), product(turned, basis.T)


def read_columns(problem: Problem, part: Any) -> np.ndarray:
    """Return which entries of (knot tangent, controls) the function part(t, knot, ctrl) reads."""
    knot, ctrl = example_knot(problem)
    leaves, tree = jax.tree.flatten((knot, ctrl))

    def flat(*xs: Any) -> Any:
        knot, ctrl = jax.tree.unflatten(tree, xs)
        return part(jnp.zeros((), ctrl.dtype), knot, ctrl)

    used = arguments_read(flat, leaves)
    n, p, m = problem.system.n, problem.parameter_count, problem.nu
    spans = [*problem.system.spans(), slice(n, n + p), slice(n + p, n + p + m)]
    return np.unique(np.concatenate([
        np.zeros(0, int),
        *(np.arange(n + p + m)[s] for s, u in zip(spans, used, strict=True) if u),
    ])).astype(int)  # fmt: skip


def arguments_read(f: Any, args: list) -> list[bool]:
    """Return for each argument whether the result of f depends on it, from the jaxpr of f."""
    jaxpr = jax.make_jaxpr(f)(*args).jaxpr
    live = {v for v in jaxpr.outvars if isinstance(v, Var)}
    for eqn in reversed(jaxpr.eqns):
        if any(v in live for v in eqn.outvars):
            live |= {v for v in eqn.invars if isinstance(v, Var)}
    return [v in live for v in jaxpr.invars]


def second_order(
    problem: Problem, where: str, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array,
    mu: jax.Array, costate: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array]:  # fmt: skip
    """Return the parts of the Hessians Q, R and S of a knot that Gauss-Newton omits. They are the
    sum of r_i r_i'' over the residuals and of costate_i f_i'' over the step."""
    n, m = problem.n, problem.nu
    zero = jnp.zeros(n + m, ctrl.dtype)
    residuals = [
        (term, value)
        for term in merit_terms(problem, where, rows, mu)
        if (value := term(k, knot, ctrl)).ndim
    ]
    after = problem.step(k, knot, ctrl)

    def curved(d: jax.Array) -> jax.Array:
        there, u = problem.plus(knot, d[:n]), ctrl + d[n:]
        total = jnp.zeros((), ctrl.dtype)
        for term, value in residuals:
            total = total + (value * term(k, there, u)).sum()
        if costate is not None:
            total = total + (costate * problem.minus(problem.step(k, there, u), after)).sum()
        return total

    H = jax.jacfwd(jax.grad(curved))(zero)
    return H[:n, :n], H[n:, n:], H[:n, n:]


def costates(path: Local, end: Quadratic) -> jax.Array:
    """Return the derivatives (N, n) of the cost with respect to the state after each step. With the
    cost gradients q_k the recursion is l_N = q_N, l_k = q_k + A_k' l_{k+1}."""

    def back(l: jax.Array, knot: tuple) -> tuple[jax.Array, jax.Array]:
        A, q = knot
        return q + product(A.T, l), l

    return jax.lax.scan(back, end.q, (path.A, path.cost.q), reverse=True)[1]


#: largest number of knots, over all problems of a batch, for which a GPU uses a thread per column
FEW = 2048


class Expanded(NamedTuple):
    """The second-order expansion of all knots.

    path, end: expansions of the knots with controls, and of the end.
    gaps: (N + 1, n); the first is from the first knot to the start.
    cost: total cost with the augmented Lagrangian, ().
    gap, violation: largest entry of a gap and of a constraint violation, ().
    """

    path: Local
    end: Quadratic
    gaps: jax.Array
    cost: jax.Array
    gap: jax.Array
    violation: jax.Array


def expand(
    problem: Problem, start: Any, knots: Knot, ctrls: jax.Array, multipliers: ConstraintMultipliers
) -> Expanded:
    """Expand all knots to second order, in parallel."""
    N, dtype = problem.horizon, ctrls.dtype
    body, following = take(knots, BODY), take(knots, NEXT)

    def cost_of(k, knot, ctrl, rows, mu):
        cost = quadratic(problem, "path", k, knot, ctrl, rows, mu)
        return cost, knot_violation(problem, "path", k, knot, ctrl)

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
        """Return the gap of the start, and the expansion and violation of the end."""
        first, last = take(knots, 0), take(knots, -1)
        gap = problem.off_start(start, first)
        none = jnp.zeros(problem.nu, dtype)
        cost = quadratic(problem, "end", jnp.asarray(N, dtype), last, none, rows, mu)
        return gap, cost, knot_violation(problem, "end", jnp.asarray(N, dtype), last, none)

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
    """Return the step derivatives A and B and the gap of knot k, with one thread per column."""
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
    """Return the indices 0 ... N - 1 of the knots with controls, as a compile-time constant."""
    return jnp.asarray(np.arange(N, dtype=dtype))


def knots_at(knots: Any, k: jax.Array) -> tuple[Any, Any]:
    """Return knot k and the next one, read inside the kernel of a sample. Slices outside of it
    would be copies, with a kernel for each copy."""
    k = k.astype(np.uint32)
    here, following = (
        jax.tree.map(lambda x, i=i: jax.lax.dynamic_index_in_dim(x, i, keepdims=False), knots)
        for i in (k, k + np.uint32(1))
    )
    return here, following


def add_curvature(
    problem: Problem,
    knots: Knot,
    ctrls: jax.Array,
    multipliers: ConstraintMultipliers,
    found: Expanded,
) -> Expanded:
    """Add the second derivatives that Gauss-Newton omits to the expansion of all knots."""
    N, dtype, mu = problem.horizon, ctrls.dtype, multipliers.penalty
    body, last = take(knots, BODY), take(knots, -1)

    def one(k, knot, ctrl, rows, costate):
        return second_order(problem, "path", k, knot, ctrl, rows, mu, costate)

    def closing(knot, rows):
        none = jnp.zeros(problem.nu, dtype)
        return second_order(problem, "end", jnp.asarray(N, dtype), knot, none, rows, mu)

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
    problem: Problem, knots: Knot, ctrls: jax.Array, multipliers: ConstraintMultipliers
) -> tuple[jax.Array, jax.Array]:
    """Return the next multipliers of the path and end constraints, in parallel over the knots."""
    N, dtype = problem.horizon, ctrls.dtype

    def one(where, k, knot, ctrl, y, mu):
        c = problem.rows(where, k, knot, ctrl)
        return mu * shifted_excess(c, y, mu, *row_bounds(problem, where, c.dtype))

    body, last = take(knots, BODY), take(knots, -1)
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
    """Return the largest entry of all gaps, including the gap of the start."""
    body, following = take(knots, BODY), take(knots, NEXT)

    def one(k: Any, knot: Knot, ctrl: jax.Array, after: Knot) -> jax.Array:
        return jnp.abs(problem.minus(problem.step(k, knot, ctrl), after)).max()

    ks = jnp.arange(problem.horizon, dtype=ctrls.dtype)
    gap = jax.vmap(threads(one))(ks, body, ctrls, following).max()
    first = take(knots, 0)
    return jnp.maximum(gap, jnp.abs(problem.off_start(start, first)).max())
