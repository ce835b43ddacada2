"""Generalized forces by virtual work: Q . dq = sum f_i . dx_i for every virtual displacement.

(Olguin Diaz, 7.1.4.) For forces at points, Q = J^T f with J = dx/dq. For a wrench on a body,
Q_k = F . V_k, with V_k the twist of the body if only q_k changes.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from rbjax.body.body import coordinate_vector
from rbjax.errors import InputError
from rbjax.rotations import se3


def of_forces(
    points: Callable[[jax.Array], jax.Array], forces: jax.Array, q: jax.Array
) -> jax.Array:
    """Compute the generalized forces Q (n,) of forces with the shape of `points(q)`.

    >>> tip = lambda q: jnp.stack([jnp.cos(q[0]), jnp.sin(q[0])])
    >>> of_forces(tip, jnp.array([0.0, 3.0]), jnp.array([0.0])).tolist()
    [3.0]
    """
    x, work = jax.vjp(points, coordinate_vector("of_forces", "q", q))
    if jnp.shape(forces) != x.shape:
        raise InputError(
            f"of_forces: forces has shape {jnp.shape(forces)}, expected {x.shape} as points(q) has"
        )
    return work(jnp.asarray(forces, x.dtype))[0]


def of_wrench(pose: Callable[[jax.Array], jax.Array], F: jax.Array, q: jax.Array) -> jax.Array:
    """Compute the generalized forces Q (n,) of a wrench F (6,) on a body with the pose `pose(q)`.

    F is in the axes of the body at its origin.

    >>> door = lambda q: se3.exp(q[0] * jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    >>> F = jnp.array([0.0, 0.0, 5.0, 1.0, 1.0, 1.0])
    >>> of_wrench(door, F, jnp.array([0.3])).round(6).tolist()
    [5.0]
    """
    q = coordinate_vector("of_wrench", "q", q)
    T, along = jax.linearize(pose, q)
    if T.shape != (4, 4) or jnp.shape(F) != (6,):
        raise InputError(
            f"of_wrench: the pose has shape {T.shape} and F {jnp.shape(F)}, expected (4, 4), (6,)"
        )
    twists = jax.vmap(lambda dq: se3.body_twist(T, along(dq)))(jnp.eye(len(q), dtype=q.dtype))
    return (twists * F).sum(-1)
