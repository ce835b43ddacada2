"""Plücker transforms and spatial cross products of arrays (Featherstone, 2.8-2.9).

Twists (omega, v) and wrenches (n, f) are (..., 6), angular first, at the origin of the frame in
which they are expressed. T (..., 4, 4) is the pose of a frame B in A: R = R_AB and B's origin p.

    motion  X_AB  = [R, 0; [p] R, R]       V_A = X_AB V_B
    force   X*_AB = [R, [p] R; 0, R]       F_A = X*_AB F_B        X* = X^-T

X = translation(p) rotation(R): the extended operators of Olguin Diaz (who puts the linear part
first). A motion and a force carried along by a frame of twist V change by V x m and V x* f.
"""

from __future__ import annotations

import jax

from rbjax.lanes import Mat3, Vec3
from rbjax.rotations import se3
from rbjax.spatial.arguments import entries, force, motion, pose_parts, stacked, takes
from rbjax.spatial.transform import Transform


@takes(T="pose")
def motion_transform(T: jax.Array) -> jax.Array:
    """X_AB (..., 6, 6), which is Ad(T).

    >>> motion_transform(se3.exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]))[:, 2].tolist()
    [0.0, 0.0, 1.0, 0.0, -2.0, 0.0]
    """
    return se3.adjoint(T)


@takes(T="pose")
def force_transform(T: jax.Array) -> jax.Array:
    """X*_AB (..., 6, 6).

    >>> force_transform(se3.exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]))[:, 4].tolist()
    [0.0, 0.0, 2.0, 0.0, 1.0, 0.0]
    """
    R, p = pose_parts(T)
    return _blocks(R, Mat3.skew(p) @ R, Mat3.zero(), R)


@takes(T="pose", V="twist")
def transform_motion(T: jax.Array, V: jax.Array) -> jax.Array:
    """X_AB V (..., 6) without the matrix: (R omega, R v + p x R omega)."""
    return stacked(Transform(*pose_parts(T)).motion_to_parent(motion(V)))


@takes(T="pose", F="twist")
def transform_force(T: jax.Array, F: jax.Array) -> jax.Array:
    """X*_AB F (..., 6) without the matrix: (R n + p x R f, R f)."""
    return stacked(Transform(*pose_parts(T)).T(force(F)))


@takes(R="rotation")
def extended_rotation(R: jax.Array) -> jax.Array:
    """diag(R, R) (..., 6, 6): a change of axes, for motions and for forces."""
    r = Mat3(*entries(R, 2))
    return _blocks(r, Mat3.zero(), Mat3.zero(), r)


@takes(p="vector")
def extended_translation(p: jax.Array) -> jax.Array:
    """[1, 0; [p], 1] (..., 6, 6): maps a motion at p to the origin. Its transpose maps a force at
    the origin to p.
    """
    one = Mat3.identity()
    return _blocks(one, Mat3.zero(), Mat3.skew(Vec3(*entries(p))), one)


@takes(omega="vector")
def extended_cross(omega: jax.Array) -> jax.Array:
    """diag([omega], [omega]) (..., 6, 6), with omega in body axes: d/dt extended_rotation(R) is
    extended_rotation(R) times this.
    """
    w = Mat3.skew(Vec3(*entries(omega)))
    return _blocks(w, Mat3.zero(), Mat3.zero(), w)


@takes(V="twist")
def motion_cross_matrix(V: jax.Array) -> jax.Array:
    """V x = [[omega], 0; [v], [omega]] (..., 6, 6), which is ad(V)."""
    return se3.ad(V)


@takes(V="twist")
def force_cross_matrix(V: jax.Array) -> jax.Array:
    """V x* = [[omega], [v]; 0, [omega]] = -(V x)^T (..., 6, 6)."""
    m = motion(V)
    w = Mat3.skew(m.ang)
    return _blocks(w, Mat3.skew(m.lin), Mat3.zero(), w)


@takes(V="twist", m="twist")
def motion_cross(V: jax.Array, m: jax.Array) -> jax.Array:
    """V x m (..., 6).

    >>> motion_cross([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0, 5.0]).tolist()
    [0.0, 0.0, 1.0, 0.0, -5.0, 0.0]
    """
    return stacked(motion(V).cross(motion(m)))


@takes(V="twist", f="twist")
def force_cross(V: jax.Array, f: jax.Array) -> jax.Array:
    """V x* f (..., 6).

    >>> force_cross([0.0, 0.0, 0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]).tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    """
    return stacked(motion(V).cross_force(force(f)))


def _blocks(a: Mat3, b: Mat3, c: Mat3, d: Mat3) -> jax.Array:
    """[a, b; c, d]."""
    rows = [[*x, *y] for x, y in zip(a.rows + c.rows, b.rows + d.rows, strict=True)]
    return stacked([x for row in rows for x in row], 6, 6)
