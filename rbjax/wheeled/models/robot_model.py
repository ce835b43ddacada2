"""A wheeled robot at one fidelity: the interface, states, rates and contacts.

All fidelities of a robot have the same coordinates q and controls u (`Robot`). Their velocities v
differ: none, the free velocities of rolling wheels, or all full velocities. Only "slipping" has
tyre states x.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import instance
from rbjax.compiling import compiled
from rbjax.display import Display, display_of, displayed, field_rows
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.lanes import Lane
from rbjax.model import State
from rbjax.model.record import Record
from rbjax.wheeled.kinematics.context import RobotContext, coordinate_rates
from rbjax.wheeled.kinematics.parameters import parameters_of, stack_lanes
from rbjax.wheeled.kinematics.planar import Pair, Twist
from rbjax.wheeled.kinematics.velocities import (
    contact_velocity,
    free_velocities,
    rolling_velocities,
    twists_of,
)
from rbjax.wheeled.robot.robot import Robot


class RobotModel(Record):
    """Base class of models of a robot at one fidelity. Subclasses define v and its rate.

    Fields:
        robot: `Robot`.
    """

    robot: Robot
    name: ClassVar[str] = ""

    def __check_init__(self) -> None:
        public = "a Robot, such as rbjax.wheeled.kinds()['differential_drive'].make()"
        instance(type(self).__name__, "robot", self.robot, Robot, public)

    def _display_(self) -> Display:
        own = display_of(self.robot)
        sizes = f"nq {self.nq}, nv {self.nv}, nx {self.nx}, nu {self.nu}"
        notes = [own.title, *(f"{n}: {x}" for n, x in field_rows(self) if n != "robot")]
        title = f"{type(self).__name__}: fidelity {self.name!r}, {sizes}"
        return Display(title, own.rows, own.columns, notes, own.picture)

    @property
    def nq(self) -> int:
        """The number of coordinates."""
        return self.robot.layout.nq

    @property
    def nv(self) -> int:
        """The number of velocities."""
        raise NotImplementedError(f"{type(self).__name__} has no property nv")

    @property
    def nx(self) -> int:
        """The number of tyre states."""
        return 0

    @property
    def nu(self) -> int:
        """The number of controls."""
        return self.robot.nu

    def full_velocities(self, context: RobotContext) -> list[Lane]:
        """Compute the full velocities w."""
        raise NotImplementedError(f"{type(self).__name__} has no method full_velocities")

    def accelerations(self, context: RobotContext) -> list[Lane]:
        """Compute the accelerations v' (nv lanes)."""
        raise NotImplementedError(f"{type(self).__name__} has no method accelerations")

    def damped_accelerations(self, context: RobotContext, h: Lane) -> list[Lane]:
        """Compute the mean of v' over a step h, with the damping forces at the end of the step."""
        return self.accelerations(context)

    def tyre_rates(self, context: RobotContext) -> list[Lane]:
        """Compute the rates x' of the tyre states (nx lanes)."""
        return []

    def project(self, context: RobotContext) -> list[Lane]:
        """Project v on the velocity constraints after a step."""
        return context.v

    def start_velocities(self, context: RobotContext, w: list[Lane]) -> list[Lane]:
        """Compute v from full velocities w that the wheels allow."""
        raise NotImplementedError(f"{type(self).__name__} has no method start_velocities")

    def wheel_forces(self, context: RobotContext) -> tuple[list[Lane], list[Pair]]:
        """Compute the loads of wheels, N, and the horizontal forces on them in body axes, N."""
        raise InputError(
            f"contacts: the fidelity is {self.name!r}, which has no forces of wheels; expected "
            "'slipping' or 'constrained'"
        )

    def coordinate_rates(self, context: RobotContext) -> list[Lane]:
        """Compute the rates q' of the coordinates (nq lanes)."""
        return coordinate_rates(context, self.full_velocities(context))

    def rates(self, context: RobotContext) -> tuple[list[Lane], list[Lane], list[Lane]]:
        """Compute the rates q', v' and x' of the state."""
        rates = self.coordinate_rates(context)
        return rates, self.accelerations(context), self.tyre_rates(context)

    def context(self, state: State, u: Any = None) -> RobotContext:
        """Convert the parameters, a state and controls to lanes. Controls are zeros if None."""
        dtype = state.q.dtype
        given = jnp.zeros(self.nu, dtype) if u is None else u
        sizes: Any = ((state.q, self.nq), (state.v, self.nv), (state.x, self.nx), (given, self.nu))
        lanes = ([x[i] for i in range(size)] for x, size in sizes)
        return RobotContext(parameters_of(self.robot, dtype), *lanes)


def as_state(q: Sequence[Lane], v: Sequence[Lane], x: Sequence[Lane], dtype: Any) -> State:
    """Stack lists of coordinates, velocities and tyre states to a `State`."""
    tyres = stack_lanes(x, dtype) if len(x) else None
    return State(stack_lanes(q, dtype), stack_lanes(v, dtype), tyres)


def check_robot_model(where: str, model: Any) -> None:
    """Raise `InputError` unless `model` is a `RobotModel`."""
    public = 'a robot at a fidelity, as rbjax.wheeled.at(robot, "reduced") gives it'
    instance(where, "model", model, RobotModel, public)


def check_state(where: str, model: RobotModel, state: Any, batch: tuple[int, ...] = ()) -> State:
    """Return the state with floating arrays of the model's sizes, in one dtype."""
    instance(where, "state", state, State, "a State, as rbjax.wheeled.start(model) gives it")
    sizes = {"q": model.nq, "v": model.nv, "x": model.nx}
    found = {}
    for name, n in sizes.items():
        value = getattr(state, name)
        if value is None:
            if not n or name == "x":  # set below, in the dtype of q and v
                continue
            value = jnp.zeros((*batch, n))
        found[name] = check_array(where, f"state.{name}", value, (*batch, n))
    dtype = jnp.result_type(*found.values())
    found = {name: x.astype(dtype) for name, x in found.items()}
    x = found.get("x", jnp.zeros((*batch, model.nx), dtype)) if model.nx else None
    return State(found["q"], found["v"], x)


def check_state_and_controls(
    where: str, model: Any, state: Any, ctrl: Any
) -> tuple[State, jax.Array]:
    """Check a model, a state and controls. Return the state and the controls in one dtype. Controls
    are zeros if None."""
    check_robot_model(where, model)
    state = check_state(where, model, state)
    given = jnp.zeros(model.nu) if ctrl is None else ctrl
    return state, check_array(where, "ctrl", given, (model.nu,)).astype(state.q.dtype)


def start(model: RobotModel, pose: Any = (0.0, 0.0, 0.0), twist: Any = (0.0, 0.0, 0.0)) -> State:
    """Make a state of a robot in which no wheel slides, trailers are straight and steering is zero.

    The twist is projected onto the twists that the wheels allow. Wheels start at the rates at which
    they roll.

    Args:
        model: `at(robot, fidelity)`.
        pose: (3,), x and y in m, the heading in rad.
        twist: (3,), vx and vy in m/s in the chassis' axes, the turning rate in rad/s.

    Returns:
        `State`.

    Raises:
        InputError: wrong types or shapes, values that are not finite.

    Example:
        >>> import rbjax as rb
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "reduced")
        >>> [round(x, 6) for x in wheeled.start(cart, twist=[0.5, 0.0, 0.2]).v.tolist()]
        [0.5, 0.2]
    """
    check_robot_model("start", model)
    pose = check_array("start", "pose", pose, (3,))
    twist = check_array("start", "twist", twist, (3,))
    dtype = jnp.result_type(pose, twist)
    q = jnp.concatenate([pose, jnp.zeros(model.nq - 3)]).astype(dtype)
    return with_twist(model, q, twist.astype(dtype))


def with_twist(model: RobotModel, q: jax.Array, twist: jax.Array) -> State:
    """Make the state at coordinates q (nq,) with a chassis twist (3,), projected on the allowed
    twists."""
    context = model.context(State(q, jnp.zeros(model.nv, q.dtype), jnp.zeros(model.nx, q.dtype)))
    V = Twist(*(twist[i] for i in range(3)))
    w = rolling_velocities(context.n, context.shape, free_velocities(context.n, context.shape, V))
    return as_state(context.q, model.start_velocities(context, w), context.x, q.dtype)


def rates(model: RobotModel, state: State, ctrl: Any) -> State:
    """Compute the rate of a state: q', v' and x'.

    Args:
        model: `at(robot, fidelity)`.
        state: q (nq,), v (nv,), x (nx,).
        ctrl: (nu,), one for each drive, in the unit of its motor, then one for each steering.

    Returns:
        `State` of rates.

    Raises:
        InputError: wrong types or shapes, values that are not finite.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "reduced")
        >>> rate = wheeled.rates(cart, wheeled.start(cart), jnp.array([0.3, 0.3]))
        >>> bool(rate.v[0] > 0)
        True
    """
    return _rates(model, *check_state_and_controls("rates", model, state, ctrl))


@compiled
def _rates(model: RobotModel, state: State, u: jax.Array) -> State:
    return as_state(*model.rates(model.context(state, u)), state.q.dtype)


@displayed
class WheelContacts(NamedTuple):
    """The contacts of n wheels with the ground.

    Fields:
        loads: (n,), N.
        forces: (n, 2), the force of the ground on the wheel along x and y of its body, N.
        sliding: (n, 2), the velocity of the contact over the ground, along the wheel and to its
            left, m/s.
    """

    loads: jax.Array
    forces: jax.Array
    sliding: jax.Array

    @property
    def lifts(self) -> jax.Array:
        """Boolean (n,): whether the load is negative. Such a wheel would lift. It exerts no
        force, and the motion is approximate."""
        return self.loads < 0


def contacts(model: RobotModel, state: State, ctrl: Any) -> WheelContacts:
    """Compute the loads, forces and sliding velocities of all wheels.

    At the fidelity "constrained" the loads are the loads at rest, and the forces are the
    multipliers of the rolling constraints.

    Args:
        model: `at(robot, "slipping")` or `at(robot, "constrained")`.
        state: q (nq,), v (nv,), x (nx,).
        ctrl: (nu,), the controls as for `rates`.

    Returns:
        `WheelContacts`, in N and m/s.

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
    return _contacts(model, *check_state_and_controls("contacts", model, state, ctrl))


@compiled
def _contacts(model: RobotModel, state: State, u: jax.Array) -> WheelContacts:
    context = model.context(state, u)
    n, shape, dtype = context.n, context.shape, state.q.dtype
    loads, forces = model.wheel_forces(context)
    w = model.full_velocities(context)
    twists, rates = twists_of(n, shape, w), n.shaft_rates(w)
    sliding = []
    for i, wheel in enumerate(n.wheels):
        along, across = contact_velocity(n, shape, twists, i)
        free = wheel.kind == "caster"
        sliding.append((along - wheel.radius * rates[wheel.shaft], 0.0 if free else across))
    pairs = (jnp.stack([stack_lanes(x, dtype) for x in rows]) for rows in (forces, sliding))
    return WheelContacts(stack_lanes(loads, dtype), *pairs)
