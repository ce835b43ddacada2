"""A knot of a problem to second order: dynamics, costs, constraints.

    dx+ = A dx + B du + gap,      cost = c + q.dx + r.du + dx'Q dx/2 + du'R du/2 + dx'S du

Costs of residuals by Gauss and Newton, costs that are numbers by their Hessians. Constraints are
residuals too, those of the augmented Lagrangian (`augmented_lagrangian`).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Var

from rbjax.control.optimal.objective import example, half_square, parts
from rbjax.control.optimal.problem import Knot, Problem
from rbjax.control.products import product


class Quadratic(NamedTuple):
    """A cost to second order: c (), q (n,), Q (n, n), r (m,), R (m, m), S (n, m)."""

    c: jax.Array
    q: jax.Array
    Q: jax.Array
    r: jax.Array
    R: jax.Array
    S: jax.Array


class Local(NamedTuple):
    """A knot with controls: A and B of its step, and its cost."""

    A: jax.Array
    B: jax.Array
    cost: Quadratic


def quadratic(
    problem: Problem, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array, mu: jax.Array,
    where: str,
) -> Quadratic:  # fmt: skip
    """The cost of a knot to second order: the sum over its costs, each differentiated by the
    coordinates that it reads only."""
    n, m, dtype = problem.n, problem.nu, ctrl.dtype
    total = jnp.zeros((), dtype)
    gradient, H = jnp.zeros(n + m, dtype), jnp.zeros((n + m, n + m), dtype)

    zero = jnp.zeros(n + m, dtype)
    for part in parts(problem, rows, mu, where):
        near = functools.partial(_beside, problem, part, k, knot, ctrl)
        at = read_columns(problem, part)
        value, slope, curvature = _second_order_in(near, zero, jnp.eye(n + m, dtype=dtype)[at])
        total = total + value
        gradient = gradient.at[at].add(slope)
        H = H.at[np.ix_(at, at)].add(curvature)
    return Quadratic(total, gradient[:n], H[:n, :n], gradient[n:], H[n:, n:], H[:n, n:])


def _beside(
    problem: Problem, part: Any, k: Any, knot: Knot, ctrl: jax.Array, d: jax.Array
) -> jax.Array:
    """A function of a knot and controls, moved by d."""
    return part(k, problem.plus(knot, d[: problem.n]), ctrl + d[problem.n :])


def _second_order_in(
    f: Any, zero: jax.Array, basis: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A cost and its first and second derivatives along the rows of `basis`."""
    value = f(zero)
    if value.ndim:
        J = jax.vmap(lambda e: jax.jvp(f, (zero,), (e,))[1])(basis)
        return half_square(value), product(J, value), product(J, J.T)
    gradient = jax.grad(f)
    turned = jax.vmap(lambda e: jax.jvp(gradient, (zero,), (e,))[1])(basis)
    return value, product(basis, gradient(zero)), product(turned, basis.T)


def read_columns(problem: Problem, part: Any) -> np.ndarray:
    """The coordinates of a knot's tangent space and of the controls on which a function depends."""
    knot, ctrl = example(problem)
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
    """Whether the result of f depends on each of its arguments, as its equations say."""
    jaxpr = jax.make_jaxpr(f)(*args).jaxpr
    live = {v for v in jaxpr.outvars if isinstance(v, Var)}
    for eqn in reversed(jaxpr.eqns):
        if any(v in live for v in eqn.outvars):
            live |= {v for v in eqn.invars if isinstance(v, Var)}
    return [v in live for v in jaxpr.invars]


def second_order(
    problem: Problem, k: Any, knot: Knot, ctrl: jax.Array, rows: jax.Array, mu: jax.Array,
    where: str, costate: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array]:  # fmt: skip
    """The parts of Q, R and S that Gauss-Newton omits: sum of r_i r_i'' of the residuals, and of
    costate_i f_i'' of the step."""
    n, m = problem.n, problem.nu
    zero = jnp.zeros(n + m, ctrl.dtype)
    residuals = [
        (part, value)
        for part in parts(problem, rows, mu, where)
        if (value := part(k, knot, ctrl)).ndim
    ]
    after = problem.step(k, knot, ctrl)

    def curved(d: jax.Array) -> jax.Array:
        there, u = problem.plus(knot, d[:n]), ctrl + d[n:]
        total = jnp.zeros((), ctrl.dtype)
        for part, value in residuals:
            total = total + (value * part(k, there, u)).sum()
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
        return q + product(A.T, l), l

    return jax.lax.scan(back, end.q, (path.A, path.cost.q), reverse=True)[1]
