"""Terms of effort: forces and power of the actuators, changes of the action, accelerations."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs.terms.frames import Term, actuator_forces, joint_entries, norm
from rbjax.sensors.solution import solution_of


def forces(transition: Any) -> jax.Array:
    """Observe the scalar forces (nu,) of the actuators, N m or N."""
    return actuator_forces(transition.after)


def force_norms(transition: Any) -> jax.Array:
    """Return |f|_2 + |f|_1 of the actuator forces f."""
    f = actuator_forces(transition.after)
    return norm(f) + jnp.abs(f).sum()


def absolute_forces(transition: Any) -> jax.Array:
    """Return |f|_1 of the actuator forces f."""
    return jnp.abs(actuator_forces(transition.after)).sum()


def squared_forces(transition: Any) -> jax.Array:
    """Return |f|^2 of the actuator forces f."""
    f = actuator_forces(transition.after)
    return (f * f).sum()


def power(transition: Any) -> jax.Array:
    """Return the sum of |v_i f_i|, W. The last nu dofs are the driven ones, with gear 1."""
    f = actuator_forces(transition.after)
    return (jnp.abs(joint_entries(transition.after.v, f.shape[0])) * jnp.abs(f)).sum()


def action_rate(transition: Any) -> jax.Array:
    """Return |a_k - a_(k-1)|^2 of the actions."""
    change = transition.action - transition.last_action
    return (change * change).sum()


def terminated(transition: Any) -> jax.Array:
    """Return 1 if a termination of the task is true in this step, else 0."""
    return jnp.asarray(transition.terminated, transition.after.q.dtype)


def joint_acceleration(count: int) -> Term:
    """Return the sum of v'^2 of the last `count` dofs, at the last physics step."""

    def read(transition: Any) -> jax.Array:
        a = joint_entries(solution_of(transition.after).acceleration, count)
        return (a * a).sum()

    return read
