"""SE(3), the group of poses, and se(3), its algebra of twists (Lynch & Park, ch. 3; Selig, ch. 4).

A pose T = [R p; 0 1] (..., 4, 4) maps coordinates of its frame into those of the parent. A twist is
angular first, xi = (phi, rho) or V = (omega, v). [xi] = [[phi] rho; 0 0].

SE(3) is SO(3) over the dual numbers (Kotelnikov's principle of transference), with ad(xi) =
[phi + eps rho]. Each 6 by 6 Jacobian is therefore [[J, 0], [Q, J]], with the Jacobian J of SO(3) at
phi and its derivative Q along rho, and is computed in this way.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.lanes import Mat3, Vec3, quaternion_matrix, safe_sqrt
from rbjax.rotations import quaternion
from rbjax.rotations.arguments import entries, pose_parts, stacked, takes
from rbjax.rotations.coefficients import inverse_jacobian_coefficient, stumpff
from rbjax.rotations.pose_derivatives import (
    body_twist,
    inverse_left_jacobian,
    inverse_right_jacobian,
    left_jacobian,
    rate_from_body_twist,
    rate_from_space_twist,
    right_jacobian,
    space_twist,
)
from rbjax.rotations.pose_lanes import halves, lower_blocks, pose_of

__all__ = [
    "identity", "pose", "hat", "vee", "exp", "log", "compose", "inverse", "interpolate", "distance",
    "adjoint", "ad", "left_jacobian", "right_jacobian", "inverse_left_jacobian",
    "inverse_right_jacobian", "rate_from_body_twist", "rate_from_space_twist", "body_twist",
    "space_twist",
]  # fmt: skip


def identity(dtype=None) -> jax.Array:
    """Return the identity pose (4, 4).

    Args:
        dtype: of the result; None for JAX's default.

    Returns:
        (4, 4), no unit.

    Example:
        >>> from rbjax.rotations.se3 import identity
        >>> identity()[3].tolist()
        [0.0, 0.0, 0.0, 1.0]
    """
    return jnp.eye(4, dtype=dtype)


@takes(R="rotation", p="vector")
def pose(R: ArrayLike, p: ArrayLike) -> jax.Array:
    """Assemble the pose [R p; 0 1] (..., 4, 4).

    Args:
        R: (..., 3, 3), rotation matrices, no unit.
        p: (..., 3), positions, m.

    Returns:
        (..., 4, 4), with lengths in m.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.se3 import pose
        >>> pose(jnp.eye(3), [1.0, 2.0, 3.0])[:3, 3].tolist()
        [1.0, 2.0, 3.0]
    """
    return pose_of(entries(R, 2), entries(p))


@takes(xi="twist")
def hat(xi: ArrayLike) -> jax.Array:
    """Return the matrix [xi] (..., 4, 4) of a twist (..., 6).

    Args:
        xi: (..., 6), twists, angular first: rad, then m.

    Returns:
        (..., 4, 4), in the units of xi.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.se3 import hat
        >>> hat([0.0, 0.0, 1.0, 4.0, 5.0, 6.0])[0].tolist()
        [0.0, -1.0, 0.0, 4.0]
    """
    x, y, z, a, b, c = entries(xi)
    o = jnp.zeros_like(x)
    return stacked([o, -z, y, a, z, o, -x, b, -y, x, o, c, o, o, o, o], 4, 4)


@takes(W="matrix4")
def vee(W: ArrayLike) -> jax.Array:
    """Return the twist xi (..., 6) of a matrix [xi], from the skew part of its 3 by 3 block.

    Args:
        W: (..., 4, 4), matrices [xi].

    Returns:
        (..., 6), in the units of W.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.se3 import hat, vee
        >>> vee(hat([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])).tolist()
        [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    """
    m = entries(W, 2)
    skew = [(m[9] - m[6]) / 2, (m[2] - m[8]) / 2, (m[4] - m[1]) / 2]
    return stacked([*skew, m[3], m[7], m[11]])


@takes(xi="twist")
def exp(xi: ArrayLike) -> jax.Array:
    """Compute the pose [exp(phi), J_l(phi) rho] that the constant twist xi reaches in unit time.

    Args:
        xi: (..., 6), twists, angular first: rad, then m.

    Returns:
        (..., 4, 4), with lengths in m.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.se3 import exp
        >>> exp([0.0, 0.0, jnp.pi, 0.0, 1.0, 0.0])[:3, 3].round(6).tolist()
        [-0.63662, 0.0, 0.0]
    """
    phi, rho = halves(entries(xi))
    c2, c3 = stumpff(phi.dot(phi), 2, 3)
    once = phi.cross(rho)
    R = quaternion_matrix(*quaternion.exp_lanes(list(phi)))
    return pose_of(R, rho + c2 * once + c3 * phi.cross(once))


@takes(T="pose")
def log(T: ArrayLike) -> jax.Array:
    """Compute the twist xi (..., 6) with exp(xi) = T and an angle of at most pi.

    Args:
        T: (..., 4, 4), poses, with lengths in m.

    Returns:
        (..., 6), twists, angular first: rad, then m.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import exp, log
        >>> log(exp([0.1, 0.2, 0.3, 4.0, 5.0, 6.0])).round(6).tolist()
        [0.09999999999999999, 0.19999999999999998, 0.3, 4.0, 5.0, 6.0]
    """
    R, p = pose_parts(T)
    phi = Vec3(*quaternion.log_lanes(quaternion.from_matrix_lanes(list(R))))
    e = inverse_jacobian_coefficient(phi.dot(phi))
    once = phi.cross(p)
    return stacked([*phi, *(p - 0.5 * once + e * phi.cross(once))])


@takes(A="pose", B="pose")
def compose(A: ArrayLike, B: ArrayLike) -> jax.Array:
    """Multiply poses: A B.

    Args:
        A: (..., 4, 4), poses, with lengths in m.
        B: (..., 4, 4), poses, with lengths in m.

    Returns:
        (..., 4, 4), A B.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import compose, exp
        >>> ahead = exp([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
        >>> compose(ahead, ahead)[:3, 3].tolist()
        [2.0, 0.0, 0.0]
    """
    (R, p), (S, r) = pose_parts(A), pose_parts(B)
    return pose_of(R @ S, p + R @ r)


@takes(T="pose")
def inverse(T: ArrayLike) -> jax.Array:
    """Compute the inverse pose [R^T, -R^T p].

    Args:
        T: (..., 4, 4), poses, with lengths in m.

    Returns:
        (..., 4, 4), with lengths in m.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import exp, inverse
        >>> inverse(exp([0.0, 0.0, 0.0, 1.0, 2.0, 3.0]))[:3, 3].tolist()
        [-1.0, -2.0, -3.0]
    """
    R, p = pose_parts(T)
    return pose_of(R.T, -(R.T @ p))


@takes(A="pose", B="pose", s="scalar")
def interpolate(A: ArrayLike, B: ArrayLike, s: ArrayLike) -> jax.Array:
    """Interpolate along the screw motion A exp(s log(A^-1 B)) from A (s = 0) to B (s = 1).

    Args:
        A: (..., 4, 4), poses, with lengths in m.
        B: (..., 4, 4), poses, with lengths in m.
        s: (...), from 0 to 1.

    Returns:
        (..., 4, 4), with lengths in m.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import exp, identity, interpolate
        >>> screw = exp([0.0, 0.0, 0.2, 0.0, 0.0, 2.0])
        >>> interpolate(identity(), screw, 0.5)[2, 3].round(6).item()
        1.0
    """
    return compose(A, exp(s[..., None] * log(compose(inverse(A), B))))


@takes(A="pose", B="pose")
def distance(A: ArrayLike, B: ArrayLike) -> tuple[jax.Array, jax.Array]:
    """Compute the rotation angle and the translation distance from A to B.

    Args:
        A: (..., 4, 4), poses, with lengths in m.
        B: (..., 4, 4), poses, with lengths in m.

    Returns:
        The angle (...), rad, and the distance (...), m.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> from rbjax.rotations.se3 import distance, exp, identity
        >>> turn, way = distance(identity(), exp([0.0, 0.0, 0.2, 0.0, 0.0, 2.0]))
        >>> round(float(turn), 6), round(float(way), 6)
        (0.2, 2.0)
    """
    (R, p), (S, r) = pose_parts(A), pose_parts(B)
    w, *u = quaternion.from_matrix_lanes(list(R.T @ S))
    d = r - p
    return quaternion.angle_lanes(w, u), safe_sqrt(d.dot(d))


@takes(T="pose")
def adjoint(T: ArrayLike) -> jax.Array:
    """Compute the adjoint matrix [[R, 0], [[p] R, R]] (..., 6, 6), which maps twists to the parent.

    Args:
        T: (..., 4, 4), poses, with lengths in m.

    Returns:
        (..., 6, 6); its lower left block is in m, the others have no unit.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.se3 import adjoint, exp
        >>> T = exp([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
        >>> (adjoint(T) @ jnp.array([0.0, 0, 1, 0, 0, 0])).tolist()
        [0.0, 0.0, 1.0, 0.0, -1.0, 0.0]
    """
    R, p = pose_parts(T)
    return lower_blocks(list(R), list(Mat3.skew(p) @ R))


@takes(xi="twist")
def ad(xi: ArrayLike) -> jax.Array:
    """Compute ad(xi) = [[[phi], 0], [[rho], [phi]]] (..., 6, 6). ad(a) b is the Lie bracket.

    Args:
        xi: (..., 6), twists, angular first: rad, then m.

    Returns:
        (..., 6, 6); its lower left block is in m, the others have no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.se3 import ad
        >>> (ad([0.0, 0, 1, 0, 0, 0]) @ jnp.array([1.0, 0, 0, 0, 0, 0])).tolist()
        [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    """
    phi, rho = halves(entries(xi))
    return lower_blocks(list(Mat3.skew(phi)), list(Mat3.skew(rho)))
