"""Solution of H x = b with contacts between two links of an articulated tree.

    H = H_0 + J^T s'' J

H_0 is the Hessian without these contacts, which the articulated-body sweeps factorize, and J their
Jacobian. Conjugate gradients with H_0 as the preconditioner begin at x = H_0^-1 b. They end after
at most as many iterations as J has active rows, after none if no such contact is active.

The residual b - H x = J^T rho and the directions p = H_0^-1 J^T pi of all iterations are given by
the forces rho and pi along the rows of the contacts. An iteration computes z = H_0^-1 J^T rho by
two sweeps with the wrenches of rho, and J z from the twists of the links at z. So no vector of
joint forces is computed, and H_0 x never.

Source: Nocedal & Wright, *Numerical Optimization*, algorithm 5.3; Golub & Van Loan, *Matrix
Computations*, 11.3 (a change of low rank).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.problem.contact_rows import ContactSet, Row, Slots
from rbjax.contact.problem.problem import Problem
from rbjax.lanes import Lane, inner, mul, pack, total, unpack

#: bytes of a number -> the norm of rho at which the iteration ends, relative to its first value
RESIDUAL = {4: 1e-5, 8: 1e-12}
#: the largest number of iterations
ITERATIONS = 40


class Direction(NamedTuple):
    """A solution of H x = b.

    Fields:
        x: (nv,) the solution.
        twists: (n + 1, 6) twists of the links that can touch at x.
        residual: (n + 1, 6) wrenches on these links, whose joint forces are b - H x.
    """

    x: jax.Array
    twists: jax.Array
    residual: jax.Array


class _Rows(NamedTuple):
    """The forces rho and pi along the rows of the contacts of a set, and the rates J p, all (n,
    dim)."""

    rho: jax.Array
    pi: jax.Array
    rates: jax.Array


class _Coupled(NamedTuple):
    """The active contacts of a set whose contacts are between two links, with their residuals
    J x - a_ref."""

    contacts: ContactSet
    slots: Slots
    residuals: jax.Array

    def rates(self, twists: jax.Array, rho: jax.Array, size: Lane) -> tuple[jax.Array, Lane]:
        """Compute J z (n, dim) from the twists of the links at z, and add rho^T J z to a number."""

        def step(k: Any, carry: tuple) -> tuple:
            out, size = carry
            y = self.contacts.rates(self._row(k), twists)
            return out.at[k].set(pack(y, out[0])), size + inner(unpack(rho[k]), y)

        return self.slots.fold(step, (jax.lax.empty(rho.shape, rho.dtype), size))

    def turned(
        self, rows: _Rows, rates: jax.Array, share: Lane, curvature: Lane
    ) -> tuple[_Rows, jax.Array, Lane]:
        """Return the rows with the next direction, the forces q = pi + s'' J p of H p = J^T q, and
        a number plus p^T H p."""

        def step(k: Any, carry: tuple) -> tuple:
            pi, rate, out, curvature = carry
            own = [a + share * b for a, b in zip(unpack(rows.rho[k]), unpack(pi[k]), strict=True)]
            y = [a + share * b for a, b in zip(unpack(rates[k]), unpack(rate[k]), strict=True)]
            cone, r = self.contacts.cone(self._row(k)), unpack(self.residuals[k])
            q = [a + b for a, b in zip(own, products(cone.response(r).H, y), strict=True)]
            new = (x.at[k].set(pack(y, x[0])) for x, y in ((pi, own), (rate, y), (out, q)))
            return *new, curvature + inner(y, q)

        begin = rows.pi, rows.rates, jax.lax.empty(rates.shape, rates.dtype), curvature
        pi, rate, q, curvature = self.slots.fold(step, begin)
        return _Rows(rows.rho, pi, rate), q, curvature

    def reduced(
        self, rho: jax.Array, alpha: Lane, q: jax.Array, wrenches: jax.Array, norm: Lane
    ) -> tuple[jax.Array, jax.Array, Lane]:
        """Return rho - alpha q, and add its wrenches and its squared norm."""

        def step(k: Any, carry: tuple) -> tuple:
            out, wrenches, norm = carry
            new = [a - alpha * b for a, b in zip(unpack(out[k]), unpack(q[k]), strict=True)]
            wrenches = self.contacts.add_forces(self._row(k), wrenches, new)
            return out.at[k].set(pack(new, out[0])), wrenches, norm + inner(new, new)

        return self.slots.fold(step, (rho, wrenches, norm))

    def _row(self, k: Any) -> Row:
        return self.slots.row(k, self.contacts.dim)


class _Iterate(NamedTuple):
    """An iterate: x and the direction p with their twists, the rows of each set of contacts, the
    wrenches of rho, rho^T J z, the squared norm of rho and its first value, and the number of
    solutions with H_0."""

    x: jax.Array
    twists: jax.Array
    p: jax.Array
    moving: jax.Array
    rows: list[_Rows]
    residual: jax.Array
    size: jax.Array
    norm: jax.Array
    first: jax.Array
    solutions: jax.Array


def solve_direction(
    problem: Problem, factors: Any, b: jax.Array, residuals: Sequence[jax.Array], acts: Any = True
) -> Direction:
    """Solve H x = b from the factors of H_0.

    residuals: J x - a_ref of all contacts.
    acts: whether the contacts between two links act; otherwise H is H_0.
    """
    tree, dtype = problem.tree, problem.dtype
    still = jnp.zeros((len(tree.touching) + 1, 6), dtype)
    every = zip(problem.sets, problem.slots, residuals, strict=True)
    sets = [_Coupled(*x) for x in every if x[0].coupled]
    if not sets:
        x, twists = tree.step(factors, b, dtype)
        return Direction(x, twists, still)
    if acts is not True:
        sets = [x._replace(slots=x.slots.unless(~acts)) for x in sets]
    touch = total(x.slots.found.length for x in sets) > 0
    bound = RESIDUAL[jnp.dtype(dtype).itemsize] ** 2

    def unfinished(at: _Iterate) -> jax.Array:
        more = (at.norm > bound * at.first) & (at.solutions <= ITERATIONS)
        return (at.solutions == 0) | (touch & more)

    def step(at: _Iterate) -> _Iterate:
        # the first solution is of b, with rho = 0, and a whole step along it
        begins = at.solutions == 0
        z, twists = tree.step(factors, jnp.where(begins, b, 0.0), dtype, at.residual)
        size, curvature, norm = [jnp.zeros((), dtype)] * 3
        rates, forces, rows, wrenches = [], [], [], still
        for of, own in zip(sets, at.rows, strict=True):
            found, size = of.rates(twists, own.rho, size)
            rates.append(found)
        share = jnp.where(at.solutions > 1, size / at.size, 0.0)
        for of, own, rate in zip(sets, at.rows, rates, strict=True):
            own, q, curvature = of.turned(own, rate, share, curvature)
            rows.append(own)
            forces.append(q)
        alpha = jnp.where(begins, 1.0, size / curvature)
        for k, (of, own, q) in enumerate(zip(sets, rows, forces, strict=True)):
            rho, wrenches, norm = of.reduced(own.rho, alpha, q, wrenches, norm)
            rows[k] = own._replace(rho=rho)
        p, moving = z + share * at.p, twists + share * at.moving
        x, sums = at.x + alpha * p, at.twists + alpha * moving
        first = jnp.where(begins, norm, at.first)
        return _Iterate(x, sums, p, moving, rows, wrenches, size, norm, first, at.solutions + 1)

    zero, number = jnp.zeros_like(b), jnp.zeros((), dtype)
    none = [_Rows(*[jnp.zeros_like(x.residuals)] * 3) for x in sets]
    start = _Iterate(zero, still, zero, still, none, still, number, number, number, jnp.int32(0))
    found = jax.lax.while_loop(unfinished, step, start)
    return Direction(found.x, found.twists, found.residual)


def products(H: Sequence[Sequence[Lane]], s: Sequence[Lane]) -> list[Lane]:
    """Compute the product H s of a symmetric matrix, given by the rows of its lower triangle."""
    n = range(len(s))
    return [total(mul(H[max(i, j)][min(i, j)], s[j]) for j in n) for i in n]


def weighted_square(weights: Sequence[Lane], x: Sequence[Lane]) -> Lane:
    """Compute the sum of w_i x_i^2."""
    return total(mul(w, mul(y, y)) for w, y in zip(weights, x, strict=True))
