"""Newton's method with a line search for the convex problem of soft contact.

    H = M + J^T s'' J,   p = -H^-1 g,   x <- x + alpha p,   alpha minimises the cost along p

The cost is convex and piecewise smooth, so the method converges from any start. Near the solution a
step is exact (pyramids, limits, friction loss) or converges quadratically (elliptic cones). The
iteration ends if the error is at most the tolerance. The error is the smaller one of the gradient g
and of Newton's decrement of the last step, relative to the forces:

    sum w_i g_i^2 / size,   -g^T p / size,   size = sum (w_i rhs_i^2 + x_i^2 / w_i),

both under a square root, with w_i = (M^-1)_ii.

It also ends if a step does not halve an error below `NEAR` times the tolerance, or hardly changes
one below `FAR` times. What is left is rounding. Without this end a GPU waits for the few robots of
a batch that take all 50 steps.

The decrement is the error of x in the norm of H. It is small for rounding errors of stiff contacts,
whose gradient is not. If alpha is above one, the decrement is alpha times larger, the length of the
step.

Across the stick disc of latched friction the curvature jumps, and a step may end at the far side of
the disc, again and again. So a step after a short one has the curvature of a bound of the cost
(`latched_disc`), along which the cost falls without such jumps.

The turns of the loop compute the cost first, and then a step. So the program has each of them once,
which an instruction cache may hold. A step that is implicit in the damping of joints also needs
(M + A)^-1 M x with a diagonal matrix A. The last turn computes it by the code of a step.

M x is never computed. A step changes it by M p = H p - J^T s'' J p. The wrenches of the last term
are kept by link, so one inward sweep gives the gradient. The solution of H p = -g gives the twists
of the links at p too, so a step is one inward and one outward sweep. What it leaves of H p + g is
also kept as wrenches (`conjugate_gradients`).

(Todorov, *Convex and analytically-invertible dynamics with contacts and constraints*, 2014; Boyd &
Vandenberghe, *Convex Optimization*, 9.5.)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import integer
from rbjax.contact.problem.link_stiffness import LinkStiffness
from rbjax.contact.problem.problem import Problem, Stiff, add_row
from rbjax.contact.solver.conjugate_gradients import (
    Direction,
    products,
    solve_direction,
    weighted_square,
)
from rbjax.lanes import Lane, add, inner, mul, neg, pack, sub, unpack

#: bytes of a number -> the relative gradient at which the iteration ends
TOLERANCE = {4: 1e-5, 8: 1e-12}
#: the largest numbers of steps, and of evaluations of a line search
ITERATIONS, SEARCHES = 50, 12
#: the slope along the step at which a line search ends, relative to the slope at its start
SLOPE = 0.1
#: errors relative to the tolerance: below the first an iteration ends that does not halve it, below
#: the second one that changes it by less than the share `STILL`. In f32 the first forces are up to
#: 1e3 times those of the solution, and their rounding stays
NEAR, FAR, STILL = 10, 30, 0.01
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
        damped: (nv,) (M + A)^-1 M x, if a diagonal matrix A is given; else None.
    """

    x: jax.Array
    iterations: jax.Array
    error: jax.Array
    residuals: list[jax.Array]
    damped: jax.Array | None = None


class _Iterate(NamedTuple):
    """An iterate of the method.

    Fields:
        x: (nv,) the acceleration.
        u: (nv,) M x - rhs + J^T w.
        w: (n + 1, 6) wrenches on the links that can touch.
        residuals: of the contacts of each set.
        iterations: the number of steps.
        decrement: Newton's decrement of the last step, relative to the forces.
        short: whether the last step was short; None for a problem without latched friction.
        error: the smaller one of the relative gradient and the decrement.
        unfinished: whether the iteration goes on.
        loss: (nv,) (M + A)^-1 A x after the last turn, if a matrix A is given; else None.
    """

    x: jax.Array
    u: jax.Array
    w: jax.Array
    residuals: list[jax.Array]
    iterations: jax.Array
    decrement: jax.Array
    short: jax.Array | None
    error: jax.Array
    unfinished: jax.Array
    loss: jax.Array | None = None


class _Cost(NamedTuple):
    """The cost at an iterate.

    Fields:
        gradient: (nv,) of the cost.
        size: of the forces (see the module).
    """

    gradient: jax.Array
    size: jax.Array


def tolerance_of(dtype: Any) -> float:
    """Return the relative gradient at which the iteration ends."""
    return TOLERANCE[jnp.dtype(dtype).itemsize]


def solve(
    problem: Problem, *, iterations: int = ITERATIONS, tolerance: float | None = None,
    added: Mapping[int, Lane] | None = None,
) -> Solution:  # fmt: skip
    """Minimise the cost of a problem with its active contacts (`Problem.detect`).

    added: entries of a diagonal matrix A by dof, for the field `damped` of the solution.
    """
    bound = tolerance_of(problem.dtype) if tolerance is None else tolerance
    constant = weighted_square(problem.tree.weights, problem.rhs)

    def turn(at: _Iterate) -> _Iterate:
        cost, error = _evaluated(problem, at, constant)
        near = (error <= NEAR * bound) & (error >= 0.5 * at.error)
        still = (error <= FAR * bound) & (jnp.abs(error - at.error) < STILL * at.error)
        goes = (error > bound) & (at.iterations < iterations) & ~(near | still)
        direction, unfinished = None, goes
        if added:  # the last turn has the matrix M + A, by the code of a step
            direction = _direction(problem, at, cost, _Last(~goes, added))
            at = at._replace(loss=direction.x)
        else:  # without active rows the cost is quadratic, and a step exact
            exact = goes & jnp.logical_not(problem.is_constrained)
            error, unfinished = jnp.where(exact, 0.0, error), goes & ~exact

        def moved(_: Any, at: _Iterate) -> _Iterate:
            return _moved(problem, at, cost, direction or _direction(problem, at, cost))

        at = at._replace(error=error, unfinished=unfinished)
        # a loop in place of a branch, so that each array of an iterate is updated in place
        return jax.lax.fori_loop(0, goes.astype(jnp.int32), moved, at)

    # the values of the cost at the start are computed in the loop, so its code is there once
    first = _start(problem)
    first = first._replace(loss=first.x) if added else first
    at = jax.lax.while_loop(lambda at: at.unfinished, turn, first)
    x = jnp.where(jnp.isnan(at.error), jnp.nan, at.x)  # an error that is NaN ends the loop
    damped = None if at.loss is None else x - at.loss
    return Solution(x, at.iterations, at.error, at.residuals, damped)


def factorize_at(problem: Problem, solution: Solution) -> Any:
    """Factorize the Hessian at a solution, with names by which a derivative saves the factors."""
    problem = replace(problem, tree=problem.tree.saved())
    at = _start(problem)._replace(x=solution.x, residuals=solution.residuals)
    return _factors(problem, at).named()


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
    begin = jnp.int32(0), infinite, short, infinite, jnp.bool_(True)
    return _Iterate(zero, u, w, residuals, *begin)


def _with_curvature(problem: Problem, at: _Iterate) -> Problem:
    """Return the problem with the curvature of the next step (see the module)."""
    return problem if at.short is None else problem.bounded(at.short)


def _unset(slots: Any, dim: int) -> jax.Array:
    """Return an uninitialised array (n, dim), whose rows of active contacts are written later."""
    return jax.lax.empty((slots.rows.shape[0], dim), slots.rows.dtype)


class _Last(NamedTuple):
    """Whether the solution is found, `here`, and the diagonal matrix A that replaces the Hessian of
    the rows there."""

    here: jax.Array
    added: Mapping[int, Lane]


def _factors(problem: Problem, at: _Iterate, last: _Last | None = None) -> Any:
    x, limits = unpack(at.x), problem.at_limits.hessian(at.x)
    rows: list[Stiff] = [({i: 1.0}, limits[i]) for i in problem.limits.dofs]
    for row in problem.loose:
        rows.append((row.J, row.response(sub(row.along(x), row.reference))[1]))
    if last is not None:
        rows = [(J, jnp.where(last.here, 0.0, h)) for J, h in rows]
        rows += [({i: 1.0}, jnp.where(last.here, a, 0.0)) for i, a in last.added.items()]
    return problem.tree.factorize(_stiffness(problem, at, last), rows)


def _stiffness(problem: Problem, at: _Iterate, last: _Last | None) -> LinkStiffness:
    """Compute the stiffness of the contacts of each pair of links, at the last turn 0."""
    out = LinkStiffness.zero(len(problem.tree.link_pairs), problem.dtype)
    for contacts, slots, r in zip(problem.sets, problem.slots, at.residuals, strict=True):
        if contacts.coupled:
            continue

        def push(k: Any, out: Any, of: Any = contacts, slots: Any = slots, r: Any = r) -> Any:
            row = slots.row(k, of.dim)
            return of.add_stiffness(row, out, of.cone(row).response(unpack(r[k])).H)

        out = (slots if last is None else slots.unless(last.here)).fold(push, out)
    return out


def _evaluated(problem: Problem, at: _Iterate, constant: Lane) -> tuple[_Cost, jax.Array]:
    """Return the cost at an iterate, and its error.

    constant: the part of the size of the forces that is the same at all iterates.
    """
    problem = _with_curvature(problem, at)
    tree, dtype = problem.tree, problem.dtype
    wrenches = at.w
    for contacts, slots, r in zip(problem.sets, problem.slots, at.residuals, strict=True):

        def push(k: Any, out: Any, of: Any = contacts, slots: Any = slots, r: Any = r) -> Any:
            row = slots.row(k, of.dim)
            f = of.cone(row).response([r[k, i] for i in range(of.dim)]).f
            return of.add_forces(row, out, f)

        wrenches = slots.fold(push, wrenches)
    forces, x = tree.generalized(wrenches), unpack(at.x)
    for row in problem.loose:
        f, _ = row.response(sub(row.along(x), row.reference))
        forces = add_row(forces, row, f)
    gradient = pack([sub(a, b) for a, b in zip(unpack(at.u), forces, strict=True)], at.x)
    gradient = problem.at_limits.subtract_forces(at.x, gradient)
    weights = tree.weights
    size = add(constant, weighted_square([1.0 / w for w in weights], x))
    size = jnp.maximum(jnp.asarray(size, dtype), jnp.finfo(dtype).tiny)
    error = jnp.minimum(jnp.sqrt(weighted_square(weights, unpack(gradient)) / size), at.decrement)
    return _Cost(gradient, size), jnp.asarray(error, dtype)


def _direction(problem: Problem, at: _Iterate, cost: _Cost, last: _Last | None = None) -> Direction:
    """Solve H p = -g, or at the last turn (M + A) p = A x."""
    problem = _with_curvature(problem, at)
    factors, b = _factors(problem, at, last), -cost.gradient
    if last is None:
        return solve_direction(problem, factors, b, at.residuals)
    own = pack([mul(last.added.get(i, 0.0), y) for i, y in enumerate(unpack(at.x))], b)
    b = jnp.where(last.here, own, b)
    return solve_direction(problem, factors, b, at.residuals, ~last.here)


def _moved(problem: Problem, at: _Iterate, cost: _Cost, direction: Direction) -> _Iterate:
    """Return the next iterate."""
    problem = _with_curvature(problem, at)
    dtype, gradient = problem.dtype, cost.gradient
    p, twists, residual = direction
    # the change of u, its product with p, and the wrenches of J^T s'' J p
    change, x, s = [neg(g) for g in unpack(gradient)], unpack(at.x), unpack(p)
    slope = inner(s, unpack(gradient))
    for row in problem.loose:
        f, h = row.response(sub(row.along(x), row.reference))
        rate = row.along(s)
        change, slope = add_row(change, row, neg(mul(h, rate))), add(slope, mul(f, rate))
    curvature, wrenches, rates = inner(s, change), residual, []
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

        numbers = (jnp.asarray(y, dtype) for y in (slope, curvature))
        begin = _unset(slots, contacts.dim), wrenches, *numbers
        found, wrenches, slope, curvature = slots.fold(along, begin)
        rates.append(found)
    bound = SLOPE * jnp.abs(inner(unpack(gradient), s))
    alpha = _line_search(problem, at, p, (slope, curvature), rates, bound)
    residuals = []
    for slots, r, rate in zip(problem.slots, at.residuals, rates, strict=True):

        def moved(k: Any, r: jax.Array, rate: Any = rate) -> jax.Array:
            return r.at[k].set(r[k] + alpha * rate[k])

        residuals.append(slots.fold(moved, r))

    def pushed(k: Any, w: jax.Array) -> jax.Array:
        return w.at[k].add(alpha * wrenches[k])

    u, w = at.u + alpha * change, jax.lax.fori_loop(0, len(at.w), pushed, at.w)
    decrement = jnp.sqrt(jnp.abs(inner(unpack(gradient), s)) / cost.size)
    decrement = jnp.maximum(alpha, 1.0) * decrement
    short = None
    if at.short is not None:  # the decrement is Newton's only with Newton's curvature
        decrement, short = jnp.where(at.short, jnp.inf, decrement), alpha < SHORT
    now = at.x + alpha * p, u, w, residuals, at.iterations + 1, decrement, short
    return _Iterate(*now, at.error, at.unfinished, at.loss)


def _line_search(
    problem: Problem, at: _Iterate, step: jax.Array, smooth: tuple, rates: list, bound: Lane
) -> jax.Array:
    """Find the zero of the cost's slope along a step (nv,), by Newton's method with a bracket.

    smooth: slope at 0 and curvature along the step of the cost without contacts and rows.
    bound: the slope at which the search ends.
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

    def unfinished(state: tuple) -> jax.Array:
        *_, first, n = state
        return (jnp.abs(first) > bound) & (n < SEARCHES)

    def better(state: tuple) -> tuple:
        alpha, low, high, _, n = state
        first, second = slope(alpha)
        low, high = jnp.where(first < 0, alpha, low), jnp.where(first < 0, high, alpha)
        new = alpha - first / second
        inside = (new > low) & (new < high)
        other = jnp.where(jnp.isfinite(high), 0.5 * (low + high), 2.0 * alpha)
        found = jnp.abs(first) <= bound
        new = jnp.where(found, alpha, jnp.where(inside, new, other))
        return new, low, high, first, n + 1

    one = jnp.ones((), problem.dtype)
    start = (one, 0 * one, jnp.inf * one, jnp.inf * one, jnp.int32(0))
    return jax.lax.while_loop(unfinished, better, start)[0]
