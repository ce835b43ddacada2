"""Unit quaternions w, x, y, z as operations on whole arrays.

The functions of `rbjax.rotations.quaternion` work on lanes, which makes the second derivatives that
Newton's method needs here slow to compile. These have fewer and larger operations.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.rotations.coefficients import arctan_over

#: product: (a b)_k = a_i PRODUCT[i, j, k] b_j
_PRODUCT = np.zeros((4, 4, 4))
for _i, _j, _k, _sign in (
    (0, 0, 0, 1), (1, 1, 0, -1), (2, 2, 0, -1), (3, 3, 0, -1),
    (0, 1, 1, 1), (1, 0, 1, 1), (2, 3, 1, 1), (3, 2, 1, -1),
    (0, 2, 2, 1), (2, 0, 2, 1), (3, 1, 2, 1), (1, 3, 2, -1),
    (0, 3, 3, 1), (3, 0, 3, 1), (1, 2, 3, 1), (2, 1, 3, -1),
):  # fmt: skip
    _PRODUCT[_i, _j, _k] = _sign
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Multiply quaternions (..., 4): the rotation b followed by the rotation a."""
    return ((a[..., :, None] * b[..., None, :])[..., None] * _PRODUCT).sum((-3, -2))


def conjugate(a: jax.Array) -> jax.Array:
    """Return the inverse of a unit quaternion (..., 4)."""
    return a * _CONJUGATE


def normalize(a: jax.Array) -> jax.Array:
    """Scale quaternions (..., 4) to unit length."""
    return a * jax.lax.rsqrt((a * a).sum(-1, keepdims=True))


def rotate(a: jax.Array, v: jax.Array) -> jax.Array:
    """Rotate vectors (..., 3) by unit quaternions (..., 4)."""
    w, u = a[..., :1], a[..., 1:]
    return v + 2 * cross(u, cross(u, v) + w * v)


def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the cross product of vectors (..., 3)."""
    return ((a[..., :, None] * b[..., None, :])[..., None] * _PRODUCT[1:, 1:, 1:]).sum((-3, -2))


def exp(phi: jax.Array) -> jax.Array:
    """Return the quaternion (..., 4) of a rotation vector (..., 3)."""
    x = (phi * phi).sum(-1, keepdims=True) / 4
    small = x < 1e-2
    half = jnp.sqrt(jnp.where(small, 1.0, x))
    near = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))))
    ratio = jnp.where(small, near, jnp.sin(half) / half)
    near = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))))
    return jnp.concatenate([jnp.where(small, near, jnp.cos(half)), phi * ratio / 2], -1)


def log(a: jax.Array) -> jax.Array:
    """Return the rotation vector (..., 3), at most pi long, of a unit quaternion (..., 4)."""
    a = jnp.where(a[..., :1] < 0, -a, a)
    u = a[..., 1:]
    return 2 * u * arctan_over(a[..., :1], (u * u).sum(-1, keepdims=True))


def from_gibbs(g: jax.Array) -> jax.Array:
    """Return the quaternion (..., 4) of a Gibbs-Rodrigues vector 2 tan(angle/2) axis, (..., 3)."""
    return normalize(jnp.concatenate([jnp.ones_like(g[..., :1]), g / 2], -1))


def to_gibbs(a: jax.Array) -> jax.Array:
    """Return the Gibbs-Rodrigues vector (..., 3) of a quaternion (..., 4), w not zero."""
    return 2 * a[..., 1:] / a[..., :1]
