"""Unit quaternions w, x, y, z (Hamilton), as arrays (..., 4).

exp and log are series near the identity, so that values and all derivatives are finite and exact
(Olguin Diaz, *3D Motion of Rigid Bodies*, 3.4; Sola, arXiv:1711.02508, eqs. 101-105). q and -q are
the same rotation. If the sign is free, w >= 0. The arguments and results of functions on *lanes*
are lists of scalars or (batch,) arrays.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.lanes import safe_sqrt
from rbjax.rotations.arguments import entries, spread, stacked, takes
from rbjax.rotations.coefficients import (
    arctan_over,
    inverse_left_jacobian,
    inverse_right_jacobian,
    left_jacobian,
    right_jacobian,
    stumpff,
    where,
)

__all__ = [
    "identity", "multiply", "conjugate", "normalize", "rotate", "to_matrix", "from_matrix",
    "exp", "log", "angle", "distance", "interpolate", "random",
    "left_jacobian", "right_jacobian", "inverse_left_jacobian", "inverse_right_jacobian",
    "product", "from_matrix_lanes", "exp_lanes", "log_lanes", "angle_lanes", "turned",
]  # fmt: skip


def identity(dtype=None) -> jax.Array:
    """Return the identity quaternion (1, 0, 0, 0)."""
    return jnp.array([1.0, 0.0, 0.0, 0.0], dtype)


@takes(a="quaternion", b="quaternion")
def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Multiply quaternions: a b is the rotation b followed by the rotation a."""
    return stacked(product(entries(a), entries(b)))


@takes(a="quaternion")
def conjugate(a: jax.Array) -> jax.Array:
    """Return the conjugate of a quaternion, the inverse of a unit quaternion."""
    return jnp.where(jnp.arange(4) == 0, a, -a)


@takes(a="quaternion")
def normalize(a: jax.Array) -> jax.Array:
    """Scale a quaternion to unit length: a / |a|."""
    return a / jnp.sqrt((a * a).sum(-1, keepdims=True))


@takes(a="quaternion", v="vector")
def rotate(a: jax.Array, v: jax.Array) -> jax.Array:
    """Rotate a vector by a unit quaternion: R(a) v = v + 2 w u x v + 2 u x (u x v).

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
def to_matrix(a: jax.Array) -> jax.Array:
    """Compute the rotation matrix (..., 3, 3) of a quaternion (..., 4) of any nonzero length.

    It is 1 + s [u](w + [u]) with s = 2 / |a|^2, computed in one pass over memory.
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
def from_matrix(R: jax.Array) -> jax.Array:
    """Compute the unit quaternion with w >= 0 of a rotation matrix (..., 3, 3).

    >>> from_matrix([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]).tolist()
    [0.0, 1.0, 0.0, 0.0]
    """
    q = from_matrix_lanes(entries(R, 2))
    shrink = _sign(q[0]) / jnp.sqrt(sum(a * a for a in q))
    return stacked([a * shrink for a in q])


@takes(phi="vector")
def exp(phi: jax.Array) -> jax.Array:
    """Compute the quaternion [cos(|phi|/2), phi sin(|phi|/2)/|phi|] of a rotation vector."""
    return stacked(exp_lanes(entries(phi)))


@takes(a="quaternion")
def log(a: jax.Array) -> jax.Array:
    """Compute the rotation vector phi (..., 3), |phi| <= pi, of a quaternion of nonzero length.

    phi = 2 atan2(|u|, |w|) u / |u| sign(w). The angle pi is a genuine singularity: one of two
    vectors is returned, and the derivative belongs to its branch.
    """
    return stacked(log_lanes(entries(a)))


@takes(a="quaternion")
def angle(a: jax.Array) -> jax.Array:
    """Compute the rotation angle (...), from 0 to pi, of a quaternion of any nonzero length.

    >>> float(angle([0.0, 0.0, 2.0, 0.0]))
    3.14159...
    """
    w, *u = entries(a)
    return angle_lanes(w, u)


@takes(a="quaternion", b="quaternion")
def distance(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute the angle (...), from 0 to pi, of the rotation from a to b.

    >>> float(distance([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]))
    3.14159...
    """
    w, *u = product(_conjugate(entries(a)), entries(b))
    return angle_lanes(w, u)


@takes(a="quaternion", b="quaternion", s="scalar")
def interpolate(a: jax.Array, b: jax.Array, s: jax.Array) -> jax.Array:
    """Interpolate by slerp, a exp(s log(a^-1 b)), on the shorter path from a (s = 0) to b (s = 1).

    At s = 1 the result is b or -b.

    >>> interpolate([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], 0.5).round(3).tolist()
    [0.707, 0.0, 0.0, 0.707]
    """
    p = entries(a)
    turn = log_lanes(product(_conjugate(p), entries(b)))
    return stacked(product(p, exp_lanes([s * x for x in turn])))


def random(key: jax.Array, shape: tuple[int, ...] = (), dtype=None) -> jax.Array:
    """Draw unit quaternions (*shape, 4) uniformly over all rotations.

    >>> random(jax.random.key(0), (5,)).shape
    (5, 4)
    """
    return normalize(jax.random.normal(key, (*shape, 4), dtype or jnp.result_type(float)))


# ----------------------------------------------------------------------------------- on lanes


def product(a: list, b: list) -> list:
    """Compute the lanes of the quaternion product a b."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]


def from_matrix_lanes(R: list) -> list:
    """Compute a quaternion, of length from 2 to 4 and either sign, of a matrix given row by row.

    It is 4 q_k (w, x, y, z) for the largest component q_k (Shepperd, 1978), without cancellation.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R
    a, b, c = zy - yz, xz - zx, yx - xy
    d, e, f = xy + yx, xz + zx, yz + zy
    rows = [
        [1 + (xx + yy + zz), a, b, c],
        [a, 1 + (xx - yy - zz), d, e],
        [b, d, 1 + (yy - xx - zz), f],
        [c, e, f, 1 + (zz - xx - yy)],
    ]
    best, largest = rows[0], rows[0][0]
    for k in (1, 2, 3):
        larger = rows[k][k] > largest
        best = [where(larger, new, old) for new, old in zip(rows[k], best, strict=True)]
        largest = where(larger, rows[k][k], largest)
    return best


def exp_lanes(phi: list) -> list:
    """Compute `exp` on lanes."""
    px, py, pz = phi
    cosine, sine = stumpff((px * px + py * py + pz * pz) / 4, 0, 1)
    scale = sine / 2
    return [cosine, px * scale, py * scale, pz * scale]


def log_lanes(q: list) -> list:
    """Compute `log` of a quaternion of any nonzero length, on lanes."""
    w, x, y, z = q
    sign = _sign(w)
    scale = 2 * sign * arctan_over(w * sign, x * x + y * y + z * z)
    return [x * scale, y * scale, z * scale]


def angle_lanes(w: jax.Array, u: list) -> jax.Array:
    """Compute the rotation angle, from 0 to pi, of a quaternion (w, u) of any nonzero length."""
    square = sum(x * x for x in u)
    return 2 * safe_sqrt(square) * arctan_over(w * _sign(w), square)


def turned(q: list, phi: list) -> list:
    """Rotate a quaternion q by phi in body axes: the lanes of the unit quaternion q exp(phi / 2).

    It is computed as q + ((1 / |q| - 1) q + q (exp(phi / 2) - 1) / |q|), which rounds once. A
    division by a rounded length would bias all components, and the bias accumulates over steps.
    """
    px, py, pz = phi
    square = (px * px + py * py + pz * pz) / 4
    sine, versine = stumpff(square, 1, 2)
    scale = sine / 2
    step = product(q, [-square * versine, px * scale, py * scale, pz * scale])
    length_squared = sum(a * a for a in q)
    missing = (1 - length_squared) / (jnp.sqrt(length_squared) + length_squared)  # 1 / |q| - 1
    return [a + (missing * a + (1 + missing) * b) for a, b in zip(q, step, strict=True)]


def _conjugate(q: list) -> list:
    w, x, y, z = q
    return [w, -x, -y, -z]


def _sign(w: jax.Array) -> jax.Array:
    """Return -1 if w < 0, else 1."""
    w = jnp.asarray(w)
    return where(w < 0, -jnp.ones_like(w), jnp.ones_like(w))
