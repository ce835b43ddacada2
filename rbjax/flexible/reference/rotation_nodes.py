"""Nodes with a position and a unit quaternion: coordinates x, y, z, qw, qx, qy, qz.

An increment is a translation in world axes and a Gibbs-Rodrigues vector, 2 tan(angle/2) axis, in
the axes of the section. Forces, moments and momenta are in world axes, so a dead moment is a
constant.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.flexible.reference import quaternions
from rbjax.flexible.reference.mesh import Curve, Formulation
from rbjax.rotations.quaternion import from_matrix


class RotationNodes(Formulation):
    """Base class of formulations whose nodes are rigid cross-sections in space.

    An element stores `mass` (k, k), in kg, and `inertia` (k, 3), in kg m^2, about its own axes.
    """

    c, d = 7, 6
    planar = (True, True, False, False, False, True)
    clamped = (True,) * 6

    def retract(self, q: jax.Array, delta: jax.Array) -> jax.Array:
        turned = quaternions.multiply(q[..., 3:], quaternions.from_gibbs(delta[..., 3:]))
        return jnp.concatenate([q[..., :3] + delta[..., :3], turned], -1)

    def midway(self, q: jax.Array, delta: jax.Array) -> jax.Array:
        end = (q + self.retract(q, delta)) / 2
        return jnp.concatenate([end[..., :3], quaternions.normalize(end[..., 3:])], -1)

    def kinetic_energy(self, data: Any, q: jax.Array, v: jax.Array) -> jax.Array:
        translation = (v[:, :3] * (data["mass"] @ v[:, :3])).sum()
        return 0.5 * (translation + (data["inertia"] * v[:, 3:] ** 2).sum())

    def momentum(self, data: Any, q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        spin = quaternions.rotate(q[:, 3:], data["inertia"] * v[:, 3:])
        return jnp.concatenate([data["mass"] @ v[:, :3], spin], -1), jnp.zeros_like(v)

    def to_world(self, q: jax.Array, f: jax.Array) -> jax.Array:
        return jnp.concatenate([f[:, :3], quaternions.rotate(q[:, 3:], f[:, 3:])], -1)

    def load(self, q: jax.Array, wrench: jax.Array) -> jax.Array:
        return wrench

    def pose(self, q: jax.Array) -> tuple[jax.Array, jax.Array]:
        return q[..., :3], quaternions.rotate(q[..., 3:], jnp.array([1.0, 0.0, 0.0]))

    def clamp_increment(self, q: jax.Array, before: jax.Array, after: jax.Array) -> jax.Array:
        return jnp.zeros(6).at[5].set(2 * jnp.tan((after - before) / 2))


def nodes_on(curve: Curve, s: np.ndarray) -> jax.Array:
    """Return the coordinates (..., 7) of sections of an unloaded beam at arclengths s (...)."""
    x, R = curve(s.ravel())
    q = jnp.concatenate([jnp.asarray(x), jax.jit(from_matrix)(jnp.asarray(R))], -1)
    return q.reshape(*s.shape, 7)


def world_increment(before: jax.Array, q: jax.Array) -> jax.Array:
    """Return the quaternion (..., 4), in world axes, of the rotation from `before` to q."""
    return quaternions.multiply(q, quaternions.conjugate(before))


def with_curvature(
    rotation: Callable[[jax.Array], jax.Array],
    phi: jax.Array,
    slope: jax.Array,
    before: jax.Array,
    kappa: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Apply an interpolated rotation to sections: their quaternions and their curvatures.

    rotation: from a vector to a quaternion, `quaternions.exp` or `from_gibbs`.
    phi, slope: vectors (points, 3) in world axes and their derivatives by arclength.
    before, kappa: quaternions (points, 4) and curvatures (points, 3), in section axes, before.

    R = A(phi) R0, kappa = kappa0 + R^T a, with [a] = A' A^T.
    """
    turn, rate = jax.jvp(rotation, (phi,), (slope,))
    turned = quaternions.multiply(turn, before)
    spatial = 2 * quaternions.multiply(rate, quaternions.conjugate(turn))[..., 1:]
    return turned, kappa + quaternions.rotate(quaternions.conjugate(turned), spatial)
