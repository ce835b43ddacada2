"""Links in world axes, and sums over the links that each of them carries.

The origin of each tree is that of its first link, so that f32 keeps its digits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax

from rbjax.dynamics.algorithms.kinematics import POSE, sweep
from rbjax.dynamics.drivers.choice import Driver
from rbjax.lanes import Mat3, Sym3, Vec3, add, mul, total
from rbjax.spatial import Force, Motion, RigidInertia, Transform


def tree_poses(d: Driver, joints: Any) -> Any:
    """Each link's pose in world axes, from the origin of its tree's first link."""
    poses = d.whole(*sweep(d, joints, POSE))
    origins = d.take(poses, [chain[0] for chain in d.topology.ancestors])
    return d.each(lambda pose, origin: Transform(pose.R, pose.p - origin.p), poses, origins)


def link_axes(d: Driver, poses: Any, joints: Any) -> Any:
    """Each link's axis S in world axes."""
    return d.each(Transform.motion_to_parent, poses, d.whole_axes(joints))


def axis_rates(d: Driver, V: Any, S: Any, poses: Any, joints: Any) -> Any:
    """S' of each link in world axes."""
    moved = d.each(Motion.cross, turning(d, V), S)
    if d.topology.constant_axes:
        return moved
    own = d.whole(d.axes(joints)[1])
    return d.each(lambda moved, pose, own: moved + pose.motion_to_parent(own), moved, poses, own)


def link_twists(d: Driver, S: Any, v: jax.Array) -> Any:
    """Each link's twist V in world axes."""

    def step(x, V_parent):
        S, speed = x
        V = V_parent + S * speed
        return V, V

    return d.whole(d.outward(step, Motion.zero(), d.zip(d.rows(S), d.lanes(v))))


def turning(d: Driver, V: Any) -> Any:
    """The twist T with S' = T x S of each link's axis. It is the twist of the link itself. For the
    three links of a ball it is that of the last, because their axes are fixed in the body."""
    return d.take(V, [link.node[-1] for link in d.topology.dofs])


def link_inertias(d: Driver, poses: Any) -> Any:
    """Each link's own inertia in world axes."""
    return d.each(
        lambda pose, link: pose.rigid_to_parent(link.inertia), poses, d.whole(d.constants)
    )


class Coriolis(NamedTuple):
    """B(I, V) = (V x* I - I V x + (I V) x-bar*) / 2 of an inertia I that moves with the twist V.

    B = [K, 0; -[f], 0] with f the linear part of I V, so B V = V x* I V and B + B^T = dI/dt.
    """

    K: Mat3
    f: Vec3

    @classmethod
    def of(cls, inertia: RigidInertia, V: Motion) -> Coriolis:
        """K = [w] (J - tr(J) / 2) + (h . u) 1 - u h^T, where V = [w; u]."""
        w, u, h, (*diagonal, xy, xz, yz) = V.ang, V.lin, inertia.h, inertia.J
        half = mul(-0.5, total(diagonal))
        turning = Mat3.skew(w) @ Sym3(*(add(x, half) for x in diagonal), xy, xz, yz)
        xx, yy, zz = (mul(a, b) for a, b in zip(u, h, strict=True))
        (ux, uy, uz), (hx, hy, hz) = -u, h
        sliding = Mat3(
            add(yy, zz), mul(ux, hy), mul(ux, hz),
            mul(uy, hx), add(xx, zz), mul(uy, hz),
            mul(uz, hx), mul(uz, hy), add(xx, yy),
        )  # fmt: skip
        return cls(turning + sliding, u * inertia.m - h.cross(w))

    @classmethod
    def zero(cls) -> Coriolis:
        return cls(Mat3.zero(), Vec3.zero())

    def __call__(self, w: Vec3) -> Force:
        """B [w; u], which does not depend on u."""
        return Force(self.K @ w, w.cross(self.f))

    def transposed(self, S: Motion) -> Vec3:
        """B^T S, whose linear part is zero."""
        return self.K.T @ S.ang + self.f.cross(S.lin)


def carried(d: Driver, values: Any, zero: Any) -> Any:
    """For each link, the sum of the values of all links that it carries, itself included."""

    def step(own, children):
        total = jax.tree.map(add, own, children)
        return total, total

    return d.whole(d.inward(step, zero, d.rows(values)))
