"""Primitive constraint rows between two frames A and B, each fixed to a body.

With d = p_B - p_A, a direction u fixed in A and a direction w fixed in B,

    row            value     force of a unit multiplier on B, with its reaction on A
    displacement   d_k       force e_k at p_B
    along          u . d     force u at p_B
    cosine         u . w     torque w x u
    distance       |d|       force d / |d| at p_B

Source: Masarati, *Multibody System Dynamics*, ch. 6; Haug, *Computer-Aided Kinematics and
Dynamics*, 9.4.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike, instance
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.frames import frame_pose, locate
from rbjax.dynamics.algorithms.kinematics import forward_kinematics
from rbjax.dynamics.arguments import check_array
from rbjax.forces import FrameState, Loads
from rbjax.forces.context import Context
from rbjax.forces.place import Place, turn_z_to
from rbjax.lanes import Vec3, add, mul, sub
from rbjax.model import WORLD, Frame, Model
from rbjax.rotations import quaternion

X, Y, Z = (Vec3(*(float(i == k) for i in range(3))) for k in range(3))
AXES = (X, Y, Z)


def time(context: Context) -> Row:
    """Return the row whose value is the time t.

    Args:
        context: a `Context`, the argument of `Constraint.rows`.

    Returns:
        A `Row`, s.

    See `coordinate` for an example.
    """
    return Row(context.t, 1.0, Loads(), 0.0)


def coordinate(context: Context, joint: str | int, k: int = 0) -> Row:
    """Return the row of a coordinate of a joint: a hinge, a slide or a chain of them.

    Args:
        context: a `Context`, the argument of `Constraint.rows`.
        joint: name or index of the joint.
        k: index of the coordinate in the joint.

    Returns:
        A `Row`, rad or m.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> now = rb.forces.Context.of(model, 0.0, model.default_state(), None)
        >>> float(rb.constraints.coordinate(now, "shoulder").value)
        0.0
    """
    j = context.joint(joint)
    i = j.start + k
    return Row(j.q[k], j.v[k], Loads({i: 1.0}), 0.0 if context.a is None else context.a[i])


def _relative(A: FrameState, B: FrameState) -> tuple[Vec3, Vec3, Vec3]:
    """Return the vector from the origin of A to the origin of B and its first two time derivatives.
    They are in world axes."""
    return (
        B.position - A.position,
        B.velocity - A.velocity,
        B.acceleration - A.acceleration,
    )


def opposed(action: Loads, reaction: Loads) -> Loads:
    """Add an action and its reaction. The sum is internal unless one of them acts on the world."""
    both = bool(action.wrenches and reaction.wrenches)
    return replace(action + reaction, internal=both)


def displacement(A: FrameState, B: FrameState) -> list[Row]:
    """Return the three rows of p_B - p_A, the vector from A's to B's origin, in world axes.

    Args:
        A: a `FrameState` of a context, as `context.body(name)`.
        B: a `FrameState` of the same context.

    Returns:
        Three `Row`s, m.

    See `along` for an example.
    """
    d, rate, acceleration = _relative(A, B)
    return [
        Row(d[k], rate[k], opposed(B.push(e), A.push(-e)), acceleration[k])
        for k, e in enumerate(AXES)
    ]


def along(A: FrameState, u: Vec3, B: FrameState) -> Row:
    """Return the row u . (p_B - p_A), with u in A's axes and the origins p of both frames.

    Args:
        A: a `FrameState` of a context, as `context.body(name)`.
        u: a `Vec3` in A's axes.
        B: a `FrameState` of the same context.

    Returns:
        A `Row`, m if u has no unit.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> now = rb.forces.Context.of(model, 0.0, model.default_state(), None)
        >>> A, B = now.body("upper"), now.body("lower")
        >>> from rbjax.lanes import Vec3
        >>> round(float(rb.constraints.along(A, Vec3(0.0, 0.0, 1.0), B).value), 3)
        -1.0
    """
    u, w = A.rotation @ u, A.angular_velocity
    d, rate, acceleration = _relative(A, B)
    du = w.cross(u)
    ddu = A.angular_acceleration.cross(u) + w.cross(du)
    return Row(
        u.dot(d),
        add(du.dot(d), u.dot(rate)),
        opposed(B.push(u), A.push(-u, at=B.position)),
        add(add(ddu.dot(d), mul(2.0, du.dot(rate))), u.dot(acceleration)),
    )


def cosine(A: FrameState, u: Vec3, B: FrameState, w: Vec3) -> Row:
    """Return the row u . w, with u in A's axes and w in B's axes.

    Args:
        A: a `FrameState` of a context, as `context.body(name)`.
        u: a `Vec3` in A's axes.
        B: a `FrameState` of the same context.
        w: a `Vec3` in B's axes.

    Returns:
        A `Row`, the product of the units of u and w.

    See `along` for an example.
    """
    u, w = A.rotation @ u, B.rotation @ w
    a, b = A.angular_velocity, B.angular_velocity
    torque = w.cross(u)
    rate = b.cross(w).cross(u) + w.cross(a.cross(u))
    acceleration = B.angular_acceleration - A.angular_acceleration
    return Row(
        u.dot(w),
        (b - a).dot(torque),
        opposed(B.push(Vec3.zero(), torque), A.push(Vec3.zero(), -torque)),
        add(acceleration.dot(torque), (b - a).dot(rate)),
    )


def distance(A: FrameState, B: FrameState, least: float = 0.0) -> Row:
    """Return the row sqrt(d^2 + least^2), with the distance d of the origins of both frames.

    It is smooth at d = 0 if `least` is not zero. Otherwise its gradient at d = 0 is set to zero.

    Args:
        A: a `FrameState` of a context, as `context.body(name)`.
        B: a `FrameState` of the same context.
        least: least value, m.

    Returns:
        A `Row`, m.

    See `along` for an example.
    """
    d, rate, acceleration = _relative(A, B)
    square = add(d.dot(d), least * least)
    positive = square > 0
    length = jnp.sqrt(jnp.where(positive, square, 1.0))
    n = d * (1.0 / length)
    radial = n.dot(rate)
    centripetal = jnp.where(positive, sub(rate.dot(rate), mul(radial, radial)) / length, 0.0)
    length = jnp.where(positive, length, 0.0)
    acceleration = add(n.dot(acceleration), centripetal)
    return Row(length, radial, opposed(B.push(n), A.push(-n)), acceleration)


def turn(A: FrameState, B: FrameState) -> list[Row]:
    """Return the three rows sin(x) n of the rotation from A to B, with angle x and axis n.

    They are half the skew part of the rotation matrix, and zero if the frames are aligned.

    Args:
        A: a `FrameState` of a context, as `context.body(name)`.
        B: a `FrameState` of the same context.

    Returns:
        Three `Row`s, no unit.

    See `along` for an example.
    """
    return [
        (cosine(A, AXES[j], B, AXES[i]) - cosine(A, AXES[i], B, AXES[j])) * -0.5
        for i, j in ((2, 1), (0, 2), (1, 0))
    ]


#: the name or index of a body, an `rb.Frame`, or None for the world
End = str | int | Frame | None


def places(
    model: Model,
    a: End,
    b: End,
    *,
    point: Any = None,
    axis: Any = (0.0, 0.0, 1.0),
    q: ArrayLike | None = None,
) -> tuple[Place, Place]:
    """Return the `Place` on each of two bodies that coincides with a given frame of the world.

    Args:
        model: the robot.
        a, b: names or indices of bodies, or `rb.Frame`s; None is the world.
        point: (3,) origin of the frame, m in world axes. None: the origin of a if it is an
            `rb.Frame`, else the origin of the world.
        axis: (3,) z axis of the frame in world axes, of any length.
        q: (nq,) configuration at which they coincide; None for the model's default state.

    Returns:
        The places on a and on b.

    Raises:
        InputError: not a model, or a point or an axis of another shape. UnknownName: no such body.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> a, b = rb.constraints.places(model, None, "lower", point=[0.3, 0.0, 0.0])
        >>> a.position.tolist()
        [0.3, 0.0, 0.0]
    """
    instance("between", "model", model, Model, "the Model that the joint is for (rbjax.load)")
    q = model.default_state().q if q is None else check_array("places", "q", q, (model.nq,))
    point = origin(model, a, q) if point is None else point
    point = check_array("places", "point", point, (3,)).astype(q.dtype)
    turn = turn_z_to(check_array("places", "axis", axis, (3,)).astype(q.dtype))
    R, p = forward_kinematics(model, q)

    def of(end: End) -> Place:
        body: str | int | None
        if isinstance(end, Frame):
            found, _ = locate("between", model, q, end)
            body = None if found == WORLD else found
        else:
            body = end
        if body is None:
            return Place(point, turn)
        k = model.body(body)
        own = quaternion.conjugate(quaternion.from_matrix(R[k]))
        return Place(R[k].T @ (point - p[k]), quaternion.multiply(own, turn), body)

    return of(a), of(b)


def origin(model: Model, end: End, q: jax.Array | None = None) -> jax.Array:
    """Return the origin (3,) of an `rb.Frame` in the world, or the world's for another end."""
    q = model.default_state().q if q is None else q
    return frame_pose(model, q, end)[1] if isinstance(end, Frame) else jnp.zeros(3, q.dtype)
