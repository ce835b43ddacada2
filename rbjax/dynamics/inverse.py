"""The inverse of the mass matrix in factors, from what the articulated-body algorithm leaves.

With U_i, D_i of each joint (aba.py), M = L^T D L where L_ij = U_i . S_j / D_i for each j that
carries i: triangular, with entries only where one link carries the other (Featherstone, 6.5). Its
inverse P has the same pattern, and

    M^-1 = P D^-1 P^T,      P_ij = -U_i . a_i / D_i,   a_i = a_parent + S_i P_ij,   a_j = S_j

the accelerations that follow a unit acceleration of joint j when nothing else drives the joints
(Carpentier 2018). World axes, so that nothing is transformed on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.drivers import Driver, Unrolled
from rbjax.dynamics.packing import pack
from rbjax.lanes import Lane, inner, mul, sub
from rbjax.materialize import materialize
from rbjax.spatial import Motion


def follow(x: Any, a_parent: Motion) -> tuple[Motion, Lane]:
    """One step: a joint that nothing drives gives way; `unit` is 1 at the joint that is moved."""
    S, U, unit = x
    qdd = sub(unit, U.dot(a_parent))
    return a_parent + S * qdd, qdd


class InverseMass:
    """M^-1 = P D^-1 P^T, of which P_ij is kept for each link j that carries i, or is it."""

    def __init__(self, d: Driver, poses: Any, S: Any, U: Any, inverse_D: Any, like: jax.Array):
        """poses and S in world axes, in the form of `Driver.whole`; U and 1 / D per link."""
        self.d, self.like = d, like
        n, chains = d.topology.nv, d.topology.ancestors
        scaled = d.rows(
            d.each(lambda pose, U, x: pose.T(U) * x, poses, d.whole(U), d.whole(inverse_D))
        )

        def column(unit):
            return d.outward(follow, Motion.zero(), d.zip(d.rows(S), scaled, unit))

        if isinstance(d, Unrolled):
            P = [column([float(i == j) for i in range(n)]) for j in range(n)]
            self.inverse_D, self.P = inverse_D, [[P[j][i] for j in range(n)] for i in range(n)]
        else:
            P = jax.vmap(lambda unit: d.pack(column(d.lanes(unit)), unit))(jnp.eye(n, dtype=like.dtype))
            self.array, self.inverse_D = P.T, list(d.pack(inverse_D, like))
            self.P = [[P[j, i] for j in range(n)] for i in range(n)]
        self.carriers = chains
        self.carried = [[i for i in range(n) if j in chains[i]] for j in range(n)]

    def across(self, x: Sequence[Lane]) -> list[Lane]:
        """D^-1 P^T x."""
        sums = [inner([self.P[i][j] for i in below], [x[i] for i in below]) for j, below in enumerate(self.carried)]
        return materialize([mul(a, b) for a, b in zip(self.inverse_D, sums, strict=True)])

    def back(self, y: Sequence[Lane]) -> list[Lane]:
        """P y."""
        return [inner([self.P[i][j] for j in above], [y[j] for j in above]) for i, above in enumerate(self.carriers)]

    def __call__(self, *columns: Any) -> tuple[Any, ...]:
        """M^-1 X of each X, whose columns are given, and M^-1 itself."""
        n, like = self.d.topology.nv, self.like

        def solve(columns, row):
            solved = [self.back(self.across(x)) for x in columns]
            unit = materialize([mul(a, b) for a, b in zip(self.inverse_D, row, strict=True)])
            return (*solved, self.back(unit))

        if isinstance(self.d, Unrolled):
            out = [solve([x[j] for x in columns], self.P[j]) for j in range(n)]
            flat = [[x[k][i] for i in range(n) for x in out] for k in range(len(columns) + 1)]
            return tuple(pack(x, jnp.zeros(n * n, like.dtype)).reshape(n, n) for x in flat)

        def step(_, x):
            *columns, row = x
            return None, tuple(pack(x, like) for x in solve(columns, row))

        _, out = jax.lax.scan(step, None, (*columns, self.array))
        return tuple(x.T for x in out)
