"""The fidelity "slipping": contacts obey a tyre law, and all velocities are free.

    M w' = f + sum J_i^T N_i mu_i(slip of wheel i),     shafts: - r N mu along the wheel

A wheel with rollers transmits only the force along the roller axes. A caster, which swivels
without resistance, transmits only the force along the wheel. A negative load means that the wheel
would lift. It then transmits no force, and the loads of the others are too large.

The slip of a light wheel decays at about (N C / v) (1 / m + r^2 / I), with the slope C of the law
and the speed v, or `smooth_speed` near rest. An explicit step must be shorter than two of these
time constants. "linearly_implicit_euler" of `rollout` has no such limit: it treats contacts as
linear dampers at the end of the step, with the secants of the tyre laws.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.lanes import Lane, add, mul, neg, sub
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import WheelParameters, with_lanes
from rbjax.wheeled.kinematics.planar import Pair, Twist, cross, rotate
from rbjax.wheeled.kinematics.velocities import contact_velocity, twists_of
from rbjax.wheeled.models.equations import (
    Damper,
    ProjectedEquations,
    columns_of,
    gravity_wrenches,
    projected_equations,
)
from rbjax.wheeled.models.forces import motor_dampers, shaft_torques, wheel_loads
from rbjax.wheeled.models.robot_model import RobotModel
from rbjax.wheeled.models.rolling import identity
from rbjax.wheeled.tyres.laws import Fiala
from rbjax.wheeled.tyres.tyre import Tyre


class Slipping(RobotModel):
    """A robot whose wheels slip. v = w, all full velocities; x, the states of tyres that relax.

    Fields:
        robot: `Robot`.
        tyre: the tyre law of all wheels, or a tuple with one law for each wheel.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["omni_3"].make()
        >>> vehicle = rb.wheeled.at(robot, "slipping", tyre=rb.wheeled.Fiala(20.0, 0.8))
        >>> vehicle.nv, vehicle.nx
        (6, 0)
    """

    name: ClassVar[str] = "slipping"
    tyre: Any = None

    def __post_init__(self) -> None:
        if self.tyre is None:
            self.tyre = Fiala(jnp.asarray(20.0), jnp.asarray(0.9))

    def __check_init__(self) -> None:
        tyres = self.tyre if isinstance(self.tyre, tuple) else (self.tyre,)
        if not all(isinstance(x, Tyre) or _relaxes(x) for x in tyres):
            raise InputError(
                f"Slipping: tyre is {type(self.tyre).__name__}, expected a law of tyres, such as "
                "rbjax.wheeled.Fiala(20.0, 0.9), or a tuple of one for each wheel"
            )
        if isinstance(self.tyre, tuple) and len(self.tyre) != len(self.robot.wheels):
            raise InputError(
                f"Slipping: got {len(self.tyre)} tyres, expected one for each of the "
                f"{len(self.robot.wheels)} wheels"
            )
        for i, (wheel, tyre) in enumerate(zip(self.robot.wheels, self.tyres, strict=True)):
            if wheel.kind in ("rollers", "caster") and _relaxes(tyre):
                raise InputError(
                    f"Slipping: the tyre of wheels[{i}], which has {wheel.kind}, relaxes; expected "
                    "a law without states there"
                )
            known = not isinstance(wheel.inertia, jax.core.Tracer)
            if known and not float(wheel.inertia) > 0 and wheel.shaft is None:
                raise InputError(
                    f"Slipping: wheels[{i}].inertia is {float(wheel.inertia)}, expected a number "
                    "above zero: a wheel that slips turns by its own inertia"
                )

    @property
    def tyres(self) -> tuple[Any, ...]:
        """The tyre law of each wheel."""
        if isinstance(self.tyre, tuple):
            return self.tyre
        return (self.tyre,) * len(self.robot.wheels)

    @property
    def nv(self) -> int:
        return self.robot.layout.nw

    @property
    def nx(self) -> int:
        return sum(tyre.size for tyre in self.tyres)

    def full_velocities(self, context: RobotContext) -> list[Lane]:
        return context.v

    def start_velocities(self, context: RobotContext, w: list[Lane]) -> list[Lane]:
        return w

    def contacts(self, context: RobotContext) -> tuple[list[Pair], list[Lane]]:
        """Compute the traction of each wheel and the rates of the tyre states.

        The traction is the force per newton of load, along the wheel's heading and to its left.
        """
        n, used = context.n, 0
        out, states = [], []
        for wheel, law, (along, across, roll) in zip(
            n.wheels, self.tyres, _contact_velocities(context, context.v), strict=True
        ):
            tyre = with_lanes(law, n.dtype)
            slides = _sliding(wheel, along, across, roll)
            if wheel.kind == "caster":
                out.append((_traction(tyre, slides[0], roll), 0.0))
            elif wheel.kind == "rollers":
                pull, c = _traction(tyre, slides[0], roll), _cosine(wheel)
                out.append((mul(pull, c), mul(pull, mul(c, wheel.slant))))
            else:
                z = context.x[used : used + tyre.size]
                used += tyre.size
                pull, rate = tyre.response(along, across, roll, z)
                out.append(pull)
                states.extend(rate)
        return out, states

    def wheel_forces(self, context: RobotContext) -> tuple[list[Lane], list[Pair]]:
        pulls, _ = self.contacts(context)
        pulls = [rotate(pull, e) for pull, e in zip(pulls, context.shape.wheels, strict=True)]
        loads = wheel_loads(context.n, pulls)
        return loads, [
            (mul(load, x), mul(load, y))
            for load, (x, y) in zip(_on_the_ground(loads), pulls, strict=True)
        ]

    def accelerations(self, context: RobotContext) -> list[Lane]:
        return self._equations(context)[0].accelerations

    def damped_accelerations(self, context: RobotContext, h: Lane) -> list[Lane]:
        equations, loads = self._equations(context)
        dampers = self._contact_dampers(context, loads, h) + motor_dampers(context, context.v)
        return equations.damped(dampers, h)

    def _equations(self, context: RobotContext) -> tuple[ProjectedEquations, list[Lane]]:
        """Compute the equations of motion, and the loads of wheels."""
        n = context.n
        loads, forces = self.wheel_forces(context)
        wrenches = gravity_wrenches(context)
        torques = shaft_torques(context, context.v, _on_the_ground(loads))
        for wheel, e, force in zip(n.wheels, context.shape.wheels, forces, strict=True):
            moment = cross(wheel.position, force)
            wrenches[wheel.body] = wrenches[wheel.body] + Twist(*force, moment)
            braking = neg(mul(wheel.radius, add(mul(force[0], e[0]), mul(force[1], e[1]))))
            torques[wheel.shaft] = add(torques[wheel.shaft], braking)
        return projected_equations(
            context, context.v, identity, context.v, torques, wrenches
        ), loads

    def _contact_dampers(
        self, context: RobotContext, loads: Sequence[Lane], h: Lane
    ) -> list[Damper]:
        """Compute the linear dampers on the sliding velocities of contacts."""
        n = context.n

        def sliding(w: Sequence[Lane]) -> list[tuple[Lane, ...]]:
            velocities = _contact_velocities(context, w)
            return [_sliding(wheel, *u) for wheel, u in zip(n.wheels, velocities, strict=True)]

        columns = [sliding(unit) for unit in columns_of(n, context.shape, identity, self.nv)]
        rates = n.shaft_rates(context.v)
        out: list[Damper] = []
        pressed = _on_the_ground(loads)
        for i, slides in enumerate(sliding(context.v)):
            wheel = n.wheels[i]
            roll, across = mul(wheel.radius, rates[wheel.shaft]), (*slides, 0.0)[1]
            found = with_lanes(self.tyres[i], n.dtype).damping(slides[0], across, roll, h)
            for k in range(len(slides)):
                out.append((mul(pressed[i], found[k]), [column[i][k] for column in columns]))
        return out

    def tyre_rates(self, context: RobotContext) -> list[Lane]:
        return self.contacts(context)[1] if self.nx else []


def _on_the_ground(loads: Sequence[Lane]) -> list[Lane]:
    """Return the loads of wheels, with zero for one that would lift."""
    return [jnp.maximum(load, 0.0) for load in loads]


def _contact_velocities(context: RobotContext, w: Sequence[Lane]) -> list[tuple[Lane, Lane, Lane]]:
    """Compute, for each wheel, the velocity of its centre along and across it, and r phi', m/s."""
    n = context.n
    twists, rates = twists_of(n, context.shape, w), n.shaft_rates(w)
    return [
        (*contact_velocity(n, context.shape, twists, i), mul(wheel.radius, rates[wheel.shaft]))
        for i, wheel in enumerate(n.wheels)
    ]


def _sliding(wheel: WheelParameters, along: Lane, across: Lane, roll: Lane) -> tuple[Lane, ...]:
    """Compute the sliding velocity of a contact in the directions in which it transmits a force.
    These are along and across a plain wheel, along a caster, and along the axes of rollers."""
    along = sub(along, roll)
    if wheel.kind == "caster":
        return (along,)
    if wheel.kind == "rollers":
        # along e . a + across n . a, a the axis of the rollers
        return (mul(_cosine(wheel), add(along, mul(wheel.slant, across))),)
    return along, across


def _cosine(wheel: WheelParameters) -> Lane:
    """Compute the cosine of the angle between the roller axes and the heading."""
    return (1.0 + wheel.slant * wheel.slant) ** -0.5


def _traction(tyre: Any, slides: Lane, roll: Lane) -> Lane:
    """Compute the traction of a tyre law along one axis, from the sliding speed along it."""
    return tyre.traction(slides / tyre.reference_speed(roll), 0.0)[0]


def _relaxes(tyre: Any) -> bool:
    return getattr(tyre, "size", 0) > 0
