"""The linear-quadratic problem of finite horizon, parallel in time.

The minimum cost between a state x at one knot and a state y at a later knot is

    V(x, y) = max over l of  1/2 x'Jx - x'e - 1/2 l'C l - l'(y - F x - b)

Two adjacent segments combine, with M = (1 + C1 J2)^-1, as

    F = F2 M F1,   b = F2 M (b1 + C1 e2) + b2,   C = F2 M C1 F2' + C2
    J = F1'J2 M F1 + J1,   e = F1'(e2 - J2 M (b1 + C1 e2)) + e1

This product is associative, so doubling gives the segments from every knot to the end in log2 N
sequential steps. Their J and -e are P and p of `riccati.backward`. R must be positive definite.
Source: Särkkä & García-Fernández, *Temporal parallelization of dynamic programming and linear
quadratic control*, IEEE TAC 68(2), 2023; Hillis & Steele, CACM 29(12), 1986 (doubling).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from rbjax.control.products import definite_factor, product
from rbjax.lanes.arrays import matrix_transpose, matvec

if TYPE_CHECKING:
    from rbjax.control.linear.riccati import LinearQuadratic


class Stretch(NamedTuple):
    """A segment of the horizon, from state x at one knot to state y at a later one.

        V(x, y) = max over l of  1/2 x'Jx - x'e - 1/2 l'C l - l'(y - F x - b)

    F, b: the closed-loop dynamics, (n, n) and (n,).
    C, e, J: coefficients of the least cost V, (n, n), (n,) and (n, n).
    """

    F: jax.Array
    b: jax.Array
    C: jax.Array
    e: jax.Array
    J: jax.Array


def join(one: Stretch, two: Stretch) -> Stretch:
    """Combine two adjacent segments of a horizon to one (`Stretch`). Leading axes are a batch."""
    turned = matrix_transpose
    n = one.b.shape[-1]
    W = jnp.eye(n, dtype=one.b.dtype) + product(one.C, two.J)
    ahead = one.b + matvec(one.C, two.e)
    found = jnp.linalg.solve(W, jnp.concatenate([one.F, one.C, ahead[..., None]], -1))
    F, C, b = found[..., :n], found[..., n : 2 * n], found[..., -1]
    J = product(turned(one.F), product(two.J, F)) + one.J
    C = product(two.F, product(C, turned(two.F))) + two.C
    return Stretch(
        product(two.F, F),
        matvec(two.F, b) + two.b,
        (C + turned(C)) / 2,
        matvec(turned(one.F), two.e - matvec(two.J, b)) + one.e,
        (J + turned(J)) / 2,
    )


def stretches(problem: LinearQuadratic) -> tuple[Stretch, jax.Array]:
    """Return the N steps and the end as segments of the associative scan, and whether all control
    weights R are positive definite."""
    A, B, d, Q, q, R, r, S = problem
    L, ok = jax.vmap(definite_factor)((R + matrix_transpose(R)) / 2)

    def step(L, A, B, d, Q, q, r, S):
        half = solve_triangular(L, jnp.concatenate([B.T, S.T, r[:, None]], 1), lower=True)
        n = A.shape[0]
        b, s, h = half[:, :n], half[:, n : 2 * n], half[:, -1]
        return Stretch(
            A - product(b.T, s), d - product(b.T, h), product(b.T, b),
            product(s.T, h) - q, (Q + Q.T) / 2 - product(s.T, s),
        )  # fmt: skip

    steps = jax.vmap(step)(L, A, B, d, Q[:-1], q[:-1], r, S)
    zero = jnp.zeros_like(Q[-1:])
    end = Stretch(zero, jnp.zeros_like(q[-1:]), zero, -q[-1:], (Q[-1:] + Q[-1:].mT) / 2)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), steps, end), ok.all()


def join_tails(each: Stretch) -> Stretch:
    """Return the segments from every knot to the end, by doubling."""
    count = each.b.shape[0]

    def turn(k, now):
        ahead = jnp.arange(count) + 2**k
        there = ahead < count
        rest = jax.tree.map(lambda x: x[jnp.minimum(ahead, count - 1)], now)
        new = join(now, rest)

        def kept(a, b):
            return jnp.where(there.reshape(-1, *[1] * (a.ndim - 1)), a, b)

        return jax.tree.map(kept, new, now)

    return jax.lax.fori_loop(0, (count - 1).bit_length(), turn, each)


def costs_to_go(problem: LinearQuadratic) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return P (N + 1, n, n) and p (N + 1, n) of all knots, and whether the weights R are positive
    definite and all results finite; others are 0."""
    steps, ok = stretches(problem)
    to_end = join_tails(steps)
    P, p = to_end.J, -to_end.e
    ok &= jnp.isfinite(P).all() & jnp.isfinite(p).all()
    P, p = (jnp.where(jnp.isfinite(x), x, 0.0) for x in (P, p))
    return P, p, ok
