"""Links in world axes, sums over subtrees, and the factors of the derivatives of RNEA.

The origin of each tree is the origin of its first link, so that float32 keeps its digits. Let V and
A be the twist and spatial acceleration of the link that carries joint j. A tangent dq_j moves the
subtree of j as one rigid body. For each body k of the subtree (Singh, Russell & Wensing 2022)

    df_k / dq_j = S_j x* f_k + I_k Psi''_j + 2 B_k Psi'_j,     Psi'_j = V x S_j
    df_k / dv_j = I_k (Psi'_j + S_j') + 2 B_k S_j,             Psi''_j = A x S_j + V x Psi'_j

with B of `Coriolis`. The sums of these forces over subtrees are computed in O(n). An entry (i, j)
is the product of a sum with S_i, in O(depth) for each column. If j moves i, the rotations of f and
of S_i cancel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from rbjax.dynamics.algorithms.kinematics import POSE, sweep
from rbjax.dynamics.drivers.choice import Driver
from rbjax.lanes import Lane, Mat3, Sym3, Vec3, add, mul, total
from rbjax.model import Topology
from rbjax.spatial import Force, Motion, RigidInertia, Transform


def tree_poses(d: Driver, joints: Any) -> Any:
    """Compute the pose of each link in world axes, from the origin of its tree's first link."""
    poses = d.whole(*sweep(d, joints, POSE))
    origins = d.take(poses, [chain[0] for chain in d.topology.ancestors])
    return d.each(lambda pose, origin: Transform(pose.R, pose.p - origin.p), poses, origins)


def link_axes(d: Driver, poses: Any, joints: Any) -> Any:
    """Compute the axis S of each link in world axes."""
    return d.each(Transform.motion_to_parent, poses, d.whole_axes(joints))


def axis_rates(d: Driver, V: Any, S: Any, poses: Any, joints: Any) -> Any:
    """Compute the time derivative S' of the axis of each link, in world axes."""
    rates = d.each(Motion.cross, axis_twists(d, V), S)
    if d.topology.constant_axes:
        return rates
    own = d.whole(d.axes(joints)[1])
    return d.each(lambda rate, pose, own: rate + pose.motion_to_parent(own), rates, poses, own)


def link_twists(d: Driver, S: Any, v: jax.Array) -> Any:
    """Compute the twist V of each link in world axes."""

    def step(x, V_parent):
        S, speed = x
        V = V_parent + S * speed
        return V, V

    return d.whole(d.outward(step, Motion.zero(), d.zip(d.rows(S), d.lanes(v))))


def axis_twists(d: Driver, V: Any) -> Any:
    """Return the twist T of each axis, with S' = T x S: the twist of the last link of its node."""
    return d.take(V, [dof.node[-1] for dof in d.topology.dofs])


def link_inertias(d: Driver, poses: Any, joints: Any) -> Any:
    """Compute the inertia of each link in world axes."""
    return d.each(
        lambda pose, link: pose.rigid_to_parent(link.inertia), poses, d.whole(d.constants)
    )


class Coriolis(NamedTuple):
    """B = (V x* I - I V x + (I V) x-bar*) / 2, of an inertia I that moves with the twist V.
    B = [K, 0; -[f], 0] with f the linear part of I V, so B V = V x* I V and B + B^T = dI/dt."""

    K: Mat3
    f: Vec3

    @classmethod
    def of(cls, inertia: RigidInertia, V: Motion) -> Coriolis:
        """Compute B with K = [w] (J - tr(J) / 2) + (h . u) 1 - u h^T, for V = [w; u]."""
        w, u, h, (*diagonal, xy, xz, yz) = V.ang, V.lin, inertia.h, inertia.J
        half = mul(-0.5, total(diagonal))
        angular = Mat3.skew(w) @ Sym3(*(add(x, half) for x in diagonal), xy, xz, yz)
        xx, yy, zz = (mul(a, b) for a, b in zip(u, h, strict=True))
        (ux, uy, uz), (hx, hy, hz) = -u, h
        linear = Mat3(
            add(yy, zz), mul(ux, hy), mul(ux, hz),
            mul(uy, hx), add(xx, zz), mul(uy, hz),
            mul(uz, hx), mul(uz, hy), add(xx, yy),
        )  # fmt: skip
        return cls(angular + linear, u * inertia.m - h.cross(w))

    @classmethod
    def zero(cls) -> Coriolis:
        return cls(Mat3.zero(), Vec3.zero())

    def __call__(self, w: Vec3) -> Force:
        """Compute the force B [w; u] of a motion [w; u]. It does not depend on u."""
        return Force(self.K @ w, w.cross(self.f))

    def transposed(self, S: Motion) -> Vec3:
        """Return the angular part of B^T S for a motion S. The linear part is zero."""
        return self.K.T @ S.ang + self.f.cross(S.lin)


def subtree_sums(d: Driver, values: Any, zero: Any) -> Any:
    """Sum values over the subtree of each link, including the link."""

    def step(own, children):
        total = jax.tree.map(add, own, children)
        return total, total

    return d.whole(d.inward(step, zero, d.rows(values)))


class Operands(NamedTuple):
    """The factors of `pair_matrix` for each link.

    Entry (i, j) is the row of link i times a column of link j if j moves i. Otherwise it is the
    axis of link i times a force of link j.
    """

    force_q: Force
    force_v: Force
    force_a: Force
    row: tuple[Lane, ...]
    column_q: tuple[Lane, ...]
    column_v: tuple[Lane, ...]


def operands(
    d: Driver, poses: Any, S: Any, v: jax.Array, a: Any, select: Callable | None = None, *given: Any
) -> Any:
    """Compute `Operands` per link at the joint accelerations `a` (per link).
    If `select` is given, compute select(pose, S, operands, *given) of each link instead."""
    V = link_twists(d, S, v)
    base = Motion(Vec3.zero(), -d.prepared.gravity)
    before = [_before(d.topology, i) for i in range(d.topology.nv)]
    V_before, T = d.take(V, before, Motion.zero()), axis_twists(d, V)
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
        Psi_d = V_before.cross(S)
        Psi_dd = A_before.cross(S) + V_before.cross(Psi_d)
        with_rate = Psi_d * 2.0 if no_balls else Psi_d + T.cross(S)
        twice_Psi_d = with_rate.ang if no_balls else Psi_d.ang * 2.0
        twice_S, IS = S.ang * 2.0, inertia(S)
        out = Operands(
            S.cross_force(force) + inertia(Psi_dd) + B(twice_Psi_d),
            inertia(with_rate) + B(twice_S),
            IS,
            (*IS, *B.transposed(S)),
            (*Psi_dd, *twice_Psi_d),
            (*with_rate, *twice_S),
        )
        return composite, out if select is None else select(pose, S, out, *more)

    nothing = RigidInertia.zero(), Coriolis.zero(), Force.zero()
    rows = d.zip(*map(d.rows, (poses, S, V, A, T, V_before, A_before)))
    return d.inward(gather, nothing, d.zip(d.constants, rows, *given))


def whole_operands(d: Driver, *args: Any) -> Operands:
    """Compute `operands` as one record, whose fields are over all links (`Driver.whole`)."""
    return Operands(*map(d.whole, d.unzip(operands(d, *args), len(Operands._fields))))


def _before(top: Topology, i: int) -> int:
    """Return the index of the link whose twist V gives the rate V x S of the axis of link i.

    It is the parent of the first link of a ball. Otherwise it is link i itself, because S x S = 0.
    """
    node = top.dofs[i].node
    return i if len(node) == 1 else top.parents[node[0]]


def inverse_pairs(S: Any, x: Operands) -> tuple:
    """Return the vectors (a, b) of each link that `pair_matrix` needs for dID/dq, dID/dv and M."""
    return (
        ((S, x.force_q), (x.row, x.column_q)),
        ((S, x.force_v), (x.row, x.column_v)),
        ((S, x.force_a), (x.force_a, S)),
    )
