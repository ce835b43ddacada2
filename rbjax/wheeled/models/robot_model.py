"""A wheeled robot at one fidelity: what its velocities are, and how they change.

All fidelities of a robot have the same coordinates q (`Robot`) and the same controls u: one number
a drive, then one a steering. They differ in v: nothing, the velocities that the wheels leave free,
or all velocities; and in x, states of tyres.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.lanes import Lane, add, inner, mul, neg, sub, total
from rbjax.model import State
from rbjax.model.record import Record
from rbjax.wheeled.kinematics.context import RobotContext, coordinate_rates
from rbjax.wheeled.kinematics.parameters import Parameters, parameters_of, stack_lanes
from rbjax.wheeled.kinematics.planar import dot, rotate
from rbjax.wheeled.kinematics.velocities import Shape, inertial_motion, shaft_speed
from rbjax.wheeled.models.equations import Damper, momentum
from rbjax.wheeled.models.loads import resisting_torques, wheel_loads
from rbjax.wheeled.robot.robot import Robot


class RobotModel(Record):
    """A robot at one fidelity. Subclasses say what v is, and how it changes.

    Fields: robot.
    """

    robot: Robot
    name: ClassVar[str] = ""

    def __check_init__(self) -> None:
        if not isinstance(self.robot, Robot):
            raise InputError(
                f"{type(self).__name__}: robot is {type(self.robot).__name__}, expected a Robot, "
                "such as rbjax.wheeled.kinds()['differential_drive'].make()"
            )

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

    # what a fidelity is

    def full_velocities(self, now: RobotContext) -> list[Lane]:
        """The full velocities w."""
        raise NotImplementedError(f"{type(self).__name__} has no method full")

    def accelerations(self, now: RobotContext) -> list[Lane]:
        """v'."""
        raise NotImplementedError(f"{type(self).__name__} has no method accelerations")

    def damped_accelerations(self, now: RobotContext, h: Lane) -> list[Lane]:
        """The mean of v' over a step h that takes what damps at its end; v' where nothing does."""
        return self.accelerations(now)

    def tyre_rates(self, now: RobotContext) -> list[Lane]:
        """x'."""
        return []

    def project(self, now: RobotContext) -> list[Lane]:
        """v after a step, put back on what it must satisfy."""
        return now.v

    def start_velocities(self, now: RobotContext, w: list[Lane]) -> list[Lane]:
        """v by full velocities that the fidelity allows."""
        raise NotImplementedError(f"{type(self).__name__} has no method start_velocities")

    # what all share

    def coordinate_rates(self, now: RobotContext) -> list[Lane]:
        """q'."""
        return coordinate_rates(now, self.full_velocities(now))

    def rates(self, now: RobotContext) -> tuple[list[Lane], list[Lane], list[Lane]]:
        """q', v', x'."""
        rates = self.coordinate_rates(now)
        return rates, self.accelerations(now), self.tyre_rates(now)

    def context(self, state: State, u: Any = None) -> RobotContext:
        """Convert the parameters, a state and controls, zeros if None, to lanes."""
        dtype = state.q.dtype
        given = jnp.zeros(self.nu, dtype) if u is None else u
        sizes = ((state.q, self.nq), (state.v, self.nv), (state.x, self.nx), (given, self.nu))
        lanes = ([x[i] for i in range(size)] for x, size in sizes)
        return RobotContext(parameters_of(self.robot, dtype), *lanes)


def shaft_torques(now: RobotContext, w: Sequence[Lane]) -> list[Lane]:
    """The torques of the drives and of damping on each shaft."""
    n = now.n
    rates = w[2 + len(n.bodies) :]
    out = [neg(mul(c, rate)) for c, rate in zip(n.damping, rates, strict=True)]
    for j, (drive, split) in enumerate(zip(n.robot.drives, n.splits, strict=True)):
        torque = n.motors[j].torque(now.u[j], shaft_speed(n, drive.wheels, split, rates))
        for i, share in zip(drive.wheels, split, strict=True):
            shaft = n.wheels[i].shaft
            out[shaft] = add(out[shaft], mul(share, torque))
    return out


def motor_dampers(now: RobotContext, w: Sequence[Lane]) -> list[Damper]:
    """How the torques of drives and of damping oppose the speeds of shafts."""
    n = now.n
    first, rates = 2 + len(n.bodies), w[2 + len(n.bodies) :]
    units = [[1.0 if k == first + i else 0.0 for k in range(len(w))] for i in range(len(rates))]
    out: list[Damper] = list(zip(n.damping, units, strict=True))
    for j, (drive, split) in enumerate(zip(n.robot.drives, n.splits, strict=True)):
        c = n.motors[j].damping(now.u[j], shaft_speed(n, drive.wheels, split, rates))
        row: list[Lane] = [0.0] * len(w)
        for i, share in zip(drive.wheels, split, strict=True):
            at = first + n.wheels[i].shaft
            row[at] = add(row[at], share)
        out.append((c, row))
    return out


def torques_at_rest_loads(now: RobotContext, w: Sequence[Lane]) -> list[Lane]:
    """The torques of drives and of rolling resistance on each shaft, with the loads at rest."""
    n = now.n
    driving = shaft_torques(now, w)
    if n.resistance is None:
        return driving
    resisting = resisting_torques(n, w, wheel_loads(n))
    return [add(a, b) for a, b in zip(driving, resisting, strict=True)]


def kinetic_energy(n: Parameters, shape: Shape, w: Sequence[Lane]) -> Lane:
    """T of all bodies, wheels and motors."""
    parts = inertial_motion(n, shape, w)
    bodies = total(
        inner(V, momentum(body, V)) for body, V in zip(n.rigid, parts.twists, strict=True)
    )
    return 0.5 * add(bodies, total(mul(i, mul(rate, rate)) for i, rate in parts.turns))


def potential_energy(now: RobotContext) -> Lane:
    """The energy of the centres of mass on the slope."""
    n = now.n
    poses, energy = now.bodies(), 0.0
    for body, (origin, e) in zip(n.bodies, poses, strict=True):
        moment = rotate(body.moment, e)
        fall = dot(n.downhill, origin)
        energy = sub(energy, add(mul(body.mass, fall), dot(n.downhill, moment)))
    for i, fork in zip(n.layout.caster_wheels, n.forks, strict=True):
        _, e = poses[n.wheels[i].body]
        moment = rotate(fork.moment, rotate(now.shape.wheels[i], e))
        energy = sub(energy, dot(n.downhill, moment))
    return energy


def as_state(q: Sequence[Lane], v: Sequence[Lane], x: Sequence[Lane], dtype: Any) -> State:
    """Lanes as arrays."""
    return State(
        stack_lanes(q, dtype), stack_lanes(v, dtype), stack_lanes(x, dtype) if len(x) else None
    )
