"""Newton's method with an exact line search for the convex problem of soft contact.

    H = M + J^T s'' J,   p = -H^-1 g,   x <- x + alpha p,   alpha minimises the cost along p

The cost is convex and piecewise smooth, so the method converges from any start. Near the solution a
step is exact (pyramids, limits, friction loss) or converges quadratically (elliptic cones). The
iteration ends if the error is at most the tolerance. The error is the smaller one of the gradient g
and of Newton's decrement of the last step, relative to the forces:

    sum w_i g_i^2 / size,   -g^T p / size,   size = sum (w_i rhs_i^2 + x_i^2 / w_i),

both under a square root, with w_i = (M^-1)_ii.

It also ends if a step does not halve an error below `NEAR` times the tolerance. What is left is
rounding. Without this end a GPU waits for the few robots of a batch that take all 50 steps.

The decrement is the error of x in the norm of H. It is small for rounding errors of stiff contacts,
whose gradient is not. If alpha is above one, the decrement is alpha times larger, the length of the
step.

Across the stick disc of latched friction the curvature jumps, and a step may end at the far side of
the disc, again and again. So a step after a short one has the curvature of a bound of the cost
(`latched_disc`), along which the cost falls without such jumps.

M x is never computed. A step changes it by M p = H p - J^T s'' J p. The wrenches of
the last term are kept by link, so one inward sweep gives the gradient. The solution of H p = -g
gives the twists of the links at p too, so a step is one inward and one outward sweep.

(Todorov, *Convex and analytically-invertible dynamics with contacts and constraints*, 2014; Boyd &
Vandenberghe, *Convex Optimization*, 9.5.)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import integer
from rbjax.contact.problem.problem import Problem, Stiff, add_row
from rbjax.contact.solver.conjugate_gradients import products, solve_direction, weighted_square
from rbjax.lanes import Lane, add, inner, mul, neg, pack, sub, unpack

#: bytes of a number -> the relative gradient at which the iteration ends
TOLERANCE = {4: 1e-5, 8: 1e-12}
#: the largest numbers of steps, and of evaluations of a line search
ITERATIONS, SEARCHES = 50, 12
#: the slope along the step at which a line search ends, relative to the slope at its start
SLOPE = 0.01
#: the error, relative to the tolerance, below which an iteration ends that does not halve it: only
#: rounding is left
NEAR = 10
#: the length below which a step is short
SHORT = 0.5


def check_iterations(where: str, iterations: Any) -> None:
    """Raise InputError unless `iterations` is a number of Newton steps."""
    integer(where, "iterations", iterations, least=1, most=2**31 - 1)


class Solution(NamedTuple):
    """The solution of the problem.

    Fields:
        x: (nv,) acceleration.
        iterations: the number of Newton steps.
        error: relative error at x; the iteration has converged if it is at most the tolerance.
        residuals: (n, dim) J x - a_ref of the active contacts of each set.
    """

    x: jax.Array
    iterations: jax.Array
    error: jax.Array
    residuals: list[jax.Array]


class _Iterate(NamedTuple):
    """An iterate of the method, with the values of the cost there.

    Fields:
        x: (nv,) the acceleration.
        u: (nv,) M x - rhs + J^T w.
        w: (n + 1, 6) wrenches on the links that can touch.
        residuals: of the contacts of each set.
        iterations: the number of steps.
        decrement: Newton's decrement of the last step, relative to the forces.
        short: whether the last step was short; None for a problem without latched friction.
        gradient: (nv,) of the cost.
        stiffness: (n, 21) of the contacts of each pair of links.
        size: of the forces (see the module).
        error: the smaller one of the relative gradient and the decrement.
        stalled: whether the last step did not halve an error near the tolerance.
    """

    x: jax.Array
    u: jax.Array
    w: jax.Array
    residuals: list[jax.Array]
    iterations: jax.Array
    decrement: jax.Array
    short: jax.Array | None
    gradient: Any = None
    stiffness: Any = None
    size: Any = None
    error: Any = None
    stalled: Any = False


def tolerance_of(dtype: Any) -> float:
    """Return the relative gradient at which the iteration ends."""
    return TOLERANCE[jnp.dtype(dtype).itemsize]


def solve(
    problem: Problem, *, iterations: int = ITERATIONS, tolerance: float | None = None
) -> Solution:
    """Minimise the cost of a problem with its active contacts (`Problem.detect`)."""
    bound = tolerance_of(problem.dtype) if tolerance is None else tolerance

    def unfinished(at: _Iterate) -> jax.Array:
        return (at.error > bound) & (at.iterations < iterations) & ~at.stalled

    def step(at: _Iterate) -> _Iterate:
        new = _evaluated(problem, _newton_step(problem, at))
        stalled = (new.error <= NEAR * bound) & (new.error >= 0.5 * at.error)
        return new._replace(stalled=stalled)

    # without a branch, so that each array of an iterate is updated in place
    first = _evaluated(problem, _start(problem))._replace(stalled=jnp.bool_(False))
    at = jax.lax.while_loop(unfinished, step, first)
    return Solution(at.x, at.iterations, at.error, at.residuals)


def factorize_at(problem: Problem, solution: Solution) -> Any:
    """Factorize the Hessian at a solution, with names by which a derivative saves the factors."""
    problem = replace(problem, tree=problem.tree.saved())
    at = _start(problem)._replace(x=solution.x, residuals=solution.residuals)
    return _factors(problem, _evaluated(problem, at)).named()


def _start(problem: Problem) -> _Iterate:
    """Return the first iterate, x = 0. The residuals of its contacts are -a_ref."""
    zero, dtype = jnp.zeros(len(problem.rhs), problem.dtype), problem.dtype
    residuals = []
    for contacts, slots in zip(problem.sets, problem.slots, strict=True):

        def opposite(k: Any, r: jax.Array, of: Any = contacts, slots: Any = slots) -> jax.Array:
            return r.at[k].set(pack([neg(y) for y in slots.row(k, of.dim).reference], r[0]))

        residuals.append(slots.fold(opposite, _unset(slots, contacts.dim)))
    u = pack([neg(y) for y in problem.rhs], zero)
    w = jnp.zeros((len(problem.tree.touching) + 1, 6), dtype)
    infinite = jnp.full((), jnp.inf, dtype)
    short = jnp.bool_(False) if problem.latched else None
    return _Iterate(zero, u, w, residuals, jnp.int32(0), infinite, short)


def _with_curvature(problem: Problem, at: _Iterate) -> Problem:
    """Return the problem with the curvature of the next step (see the module)."""
    return problem if at.short is None else problem.bounded(at.short)


def _unset(slots: Any, dim: int) -> jax.Array:
    """Return an uninitialised array (n, dim), whose rows of active contacts are written later."""
    return jax.lax.empty((slots.rows.shape[0], dim), slots.rows.dtype)


def _factors(problem: Problem, at: _Iterate) -> Any:
    x, limits = unpack(at.x), problem.at_limits.hessian(at.x)
    rows: list[Stiff] = [({i: 1.0}, limits[i]) for i in problem.limits.dofs]
    for row in problem.loose:
        rows.append((row.J, row.response(sub(row.along(x), row.reference))[1]))
    return problem.tree.factorize(at.stiffness, rows)


def _evaluated(problem: Problem, at: _Iterate) -> _Iterate:
    """Return an iterate with its gradient, stiffness, size and error."""
    problem = _with_curvature(problem, at)
    tree, dtype = problem.tree, problem.dtype
    none, wrenches = jnp.zeros((len(tree.link_pairs), 21), dtype), at.w
    # in place, as the iterate that it belongs to is over
    stiffness = (
        none if at.stiffness is None else jax.lax.dynamic_update_slice(at.stiffness, none, (0, 0))
    )
    for contacts, slots, r in zip(problem.sets, problem.slots, at.residuals, strict=True):

        def push(k: Any, carry: tuple, of: Any = contacts, slots: Any = slots, r: Any = r) -> tuple:
            wrenches, stiffness = carry
            row = slots.row(k, of.dim)
            found = of.cone(row).response([r[k, i] for i in range(of.dim)])
            wrenches = of.add_forces(row, wrenches, found.f)
            if of.coupled:
                return wrenches, stiffness
            return wrenches, of.add_stiffness(row, stiffness, row.stiffness(found.H))

        wrenches, stiffness = slots.fold(push, (wrenches, stiffness))
    forces, x = tree.generalized(wrenches), unpack(at.x)
    for row in problem.loose:
        f, _ = row.response(sub(row.along(x), row.reference))
        forces = add_row(forces, row, f)
    gradient = pack([sub(a, b) for a, b in zip(unpack(at.u), forces, strict=True)], at.x)
    gradient = problem.at_limits.subtract_forces(at.x, gradient)
    weights = tree.weights
    size = add(
        weighted_square(weights, problem.rhs), weighted_square([1.0 / w for w in weights], x)
    )
    size = jnp.maximum(jnp.asarray(size, dtype), jnp.finfo(dtype).tiny)
    error = jnp.minimum(jnp.sqrt(weighted_square(weights, unpack(gradient)) / size), at.decrement)
    error = jnp.asarray(error, dtype)
    return at._replace(gradient=gradient, stiffness=stiffness, size=size, error=error)


def _newton_step(problem: Problem, at: _Iterate) -> _Iterate:
    """Return the next iterate, without the values of the cost."""
    problem = _with_curvature(problem, at)
    dtype = problem.dtype
    factors = _factors(problem, at)
    p, product, twists = solve_direction(problem, factors, -at.gradient, at.residuals)
    # the change of u, its product with p, and the wrenches of J^T s'' J p
    change, x, s = unpack(product), unpack(at.x), unpack(p)
    slope = inner(s, unpack(at.gradient))
    for row in problem.loose:
        f, h = row.response(sub(row.along(x), row.reference))
        rate = row.along(s)
        change, slope = add_row(change, row, neg(mul(h, rate))), add(slope, mul(f, rate))
    curvature, wrenches, rates = inner(s, change), jnp.zeros_like(at.w), []
    numbers = (jnp.asarray(y, dtype) for y in (slope, curvature))
    change, slope, curvature = problem.at_limits.along(at.x, p, (pack(change, p), *numbers))
    for contacts, slots, r in zip(problem.sets, problem.slots, at.residuals, strict=True):

        def along(k: Any, carry: tuple, of: Any = contacts, slots: Any = slots, r: Any = r) -> Any:
            rates, wrenches, slope, curvature = carry
            row = slots.row(k, of.dim)
            s = of.rates(row, twists)
            found = of.cone(row).response([r[k, i] for i in range(of.dim)])
            change = products(found.H, s)
            wrenches = of.add_forces(row, wrenches, change)
            slope, curvature = add(slope, inner(found.f, s)), sub(curvature, inner(change, s))
            return rates.at[k].set(jnp.stack(s)), wrenches, slope, curvature

        begin = (
            _unset(slots, contacts.dim),
            wrenches,
            jnp.asarray(slope, dtype),
            jnp.asarray(curvature, dtype),
        )
        found, wrenches, slope, curvature = slots.fold(along, begin)
        rates.append(found)
    alpha = _line_search(problem, at, p, (slope, curvature), rates)
    residuals = []
    for slots, r, rate in zip(problem.slots, at.residuals, rates, strict=True):

        def moved(k: Any, r: jax.Array, rate: Any = rate) -> jax.Array:
            return r.at[k].set(r[k] + alpha * rate[k])

        residuals.append(slots.fold(moved, r))
    u, w = at.u + alpha * change, at.w + alpha * wrenches
    decrement = jnp.sqrt(jnp.abs(inner(unpack(at.gradient), s)) / at.size)
    decrement = jnp.maximum(alpha, 1.0) * decrement
    short = None
    if at.short is not None:  # the decrement is Newton's only with Newton's curvature
        decrement, short = jnp.where(at.short, jnp.inf, decrement), alpha < SHORT
    now = at.x + alpha * p, u, w, residuals, at.iterations + 1, decrement, short
    return _Iterate(*now, stiffness=at.stiffness)


def _line_search(
    problem: Problem, at: _Iterate, step: jax.Array, smooth: tuple, rates: list
) -> jax.Array:
    """Find the zero of the cost's slope along a step (nv,), by Newton's method with a bracket.

    smooth: slope at 0 and curvature along the step of the cost without contacts and rows.
    """
    x, p = unpack(at.x), unpack(step)
    constant, curvature = smooth
    scalar = [(row, sub(row.along(x), row.reference), row.along(p)) for row in problem.loose]

    def slope(alpha: jax.Array) -> tuple[Lane, Lane]:
        first, second = add(constant, mul(alpha, curvature)), curvature
        for row, r, s in scalar:
            f, h = row.response(add(r, mul(alpha, s)))
            first, second = sub(first, mul(f, s)), add(second, mul(h, mul(s, s)))
        out = problem.at_limits.add_slope(at.x, step, alpha, (first, second))
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

    begin = SLOPE * jnp.abs(inner(unpack(at.gradient), p))

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
