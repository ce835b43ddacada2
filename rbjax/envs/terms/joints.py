"""Terms of the joints of a robot with a floating base: pose, limits, and standing still.

q_j are the last n entries of q, one of each joint, and h a pose (n,), in rad or m. Weights are
(n,), and zero leaves a joint out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import integer, shown
from rbjax.envs.terms.frames import Term, joint_entries, norm, numbers_of, variable_of, weights_of
from rbjax.errors import InputError

#: a command of this norm or less is zero
STILL = 0.01


def joint_offsets(home: Sequence[float]) -> Term:
    """Return the term that observes q_j - h.

    Args:
        home: pose h (n,), rad or m.

    Returns:
        Function of a `Transition` that returns (n,), rad or m.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Observation("q", rb.envs.terms.joint_offsets((0.5, 0.5)), noise=0.03).noise
        0.03
    """
    h = numbers_of("joint_offsets", "home", home)

    def read(transition: Any) -> jax.Array:
        q = joint_entries(transition.after.q, len(h))
        return q - jnp.asarray(h, q.dtype)

    return read


def joint_velocities(count: int) -> Term:
    """Return the term that observes the velocities of the last joints.

    Args:
        count: number n of joints.

    Returns:
        Function of a `Transition` that returns (n,), rad/s or m/s.

    Raises:
        InputError: a count that is not a positive integer.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Observation("v", rb.envs.terms.joint_velocities(12), noise=1.5).noise
        1.5
    """
    integer("joint_velocities", "count", count, least=1)

    def read(transition: Any) -> jax.Array:
        return joint_entries(transition.after.v, count)

    return read


def pose_error(home: Sequence[float], weights: Any = 1.0) -> Term:
    """Return the term: the sum of weights * (q_j - h)^2.

    Args:
        home: pose h (n,), rad or m.
        weights: number or array (n,), 1/rad^2 or 1/m^2.

    Returns:
        Function of a `Transition` that returns (), without unit.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("pose", rb.envs.terms.pose_error((0.5, 0.5)), -0.1).weight
        -0.1
    """
    offsets = joint_offsets(home)
    weights_of("pose_error", weights, len(home))

    def read(t: Any) -> jax.Array:
        e = offsets(t)
        return (jnp.asarray(weights, e.dtype) * e * e).sum()

    return read


def pose_similarity(home: Sequence[float], weights: Any = 1.0) -> Term:
    """Return the reward of a pose: exp(-sum of weights * (q_j - h)^2).

    Args:
        home: pose h (n,), rad or m.
        weights: number or array (n,), 1/rad^2 or 1/m^2.

    Returns:
        Function of a `Transition` that returns (), from 0 to 1.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("pose", rb.envs.terms.pose_similarity((0.5, 0.5)), 0.5).weight
        0.5
    """
    error = pose_error(home, weights)

    def read(t: Any) -> jax.Array:
        return jnp.exp(-error(t))

    return read


def joint_deviation(home: Sequence[float], weights: Any = 1.0) -> Term:
    """Return the term: the sum of weights * |q_j - h|.

    Args:
        home: pose h (n,), rad or m.
        weights: number, array (n,), or a function of the transition that returns one; 1/rad or 1/m.

    Returns:
        Function of a `Transition` that returns (), without unit.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("knees", rb.envs.terms.joint_deviation((0.5, 0.5)), -0.1).weight
        -0.1
    """
    offsets = joint_offsets(home)
    if not callable(weights):
        weights_of("joint_deviation", weights, len(home))

    def read(t: Any) -> jax.Array:
        w = weights(t) if callable(weights) else weights
        e = offsets(t)
        return (jnp.asarray(w, e.dtype) * jnp.abs(e)).sum()

    return read


def stand_still(home: Sequence[float], command: str = "command") -> Term:
    """Return the term: the sum of |q_j - h| if the command is zero, else 0.

    Args:
        home: pose h (n,), rad or m.
        command: name of the variable of the task with the command.

    Returns:
        Function of a `Transition` that returns (), rad or m.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("still", rb.envs.terms.stand_still((0.5, 0.5)), -1.0).weight
        -1.0
    """
    deviation = joint_deviation(home)

    def read(transition: Any) -> jax.Array:
        return jnp.where(norm(variable_of(transition, command)) < STILL, deviation(transition), 0.0)

    return read


def joint_limit_violation(lower: Sequence[float], upper: Sequence[float]) -> Term:
    """Return the term: the sum of max(l - q_j, 0) + max(q_j - u, 0), the excess over limits.

    Args:
        lower, upper: limits l and u (n,), rad or m.

    Returns:
        Function of a `Transition` that returns (), rad or m.

    Raises:
        InputError: not as many lower as upper limits, or lower ones above upper ones.

    Example:
        >>> import rbjax as rb
        >>> limits = rb.envs.terms.joint_limit_violation((-1.0, -1.0), (1.0, 1.0))
        >>> rb.envs.Reward("limits", limits, -1.0).weight
        -1.0
    """
    where = "joint_limit_violation"
    low, high = numbers_of(where, "lower", lower), numbers_of(where, "upper", upper)
    if low.shape != high.shape or (low > high).any():
        raise InputError(
            f"{where}: lower is {shown(lower)} and upper {shown(upper)}, expected as many numbers, "
            "lower ones at most upper ones"
        )

    def read(transition: Any) -> jax.Array:
        q = joint_entries(transition.after.q, len(low))
        below = jnp.maximum(jnp.asarray(low, q.dtype) - q, 0.0)
        return (below + jnp.maximum(q - jnp.asarray(high, q.dtype), 0.0)).sum()

    return read
