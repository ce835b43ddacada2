"""Terms of the joints of a robot with a floating base: pose, limits, and standing still.

q_j are the last n entries of q, one of each joint, and h a pose (n,), in rad or m. Weights are
(n,), and zero leaves a joint out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.envs.terms.frames import Term, joint_entries, norm

#: a command of this norm or less is zero
STILL = 0.01


def joint_offsets(home: Sequence[float]) -> Term:
    """Observe q_j - h (n,)."""
    h = np.asarray(home)

    def read(transition: Any) -> jax.Array:
        q = joint_entries(transition.after.q, len(h))
        return q - jnp.asarray(h, q.dtype)

    return read


def joint_velocities(count: int) -> Term:
    """Observe the velocities (n,) of the last `count` joints."""

    def read(transition: Any) -> jax.Array:
        return joint_entries(transition.after.v, count)

    return read


def pose_error(home: Sequence[float], weights: Any = 1.0) -> Term:
    """Return the sum of weights * (q_j - h)^2."""
    offsets = joint_offsets(home)

    def read(t: Any) -> jax.Array:
        e = offsets(t)
        return (jnp.asarray(weights, e.dtype) * e * e).sum()

    return read


def pose_similarity(home: Sequence[float], weights: Any = 1.0) -> Term:
    """Reward a pose: exp(-sum of weights * (q_j - h)^2)."""
    error = pose_error(home, weights)

    def read(t: Any) -> jax.Array:
        return jnp.exp(-error(t))

    return read


def joint_deviation(home: Sequence[float], weights: Any = 1.0) -> Term:
    """Return the sum of weights * |q_j - h|.

    weights: number, array (n,), or a function of the transition that returns one.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("knees", rb.envs.terms.joint_deviation((0.5, 0.5)), -0.1).weight
        -0.1
    """
    offsets = joint_offsets(home)

    def read(t: Any) -> jax.Array:
        w = weights(t) if callable(weights) else weights
        e = offsets(t)
        return (jnp.asarray(w, e.dtype) * jnp.abs(e)).sum()

    return read


def stand_still(home: Sequence[float], command: str = "command") -> Term:
    """Return the sum of |q_j - h| if the command is zero, else 0."""
    deviation = joint_deviation(home)

    def read(transition: Any) -> jax.Array:
        return jnp.where(norm(transition.variables[command]) < STILL, deviation(transition), 0.0)

    return read


def joint_limit_violation(lower: Sequence[float], upper: Sequence[float]) -> Term:
    """Return the sum of the distances of q_j beyond limits (n,), max(l - q, 0) + max(q - u, 0)."""
    low, high = np.asarray(lower), np.asarray(upper)

    def read(transition: Any) -> jax.Array:
        q = joint_entries(transition.after.q, len(low))
        below = jnp.maximum(jnp.asarray(low, q.dtype) - q, 0.0)
        return (below + jnp.maximum(q - jnp.asarray(high, q.dtype), 0.0)).sum()

    return read
