"""SO(3), the group of rotation matrices, and so(3), its algebra of skew-symmetric matrices.

R = exp([phi]) rotates by |phi| about phi. R_AB maps B-coordinates to A-coordinates. exp and log use
the unit quaternion (Shepperd's method), which keeps the digits that the trace of R loses at the
angle pi (Olguin Diaz, 3.2.4; Sola, arXiv:1812.01537, app. B).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, batch_shape, random_key
from rbjax.errors import InputError
from rbjax.lanes import Mat3, matmat, quaternion_matrix
from rbjax.rotations import quaternion
from rbjax.rotations.arguments import entries, stacked, takes
from rbjax.rotations.coefficients import (
    away_from_zero,
    inverse_left_jacobian,
    inverse_right_jacobian,
    left_jacobian,
    right_jacobian,
)

__all__ = [
    "identity", "hat", "vee", "exp", "log", "compose", "inverse", "distance", "interpolate",
    "left_jacobian", "right_jacobian", "inverse_left_jacobian", "inverse_right_jacobian",
    "project", "projection_margin", "random",
]  # fmt: skip


def identity(dtype=None) -> jax.Array:
    """Return the identity matrix (3, 3).

    Args:
        dtype: of the result; None for JAX's default.

    Returns:
        (3, 3), no unit.

    Example:
        >>> from rbjax.rotations.so3 import identity
        >>> identity().tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return jnp.eye(3, dtype=dtype)


@takes(phi="vector")
def hat(phi: ArrayLike) -> jax.Array:
    """Return the skew-symmetric matrix [phi] (..., 3, 3), with [phi] a = phi x a.

    Args:
        phi: (..., 3), rotation vectors, rad.

    Returns:
        (..., 3, 3), skew-symmetric, in the unit of phi.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.so3 import hat
        >>> hat([1.0, 2.0, 3.0]).tolist()
        [[0.0, -3.0, 2.0], [3.0, 0.0, -1.0], [-2.0, 1.0, 0.0]]
    """
    x, y, z = entries(phi)
    o = jnp.zeros_like(x)
    return stacked([o, -z, y, z, o, -x, -y, x, o], 3, 3)


@takes(W="matrix")
def vee(W: ArrayLike) -> jax.Array:
    """Return the vector phi (..., 3) of the skew-symmetric part [phi] of a matrix.

    Args:
        W: (..., 3, 3), any matrices.

    Returns:
        (..., 3), in the unit of W.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.so3 import hat, vee
        >>> vee(hat([1.0, 2.0, 3.0])).tolist()
        [1.0, 2.0, 3.0]
    """
    _, xy, xz, yx, _, yz, zx, zy, _ = entries(W, 2)
    return stacked([(zy - yz) / 2, (xz - zx) / 2, (yx - xy) / 2])


@takes(phi="vector")
def exp(phi: ArrayLike) -> jax.Array:
    """Compute the rotation matrix (..., 3, 3) of the rotation by |phi| about phi (..., 3).

    Args:
        phi: (..., 3), rotation vectors, rad.

    Returns:
        (..., 3, 3), rotation matrices, no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.so3 import exp
        >>> exp([0.0, 0.0, jnp.pi / 2]).round(6).tolist()
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return stacked(quaternion_matrix(*quaternion.exp_lanes(entries(phi))), 3, 3)


@takes(R="rotation")
def log(R: ArrayLike) -> jax.Array:
    """Compute the rotation vector phi (..., 3) with exp(phi) = R and |phi| <= pi.

    The angle pi is a genuine singularity: one of two vectors is returned, and the derivative
    belongs to its branch.

    Args:
        R: (..., 3, 3), rotation matrices, no unit.

    Returns:
        (..., 3), rad.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> from rbjax.rotations.so3 import log
        >>> log([[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]).tolist()
        [0.0, 3.141592653589793, 0.0]
    """
    return stacked(quaternion.log_lanes(quaternion.from_matrix_lanes(entries(R, 2))))


@takes(A="rotation", B="rotation")
def compose(A: ArrayLike, B: ArrayLike) -> jax.Array:
    """Multiply rotation matrices: A B is the rotation B followed by the rotation A.

    Args:
        A: (..., 3, 3), rotation matrices, no unit.
        B: (..., 3, 3), rotation matrices, no unit.

    Returns:
        (..., 3, 3), the product A B.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> from rbjax.rotations.so3 import compose, exp
        >>> (compose(exp([0.0, 0.0, 1.0]), exp([0.0, 0.0, -1.0])).round(6) + 0.0).tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return stacked(Mat3(*entries(A, 2)) @ Mat3(*entries(B, 2)), 3, 3)


@takes(R="rotation")
def inverse(R: ArrayLike) -> jax.Array:
    """Return the inverse rotation R^T.

    Args:
        R: (..., 3, 3), rotation matrices, no unit.

    Returns:
        (..., 3, 3), R^T.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> from rbjax.rotations.so3 import exp, inverse, log
        >>> R = exp([0.1, 0.2, 0.3])
        >>> log(inverse(R)).round(6).tolist()
        [-0.09999999999999999, -0.19999999999999998, -0.3]
    """
    return jnp.swapaxes(R, -1, -2)


@takes(A="rotation", B="rotation")
def distance(A: ArrayLike, B: ArrayLike) -> jax.Array:
    """Compute the angle (...), from 0 to pi, of the rotation from A to B.

    Args:
        A: (..., 3, 3), rotation matrices, no unit.
        B: (..., 3, 3), rotation matrices, no unit.

    Returns:
        (...), rad.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> from rbjax.rotations.so3 import distance, exp
        >>> float(distance(exp([0.0, 0.0, 0.1]), exp([0.0, 0.0, 1.1])).round(6))
        1.0
    """
    return quaternion.distance(quaternion.from_matrix(A), quaternion.from_matrix(B))


@takes(A="rotation", B="rotation", s="scalar")
def interpolate(A: ArrayLike, B: ArrayLike, s: ArrayLike) -> jax.Array:
    """Interpolate along the geodesic A exp(s log(A^T B)) from A (s = 0) to B (s = 1).

    Args:
        A: (..., 3, 3), rotation matrices, no unit.
        B: (..., 3, 3), rotation matrices, no unit.
        s: (...), from 0 to 1.

    Returns:
        (..., 3, 3), rotation matrices.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> from rbjax.rotations.so3 import exp, interpolate, log
        >>> log(interpolate(exp([0.0, 0.0, 0.1]), exp([0.0, 0.0, 1.1]), 0.5)).round(6).tolist()
        [0.0, 0.0, 0.6]
    """
    a, b = Mat3(*entries(A, 2)), Mat3(*entries(B, 2))
    turn = quaternion.log_lanes(quaternion.from_matrix_lanes(list(a.T @ b)))
    step = quaternion_matrix(*quaternion.exp_lanes([s * x for x in turn]))
    return stacked(a @ step, 3, 3)


def random(key: jax.Array, shape: tuple[int, ...] = (), dtype=None) -> jax.Array:
    """Draw rotation matrices (*shape, 3, 3) uniformly over SO(3) (Haar measure).

    Args:
        key: a key of `jax.random`.
        shape: leading axes of the result.
        dtype: of the result; None for JAX's default.

    Returns:
        (*shape, 3, 3), rotation matrices, no unit.

    Example:
        >>> import jax
        >>> from rbjax.rotations.so3 import random
        >>> random(jax.random.key(0), (5,)).shape
        (5, 3, 3)
    """
    random_key("so3.random", key)
    shape = batch_shape("so3.random", shape)
    return quaternion.to_matrix(quaternion.random(key, shape, dtype))


def project(M: ArrayLike) -> jax.Array:
    """Compute the rotation nearest to M in the Frobenius norm (orthogonal Procrustes, polar).

    It is not unique if `projection_margin` is 0. If M is not traced, this raises `InputError`. If M
    is traced, one of the nearest rotations is returned, with finite derivatives.

    Args:
        M: (..., 3, 3), any matrices.

    Returns:
        (..., 3, 3), the nearest rotation matrices, no unit.

    Raises:
        InputError: another shape, values that are not finite, or a nearest rotation that is not
            unique.

    Example:
        >>> from rbjax.rotations.so3 import project
        >>> project([[2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 1.0]]).round(6).tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    margin = projection_margin(M)
    if not isinstance(margin, jax.core.Tracer):
        least = float(np.min(margin, initial=1.0))
        if least < 8 * float(jnp.finfo(margin.dtype).eps):
            raise InputError(
                f"project: the rotation nearest to M is not unique (projection_margin {least:.2g}),"
                f" expected a matrix of rank 2 at least, and not a reflection with equal stretches"
            )
    return _project(M)


@takes(M="matrix")
def projection_margin(M: ArrayLike) -> jax.Array:
    """Compute the margin (s_2 + s_3 sign(det M)) / s_1 from the singular values s_k of M.

    It is 2 for a rotation, and 0 if the nearest rotation is not unique (rank 1, or a reflection).

    Args:
        M: (..., 3, 3), any matrices.

    Returns:
        (...), from 0 to 2, no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.so3 import projection_margin
        >>> float(projection_margin(jnp.diag(jnp.array([1.0, 1.0, -1.0]))))
        0.0
    """
    U, s, Vt = jnp.linalg.svd(M)
    sign = jnp.where(_determinant(U) * _determinant(Vt) < 0, -1.0, 1.0)
    return (s[..., 1] + sign * s[..., 2]) / away_from_zero(s[..., 0])


@takes(M="matrix")
def _project(M: jax.Array) -> jax.Array:
    return _polar(M)


@jax.custom_jvp
def _polar(M: jax.Array) -> jax.Array:
    U, _, Vt = jnp.linalg.svd(M)
    sign = jnp.where(_determinant(U) * _determinant(Vt) < 0, -1.0, 1.0).astype(M.dtype)
    last = U[..., :, 2:] * Vt[..., 2:, :] * sign[..., None, None]
    return matmat(U[..., :, :2], Vt[..., :2, :]) + last


@_polar.defjvp
def _polar_jvp(primals, tangents):
    """Compute dR = R [w] from (tr(S) 1 - S) w = vee(R^T dM - dM^T R), with S = R^T M symmetric.

    The derivative of the SVD would divide by differences of singular values, which are equal for
    every rotation.
    """
    (M,), (dM,) = primals, tangents
    R = _polar(M)
    r = Mat3(*entries(R, 2)).T
    S, D = r @ Mat3(*entries(M, 2)), list(r @ Mat3(*entries(dM, 2)))
    xx, yy, zz = S[0], S[4], S[8]
    xy, xz, yz = (S[1] + S[3]) / 2, (S[2] + S[6]) / 2, (S[5] + S[7]) / 2
    a, b, c, d, e, f = yy + zz, xx + zz, xx + yy, -xy, -xz, -yz  # tr(S) 1 - S
    A, B, C = b * c - f * f, a * c - e * e, a * b - d * d  # and its adjugate
    Dd, E, F = e * f - d * c, d * f - b * e, d * e - a * f
    scale = 1 / away_from_zero(a * A + d * Dd + e * E)
    u, v, w = D[7] - D[5], D[2] - D[6], D[3] - D[1]
    turn = stacked(
        [
            (A * u + Dd * v + E * w) * scale,
            (Dd * u + B * v + F * w) * scale,
            (E * u + F * v + C * w) * scale,
        ]
    )
    return R, matmat(R, hat(turn))


def _determinant(M: jax.Array) -> jax.Array:
    a, b, c = Mat3(*entries(M, 2)).rows
    return a.dot(b.cross(c))
