"""Unit quaternions w, x, y, z (Hamilton), as arrays (..., 4).

exp and log are series near the identity, so that values and all derivatives are finite and exact
(Olguin Diaz, *3D Motion of Rigid Bodies*, 4.4; Sola, arXiv:1711.02508, eqs. 101-105). q and -q are
the same rotation. If the sign is free, w >= 0. The functions on *lanes* are in `quaternion_lanes`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike, batch_shape, random_key
from rbjax.rotations.arguments import entries, spread, stacked, takes
from rbjax.rotations.coefficients import (
    inverse_left_jacobian,
    inverse_right_jacobian,
    left_jacobian,
    right_jacobian,
)
from rbjax.rotations.quaternion_lanes import (
    angle_lanes,
    conjugate_lanes,
    exp_lanes,
    from_matrix_lanes,
    log_lanes,
    product,
    sign_of,
    turned,
)

__all__ = [
    "identity", "multiply", "conjugate", "normalize", "rotate", "to_matrix", "from_matrix",
    "exp", "log", "angle", "distance", "interpolate", "random",
    "left_jacobian", "right_jacobian", "inverse_left_jacobian", "inverse_right_jacobian",
    "product", "from_matrix_lanes", "exp_lanes", "log_lanes", "angle_lanes", "turned",
]  # fmt: skip


def identity(dtype=None) -> jax.Array:
    """Return the identity quaternion (1, 0, 0, 0).

    Args:
        dtype: of the result; None for JAX's default.

    Returns:
        (4,), no unit.

    Example:
        >>> from rbjax.rotations.quaternion import identity
        >>> identity().tolist()
        [1.0, 0.0, 0.0, 0.0]
    """
    return jnp.array([1.0, 0.0, 0.0, 0.0], dtype)


@takes(a="quaternion", b="quaternion")
def multiply(a: ArrayLike, b: ArrayLike) -> jax.Array:
    """Multiply quaternions: a b is the rotation b followed by the rotation a.

    Args:
        a: (..., 4), quaternions of nonzero length, no unit.
        b: (..., 4), quaternions of nonzero length, no unit.

    Returns:
        (..., 4), the product a b.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import multiply
        >>> multiply([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]).tolist()
        [0.0, 0.0, 0.0, 1.0]
    """
    return stacked(product(entries(a), entries(b)))


@takes(a="quaternion")
def conjugate(a: ArrayLike) -> jax.Array:
    """Return the conjugate of a quaternion, the inverse of a unit quaternion.

    Args:
        a: (..., 4), quaternions of nonzero length, no unit.

    Returns:
        (..., 4), (w, -x, -y, -z).

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import conjugate
        >>> (conjugate([0.0, 1.0, 0.0, 0.0]) + 0.0).tolist()
        [0.0, -1.0, 0.0, 0.0]
    """
    return jnp.where(jnp.arange(4) == 0, a, -a)


@takes(a="quaternion")
def normalize(a: ArrayLike) -> jax.Array:
    """Scale a quaternion to unit length: a / |a|.

    Args:
        a: (..., 4), quaternions of nonzero length, no unit.

    Returns:
        (..., 4), of unit length.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import normalize
        >>> normalize([0.0, 0.0, 3.0, 4.0]).round(6).tolist()
        [0.0, 0.0, 0.6, 0.7999999999999999]
    """
    return a / jnp.sqrt((a * a).sum(-1, keepdims=True))


@takes(a="quaternion", v="vector")
def rotate(a: ArrayLike, v: ArrayLike) -> jax.Array:
    """Rotate a vector by a unit quaternion: R(a) v = v + 2 w u x v + 2 u x (u x v).

    Args:
        a: (..., 4), unit quaternions.
        v: (..., 3), vectors in any unit.

    Returns:
        (..., 3), the rotated vectors, in the unit of v.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import rotate
        >>> rotate([1.0, 0.0, 0.0, 0.0], [1.0, 2.0, 3.0]).tolist()
        [1.0, 2.0, 3.0]
    """
    (w, x, y, z), (a1, a2, a3) = entries(a), entries(v)
    t1, t2, t3 = 2 * (y * a3 - z * a2), 2 * (z * a1 - x * a3), 2 * (x * a2 - y * a1)
    return stacked(
        [
            a1 + w * t1 + (y * t3 - z * t2),
            a2 + w * t2 + (z * t1 - x * t3),
            a3 + w * t3 + (x * t2 - y * t1),
        ]
    )


@takes(a="quaternion")
def to_matrix(a: ArrayLike) -> jax.Array:
    """Compute the rotation matrix (..., 3, 3) of a quaternion (..., 4) of any nonzero length.

    It is 1 + s [u](w + [u]) with s = 2 / |a|^2, computed in one pass over memory.

    Args:
        a: (..., 4), quaternions of nonzero length, no unit.

    Returns:
        (..., 3, 3), rotation matrices, no unit.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import to_matrix
        >>> to_matrix([0.0, 0.0, 0.0, 2.0]).tolist()
        [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    w, x, y, z = entries(a)
    turn = stacked([
        y * y + z * z, x * y - w * z, x * z + w * y,
        x * y + w * z, x * x + z * z, y * z - w * x,
        x * z - w * y, y * z + w * x, x * x + y * y,
    ], 3, 3)  # fmt: skip
    s = 2 / spread(w * w + x * x + y * y + z * z, 3, 3)
    return jnp.where(jnp.eye(3, dtype=bool), 1 - s * turn, s * turn)


@takes(R="rotation")
def from_matrix(R: ArrayLike) -> jax.Array:
    """Compute the unit quaternion with w >= 0 of a rotation matrix (..., 3, 3).

    Args:
        R: (..., 3, 3), rotation matrices, no unit.

    Returns:
        (..., 4), of unit length.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> from rbjax.rotations.quaternion import from_matrix
        >>> from_matrix([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]).tolist()
        [0.0, 1.0, 0.0, 0.0]
    """
    q = from_matrix_lanes(entries(R, 2))
    shrink = sign_of(q[0]) / jnp.sqrt(sum(a * a for a in q))
    return stacked([a * shrink for a in q])


@takes(phi="vector")
def exp(phi: ArrayLike) -> jax.Array:
    """Compute the quaternion [cos(|phi|/2), phi sin(|phi|/2)/|phi|] of a rotation vector.

    Args:
        phi: (..., 3), rotation vectors, rad.

    Returns:
        (..., 4), of unit length.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.quaternion import exp
        >>> exp([jnp.pi, 0.0, 0.0]).round(6).tolist()
        [0.0, 1.0, 0.0, 0.0]
    """
    return stacked(exp_lanes(entries(phi)))


@takes(a="quaternion")
def log(a: ArrayLike) -> jax.Array:
    """Compute the rotation vector phi (..., 3), |phi| <= pi, of a quaternion of nonzero length.

    phi = 2 atan2(|u|, |w|) u / |u| sign(w). The angle pi is a genuine singularity: one of two
    vectors is returned, and the derivative belongs to its branch.

    Args:
        a: (..., 4), quaternions of nonzero length, no unit.

    Returns:
        (..., 3), rotation vectors, rad.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import log
        >>> log([0.0, 0.0, 1.0, 0.0]).tolist()
        [0.0, 3.141592653589793, 0.0]
    """
    return stacked(log_lanes(entries(a)))


@takes(a="quaternion")
def angle(a: ArrayLike) -> jax.Array:
    """Compute the rotation angle (...), from 0 to pi, of a quaternion of any nonzero length.

    Args:
        a: (..., 4), quaternions of nonzero length, no unit.

    Returns:
        (...), rad.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import angle
        >>> float(angle([0.0, 0.0, 2.0, 0.0]))
        3.141592653589793
    """
    w, *u = entries(a)
    return angle_lanes(w, u)


@takes(a="quaternion", b="quaternion")
def distance(a: ArrayLike, b: ArrayLike) -> jax.Array:
    """Compute the angle (...), from 0 to pi, of the rotation from a to b.

    Args:
        a: (..., 4), quaternions of nonzero length, no unit.
        b: (..., 4), quaternions of nonzero length, no unit.

    Returns:
        (...), rad.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import distance
        >>> float(distance([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]))
        3.141592653589793
    """
    w, *u = product(conjugate_lanes(entries(a)), entries(b))
    return angle_lanes(w, u)


@takes(a="quaternion", b="quaternion", s="scalar")
def interpolate(a: ArrayLike, b: ArrayLike, s: ArrayLike) -> jax.Array:
    """Interpolate by slerp, a exp(s log(a^-1 b)), on the shorter path from a (s = 0) to b (s = 1).

    At s = 1 the result is b or -b.

    Args:
        a: (..., 4), quaternions of nonzero length, no unit.
        b: (..., 4), quaternions of nonzero length, no unit.
        s: (...), from 0 to 1.

    Returns:
        (..., 4), of the length of a.

    Raises:
        InputError: another shape, values that are not finite, or a quaternion of length zero.

    Example:
        >>> from rbjax.rotations.quaternion import interpolate
        >>> interpolate([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], 0.5).round(3).tolist()
        [0.707, 0.0, 0.0, 0.707]
    """
    p = entries(a)
    turn = log_lanes(product(conjugate_lanes(p), entries(b)))
    return stacked(product(p, exp_lanes([s * x for x in turn])))


def random(key: jax.Array, shape: tuple[int, ...] = (), dtype=None) -> jax.Array:
    """Draw unit quaternions (*shape, 4) uniformly over all rotations.

    Args:
        key: a key of `jax.random`.
        shape: leading axes of the result.
        dtype: of the result; None for JAX's default.

    Returns:
        (*shape, 4), unit quaternions.

    Example:
        >>> import jax
        >>> from rbjax.rotations.quaternion import random
        >>> random(jax.random.key(0), (5,)).shape
        (5, 4)
    """
    random_key("quaternion.random", key)
    shape = batch_shape("quaternion.random", shape)
    return normalize(jax.random.normal(key, (*shape, 4), dtype or jnp.result_type(float)))
