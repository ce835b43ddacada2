"""Derivatives of an optimum by the implicit function theorem.

At an optimum the gradient of the Lagrangian L with respect to the unknowns z (states, free
controls, costates, multipliers) is zero for all parameters p of the problem (`optimality`).
Therefore

    K dz = - d(grad L)/dp dp,      K = d(grad L)/dz,  symmetric

`riccati_solve` solves this system in O(N), in forward and in reverse mode. The derivative of the
optimal cost is the derivative of L with respect to p. If the search failed, the derivatives are
finite but meaningless. Source: Fiacco 1983; Amos et al., *Differentiable MPC*, 2018.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.control.optimal.derivatives.optimality import (
    Functions,
    KKTSystem,
    KnotValues,
    PrimalDualPoint,
    solve_kkt,
)
from rbjax.control.optimal.objective import cost_terms, residuals, row_bounds
from rbjax.control.optimal.problem import Knot, Problem, take
from rbjax.control.optimal.solution import SearchResult
from rbjax.control.status import CONVERGED


def differentiable(
    search: Callable[..., SearchResult], problem: Problem, start: Any, knots: Knot,
    ctrls: jax.Array, options: Any,
) -> SearchResult:  # fmt: skip
    """Run search(problem, start, knots, ctrls, options) with derivatives of the optimum.
    Derivatives are with respect to the arrays of the problem, the arrays that its functions close
    over, and the start."""
    arrays, rest = eqx.partition(problem, _traced)
    N, n, m = problem.horizon, problem.n, problem.nu

    def whole(arrays: Any) -> Problem:
        return eqx.combine(arrays, rest)

    def run(arrays: Any, *given: Any) -> SearchResult:
        return search(whole(arrays), *given)

    def path(arrays: Any, d: jax.Array, k: Any, knot: Knot, ctrl: jax.Array, following: Knot):
        p = whole(arrays)
        there, u = p.plus(knot, d[:n]), ctrl + d[n:]
        r, rest_ = residuals(cost_terms(p, "path"), k, there, u)
        c = p.rows("path", k, there, u)
        gap = p.minus(p.step(k, there, u), following)
        return KnotValues(r, rest_, gap, c, *row_bounds(p, "path", c.dtype))

    def end(arrays: Any, d: jax.Array, knot: Knot):
        p = whole(arrays)
        there, u = p.plus(knot, d), jnp.zeros(m, d.dtype)
        r, rest_ = residuals(cost_terms(p, "end"), N, there, u)
        c = p.rows("end", N, there, u)
        return KnotValues(r, rest_, jnp.zeros(0, d.dtype), c, *row_bounds(p, "end", c.dtype))

    given = (arrays, start, knots, ctrls, options)
    functions = Functions(_without_operands(run), _without_operands(path), _without_operands(end))
    found: tuple = ()
    if any(map(_may_close_over_tracers, jax.tree.leaves(rest))):
        one = take(knots, 0)
        d, number = jnp.zeros(n + m, ctrls.dtype), jnp.zeros((), ctrls.dtype)
        functions, found = _hoist_closures(
            Functions(run, path, end),
            (given, (arrays, d, number, one, ctrls[0], one), (arrays, d[:n], one)),
        )

    @jax.custom_jvp
    def optimum(found: tuple, *given: Any) -> SearchResult:
        return functions.run(found, *given)

    @optimum.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple[SearchResult, SearchResult]:
        out = optimum(*primals)
        parameters, directions = primals[:3], tangents[:3]
        return out, _solution_tangent(functions, whole, out, parameters, directions)

    return optimum(found, *given)


def _traced(x: Any) -> bool:
    """Return whether x is traced. Only traced values may need a derivative."""
    return isinstance(x, jax.core.Tracer)


def _without_operands(f: Callable) -> Callable:
    return lambda _, *args: f(*args)


def _may_close_over_tracers(f: Any) -> bool:
    """Return whether f may close over arrays that are not leaves of the problem."""
    if not callable(f):
        return False
    inside = getattr(f, "__wrapped__", f)
    if not hasattr(inside, "__code__"):
        return type(f).__name__ != "builtin_function_or_method"
    held = (getattr(inside, x) for x in ("__closure__", "__defaults__", "__kwdefaults__"))
    return any(x is not None for x in held)


def _hoist_closures(functions: Functions, examples: tuple) -> tuple[Functions, tuple]:
    """Return the functions with their closed-over tracers as first argument, and the tracers."""
    found = [jax.closure_convert(f, *x) for f, x in zip(functions, examples, strict=True)]
    hoisted = tuple(consts for _, consts in found)
    of = lambda k: lambda consts, *args: found[k][0](*args, *consts[k])  # noqa: E731
    return Functions(of(0), of(1), of(2)), hoisted


def _solution_tangent(
    functions: Functions, whole: Callable, out: SearchResult, parameters: tuple, directions: tuple
) -> SearchResult:
    """Return the tangent of a result, by the implicit function theorem."""
    kkt_system = KKTSystem(functions, whole, parameters)
    point = PrimalDualPoint(out.knots, out.ctrl, out.path, out.end)
    kkt = kkt_system.polished(point, out.status == CONVERGED)
    change = jax.jvp(lambda x: kkt_system.gradient(x, kkt), (parameters,), (directions,))[1]
    dz = solve_kkt(kkt, jax.tree.map(jnp.negative, change))
    held = jax.jvp(lambda x: kkt_system.controls(x, kkt), (parameters,), (directions,))[1]
    du = dz.u + held

    def moved(x: jax.Array) -> Knot:
        return jax.vmap(kkt_system.problem.plus)(out.knots, x)

    knots = jax.jvp(moved, (jnp.zeros_like(dz.x),), (dz.x,))[1]
    # L is stationary in the unknowns, so its derivative by the parameters is that of the cost
    L = jax.jvp(lambda x: kkt_system.lagrangian(x, kkt), (parameters,), (directions,))[1]
    zero = jax.tree.map(_no_tangent, out)
    return zero._replace(knots=knots, ctrl=du, cost=L, path=dz.path, end=dz.end)


def _no_tangent(x: jax.Array) -> Any:
    x = jnp.asarray(x)
    if jnp.issubdtype(x.dtype, jnp.inexact):
        return jnp.zeros(x.shape, x.dtype)
    return np.zeros(x.shape, jax.dtypes.float0)
