"""Newton's method with an exact line search for the convex problem of soft contact.

    H = M + J^T s'' J,   p = -H^-1 g,   x <- x + alpha p,   alpha minimises the cost along p

The cost is convex and piecewise smooth, so the method converges from any start. Near the solution a
step is exact (pyramids, limits, friction loss) or converges quadratically (elliptic cones). The
iteration ends if the gradient g is small relative to the forces:

    sum w_i g_i^2 <= tolerance^2 sum w_i (rhs_i^2 + (M x)_i^2 + (J^T f)_i^2),   w_i = (M^-1)_ii

(Todorov, *Convex and analytically-invertible dynamics with contacts and constraints*, 2014; Boyd &
Vandenberghe, *Convex Optimization*, 9.5.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.problem import Problem, add_row
from rbjax.lanes import Lane, add, inner, mul, neg, pack, sub, total, unpack
from rbjax.lanes.factorization import LDLT

#: bytes of a number -> the relative gradient at which the iteration ends
TOLERANCE = {4: 1e-5, 8: 1e-12}
#: the largest numbers of steps, and of evaluations of a line search
ITERATIONS, SEARCHES = 50, 12
#: the slope along the step at which a line search ends, relative to the slope at its start
SLOPE = 0.01


class Solution(NamedTuple):
    """The solution of the problem.

    Fields:
        x: (nv,) acceleration.
        iterations: the number of Newton steps.
        error: relative gradient at x; the iteration has converged if it is at most the tolerance.
        residuals: (n, dim) J x - a_ref of the slots of each set.
    """

    x: jax.Array
    iterations: jax.Array
    error: jax.Array
    residuals: list[jax.Array]


class _Iterate(NamedTuple):
    """An iterate: x, M x, the residuals of the contacts of each set, the error of the iterate
    before the last step, and the number of steps."""

    x: jax.Array
    Mx: jax.Array
    residuals: list[jax.Array]
    error: jax.Array
    iterations: jax.Array


class _Values(NamedTuple):
    """Gradient (nv,), stiffness of each pair of links (n, 21), and error at an iterate."""

    gradient: jax.Array
    stiffness: jax.Array
    error: jax.Array


def tolerance_of(dtype: Any) -> float:
    """Return the relative gradient at which the iteration ends."""
    return TOLERANCE[jnp.dtype(dtype).itemsize]


def solve(
    problem: Problem, *, iterations: int = ITERATIONS, tolerance: float | None = None
) -> Solution:
    """Minimise the cost of a problem with its active contacts (`Problem.detect`)."""
    bound = tolerance_of(problem.dtype) if tolerance is None else tolerance

    def unfinished(at: _Iterate) -> jax.Array:
        return (at.error > bound) & (at.iterations <= iterations)

    def step(at: _Iterate) -> _Iterate:
        values = _evaluate(problem, at)
        at = at._replace(error=values.error)
        more = (values.error > bound) & (at.iterations < iterations)
        moved = jax.lax.cond(more, lambda: _newton_step(problem, at, values), lambda: at)
        return moved._replace(iterations=at.iterations + 1)

    at = jax.lax.while_loop(unfinished, step, _start(problem))
    return Solution(at.x, at.iterations - 1, at.error, at.residuals)


def factorize_at(problem: Problem, solution: Solution) -> LDLT:
    """Factorize the Hessian at a solution."""
    at = _start(problem)._replace(x=solution.x, residuals=solution.residuals)
    return _factors(problem, at, _evaluate(problem, at))


def _start(problem: Problem) -> _Iterate:
    """Return the iterate x = 0, whose residuals are -a_ref."""
    zero = jnp.zeros(len(problem.rhs), problem.dtype)
    residuals = []
    for contacts, slots in zip(problem.sets, problem.slots, strict=True):
        residuals.append(-slots.rows[:, 6 * contacts.dim + 1 :])
    return _Iterate(zero, zero, residuals, jnp.full((), jnp.inf, problem.dtype), jnp.int32(0))


def _factors(problem: Problem, at: _Iterate, values: _Values) -> LDLT:
    x = unpack(at.x)
    rows = [(row, row.response(sub(row.along(x), row.reference))[1]) for row in problem.rows]
    return problem.tree.factorize(values.stiffness, rows)


def _evaluate(problem: Problem, at: _Iterate) -> _Values:
    """Compute gradient, stiffness and error at an iterate."""
    tree, dtype = problem.tree, problem.dtype
    wrenches = jnp.zeros((len(tree.touching) + 1, 6), dtype)
    stiffness = jnp.zeros((len(tree.link_pairs), 21), dtype)
    for contacts, slots, r in zip(problem.sets, problem.slots, at.residuals, strict=True):

        def push(k: Any, carry: tuple, of: Any = contacts, slots: Any = slots, r: Any = r) -> tuple:
            wrenches, stiffness = carry
            row = slots.row(k, of.dim)
            found = of.cone(row).response([r[k, i] for i in range(of.dim)])
            wrenches = of.add_wrench(row, wrenches, row.wrench(found.f))
            return wrenches, of.add_stiffness(row, stiffness, row.stiffness(found.H))

        wrenches, stiffness = slots.fold(push, (wrenches, stiffness))
    forces, x = tree.generalized(wrenches), unpack(at.x)
    for row in problem.rows:
        f, _ = row.response(sub(row.along(x), row.reference))
        forces = add_row(forces, row, f)
    y = unpack(at.Mx)
    g = [sub(a, add(b, f)) for a, b, f in zip(y, problem.rhs, forces, strict=True)]
    size = _square(tree.weights, y, problem.rhs, forces)
    error = jnp.sqrt(_square(tree.weights, g) / jnp.maximum(size, jnp.finfo(dtype).tiny))
    return _Values(pack(g, at.x), stiffness, jnp.asarray(error, dtype))


def _square(weights: Sequence[Lane], *vectors: Sequence[Lane]) -> Lane:
    """Compute the sum of w_i x_i^2 over some vectors x."""
    return total(mul(d, mul(x, x)) for v in vectors for d, x in zip(weights, v, strict=True))


def _newton_step(problem: Problem, at: _Iterate, values: _Values) -> _Iterate:
    tree, g = problem.tree, unpack(values.gradient)
    step = pack(_factors(problem, at, values).solve([neg(y) for y in g]), at.x)
    p = unpack(step)
    change = pack(tree.times_M(p), at.x)
    twists = tree.twists(p, problem.dtype)
    rates = []
    for contacts, slots, r in zip(problem.sets, problem.slots, at.residuals, strict=True):

        def along(k: Any, r: jax.Array, of: Any = contacts, slots: Any = slots) -> jax.Array:
            row = slots.row(k, of.dim)
            return r.at[k].set(jnp.stack(row.along(of.relative(row, twists))))

        rates.append(slots.fold(along, jnp.zeros_like(r)))
    alpha = _line_search(problem, at, values, p, unpack(change), rates)
    residuals = [r + alpha * s for r, s in zip(at.residuals, rates, strict=True)]
    return _Iterate(
        at.x + alpha * step, at.Mx + alpha * change, residuals, at.error, at.iterations
    )  # fmt: skip


def _line_search(
    problem: Problem, at: _Iterate, values: _Values, p: list, Mp: list, rates: list
) -> jax.Array:
    """Find the zero of the cost's slope along p, by Newton's method with a bracket."""
    x, rhs = unpack(at.x), problem.rhs
    constant = inner(p, [sub(a, b) for a, b in zip(unpack(at.Mx), rhs, strict=True)])
    curvature = inner(p, Mp)
    scalar = [(row, sub(row.along(x), row.reference), row.along(p)) for row in problem.rows]

    def slope(alpha: jax.Array) -> tuple[Lane, Lane]:
        first, second = add(constant, mul(alpha, curvature)), curvature
        for row, r, s in scalar:
            f, h = row.response(add(r, mul(alpha, s)))
            first, second = sub(first, mul(f, s)), add(second, mul(h, mul(s, s)))
        out = (first, second)
        groups = zip(problem.sets, problem.slots, at.residuals, rates, strict=True)
        for contacts, slots, r, rate in groups:

            def more(
                k: Any, carry: tuple, of: Any = contacts, slots: Any = slots, r: Any = r,
                rate: Any = rate,
            ) -> tuple:  # fmt: skip
                first, second = carry
                s = [rate[k, i] for i in range(of.dim)]
                row = slots.row(k, of.dim)
                f, H = of.cone(row).response([r[k, i] + alpha * s[i] for i in range(of.dim)])
                for i, a in enumerate(s):
                    first = first - f[i] * a
                    for j in range(i + 1):
                        both = mul(a, s[j]) if i == j else 2.0 * a * s[j]
                        second = add(second, mul(H[i][j], both))
                return first, second

            out = slots.fold(more, out)
        return out

    begin = SLOPE * jnp.abs(inner(unpack(values.gradient), p))

    def unfinished(state: tuple) -> jax.Array:
        *_, first, n = state
        return (jnp.abs(first) > begin) & (n < SEARCHES)

    def better(state: tuple) -> tuple:
        alpha, low, high, _, n = state
        first, second = slope(alpha)
        low, high = jnp.where(first < 0, alpha, low), jnp.where(first < 0, high, alpha)
        new = alpha - first / second
        inside = (new > low) & (new < high)
        other = jnp.where(jnp.isfinite(high), 0.5 * (low + high), 2.0 * alpha)
        found = jnp.abs(first) <= begin
        new = jnp.where(found, alpha, jnp.where(inside, new, other))
        return new, low, high, first, n + 1

    one = jnp.ones((), problem.dtype)
    start = (one, 0 * one, jnp.inf * one, jnp.inf * one, jnp.int32(0))
    return jax.lax.while_loop(unfinished, better, start)[0]
