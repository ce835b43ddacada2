"""Plücker transforms, cross products, twists and wrenches as arrays (Featherstone, 2.8-2.9).

Twists (omega, v) and wrenches (n, f) are (..., 6), angular first, at the origin of the frame in
which they are expressed. T (..., 4, 4) is the pose of a frame B in A: R = R_AB and B's origin p.

    motion  X_AB  = [R, 0; [p] R, R]       V_A = X_AB V_B
    force   X*_AB = [R, [p] R; 0, R]       F_A = X*_AB F_B        X* = X^-T

X is the product of extended_translation(p) and extended_rotation(R) of Olguin Diaz, who puts the
linear part first. A motion m and a force f that are fixed in a frame of twist V have the rates
V x m and V x* f. If only the reference point changes, by r from O to P (Olguin Diaz, ch. 4-5):

    v_P = v_O + omega x r,    n_P = n_O - r x f
"""

from __future__ import annotations

import jax

from rbjax.lanes import Mat3, Vec3
from rbjax.rotations import screws, se3
from rbjax.rotations.arguments import entries, pose_parts, stacked, takes
from rbjax.rotations.screws import Screw
from rbjax.spatial.vectors import Force, Motion, Transform


@takes(T="pose")
def motion_transform(T: jax.Array) -> jax.Array:
    """Compute the motion transform X_AB (..., 6, 6), which is Ad(T).

    >>> motion_transform(se3.exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]))[:, 2].tolist()
    [0.0, 0.0, 1.0, 0.0, -2.0, 0.0]
    """
    return se3.adjoint(T)


@takes(T="pose")
def force_transform(T: jax.Array) -> jax.Array:
    """Compute the force transform X*_AB (..., 6, 6) from the pose T of frame B in frame A: it maps
    forces from B to A.

    >>> force_transform(se3.exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]))[:, 4].tolist()
    [0.0, 0.0, 2.0, 0.0, 1.0, 0.0]
    """
    R, p = pose_parts(T)
    return _blocks(R, Mat3.skew(p) @ R, Mat3.zero(), R)


@takes(T="pose", V="twist")
def transform_motion(T: jax.Array, V: jax.Array) -> jax.Array:
    """Transform a motion: X_AB V (..., 6) = (R omega, R v + p x R omega)."""
    return stacked(Transform(*pose_parts(T)).motion_to_parent(_motion(V)))


@takes(T="pose", F="twist")
def transform_force(T: jax.Array, F: jax.Array) -> jax.Array:
    """Transform a force: X*_AB F (..., 6) = (R n + p x R f, R f)."""
    return stacked(Transform(*pose_parts(T)).T(_force(F)))


@takes(R="rotation")
def extended_rotation(R: jax.Array) -> jax.Array:
    """Compute diag(R, R) (..., 6, 6), the change of axes of motions and of forces."""
    r = Mat3(*entries(R, 2))
    return _blocks(r, Mat3.zero(), Mat3.zero(), r)


@takes(p="vector")
def extended_translation(p: jax.Array) -> jax.Array:
    """Compute [1, 0; [p], 1] (..., 6, 6), which maps a motion at p to the origin.

    Its transpose maps a force at the origin to p.
    """
    one = Mat3.identity()
    return _blocks(one, Mat3.zero(), Mat3.skew(Vec3(*entries(p))), one)


@takes(omega="vector")
def extended_cross(omega: jax.Array) -> jax.Array:
    """Compute diag([omega], [omega]) (..., 6, 6), with omega in body axes.

    d/dt extended_rotation(R) = extended_rotation(R) extended_cross(omega)
    """
    w = Mat3.skew(Vec3(*entries(omega)))
    return _blocks(w, Mat3.zero(), Mat3.zero(), w)


@takes(V="twist")
def motion_cross_matrix(V: jax.Array) -> jax.Array:
    """Compute the matrix V x = [[omega], 0; [v], [omega]] (..., 6, 6), which is ad(V)."""
    return se3.ad(V)


@takes(V="twist")
def force_cross_matrix(V: jax.Array) -> jax.Array:
    """Compute the matrix V x* = [[omega], [v]; 0, [omega]] = -(V x)^T (..., 6, 6)."""
    m = _motion(V)
    w = Mat3.skew(m.ang)
    return _blocks(w, Mat3.skew(m.lin), Mat3.zero(), w)


@takes(V="twist", m="twist")
def motion_cross(V: jax.Array, m: jax.Array) -> jax.Array:
    """Compute the cross product V x m (..., 6) of motions.

    >>> motion_cross([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0, 5.0]).tolist()
    [0.0, 0.0, 1.0, 0.0, -5.0, 0.0]
    """
    return stacked(_motion(V).cross(_motion(m)))


@takes(V="twist", f="twist")
def force_cross(V: jax.Array, f: jax.Array) -> jax.Array:
    """Compute the cross product V x* f (..., 6) of a motion and a force.

    >>> force_cross([0.0, 0.0, 0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]).tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    """
    return stacked(_motion(V).cross_force(_force(f)))


def _motion(V: jax.Array) -> Motion:
    return Motion.from_lanes(entries(V))


def _force(F: jax.Array) -> Force:
    return Force.from_lanes(entries(F))


def _blocks(a: Mat3, b: Mat3, c: Mat3, d: Mat3) -> jax.Array:
    """Assemble the block matrix [a, b; c, d] (..., 6, 6)."""
    rows = [[*x, *y] for x, y in zip(a.rows + c.rows, b.rows + d.rows, strict=True)]
    return stacked([x for row in rows for x in row], 6, 6)


@takes(V="twist", point="vector")
def twist_at(V: jax.Array, point: jax.Array) -> jax.Array:
    """Compute the twist (omega, v + omega x r) (..., 6) at a point from the twist V at the origin.

    >>> twist_at([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0]).tolist()
    [0.0, 0.0, 1.0, 0.0, 2.0, 0.0]
    """
    m, r = _motion(V), Vec3(*entries(point))
    return stacked(Motion(m.ang, m.lin + m.ang.cross(r)))


@takes(F="twist", point="vector")
def wrench_at(F: jax.Array, point: jax.Array) -> jax.Array:
    """Compute the wrench (n - r x f, f) (..., 6) at a point from the wrench F at the origin.

    >>> wrench_at([0.0, 0.0, 2.0, 0.0, 1.0, 0.0], [2.0, 0.0, 0.0]).tolist()
    [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    """
    f, r = _force(F), Vec3(*entries(point))
    return stacked(Force(f.ang - r.cross(f.lin), f.lin))


@takes(f="vector", point="vector")
def force_at(f: jax.Array, point: jax.Array) -> jax.Array:
    """Compute the wrench (r x f, f) (..., 6) at the origin of a force f (..., 3) at a point.

    >>> force_at([0.0, 1.0, 0.0], [2.0, 0.0, 0.0]).tolist()
    [0.0, 0.0, 2.0, 0.0, 1.0, 0.0]
    """
    f_, r = Vec3(*entries(f)), Vec3(*entries(point))
    return stacked(Force(r.cross(f_), f_))


@takes(wrenches="twist", points="vector", about="vector")
def merge_wrenches(wrenches: jax.Array, points: jax.Array, about: jax.Array) -> jax.Array:
    """Sum wrenches (..., n, 6) at different points (..., n, 3) to one wrench at the point `about`.

    All are in the same axes.

    >>> couple = [[0.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, -1.0, 0.0]]
    >>> merge_wrenches(couple, [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [7.0, 7.0, 7.0]).tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    """
    return wrench_at(wrenches, about[..., None, :] - points).sum(-2)


@takes(F="twist", V="twist")
def power(F: jax.Array, V: jax.Array) -> jax.Array:
    """Compute the power n . omega + f . v (...) of a wrench and a twist at one point in one frame.

    >>> float(power([1.0, 0.0, 0.0, 0.0, 2.0, 0.0], [3.0, 0.0, 0.0, 0.0, 4.0, 0.0]))
    11.0
    """
    return _motion(V).dot(_force(F))


@takes(F="twist")
def central_axis(F: jax.Array) -> Screw:
    """Compute the central axis of a wrench: a force along a line and a couple about it (Poinsot).

    `axis` and `point` define the line, `pitch` is couple / force, and `magnitude` is the force. For
    a pure couple the pitch is infinite, and `magnitude` is the couple.

    >>> s = central_axis([0.0, 0.0, 2.0, 0.0, 1.0, 0.0])
    >>> s.axis.tolist(), s.point.tolist(), float(s.magnitude)
    ([0.0, 1.0, 0.0], [2.0, 0.0, 0.0], 1.0)
    """
    f = _force(F)
    return screws.from_twist(stacked([*f.lin, *f.ang]))
