"""SE(3), the group of poses, and se(3), its algebra of twists (Lynch & Park, ch. 3; Selig, ch. 4).

A pose T = [R p; 0 1] (..., 4, 4) maps coordinates of its frame into those of the parent. A twist is
angular first, xi = (phi, rho) or V = (omega, v). [xi] = [[phi] rho; 0 0].

SE(3) is SO(3) over the dual numbers (Kotelnikov's principle of transference), with ad(xi) =
[phi + eps rho]. Each 6 by 6 Jacobian is therefore [[J, 0], [Q, J]], with the Jacobian J of SO(3) at
phi and its derivative Q along rho, and is computed in this way.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from rbjax.lanes import Mat3, Vec3, quaternion_matrix, safe_sqrt
from rbjax.rotations import quaternion
from rbjax.rotations.arguments import entries, pose_parts, stacked, takes
from rbjax.rotations.coefficients import (
    inverse_jacobian_coefficient,
    inverse_left_lanes,
    left_lanes,
    stumpff,
)

__all__ = [
    "identity", "pose", "hat", "vee", "exp", "log", "compose", "inverse", "interpolate", "distance",
    "adjoint", "ad", "left_jacobian", "right_jacobian", "inverse_left_jacobian",
    "inverse_right_jacobian", "rate_from_body_twist", "rate_from_space_twist", "body_twist",
    "space_twist",
]  # fmt: skip


def identity(dtype=None) -> jax.Array:
    """Return the identity pose (4, 4)."""
    return jnp.eye(4, dtype=dtype)


@takes(R="rotation", p="vector")
def pose(R: jax.Array, p: jax.Array) -> jax.Array:
    """Assemble the pose [R p; 0 1] (..., 4, 4).

    >>> pose(jnp.eye(3), [1.0, 2.0, 3.0])[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    return _pose(entries(R, 2), entries(p))


@takes(xi="twist")
def hat(xi: jax.Array) -> jax.Array:
    """Return the matrix [xi] (..., 4, 4) of a twist (..., 6).

    >>> hat([0.0, 0.0, 1.0, 4.0, 5.0, 6.0])[0].tolist()
    [0.0, -1.0, 0.0, 4.0]
    """
    x, y, z, a, b, c = entries(xi)
    o = jnp.zeros_like(x)
    return stacked([o, -z, y, a, z, o, -x, b, -y, x, o, c, o, o, o, o], 4, 4)


@takes(W="matrix4")
def vee(W: jax.Array) -> jax.Array:
    """Return the twist xi (..., 6) of a matrix [xi], from the skew part of its 3 by 3 block."""
    m = entries(W, 2)
    skew = [(m[9] - m[6]) / 2, (m[2] - m[8]) / 2, (m[4] - m[1]) / 2]
    return stacked([*skew, m[3], m[7], m[11]])


@takes(xi="twist")
def exp(xi: jax.Array) -> jax.Array:
    """Compute the pose [exp(phi), J_l(phi) rho] that the constant twist xi reaches in unit time.

    >>> exp([0.0, 0.0, jnp.pi, 0.0, 1.0, 0.0])[:3, 3].round(6).tolist()
    [-0.63662, 0.0, 0.0]
    """
    phi, rho = _halves(entries(xi))
    c2, c3 = stumpff(phi.dot(phi), 2, 3)
    once = phi.cross(rho)
    R = quaternion_matrix(*quaternion.exp_lanes(list(phi)))
    return _pose(R, rho + c2 * once + c3 * phi.cross(once))


@takes(T="pose")
def log(T: jax.Array) -> jax.Array:
    """Compute the twist xi (..., 6) with exp(xi) = T and an angle of at most pi.

    >>> jnp.allclose(log(exp([0.1, 0.2, 0.3, 4.0, 5.0, 6.0])), jnp.array([0.1, 0.2, 0.3, 4, 5, 6]))
    Array(True, dtype=bool)
    """
    R, p = pose_parts(T)
    phi = Vec3(*quaternion.log_lanes(quaternion.from_matrix_lanes(list(R))))
    e = inverse_jacobian_coefficient(phi.dot(phi))
    once = phi.cross(p)
    return stacked([*phi, *(p - 0.5 * once + e * phi.cross(once))])


@takes(A="pose", B="pose")
def compose(A: jax.Array, B: jax.Array) -> jax.Array:
    """Multiply poses: A B."""
    (R, p), (S, r) = pose_parts(A), pose_parts(B)
    return _pose(R @ S, p + R @ r)


@takes(T="pose")
def inverse(T: jax.Array) -> jax.Array:
    """Compute the inverse pose [R^T, -R^T p]."""
    R, p = pose_parts(T)
    return _pose(R.T, -(R.T @ p))


@takes(A="pose", B="pose", s="scalar")
def interpolate(A: jax.Array, B: jax.Array, s: jax.Array) -> jax.Array:
    """Interpolate along the screw motion A exp(s log(A^-1 B)) from A (s = 0) to B (s = 1).

    >>> interpolate(identity(), exp([0.0, 0.0, 0.2, 0.0, 0.0, 2.0]), 0.5)[2, 3].round(6).item()
    1.0
    """
    return compose(A, exp(s[..., None] * log(compose(inverse(A), B))))


@takes(A="pose", B="pose")
def distance(A: jax.Array, B: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute the rotation angle and the translation distance from A to B."""
    (R, p), (S, r) = pose_parts(A), pose_parts(B)
    w, *u = quaternion.from_matrix_lanes(list(R.T @ S))
    d = r - p
    return quaternion.angle_lanes(w, u), safe_sqrt(d.dot(d))


@takes(T="pose")
def adjoint(T: jax.Array) -> jax.Array:
    """Compute the adjoint matrix [[R, 0], [[p] R, R]] (..., 6, 6), which maps twists to the parent.

    >>> (adjoint(exp([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])) @ jnp.array([0.0, 0, 1, 0, 0, 0])).tolist()
    [0.0, 0.0, 1.0, 0.0, -1.0, 0.0]
    """
    R, p = pose_parts(T)
    return _blocks(list(R), list(Mat3.skew(p) @ R))


@takes(xi="twist")
def ad(xi: jax.Array) -> jax.Array:
    """Compute ad(xi) = [[[phi], 0], [[rho], [phi]]] (..., 6, 6). ad(a) b is the Lie bracket."""
    phi, rho = _halves(entries(xi))
    return _blocks(list(Mat3.skew(phi)), list(Mat3.skew(rho)))


@takes(xi="twist")
def left_jacobian(xi: jax.Array) -> jax.Array:
    """Compute J_l (..., 6, 6) of exp(xi + d) = exp(J_l d) exp(xi), with V_space = J_l xi'."""
    return _dual(left_lanes, entries(xi))


@takes(xi="twist")
def right_jacobian(xi: jax.Array) -> jax.Array:
    """Compute J_r (..., 6, 6) of exp(xi + d) = exp(xi) exp(J_r d), with V_body = J_r xi'."""
    return _dual(left_lanes, entries(-xi))


@takes(xi="twist")
def inverse_left_jacobian(xi: jax.Array) -> jax.Array:
    """Compute J_l^-1 (..., 6, 6), with xi' = J_l^-1 V_space, for angles below 2 pi."""
    return _dual(inverse_left_lanes, entries(xi))


@takes(xi="twist")
def inverse_right_jacobian(xi: jax.Array) -> jax.Array:
    """Compute J_r^-1 (..., 6, 6), with xi' = J_r^-1 V_body, for angles below 2 pi."""
    return _dual(inverse_left_lanes, entries(-xi))


# ----------------------------------------------------------------------- pose kinematics


@takes(T="pose", V="twist")
def rate_from_body_twist(T: jax.Array, V: jax.Array) -> jax.Array:
    """Compute the rate of a pose, T' = T [V_body] (..., 4, 4)."""
    R, _ = pose_parts(T)
    omega, v = _halves(entries(V))
    return _bottomed(R @ Mat3.skew(omega), R @ v, 0.0)


@takes(T="pose", V="twist")
def rate_from_space_twist(T: jax.Array, V: jax.Array) -> jax.Array:
    """Compute the rate of a pose, T' = [V_space] T (..., 4, 4)."""
    R, p = pose_parts(T)
    omega, v = _halves(entries(V))
    return _bottomed(Mat3.skew(omega) @ R, omega.cross(p) + v, 0.0)


@takes(T="pose", dT="matrix4")
def body_twist(T: jax.Array, dT: jax.Array) -> jax.Array:
    """Compute the body twist V_body (..., 6), with [V_body] = T^-1 T'.

    >>> body_twist(identity(), hat([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])).tolist()
    [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    """
    (R, _), (dR, dp) = pose_parts(T), pose_parts(dT)
    return stacked([*_vee(R.T @ dR), *(R.T @ dp)])


@takes(T="pose", dT="matrix4")
def space_twist(T: jax.Array, dT: jax.Array) -> jax.Array:
    """Compute the space twist V_space (..., 6), with [V_space] = T' T^-1."""
    (R, p), (dR, dp) = pose_parts(T), pose_parts(dT)
    omega = _vee(dR @ R.T)
    return stacked([*omega, *(dp - omega.cross(p))])


# ------------------------------------------------------------------------------- on lanes


def _pose(R, p) -> jax.Array:
    return _bottomed(R, p, 1.0)


def _bottomed(R, p, corner: float) -> jax.Array:
    r, p = list(R), list(p)
    return stacked([*r[0:3], p[0], *r[3:6], p[1], *r[6:9], p[2], 0.0, 0.0, 0.0, corner], 4, 4)


def _halves(xi: list) -> tuple[Vec3, Vec3]:
    return Vec3(*xi[:3]), Vec3(*xi[3:])


def _vee(W: Mat3) -> Vec3:
    return 0.5 * Vec3(W[7] - W[5], W[2] - W[6], W[3] - W[1])


def _blocks(A: list, B: list) -> jax.Array:
    """Assemble the block matrix [[A, 0], [B, A]] (..., 6, 6)."""
    rows = [[*A[3 * i : 3 * i + 3], 0.0, 0.0, 0.0] for i in range(3)]
    rows += [[*B[3 * i : 3 * i + 3], *A[3 * i : 3 * i + 3]] for i in range(3)]
    return stacked([x for row in rows for x in row], 6, 6)


def _dual(J: Callable[[list], list], xi: list) -> jax.Array:
    """Compute the 6 by 6 Jacobian [[J, 0], [Q, J]] of xi = (phi, rho) from the Jacobian J of SO(3).
    Q is the derivative of J at phi along rho."""
    return _blocks(*jax.jvp(J, (xi[:3],), (xi[3:],)))
