"""Terms of effort: forces and power of the actuators, changes of the action, accelerations."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs.terms.frames import Term, actuator_forces, joint_entries, norm
from rbjax.sensors.solution import solution_of


def forces(transition: Any) -> jax.Array:
    """Observe the scalar forces of the actuators.

    Args:
        transition: a `Transition`.

    Returns:
        (nu,), N m or N.

    Raises:
        InputError: at the evaluation, if the robot has no actuators.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Observation("forces", rb.envs.terms.forces, noise=0.1).noise
        0.1
    """
    return actuator_forces(transition.after)


def force_norms(transition: Any) -> jax.Array:
    """Compute |f|_2 + |f|_1 of the actuator forces f.

    Args:
        transition: a `Transition`.

    Returns:
        (), N m or N.

    Raises:
        InputError: at the evaluation, if the robot has no actuators.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("torques", rb.envs.terms.force_norms, -0.0002).weight
        -0.0002
    """
    f = actuator_forces(transition.after)
    return norm(f) + jnp.abs(f).sum()


def absolute_forces(transition: Any) -> jax.Array:
    """Compute |f|_1 of the actuator forces f.

    Args:
        transition: a `Transition`.

    Returns:
        (), N m or N.

    Raises:
        InputError: at the evaluation, if the robot has no actuators.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("torques", rb.envs.terms.absolute_forces, -0.001).weight
        -0.001
    """
    return jnp.abs(actuator_forces(transition.after)).sum()


def squared_forces(transition: Any) -> jax.Array:
    """Compute |f|^2 of the actuator forces f.

    Args:
        transition: a `Transition`.

    Returns:
        (), N^2 m^2 or N^2.

    Raises:
        InputError: at the evaluation, if the robot has no actuators.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("torques", rb.envs.terms.squared_forces, -0.001).weight
        -0.001
    """
    f = actuator_forces(transition.after)
    return (f * f).sum()


def power(transition: Any) -> jax.Array:
    """Compute the sum of |v_i f_i|. The last nu dofs are the driven ones, with gear 1.

    Args:
        transition: a `Transition`.

    Returns:
        (), W.

    Raises:
        InputError: at the evaluation, if the robot has no actuators.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("power", rb.envs.terms.power, -0.001).weight
        -0.001
    """
    f = actuator_forces(transition.after)
    return (jnp.abs(joint_entries(transition.after.v, f.shape[0])) * jnp.abs(f)).sum()


def action_rate(transition: Any) -> jax.Array:
    """Compute |a_k - a_(k-1)|^2 of the actions.

    Args:
        transition: a `Transition`; the term reads its actions (na,).

    Returns:
        (), in the squared unit of the actions.

    Example:
        >>> from types import SimpleNamespace
        >>> import jax.numpy as jnp
        >>> from rbjax.envs.terms import action_rate
        >>> change = SimpleNamespace(action=jnp.ones(2), last_action=jnp.zeros(2))
        >>> float(action_rate(change))
        2.0
    """
    change = transition.action - transition.last_action
    return (change * change).sum()


def terminated(transition: Any) -> jax.Array:
    """Return 1 if a termination of the task is true in this step, else 0.

    Args:
        transition: a `Transition`.

    Returns:
        (), without unit.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("termination", rb.envs.terms.terminated, -1.0).weight
        -1.0
    """
    return jnp.asarray(transition.terminated, transition.after.q.dtype)


def joint_acceleration(count: int) -> Term:
    """Return the term: the sum of v'^2 of the last `count` dofs, at the last physics step.

    Args:
        count: number of dofs.

    Returns:
        Function of a `Transition` that returns (), rad^2/s^4 or m^2/s^4.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("smooth", rb.envs.terms.joint_acceleration(12), -2.5e-7).weight
        -2.5e-07
    """

    def read(transition: Any) -> jax.Array:
        a = joint_entries(solution_of(transition.after).acceleration, count)
        return (a * a).sum()

    return read
