"""The inverse of the mass matrix in factors, from the articulated-body algorithm.

With U_i and D_i of each joint (aba.py), M = L^T D L with L_ij = U_i . S_j / D_i for each link j
that carries i. L is triangular, and its entries are zero unless j carries i (Featherstone, 6.5).
The inverse P of L has the same pattern:

    M^-1 = P D^-1 P^T,   P_ij = -sum over k from j to the parent of i of L_ik P_kj,   P_jj = 1

Column j of P contains the accelerations of all joints that a unit acceleration of joint j causes if
no other joint is driven (Carpentier 2018): P_ij = -U_i . a_parent / D_i with
a_i = a_parent + S_i P_ij. All vectors are in world axes, so the sweep needs no transforms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.dynamics.algorithms.aba import factorize, solve
from rbjax.dynamics.algorithms.columns import inverse_mass_by_columns
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.drivers.pairs import pair_columns, pair_entries
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.lanes import Lane, fusion_barrier, inner, mul, neg, sub
from rbjax.lanes.arrays import pack
from rbjax.model import Model
from rbjax.spatial import Motion


class InverseMass:
    """The inverse M^-1 = P D^-1 P^T. P[i][j] is zero unless j is i or a link that carries i."""

    def __init__(self, d: Driver, poses: Any, S: Any, U: Any, inverse_D: Any, like: jax.Array):
        """Compute P from poses and S (whole form, world axes), and U and 1 / D (per link)."""
        self.d, self.like = d, like
        n = d.topology.nv
        self.carriers = list(enumerate(d.topology.ancestors))
        self.carried = [(j, [i for i, to in self.carriers if j in to]) for j in range(n)]
        scaled = d.each(lambda pose, U, x: pose.T(U) * x, poses, d.whole(U), d.whole(inverse_D))
        if d.listed:
            self.inverse_D = d.whole(inverse_D)
            self.P = self._by_substitution(S, scaled)
        else:
            self.inverse_D = list(d.pack(inverse_D, like))
            self.array = _responses(d, S, scaled, like)
            self.P = [list(row) for row in self.array]

    def _by_substitution(self, S: list, scaled: list) -> list[list[Lane]]:
        L = fusion_barrier([[scaled[i].dot(S[j]) for j in to[:-1]] for i, to in self.carriers])
        P: list[list[Lane]] = []
        for i, (*above, _) in self.carriers:
            row: list[Lane] = [0.0] * len(L)
            row[i] = 1.0
            for at, j in enumerate(above):
                row[j] = neg(inner(L[i][at:], [P[k][j] for k in above[at:]]))
            P.append(fusion_barrier(row))
        return P

    def solve(self, columns: Sequence[Sequence[Lane]], row: Sequence[Lane]) -> list[list[Lane]]:
        """Compute -M^-1 x for each column x, and column j of M^-1 from row j of P."""
        P = self.P

        def driven(x):
            return [neg(inner([P[i][j] for i in to], [x[i] for i in to])) for j, to in self.carried]

        def scaled(y):
            return [mul(a, b) for a, b in zip(self.inverse_D, y, strict=True)]

        def moved(y):
            return [inner([P[i][j] for j in to], [y[j] for j in to]) for i, to in self.carriers]

        return [moved(y) for y in fusion_barrier([scaled(y) for y in (*map(driven, columns), row)])]

    def __call__(self, *pairs: Any) -> list[jax.Array]:
        """Compute -M^-1 X for each matrix X = `pair_matrix(d, *pair)`, and last M^-1 itself."""
        d, n, like = self.d, self.d.topology.nv, self.like
        count = len(pairs) + 1
        flat = jnp.zeros(count * n, like.dtype)
        if d.listed:
            X = fusion_barrier([pair_entries(d.topology, *pair) for pair in pairs])
            out = [self.solve([[row[j] for row in x] for x in X], self.P[j]) for j in range(n)]
            for j in range(n):
                out[j][-1][j + 1 :] = [out[i][-1][j] for i in range(j + 1, n)]  # symmetric
            lanes = [out[j][k][i] for k in range(count) for i in range(n) for j in range(n)]
            return list(pack(lanes, jnp.zeros(flat.size * n, like.dtype)).reshape(count, n, n))
        columns, xs = pair_columns(d.topology, pairs, like)

        def step(_, x):
            row, own = x
            out = self.solve([list(x) for x in fusion_barrier(columns(own))], list(row))
            return None, pack([x for column in out for x in column], flat)

        _, solved = jax.lax.scan(step, None, (self.array, xs))
        return [solved[:, k * n : (k + 1) * n].T for k in range(count)]


def _responses(d: Driver, S: Any, scaled: Any, like: jax.Array) -> jax.Array:
    """Compute P as an array (nv, nv): the joint accelerations for a unit acceleration of each
    joint."""

    def follow(x, a_parent):
        S, U, unit = x
        qdd = sub(unit, U.dot(a_parent))
        return a_parent + S * qdd, qdd

    def column(unit):
        steps = d.zip(d.rows(S), d.rows(scaled), d.lanes(unit))
        return d.pack(d.outward(follow, Motion.zero(), steps), unit)

    return jax.vmap(column, out_axes=1)(jnp.eye(d.topology.nv, dtype=like.dtype))


@algorithm("q", pairs=True, multi_kernel=inverse_mass_by_columns)
def inverse_mass_matrix(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the inverse mass matrix M(q)^-1 (nv, nv), with ABA in O(n) for each column.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        (nv, nv), 1/kg and 1/(kg m^2), in SI units.

    Source: Featherstone, 7.5; Carpentier (2018), analytical inverse of the joint-space inertia.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rb.inverse_mass_matrix(model, model.default_state().q).shape
        (2, 2)
    """
    if not model.nv:
        return jnp.zeros((0, 0), q.dtype)
    d = driver(model, q.dtype)
    factors = factorize(d, d.joints(q, None))

    def column(unit):
        return d.pack(solve(d, factors, d.lanes(unit)), unit)

    return jax.vmap(column)(jnp.eye(model.nv, dtype=q.dtype))
