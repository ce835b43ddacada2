"""Quaternions w, x, y, z on lanes: lists of scalars or (batch,) arrays.

They are the formulas of `quaternion`, for functions that are written on lanes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.lanes import safe_sqrt
from rbjax.rotations.coefficients import arctan_over, stumpff, where


def product(a: list, b: list) -> list:
    """Compute the lanes of the quaternion product a b.

    Args:
        a: four lanes.
        b: four lanes.

    Returns:
        Four lanes, in the product of the units.

    Example:
        >>> from rbjax.rotations.quaternion import product
        >>> product([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0])
        [0.0, 0.0, 0.0, 1.0]
    """
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

    Args:
        R: nine lanes, a rotation matrix row by row.

    Returns:
        Four lanes, w, x, y, z.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.quaternion import from_matrix_lanes
        >>> [float(x) for x in from_matrix_lanes([*jnp.eye(3).ravel()])]
        [4.0, 0.0, 0.0, 0.0]
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
    """Compute `exp` on lanes.

    Args:
        phi: three lanes, a rotation vector, rad.

    Returns:
        Four lanes, a unit quaternion.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.quaternion import exp_lanes
        >>> [round(float(x), 6) for x in exp_lanes([jnp.pi, 0.0, 0.0])]
        [0.0, 1.0, 0.0, 0.0]
    """
    px, py, pz = phi
    cosine, sine = stumpff((px * px + py * py + pz * pz) / 4, 0, 1)
    scale = sine / 2
    return [cosine, px * scale, py * scale, pz * scale]


def log_lanes(q: list) -> list:
    """Compute `log` of a quaternion of any nonzero length, on lanes.

    Args:
        q: four lanes, a quaternion of nonzero length.

    Returns:
        Three lanes, a rotation vector, rad.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.quaternion import log_lanes
        >>> [round(float(x), 6) for x in log_lanes([jnp.zeros(()), 2.0, 0.0, 0.0])]
        [3.141593, 0.0, 0.0]
    """
    w, x, y, z = q
    sign = sign_of(w)
    scale = 2 * sign * arctan_over(w * sign, x * x + y * y + z * z)
    return [x * scale, y * scale, z * scale]


def angle_lanes(w: jax.Array, u: list) -> jax.Array:
    """Compute the rotation angle, from 0 to pi, of a quaternion (w, u) of any nonzero length.

    Args:
        w: lane, the scalar part.
        u: three lanes, the vector part.

    Returns:
        Lane, rad.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.quaternion import angle_lanes
        >>> round(float(angle_lanes(jnp.zeros(()), [2.0, 0.0, 0.0])), 6)
        3.141593
    """
    square = sum(x * x for x in u)
    return 2 * safe_sqrt(square) * arctan_over(w * sign_of(w), square)


def turned(q: list, phi: list) -> list:
    """Rotate a quaternion q by phi in body axes: the lanes of the unit quaternion q exp(phi / 2).

    It is computed as q + ((1 / |q| - 1) q + q (exp(phi / 2) - 1) / |q|), which rounds once. A
    division by a rounded length would bias all components, and the bias accumulates over steps.

    Args:
        q: four lanes, a quaternion of nonzero length.
        phi: three lanes, a rotation vector in body axes, rad.

    Returns:
        Four lanes, a unit quaternion.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.quaternion import turned
        >>> [round(float(x), 6) for x in turned([1.0, 0.0, 0.0, 0.0], [jnp.pi, 0.0, 0.0])]
        [0.0, 1.0, 0.0, 0.0]
    """
    px, py, pz = phi
    square = (px * px + py * py + pz * pz) / 4
    sine, versine = stumpff(square, 1, 2)
    scale = sine / 2
    step = product(q, [-square * versine, px * scale, py * scale, pz * scale])
    length_squared = sum(a * a for a in q)
    missing = (1 - length_squared) / (jnp.sqrt(length_squared) + length_squared)  # 1 / |q| - 1
    return [a + (missing * a + (1 + missing) * b) for a, b in zip(q, step, strict=True)]


def conjugate_lanes(q: list) -> list:
    w, x, y, z = q
    return [w, -x, -y, -z]


def sign_of(w: jax.Array) -> jax.Array:
    """Return -1 if w < 0, else 1."""
    w = jnp.asarray(w)
    return where(w < 0, -jnp.ones_like(w), jnp.ones_like(w))
