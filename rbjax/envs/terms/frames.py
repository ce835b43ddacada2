"""Frames of a robot after a control step, and readings of actuators, each computed once a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, real_array, shown
from rbjax.errors import InputError
from rbjax.forces.context import Context, FrameState
from rbjax.lanes import Lane, safe_sqrt, total
from rbjax.sensors.actuators import actuator_force
from rbjax.sensors.fixed import named_frame

#: a term: a function of a `rbjax.envs.Transition`
Term = Callable[[Any], Any]


def frame_at(context: Context, frame: Any) -> FrameState:
    """Return the motion of a frame at an instant.

    frame: name of a site or of a body, or an `rb.Frame`.
    """
    if not isinstance(frame, str):
        named_frame(context.model, frame)  # raises for another type, which may not be hashable
    found: dict[Any, FrameState] = context.once(frame_at, dict)
    if frame not in found:
        found[frame] = context.frame(named_frame(context.model, frame))
    return found[frame]


def scalar(context: Context, value: Any) -> jax.Array:
    """Return a lane as an array () in the dtype of q."""
    return jnp.asarray(value, context.q.dtype)


def variable_of(transition: Any, name: str) -> Any:
    """Return a variable of the task.

    Raises:
        UnknownName: the task has no such variable.
    """
    return transition.variables[choice("variable of the task", name, transition.variables)]


def numbers_of(where: str, name: str, value: Any) -> np.ndarray:
    """Convert one number of each joint to an array (n,)."""
    x = real_array(where, name, value, ndim=1)
    if not x.size:
        raise InputError(f"{where}: {name} is empty, expected one number of each joint")
    return x


def weights_of(where: str, weights: Any, n: int) -> np.ndarray:
    """Check weights: a number or (n,), of at least zero."""
    x = real_array(where, "weights", weights)
    if x.shape not in ((), (1,), (n,)) or (x < 0).any():
        raise InputError(
            f"{where}: weights is {shown(weights)}, expected a number or ({n},) of at least zero"
        )
    return x


def squares(lanes: Any) -> Lane:
    """Return the sum of the squares of lanes."""
    return total(x * x for x in lanes)


def length(lanes: Any) -> Lane:
    """Return the Euclidean norm of lanes. The derivative at zero is zero."""
    return safe_sqrt(squares(lanes))


def norm(x: jax.Array) -> jax.Array:
    """Return the Euclidean norm of an array (n,). The derivative at zero is zero."""
    return jnp.asarray(safe_sqrt((x * x).sum()))


def joint_entries(values: jax.Array, count: int) -> jax.Array:
    """Return the last `count` entries of q or v: the joints of a robot with a floating base."""
    if count > values.shape[0]:
        raise InputError(
            f"term of joints: {count} joints are given, and the robot has {values.shape[0]} "
            "coordinates; give one number of each joint"
        )
    return values[values.shape[0] - count :]


def actuator_forces(context: Context) -> jax.Array:
    """Return the scalar forces (nu,) of all actuators, within their ranges."""

    if not context.model.nu:
        raise InputError(
            "forces of actuators: the robot has no actuators, expected one or more; leave out "
            "terms of forces and power, or add actuators to the file"
        )

    def found() -> jax.Array:
        names = range(context.model.nu)
        return jnp.stack([scalar(context, actuator_force(context, k)) for k in names])

    forces: jax.Array = context.once(actuator_forces, found)
    return forces
