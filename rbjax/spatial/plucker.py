"""Plücker transforms, cross products, twists and wrenches as arrays (Featherstone, 2.8-2.9).

Twists (omega, v) and wrenches (n, f) are (..., 6), angular first, at the origin of the frame in
which they are expressed. T (..., 4, 4) is the pose of a frame B in A: R = R_AB and B's origin p.

    motion  X_AB  = [R, 0; [p] R, R]       V_A = X_AB V_B
    force   X*_AB = [R, [p] R; 0, R]       F_A = X*_AB F_B        X* = X^-T

X is the product of extended_translation(p) and extended_rotation(R) of Olguin Diaz, who puts the
linear part first. A motion m and a force f that are fixed in a frame of twist V have the rates
V x m and V x* f.
"""

from __future__ import annotations

import jax

from rbjax.arguments import ArrayLike
from rbjax.lanes import Mat3, Vec3
from rbjax.rotations import se3
from rbjax.rotations.arguments import entries, pose_parts, stacked, takes
from rbjax.spatial.vectors import Force, Motion, Transform


@takes(T="pose")
def motion_transform(T: ArrayLike) -> jax.Array:
    """Compute the motion transform X_AB (..., 6, 6), which is Ad(T).

    Args:
        T: (..., 4, 4), pose of B in A, with lengths in m.

    Returns:
        (..., 6, 6); the off-diagonal block is in m, the others have no unit.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations import se3
        >>> from rbjax.spatial import motion_transform
        >>> motion_transform(se3.exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]))[:, 2].tolist()
        [0.0, 0.0, 1.0, 0.0, -2.0, 0.0]
    """
    return se3.adjoint(T)


@takes(T="pose")
def force_transform(T: ArrayLike) -> jax.Array:
    """Compute the force transform X*_AB (..., 6, 6) from the pose T of frame B in frame A: it maps
    forces from B to A.

    Args:
        T: (..., 4, 4), pose of B in A, with lengths in m.

    Returns:
        (..., 6, 6); the off-diagonal block is in m, the others have no unit.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations import se3
        >>> from rbjax.spatial import force_transform
        >>> force_transform(se3.exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0]))[:, 4].tolist()
        [0.0, 0.0, 2.0, 0.0, 1.0, 0.0]
    """
    R, p = pose_parts(T)
    return _blocks(R, Mat3.skew(p) @ R, Mat3.zero(), R)


@takes(T="pose", V="twist")
def transform_motion(T: ArrayLike, V: ArrayLike) -> jax.Array:
    """Transform a motion: X_AB V (..., 6) = (R omega, R v + p x R omega).

    Args:
        T: (..., 4, 4), pose of B in A, with lengths in m.
        V: (..., 6), twists, rad/s, then m/s.

    Returns:
        (..., 6), in A, in the units of V.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations import se3
        >>> from rbjax.spatial import transform_motion
        >>> T = se3.exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0])
        >>> transform_motion(T, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]).tolist()
        [0.0, 0.0, 1.0, 0.0, -2.0, 0.0]
    """
    return stacked(Transform(*pose_parts(T)).motion_to_parent(_motion(V)))


@takes(T="pose", F="twist")
def transform_force(T: ArrayLike, F: ArrayLike) -> jax.Array:
    """Transform a force: X*_AB F (..., 6) = (R n + p x R f, R f).

    Args:
        T: (..., 4, 4), pose of B in A, with lengths in m.
        F: (..., 6), wrenches, N m, then N.

    Returns:
        (..., 6), in A, N m, then N.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations import se3
        >>> from rbjax.spatial import transform_force
        >>> T = se3.exp([0.0, 0.0, 0.0, 2.0, 0.0, 0.0])
        >>> transform_force(T, [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]).tolist()
        [0.0, 0.0, 2.0, 0.0, 1.0, 0.0]
    """
    return stacked(Transform(*pose_parts(T)).T(_force(F)))


@takes(R="rotation")
def extended_rotation(R: ArrayLike) -> jax.Array:
    """Compute diag(R, R) (..., 6, 6), the change of axes of motions and of forces.

    Args:
        R: (..., 3, 3), no unit.

    Returns:
        (..., 6, 6), no unit.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import extended_rotation
        >>> extended_rotation(jnp.eye(3)).shape
        (6, 6)
    """
    r = Mat3(*entries(R, 2))
    return _blocks(r, Mat3.zero(), Mat3.zero(), r)


@takes(p="vector")
def extended_translation(p: ArrayLike) -> jax.Array:
    """Compute [1, 0; [p], 1] (..., 6, 6), which maps a motion at p to the origin.

    Its transpose maps a force at the origin to p.

    Args:
        p: (..., 3), m.

    Returns:
        (..., 6, 6); the lower left block is in m.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import extended_translation
        >>> extended_translation([2.0, 0.0, 0.0])[4].tolist()
        [0.0, 0.0, -2.0, 0.0, 1.0, 0.0]
    """
    one = Mat3.identity()
    return _blocks(one, Mat3.zero(), Mat3.skew(Vec3(*entries(p))), one)


@takes(omega="vector")
def extended_cross(omega: ArrayLike) -> jax.Array:
    """Compute diag([omega], [omega]) (..., 6, 6), with omega in body axes.

    d/dt extended_rotation(R) = extended_rotation(R) extended_cross(omega)

    Args:
        omega: (..., 3), in body axes, rad/s.

    Returns:
        (..., 6, 6), rad/s.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import extended_cross
        >>> extended_cross([0.0, 0.0, 1.0])[4].tolist()
        [0.0, 0.0, 0.0, 1.0, 0.0, -0.0]
    """
    w = Mat3.skew(Vec3(*entries(omega)))
    return _blocks(w, Mat3.zero(), Mat3.zero(), w)


@takes(V="twist")
def motion_cross_matrix(V: ArrayLike) -> jax.Array:
    """Compute the matrix V x = [[omega], 0; [v], [omega]] (..., 6, 6), which is ad(V).

    Args:
        V: (..., 6), twists, rad/s, then m/s.

    Returns:
        (..., 6, 6), rad/s, and m/s in the off-diagonal block.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import motion_cross_matrix
        >>> motion_cross_matrix([0.0, 0, 0, 0, 0, 2])[4].tolist()
        [2.0, 0.0, -0.0, 0.0, 0.0, -0.0]
    """
    return se3.ad(V)


@takes(V="twist")
def force_cross_matrix(V: ArrayLike) -> jax.Array:
    """Compute the matrix V x* = [[omega], [v]; 0, [omega]] = -(V x)^T (..., 6, 6).

    Args:
        V: (..., 6), twists, rad/s, then m/s.

    Returns:
        (..., 6, 6), rad/s, and m/s in the off-diagonal block.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import force_cross_matrix
        >>> force_cross_matrix([0.0, 0, 0, 0, 0, 2])[1].tolist()
        [0.0, 0.0, -0.0, 2.0, 0.0, -0.0]
    """
    m = _motion(V)
    w = Mat3.skew(m.ang)
    return _blocks(w, Mat3.skew(m.lin), Mat3.zero(), w)


@takes(V="twist", m="twist")
def motion_cross(V: ArrayLike, m: ArrayLike) -> jax.Array:
    """Compute the cross product V x m (..., 6) of motions.

    Args:
        V: (..., 6), twists, rad/s, then m/s.
        m: (..., 6), motions, such as twists, rad/s and m/s.

    Returns:
        (..., 6), in the unit of m per second.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import motion_cross
        >>> along_y = [0.0, 1.0, 0.0, 0.0, 0.0, 5.0]
        >>> motion_cross([1.0, 0.0, 0.0, 0.0, 0.0, 0.0], along_y).tolist()
        [0.0, 0.0, 1.0, 0.0, -5.0, 0.0]
    """
    return stacked(_motion(V).cross(_motion(m)))


@takes(V="twist", f="twist")
def force_cross(V: ArrayLike, f: ArrayLike) -> jax.Array:
    """Compute the cross product V x* f (..., 6) of a motion and a force.

    Args:
        V: (..., 6), twists, rad/s, then m/s.
        f: (..., 6), forces, N m, then N.

    Returns:
        (..., 6), N m/s, then N/s.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import force_cross
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
