"""Rows between two frames A and B, each fixed to a body: what loop joints are made of.

With d = p_B - p_A, and u, w directions that are fixed in A and B,

    displacement   d_k                    force e_k at p_B, and back on A
    along          u . d                  force u at p_B, on A against it at the same point
    cosine         u . w                  torque w x u on B, and back on A
    distance       |d|                    force d / |d| at p_B, and back on A
(Masarati, *Multibody System Dynamics*, ch. 6; Haug, *Computer-Aided Kinematics and Dynamics*, 9.4)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import instance
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.kinematics import forward_kinematics
from rbjax.dynamics.arguments import check_array
from rbjax.forces import Frame, Loads
from rbjax.forces.context import Context
from rbjax.forces.place import Place, turn_z_to
from rbjax.lanes import Vec3, add, mul, sub
from rbjax.model import Model
from rbjax.rotations import quaternion

X, Y, Z = (Vec3(*(float(i == k) for i in range(3))) for k in range(3))
AXES = (X, Y, Z)


def time(now: Context) -> Row:
    """t."""
    return Row(now.t, 1.0, Loads(), 0.0)


def coordinate(now: Context, joint: str | int, k: int = 0) -> Row:
    """A coordinate of a joint of one coordinate or of a chain of such."""
    j = now.joint(joint)
    i = j.start + k
    return Row(j.q[k], j.v[k], Loads({i: 1.0}), 0.0 if now.a is None else now.a[i])


def _apart(A: Frame, B: Frame) -> tuple[Vec3, Vec3, Vec3]:
    """d with its first two derivatives, in world axes."""
    return (
        B.position - A.position,
        B.velocity - A.velocity,
        B.acceleration - A.acceleration,
    )


def opposed(action: Loads, reaction: Loads) -> Loads:
    """An action and its reaction; the world feels none."""
    both = bool(action.wrenches and reaction.wrenches)
    return replace(action + reaction, internal=both)


def displacement(A: Frame, B: Frame) -> list[Row]:
    """p_B - p_A in world axes."""
    d, rate, bent = _apart(A, B)
    return [Row(d[k], rate[k], opposed(B.push(e), A.push(-e)), bent[k]) for k, e in enumerate(AXES)]


def along(A: Frame, u: Vec3, B: Frame) -> Row:
    """u . (p_B - p_A), with u in A's axes."""
    u, w = A.rotation @ u, A.angular_velocity
    d, rate, bent = _apart(A, B)
    du = w.cross(u)
    ddu = A.angular_acceleration.cross(u) + w.cross(du)
    return Row(
        u.dot(d),
        add(du.dot(d), u.dot(rate)),
        opposed(B.push(u), A.push(-u, at=B.position)),
        add(add(ddu.dot(d), mul(2.0, du.dot(rate))), u.dot(bent)),
    )


def cosine(A: Frame, u: Vec3, B: Frame, w: Vec3) -> Row:
    """u . w, with u in A's axes and w in B's."""
    u, w = A.rotation @ u, B.rotation @ w
    a, b = A.angular_velocity, B.angular_velocity
    turn = w.cross(u)
    turned = b.cross(w).cross(u) + w.cross(a.cross(u))
    bent = B.angular_acceleration - A.angular_acceleration
    return Row(
        u.dot(w),
        (b - a).dot(turn),
        opposed(B.push(Vec3.zero(), turn), A.push(Vec3.zero(), -turn)),
        add(bent.dot(turn), (b - a).dot(turned)),
    )


def distance(A: Frame, B: Frame, least: float = 0.0) -> Row:
    """d = |p_B - p_A|, or sqrt(d^2 + least^2), which is smooth at d = 0. If `least` is 0, the
    gradient at d = 0 is zero."""
    d, rate, bent = _apart(A, B)
    square = add(d.dot(d), least * least)
    apart = square > 0
    length = jnp.sqrt(jnp.where(apart, square, 1.0))
    n = d * (1.0 / length)
    along = n.dot(rate)
    turning = jnp.where(apart, sub(rate.dot(rate), mul(along, along)) / length, 0.0)
    length = jnp.where(apart, length, 0.0)
    return Row(length, along, opposed(B.push(n), A.push(-n)), add(n.dot(bent), turning))


def turn(A: Frame, B: Frame) -> list[Row]:
    """The sine of the angle by which B is turned against A, times its axis, in axes between those
    of A and B: half the skew part of the rotation. Zero where they are aligned."""
    return [
        (cosine(A, AXES[j], B, AXES[i]) - cosine(A, AXES[i], B, AXES[j])) * -0.5
        for i, j in ((2, 1), (0, 2), (1, 0))
    ]


def places(
    model: Model,
    a: str | int | None,
    b: str | int | None,
    *,
    point: Any = (0.0, 0.0, 0.0),
    axis: Any = (0.0, 0.0, 1.0),
    q: jax.Array | None = None,
) -> tuple[Place, Place]:
    """One frame, fixed to two bodies (or the world, None) as they are in a configuration.

    Args:
        model: the robot.
        a, b: names or indices of bodies.
        point: (3,) m in the world.
        axis: (3,), of any length, in the world.
        q: (nq,); the model's default state if None.
    """
    instance("between", "model", model, Model, "the Model that the joint is for (rbjax.load)")
    q = model.default_state().q if q is None else q
    point = check_array("places", "point", point, (3,)).astype(q.dtype)
    turn = turn_z_to(check_array("places", "axis", axis, (3,)).astype(q.dtype))
    R, p = forward_kinematics(model, q)

    def of(body: str | int | None) -> Place:
        if body is None:
            return Place(point, turn)
        k = model.body(body)
        own = quaternion.conjugate(quaternion.from_matrix(R[k]))
        return Place(R[k].T @ (point - p[k]), quaternion.multiply(own, turn), body)

    return of(a), of(b)
