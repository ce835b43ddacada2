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
from rbjax.wheeled.kinematics.context import Context, coordinate_rates
from rbjax.wheeled.kinematics.numbers import Numbers, numbers_of, stacked
from rbjax.wheeled.kinematics.planar import dot, turned
from rbjax.wheeled.kinematics.velocities import Shape, motion, shaft_speed
from rbjax.wheeled.models.equations import Damper, momentum
from rbjax.wheeled.models.loads import resisting_torques, wheel_loads
from rbjax.wheeled.robot.robot import Robot


class Fidelity(Record):
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

    def full(self, n: Numbers, now: Context) -> list[Lane]:
        """The full velocities w."""
        raise NotImplementedError(f"{type(self).__name__} has no method full")

    def accelerations(self, n: Numbers, now: Context) -> list[Lane]:
        """v'."""
        raise NotImplementedError(f"{type(self).__name__} has no method accelerations")

    def damped_accelerations(self, n: Numbers, now: Context, h: Lane) -> list[Lane]:
        """The mean of v' over a step h that takes what damps at its end; v' where nothing does."""
        return self.accelerations(n, now)

    def relaxation(self, n: Numbers, now: Context) -> list[Lane]:
        """x'."""
        return []

    def project(self, n: Numbers, now: Context) -> list[Lane]:
        """v after a step, put back on what it must satisfy."""
        return now.v

    def start_velocities(self, n: Numbers, now: Context, w: list[Lane]) -> list[Lane]:
        """v by full velocities that the fidelity allows."""
        raise NotImplementedError(f"{type(self).__name__} has no method start_velocities")

    # what all share

    def coordinate_rates(self, n: Numbers, now: Context) -> list[Lane]:
        """q'."""
        return coordinate_rates(n, now, self.full(n, now))

    def rates(self, n: Numbers, now: Context) -> tuple[list[Lane], list[Lane], list[Lane]]:
        """q', v', x'."""
        rates = self.coordinate_rates(n, now)
        return rates, self.accelerations(n, now), self.relaxation(n, now)

    def instant(self, state: State, u: Any = None) -> tuple[Numbers, Context]:
        """The robot's numbers and a state as lanes."""
        dtype = state.q.dtype
        given = jnp.zeros(self.nu, dtype) if u is None else u
        x = state.x if self.nx else None
        n = numbers_of(self.robot, dtype)
        return n, Context(
            n,
            [state.q[i] for i in range(self.nq)],
            [state.v[i] for i in range(self.nv)],
            [] if x is None else [x[i] for i in range(self.nx)],
            [given[i] for i in range(self.nu)],
        )


def shaft_torques(n: Numbers, now: Context, w: Sequence[Lane]) -> list[Lane]:
    """The torques of the drives and of damping on each shaft."""
    rates = w[2 + len(n.bodies) :]
    out = [neg(mul(c, rate)) for c, rate in zip(n.damping, rates, strict=True)]
    for j, (drive, split) in enumerate(zip(n.robot.drives, n.splits, strict=True)):
        torque = n.motors[j].torque(now.u[j], shaft_speed(n, drive.wheels, split, rates))
        for i, share in zip(drive.wheels, split, strict=True):
            shaft = n.wheels[i].shaft
            out[shaft] = add(out[shaft], mul(share, torque))
    return out


def motor_dampers(n: Numbers, now: Context, w: Sequence[Lane]) -> list[Damper]:
    """How the torques of drives and of damping oppose the speeds of shafts."""
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


def torques_at_rest_loads(n: Numbers, now: Context, w: Sequence[Lane]) -> list[Lane]:
    """The torques of drives and of rolling resistance on each shaft, with the loads at rest."""
    driving = shaft_torques(n, now, w)
    if n.resistance is None:
        return driving
    resisting = resisting_torques(n, w, wheel_loads(n))
    return [add(a, b) for a, b in zip(driving, resisting, strict=True)]


def kinetic_energy(n: Numbers, shape: Shape, w: Sequence[Lane]) -> Lane:
    """T of all bodies, wheels and motors."""
    parts = motion(n, shape, w)
    bodies = total(
        inner(V, momentum(body, V)) for body, V in zip(n.rigid, parts.twists, strict=True)
    )
    return 0.5 * add(bodies, total(mul(i, mul(rate, rate)) for i, rate in parts.turns))


def potential_energy(n: Numbers, now: Context) -> Lane:
    """The energy of the centres of mass on the slope."""
    poses, energy = now.bodies(), 0.0
    for body, (origin, e) in zip(n.bodies, poses, strict=True):
        moment = turned(body.moment, e)
        fall = dot(n.downhill, origin)
        energy = sub(energy, add(mul(body.mass, fall), dot(n.downhill, moment)))
    for i, fork in zip(n.layout.caster_wheels, n.forks, strict=True):
        _, e = poses[n.wheels[i].body]
        moment = turned(fork.moment, turned(now.shape.wheels[i], e))
        energy = sub(energy, dot(n.downhill, moment))
    return energy


def as_state(q: Sequence[Lane], v: Sequence[Lane], x: Sequence[Lane], dtype: Any) -> State:
    """Lanes as arrays."""
    return State(stacked(q, dtype), stacked(v, dtype), stacked(x, dtype) if len(x) else None)
