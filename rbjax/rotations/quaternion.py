"""Unit quaternions w, x, y, z (Hamilton), as arrays (..., 4).

exp and log are series near the identity, so that values and all derivatives stay finite and exact
there (Olguin Diaz, *3D Motion of Rigid Bodies*, 3.4; Sola, arXiv:1711.02508, eqs. 101-105).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.lanes import quaternion_matrix


def identity(dtype=None) -> jax.Array:
    """The quaternion of no rotation."""
    return jnp.array([1.0, 0.0, 0.0, 0.0], dtype)


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """The rotation b followed by a, in a's axes: a b."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def conjugate(a: jax.Array) -> jax.Array:
    """The inverse of a unit quaternion."""
    return a * jnp.array([1.0, -1.0, -1.0, -1.0], a.dtype)


def normalize(a: jax.Array) -> jax.Array:
    """a / |a|."""
    return a / jnp.sqrt((a * a).sum(-1, keepdims=True))


def to_matrix(a: jax.Array) -> jax.Array:
    """Rotation matrix (..., 3, 3) of quaternions (..., 4) of any nonzero length."""
    R = quaternion_matrix(*jnp.moveaxis(a, -1, 0))
    return jnp.stack(list(R), -1).reshape(*a.shape[:-1], 3, 3)


def exp(phi: jax.Array) -> jax.Array:
    """The quaternion [cos(|phi|/2), phi sin(|phi|/2)/|phi|] of a rotation vector (..., 3)."""
    half_squared = (phi * phi).sum(-1, keepdims=True) / 4
    return jnp.concatenate([_cos_sqrt(half_squared), phi * (_sinc_sqrt(half_squared) / 2)], -1)


def log(a: jax.Array) -> jax.Array:
    """The rotation vector (..., 3) of a unit quaternion, of length at most pi.

    phi = 2 atan2(|u|, |w|) u / |u| sign(w). The angle pi is a genuine singularity: one of the two
    vectors is returned, and the derivative is that of its branch.
    """
    w, u = a[..., :1], a[..., 1:]
    return u * _log_scale(w, (u * u).sum(-1, keepdims=True))


def log_lanes(q: list) -> list:
    """`log` of a quaternion of any nonzero length, on lanes."""
    shrink = jax.lax.rsqrt(sum(a * a for a in q))
    w, x, y, z = (a * shrink for a in q)
    scale = _log_scale(w, x * x + y * y + z * z)
    return [x * scale, y * scale, z * scale]


def _log_scale(w: jax.Array, square: jax.Array) -> jax.Array:
    """phi / u, from w and |u|^2."""
    sign = _where(w < 0, -jnp.ones_like(w), jnp.ones_like(w))
    w = w * sign
    small = square < (1e-4 if w.dtype == jnp.float64 else 1e-2)
    safe = _where(small, 1.0, square)
    n = jnp.sqrt(safe)
    far = 2 * jnp.arctan2(n, _where(small, 1.0, w)) / n
    one = _where(small, w, 1.0)  # no division by the zero w of half a turn, in gradients either
    x = _where(small, square, 0.0) / (one * one)  # tan^2 of half the angle
    series = 1 + x * (-1 / 3 + x * (1 / 5 + x * (-1 / 7 + x * (1 / 9 - x * (1 / 11 - x / 13)))))
    near = 2 * series / one
    return sign * _where(small, near, far)


def _cos_sqrt(x: jax.Array) -> jax.Array:
    """cos(sqrt(x)), entire in x."""
    small = x < 0.05
    series = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90 * (1 - x / 132)))))
    return _where(small, series, jnp.cos(jnp.sqrt(_where(small, 1.0, x))))


def _sinc_sqrt(x: jax.Array) -> jax.Array:
    """sin(sqrt(x)) / sqrt(x), entire in x."""
    small = x < 0.05
    root = jnp.sqrt(_where(small, 1.0, x))
    series = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110 * (1 - x / 156)))))
    return _where(small, series, jnp.sin(root) / root)


def turned(q: list, phi: list) -> list:
    """Lanes of q exp(phi / 2), of unit length: the rotation q followed by phi in body axes."""
    px, py, pz = phi
    half_squared = (px * px + py * py + pz * pz) / 4
    ew, scale = _cos_sqrt(half_squared), _sinc_sqrt(half_squared) / 2
    ex, ey, ez = px * scale, py * scale, pz * scale
    w, x, y, z = q
    out = [
        w * ew - x * ex - y * ey - z * ez,
        w * ex + x * ew + y * ez - z * ey,
        w * ey - x * ez + y * ew + z * ex,
        w * ez + x * ey - y * ex + z * ew,
    ]
    shrink = jax.lax.rsqrt(sum(a * a for a in out))
    return [a * shrink for a in out]


def _where(condition: jax.Array, a, b) -> jax.Array:
    """`jnp.where`, less its nested jit: that, transposed inside a kernel, Triton cannot lower."""
    like = a if isinstance(a, jax.Array) else b
    shape = condition.shape
    a, b = (jnp.broadcast_to(jnp.asarray(x, like.dtype), shape) for x in (a, b))
    return jax.lax.select(condition, a, b)
