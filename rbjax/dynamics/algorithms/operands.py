"""The factors of the derivatives of inverse dynamics, link by link.

In world axes, with V and A the twist and spatial acceleration of the link that carries joint j. A
tangent dq_j moves the subtree of j as one rigid body, so for each body k of the subtree (Singh,
Russell & Wensing 2022)

    df_k / dq_j = S_j x* f_k + I_k (A x S_j + V x V x S_j) + 2 B_k (V x S_j)
    df_k / dv_j = I_k (V x S_j + S_j') + 2 B_k S_j

with B of `Coriolis`. Sums of these over a subtree are composites, and an entry (i, j) is a
product with S_i: O(n) for the composites, and O(depth) a column. If j moves i, the rotations of f
and of S_i cancel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from rbjax.dynamics.algorithms.composites import (
    Coriolis,
    link_twists,
    turning,
)
from rbjax.dynamics.drivers.choice import Driver
from rbjax.lanes import Lane, Sym3, Vec3, add
from rbjax.model import Topology
from rbjax.spatial import Force, Motion, RigidInertia


class Operands(NamedTuple):
    """The factors of `pair_matrix` for each link. Entry (i, j) is the row of link i times a column
    of link j if j moves i, else the axis of i times a force of j."""

    force_q: Force
    force_v: Force
    force_a: Force
    row: tuple[Lane, ...]
    column_q: tuple[Lane, ...]
    column_v: tuple[Lane, ...]


def operands(
    d: Driver, poses: Any, S: Any, v: jax.Array, a: Any, kept: Callable | None = None, *given: Any
) -> Any:
    """`Operands` at accelerations `a` per link, or kept(pose, S, operands, *given) of each link;
    per link."""
    V = link_twists(d, S, v)
    base = Motion(Vec3.zero(), -d.prepared.gravity)
    before = [_before(d.topology, i) for i in range(d.topology.nv)]
    V_before, T = d.take(V, before, Motion.zero()), turning(d, V)
    no_balls = T is V_before

    def accelerate(x, A_parent):
        S, V_before, speed, qdd = x
        A = A_parent + S * qdd + V_before.cross(S) * speed
        return A, A

    A = d.whole(d.outward(accelerate, base, d.zip(d.rows(S), d.rows(V_before), d.lanes(v), a)))
    A_before = d.take(A, before, base)

    def gather(x, children):
        link, (pose, S, V, A, T, V_before, A_before), *more = x
        inertia = pose.rigid_to_parent(link.inertia)
        own = inertia, (B := Coriolis.of(inertia, V)), inertia(A) + B(V.ang)
        inertia, B, force = composite = jax.tree.map(add, own, children)
        drift = V_before.cross(S)
        bend = A_before.cross(S) + V_before.cross(drift)
        both = drift * 2.0 if no_balls else drift + T.cross(S)
        turn, axis = both.ang if no_balls else drift.ang * 2.0, S.ang * 2.0
        IS = inertia(S)
        out = Operands(
            S.cross_force(force) + inertia(bend) + B(turn),
            inertia(both) + B(axis),
            IS,
            (*IS, *B.transposed(S)),
            (*bend, *turn),
            (*both, *axis),
        )
        return composite, out if kept is None else kept(pose, S, out, *more)

    massless = RigidInertia(0.0, Vec3.zero(), Sym3.zero())
    nothing = massless, Coriolis.zero(), Force.zero()
    rows = d.zip(*map(d.rows, (poses, S, V, A, T, V_before, A_before)))
    return d.inward(gather, nothing, d.zip(d.constants, rows, *given))


def whole_operands(d: Driver, *args: Any) -> Operands:
    """`operands`, each in the form of `Driver.whole`."""
    return Operands(*map(d.whole, d.unzip(operands(d, *args), len(Operands._fields))))


def _before(top: Topology, i: int) -> int:
    """The link whose motion moves the axis of link i while the joint of i is at rest: the parent of
    the first link for a ball, else the link itself, because S x S = 0."""
    node = top.dofs[i].node
    return i if len(node) == 1 else top.parents[node[0]]


def inverse_pairs(S: Any, x: Operands) -> tuple:
    """The factors of `pair_matrix` for dID/dq, dID/dv and M."""
    return (
        ((S, x.force_q), (x.row, x.column_q)),
        ((S, x.force_v), (x.row, x.column_v)),
        ((S, x.force_a), (x.force_a, S)),
    )
