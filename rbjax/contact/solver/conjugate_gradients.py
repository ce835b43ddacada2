"""Solution of H x = b with contacts between two links of an articulated tree.

    H = H_0 + J^T s'' J

H_0 is the Hessian without these contacts, which the articulated-body sweeps factorize, and J their
Jacobian. Conjugate gradients with H_0 as the preconditioner end after at most one iteration more
than J has active rows, after one if no such contact is active. H_0 p is never computed: it follows
from the residual as p follows from H_0^-1 r. J p follows from the twists of the links at p.

Source: Nocedal & Wright, *Numerical Optimization*, algorithm 5.3; Golub & Van Loan, *Matrix
Computations*, 11.3 (a change of low rank).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.problem.problem import Problem
from rbjax.lanes import Lane, inner, mul, pack, total, unpack

#: bytes of a number -> the norm of the residual at which the iteration ends, relative to b
RESIDUAL = {4: 1e-6, 8: 1e-13}
#: the largest number of iterations
ITERATIONS = 40


class Direction(NamedTuple):
    """A solution of H x = b.

    Fields:
        x: (nv,) the solution.
        product: (nv,) H x, which differs from b by the residual.
        twists: (n + 1, 6) twists of the links that can touch at x.
    """

    x: jax.Array
    product: jax.Array
    twists: jax.Array


class _Iterate(NamedTuple):
    """An iterate: x with its twists, the residual b - H x, the search direction p with H_0 p and
    its twists, r^T H_0^-1 r, and the number of iterations."""

    x: jax.Array
    twists: jax.Array
    residual: jax.Array
    p: jax.Array
    product: jax.Array
    moving: jax.Array
    size: jax.Array
    iterations: jax.Array


def solve_direction(
    problem: Problem, factors: Any, b: jax.Array, residuals: Sequence[jax.Array], acts: Any = True
) -> Direction:
    """Solve H x = b from the factors of H_0.

    residuals: J x - a_ref of all contacts.
    acts: whether the contacts between two links act; otherwise H is H_0.
    """
    tree, dtype = problem.tree, problem.dtype
    if not any(contacts.coupled for contacts in problem.sets):
        x, twists = tree.step(factors, b, dtype)
        return Direction(x, b, twists)
    both = zip(problem.sets, problem.slots, strict=True)
    # most of the time no such contact is active, and the branch saves the inward sweep
    touch = total(slots.found.length for contacts, slots in both if contacts.coupled) > 0
    touch = touch & acts
    bound = RESIDUAL[jnp.dtype(dtype).itemsize] ** 2 * weighted_square(tree.weights, unpack(b))

    def unfinished(at: _Iterate) -> jax.Array:
        size = weighted_square(tree.weights, unpack(at.residual))
        return (size > bound) & (at.iterations < ITERATIONS)

    def step(at: _Iterate) -> _Iterate:
        z, twists = tree.step(factors, at.residual, dtype)
        size = inner(unpack(z), unpack(at.residual))
        share = jnp.where(at.iterations > 0, size / at.size, 0.0)
        p, product = z + share * at.p, at.residual + share * at.product
        moving = twists + share * at.moving
        Hp = product + jax.lax.cond(
            touch, lambda: coupling(problem, moving, residuals), lambda: jnp.zeros_like(b)
        )
        alpha = size / inner(unpack(p), unpack(Hp))
        x, sums = at.x + alpha * p, at.twists + alpha * moving
        left = at.residual - alpha * Hp
        return _Iterate(x, sums, left, p, product, moving, size, at.iterations + 1)

    zero, still = jnp.zeros_like(b), jnp.zeros((len(tree.touching) + 1, 6), dtype)
    one = jnp.ones((), dtype)
    start = _Iterate(zero, still, b, zero, zero, still, one, jnp.int32(0))
    found = jax.lax.while_loop(unfinished, step, start)
    return Direction(found.x, b - found.residual, found.twists)


def coupling(problem: Problem, twists: jax.Array, residuals: Sequence[jax.Array]) -> jax.Array:
    """Compute H p of the contacts between two links, from the link twists at a direction p.

    The result is J^T s'' J p with the Hessians s'' of these contacts at the residuals.
    """
    wrenches = jnp.zeros_like(twists)
    for contacts, slots, r in zip(problem.sets, problem.slots, residuals, strict=True):
        if not contacts.coupled:
            continue

        def push(k: Any, out: Any, of: Any = contacts, slots: Any = slots, r: Any = r) -> Any:
            row = slots.row(k, of.dim)
            H = of.cone(row).response([r[k, i] for i in range(of.dim)]).H
            return of.add_forces(row, out, products(H, of.rates(row, twists)))

        wrenches = slots.fold(push, wrenches)
    like = jnp.zeros(len(problem.rhs), problem.dtype)
    return pack(problem.tree.generalized(wrenches), like)


def products(H: Sequence[Sequence[Lane]], s: Sequence[Lane]) -> list[Lane]:
    """Compute the product H s of a symmetric matrix, given by the rows of its lower triangle."""
    n = range(len(s))
    return [total(mul(H[max(i, j)][min(i, j)], s[j]) for j in n) for i in n]


def weighted_square(weights: Sequence[Lane], x: Sequence[Lane]) -> Lane:
    """Compute the sum of w_i x_i^2."""
    return total(mul(w, mul(y, y)) for w, y in zip(weights, x, strict=True))
