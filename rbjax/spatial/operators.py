"""The cross-product operator [a], [a] b = a x b, and identities of its products.

(Olguin Diaz, *3D Motion of Rigid Bodies*, appendix A.) Each function computes the right-hand side
of an identity.

    [a]^T = -[a],  [a] b = -[b] a,  [a] a = 0            (`so3.hat`)
    [a][b]           = b a^T - (a . b) 1                 `double_cross`
    [a x b]          = b a^T - a b^T = [a][b] - [b][a]   `cross_of_cross`
    [a][b][a]        = -(a . b) [a]                      `triple_cross`
    [a]^n            = -|a|^2 [a]^(n-2)                  `cross_power`
    [R a]            = R [a] R^T                         `rotated_cross`
    M^T [M a] M      = det(M) [a]                        `congruent_cross`
    [a] M + M^T [a]  = [(tr(M) 1 - M) a]                 `cross_sum`
    n n^T, -[n]^2    = 1 - n n^T   of a unit n           `along`, `across`

The extended operators, 6 by 6, are in `plucker`; their rates along a motion with body twist V:

    d/dt X_AB = X_AB (V x),   d/dt X*_AB = X*_AB (V x*)   `motion_transform_rate`, `force_...`
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.lanes import Mat3, Vec3, matmat, outer
from rbjax.rotations import so3
from rbjax.rotations.arguments import entries, stacked, takes
from rbjax.spatial.plucker import (
    force_cross_matrix,
    force_transform,
    motion_cross_matrix,
    motion_transform,
)


@takes(a="vector", b="vector")
def double_cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute [a][b] = b a^T - (a . b) 1 (..., 3, 3).

    >>> double_cross([0.0, 0.0, 1.0], [0.0, 0.0, 1.0]).diagonal().tolist()
    [-1.0, -1.0, 0.0]
    """
    dot = (a * b).sum(-1)[..., None, None]
    return outer(b, a) - dot * jnp.eye(3, dtype=a.dtype)


@takes(a="vector", b="vector")
def cross_of_cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute [a x b] = b a^T - a b^T (..., 3, 3), the commutator of [a] and [b].

    >>> cross_of_cross([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])[0].tolist()
    [0.0, -1.0, 0.0]
    """
    return outer(b, a) - outer(a, b)


@takes(a="vector", b="vector")
def triple_cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Compute [a][b][a] = -(a . b) [a] (..., 3, 3)."""
    return -(a * b).sum(-1)[..., None, None] * so3.hat(a)


@takes(["n"], a="vector")
def cross_power(a: jax.Array, n: int) -> jax.Array:
    """Compute the power [a]^n (..., 3, 3), n >= 1: (-|a|^2)^k [a] or (-|a|^2)^k [a]^2.

    >>> cross_power([0.0, 0.0, 2.0], 3)[0, 1].item()
    8.0
    """
    k, odd = divmod(n - 1, 2)
    scale = (-(a * a).sum(-1)) ** k
    return scale[..., None, None] * (double_cross(a, a) if odd else so3.hat(a))


@takes(R="rotation", a="vector")
def rotated_cross(R: jax.Array, a: jax.Array) -> jax.Array:
    """Compute R [a] R^T = [R a] (..., 3, 3)."""
    return so3.hat((R * a[..., None, :]).sum(-1))


@takes(M="matrix", a="vector")
def congruent_cross(M: jax.Array, a: jax.Array) -> jax.Array:
    """Compute M^T [M a] M = det(M) [a] (..., 3, 3) for any matrix M."""
    x, y, z = Mat3(*entries(M, 2)).rows
    return x.dot(y.cross(z))[..., None, None] * so3.hat(a)


@takes(M="matrix", a="vector")
def cross_sum(M: jax.Array, a: jax.Array) -> jax.Array:
    """Compute [a] M + M^T [a] = [(tr(M) 1 - M) a] (..., 3, 3) for any matrix M."""
    trace = jnp.trace(M, axis1=-2, axis2=-1)[..., None]
    return so3.hat(trace * a - (M * a[..., None, :]).sum(-1))


@takes(n="vector")
def along(n: jax.Array) -> jax.Array:
    """Compute n n^T / |n|^2 (..., 3, 3), the projection onto the direction of n."""
    return outer(n, n) / (n * n).sum(-1)[..., None, None]


@takes(n="vector")
def across(n: jax.Array) -> jax.Array:
    """Compute -[n]^2 / |n|^2 (..., 3, 3), the projection onto the plane orthogonal to n.

    >>> across([0.0, 0.0, 2.0]).trace().item()
    2.0
    """
    return -double_cross(n, n) / (n * n).sum(-1)[..., None, None]


@takes(a="vector", b="vector", c="vector")
def triple_product(a: jax.Array, b: jax.Array, c: jax.Array) -> jax.Array:
    """Compute the triple product a . (b x c) (...), the signed volume that the vectors span.

    >>> float(triple_product([1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]))
    6.0
    """
    return Vec3(*entries(a)).dot(Vec3(*entries(b)).cross(Vec3(*entries(c))))


@takes(a="vector", b="vector", c="vector")
def double_cross_product(a: jax.Array, b: jax.Array, c: jax.Array) -> jax.Array:
    """Compute a x (b x c) = (a . c) b - (a . b) c (..., 3)."""
    u, v, w = (Vec3(*entries(x)) for x in (a, b, c))
    return stacked(u.dot(w) * v - u.dot(v) * w)


@takes(T="pose", V="twist")
def motion_transform_rate(T: jax.Array, V: jax.Array) -> jax.Array:
    """Compute d/dt X_AB = X_AB (V x) (..., 6, 6) for a frame B with pose T and body twist V."""
    return matmat(motion_transform(T), motion_cross_matrix(V))


@takes(T="pose", V="twist")
def force_transform_rate(T: jax.Array, V: jax.Array) -> jax.Array:
    """Compute d/dt X*_AB = X*_AB (V x*) (..., 6, 6) for a frame B with pose T and body twist V."""
    return matmat(force_transform(T), force_cross_matrix(V))
