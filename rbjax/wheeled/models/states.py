"""States of a vehicle and their rates: the entry of its public functions."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiling import compiled
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.wheeled.kinematics.planar import Twist
from rbjax.wheeled.kinematics.velocities import free_velocities, rolling_velocities
from rbjax.wheeled.models.robot_model import RobotModel, as_state


def check_vehicle(where: str, vehicle: Any) -> None:
    """Refuse what is no robot at a fidelity."""
    if not isinstance(vehicle, RobotModel):
        raise InputError(
            f"{where}: vehicle is {type(vehicle).__name__}, expected a robot at a fidelity, as "
            'rbjax.wheeled.at(robot, "kinematical") gives it'
        )


def check_state(where: str, vehicle: RobotModel, state: Any, batch: tuple[int, ...] = ()) -> State:
    """A state with floating arrays of the vehicle's sizes, in one dtype."""
    if not isinstance(state, State):
        raise InputError(
            f"{where}: state is {type(state).__name__}, expected a State, as "
            "rbjax.wheeled.start(vehicle) gives it"
        )
    sizes = {"q": vehicle.nq, "v": vehicle.nv, "x": vehicle.nx}
    found = {}
    for name, n in sizes.items():
        value = getattr(state, name)
        if value is None:
            if not n or name == "x":  # set below, in the dtype of the others
                continue
            value = jnp.zeros((*batch, n))
        found[name] = check_array(where, f"state.{name}", value, (*batch, n))
    dtype = jnp.result_type(*found.values())
    found = {name: x.astype(dtype) for name, x in found.items()}
    x = found.get("x", jnp.zeros((*batch, vehicle.nx), dtype)) if vehicle.nx else None
    return State(found["q"], found["v"], x)


def start(vehicle: RobotModel, pose: Any = (0.0, 0.0, 0.0), twist: Any = (0.0, 0.0, 0.0)) -> State:
    """A state of a vehicle in which no wheel slides: trailers straight, steering ahead.

    Of a twist that the wheels do not allow it takes the allowed part. A wheel starts at the speed
    at which it rolls.

    Args:
        vehicle: `at(robot, fidelity)`.
        pose: (3,), x and y in m, the heading in rad.
        twist: (3,), vx and vy in m/s in the chassis' axes, the turning rate in rad/s.

    Returns:
        `State`.

    Raises:
        InputError: wrong types or shapes, values that are not finite.

    Example:
        >>> import rbjax as rb
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "kinematical")
        >>> [round(x, 6) for x in wheeled.start(cart, twist=[0.5, 0.0, 0.2]).v.tolist()]
        [0.5, 0.2]
    """
    check_vehicle("start", vehicle)
    pose = check_array("start", "pose", pose, (3,))
    twist = check_array("start", "twist", twist, (3,))
    dtype = jnp.result_type(pose, twist)
    q = jnp.concatenate([pose, jnp.zeros(vehicle.nq - 3)]).astype(dtype)
    return with_twist(vehicle, q, twist.astype(dtype))


def with_twist(vehicle: RobotModel, q: jax.Array, twist: jax.Array) -> State:
    """The state at coordinates q (nq,) whose chassis has the allowed part of a twist (3,)."""
    bare = State(q, jnp.zeros(vehicle.nv, q.dtype), jnp.zeros(vehicle.nx, q.dtype))
    now = vehicle.context(bare)
    n = now.n
    shape = now.shape
    w = rolling_velocities(
        n, shape, free_velocities(n, shape, Twist(*(twist[i] for i in range(3))))
    )
    return as_state(now.q, vehicle.start_velocities(now, w), now.x, q.dtype)


def rates(vehicle: RobotModel, state: State, controls: Any) -> State:
    """The rate of a state: q', v' and x'.

    Args:
        vehicle: `at(robot, fidelity)`.
        state: q (nq,), v (nv,), x (nx,).
        controls: (nu,), one a drive, in the unit of its motor, then one a steering.

    Returns:
        `State` of rates.

    Raises:
        InputError: wrong types or shapes, values that are not finite.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "kinematical")
        >>> rate = wheeled.rates(cart, wheeled.start(cart), jnp.array([0.3, 0.3]))
        >>> bool(rate.v[0] > 0)
        True
    """
    check_vehicle("rates", vehicle)
    state = check_state("rates", vehicle, state)
    u = check_array("rates", "controls", controls, (vehicle.nu,)).astype(state.q.dtype)
    return _rates(vehicle, state, u)


@compiled
def _rates(vehicle: RobotModel, state: State, u: jax.Array) -> State:
    now = vehicle.context(state, u)
    q, v, x = vehicle.rates(now)
    return as_state(q, v, x, state.q.dtype)
