"""What the ground does to each wheel of a vehicle, for looking and for checks."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiling import compiled
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.wheeled.kinematics.parameters import stack_lanes
from rbjax.wheeled.kinematics.planar import rotate
from rbjax.wheeled.kinematics.velocities import contact_velocity, twists_of
from rbjax.wheeled.models.constrained import Constrained
from rbjax.wheeled.models.loads import wheel_loads
from rbjax.wheeled.models.robot_model import RobotModel
from rbjax.wheeled.models.slipping import Slipping
from rbjax.wheeled.models.states import check_state, check_vehicle


class Contacts(NamedTuple):
    """Of n wheels: loads (n,) N; forces (n, 2) N on the wheel, along x and y of its body; sliding
    (n, 2) m/s, the velocity of the contact over the ground, along the wheel and to its left."""

    loads: jax.Array
    forces: jax.Array
    sliding: jax.Array

    @property
    def lifts(self) -> jax.Array:
        """Whether the ground would have to pull a wheel (n,): a motion on all wheels is not so."""
        return self.loads < 0


def contacts(vehicle: RobotModel, state: State, controls: Any) -> Contacts:
    """Loads, forces and sliding of all wheels at an instant.

    At the fidelity "constrained" the loads are those at rest, and the forces are the multipliers of
    rolling rows.

    Args:
        vehicle: `at(robot, "slipping")` or `at(robot, "constrained")`.
        state: q (nq,), v (nv,), x (nx,).
        controls: (nu,).

    Returns:
        `Contacts`.

    Raises:
        InputError: wrong types or shapes, values that are not finite, another fidelity.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> car = wheeled.at(wheeled.kinds()["car"].make(), "slipping")
        >>> found = wheeled.contacts(car, wheeled.start(car), jnp.zeros(2))
        >>> round(float(found.loads.sum()) / 9.81), bool(found.lifts.any())
        (1180, False)
    """
    check_vehicle("contacts", vehicle)
    if not isinstance(vehicle, (Slipping, Constrained)):
        raise InputError(
            f"contacts: the fidelity is {vehicle.name!r}, which has no forces of wheels; "
            "expected 'slipping' or 'constrained'"
        )
    state = check_state("contacts", vehicle, state)
    u = check_array("contacts", "controls", controls, (vehicle.nu,)).astype(state.q.dtype)
    return _contacts(vehicle, state, u)


@compiled
def _contacts(vehicle: Slipping | Constrained, state: State, u: jax.Array) -> Contacts:
    now = vehicle.context(state, u)
    n = now.n
    shape = now.shape
    if isinstance(vehicle, Slipping):
        loads, forces = vehicle.forces(now)
    else:
        loads = wheel_loads(n)
        own = vehicle.wheel_forces(now)
        forces = [rotate(f, e) for f, e in zip(own, shape.wheels, strict=True)]
    w = vehicle.full_velocities(now)
    twists, rates = twists_of(n, shape, w), w[2 + len(n.bodies) :]
    sliding = []
    for i, wheel in enumerate(n.wheels):
        along, across = contact_velocity(n, shape, twists, i)
        free = wheel.kind == "caster"
        sliding.append((along - wheel.radius * rates[wheel.shaft], 0.0 if free else across))
    dtype = state.q.dtype

    pairs = (jnp.stack([stack_lanes(x, dtype) for x in rows]) for rows in (forces, sliding))
    return Contacts(stack_lanes(loads, dtype), *pairs)
