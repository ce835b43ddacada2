"""The fidelity "constrained": a multibody model of all parts, with wheels as constraints.

It uses only the multibody dynamics and the constraints of rbjax, so it validates the reduced
fidelities of `rolling`. Its multipliers are the forces of the ground on the wheels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import choice, instance
from rbjax.constraints import Formulation
from rbjax.constraints.equations.constrained_motion import constrained_motion
from rbjax.constraints.equations.projection import project_state
from rbjax.lanes import Lane, add, mul, sub
from rbjax.model import Model, State
from rbjax.wheeled.kinematics.context import RobotContext, coordinate_rates, steering_rates
from rbjax.wheeled.kinematics.parameters import indices, stack_lanes
from rbjax.wheeled.kinematics.planar import Pair, direction, rotate, rotate_back
from rbjax.wheeled.kinematics.velocities import drive_speeds
from rbjax.wheeled.models.forces import shaft_torques, wheel_loads
from rbjax.wheeled.models.robot_model import RobotModel, check_state_and_controls
from rbjax.wheeled.multibody.full_model import (
    BASES,
    contact_ways,
    knuckle_joint,
    model_of,
    wheel_joint,
)
from rbjax.wheeled.multibody.wheel_rows import linked


class Constrained(RobotModel):
    """The multibody model of all parts, whose wheels are constraints. v = w, the full velocities.

        M a + b = tau + G^T l,   G a = -(G' v + ...)

    `full_velocities` and `project` project the velocities on the constraints, by the smallest
    change in the norm of the mass matrix.

    Fields:
        robot: `Robot`.
        formulation: static, one of `rbjax.constraints.formulations`.

    Raises:
        InputError: a wheel without inertia about its axle, a caster without yaw_inertia.

    Source: Masarati, *Multibody System Dynamics*, ch. 7; Olguín Díaz, *3D Motion of Rigid Bodies*,
    ch. 8.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.wheeled.models.constrained import Constrained
        >>> cart = Constrained(rb.wheeled.kinds()["differential_drive"].make())
        >>> cart.nv
        6
    """

    formulation: Formulation = eqx.field(static=True, default=Formulation())
    name: ClassVar[str] = "constrained"

    def __check_init__(self) -> None:
        public = "one of rbjax.constraints.formulations(), such as Formulation()"
        instance("Constrained", "formulation", self.formulation, Formulation, public)

    @property
    def nv(self) -> int:
        return self.robot.layout.nw

    def full_velocities(self, context: RobotContext) -> list[Lane]:
        model, state = full_state(context, context.v)
        return robot_velocities(context, model, project_state(model, 0.0, state, positions=False).v)

    def project(self, context: RobotContext) -> list[Lane]:
        return self.full_velocities(context)

    def start_velocities(self, context: RobotContext, w: list[Lane]) -> list[Lane]:
        return list(w)

    def accelerations(self, context: RobotContext) -> list[Lane]:
        w = self.full_velocities(context)
        model, state = full_state(context, w)
        tau = torques(context, model, w)
        a = robot_velocities(context, model, self.formulation(model, 0.0, state, tau, {}))
        # (R V)' = R (V' + w x V)
        a[0], a[1] = add(a[0], mul(w[2], w[1])), sub(a[1], mul(w[2], w[0]))
        return a

    def wheel_forces(self, context: RobotContext) -> tuple[list[Lane], list[Pair]]:
        forces = zip(self.axle_forces(context), context.shape.wheels, strict=True)
        return wheel_loads(context.n), [rotate(f, e) for f, e in forces]

    def axle_forces(self, context: RobotContext) -> list[Pair]:
        """Compute the force of the ground on each wheel, ahead and to the left of the wheel, N.

        The constraint rows of wheels on one axle are redundant; the forces are the ones of least
        norm (`rbjax.constraints.multipliers`). If several wheels share a shaft, only the first one
        has a rolling constraint and has their whole force ahead. The lateral force on skidding
        wheels is `skidding_force`.
        """
        n = context.n
        out, l, at = [], self._multipliers(context), 0
        for i in range(len(n.wheels)):
            ways = contact_ways(n, i)
            force = dict(zip(ways, [l[at + k] for k in range(len(ways))], strict=True))
            at += len(ways)
            if "roller" in force:
                c, s = direction(n.lane(n.robot.wheels[i].roller))
                force = {"ahead": mul(c, force["roller"]), "left": mul(s, force["roller"])}
            out.append((force.get("ahead", 0.0), force.get("left", 0.0)))
        return out

    def skidding_force(self, context: RobotContext) -> Lane:
        """Compute the lateral force on the turning axis of skidding wheels, N, positive to the
        left. It is 0 if no wheel skids."""
        n = context.n
        if not any(leader.what == "skidding" for leader in n.robot.arrangement.leaders):
            return 0.0
        return self._multipliers(context)[
            sum(len(contact_ways(n, i)) for i in range(len(n.wheels)))
        ]

    def _multipliers(self, context: RobotContext) -> jax.Array:
        w = self.full_velocities(context)
        model, state = full_state(context, w)
        return constrained_motion(model, 0.0, state, torques(context, model, w), {})[1]


def full_state(context: RobotContext, w: Sequence[Lane]) -> tuple[Model, State]:
    """Make the multibody model at the current steering rates, and its state at full velocities
    w."""
    n = context.n
    layout, rates = n.layout, coordinate_rates(context, w)
    steering = steering_rates(context)
    model = model_of(n, steering_rates=steering)
    names = {f"hitch_{k}": at for k, at in enumerate(indices(layout.trailers), start=1)}
    names |= {f"steering_{j}": at for j, at in enumerate(indices(layout.steerings))}
    names |= {
        f"caster_{i}": at
        for i, at in zip(layout.caster_wheels, indices(layout.casters), strict=True)
    }
    names |= {wheel_joint(i): layout.shafts.start + x.shaft for i, x in enumerate(n.wheels)}
    q, v = (
        {name: context.q[at] for name, at in names.items()},
        {k: rates[at] for k, at in names.items()},
    )
    for i, wheel in enumerate(n.wheels):
        if wheel.kind == "steered":
            name, j = knuckle_joint(n, i)
            if name not in q:
                slope, _, q[name] = linked(n, j, i, context.q[layout.steerings.start + j])
                v[name] = mul(slope, steering[j])
    angles, speeds = (drive_speeds(n, x[layout.shafts]) for x in (context.q, rates))
    for j in range(len(n.robot.drives)):
        q[f"motor_{j}"], v[f"motor_{j}"] = angles[j], speeds[j]
    others = model.joint_names[1:]
    return model, State(
        stack_lanes([*context.q[:3], *(q[name] for name in others)], n.dtype),
        stack_lanes([*rates[:3], *(v[name] for name in others)], n.dtype),
    )


def full_model_state(
    model: RobotModel, state: State, ctrl: Any = None, base: str = "planar"
) -> State:
    """Convert a state of a robot to a state of its multibody model, `full_model(robot, base)`.

    Args:
        model: `at(robot, fidelity)`.
        state: q (nq,), v (nv,).
        ctrl: (nu,); only the controls of steerings matter, which determine the steering rates.
            Zeros if None.
        base: "planar", "free" or "slides".

    Returns:
        `State` of the multibody model. A free base is at the height at which its wheels just touch.

    Raises:
        InputError: wrong types or shapes, values that are not finite.
        UnknownName: no such base.

    Example:
        >>> import rbjax as rb
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "reduced")
        >>> state = wheeled.start(cart, twist=[0.4, 0.0, 0.0])
        >>> full = wheeled.full_model_state(cart, state, base="free")
        >>> full.q.shape, [round(x, 3) for x in full.v[6:8].tolist()]
        ((11,), [5.0, 5.0])
    """
    choice("base", base, BASES)
    state, u = check_state_and_controls("full_model_state", model, state, ctrl)
    context = model.context(state, u)
    n = context.n
    full = full_state(context, model.full_velocities(context))[1]
    if base != "free":
        return full
    turn = direction(0.5 * full.q[2])
    pose = [full.q[0], full.q[1], 0.0, turn[0], 0.0, 0.0, turn[1]]
    twist = [full.v[0], full.v[1], 0.0, 0.0, 0.0, full.v[2]]
    return State(
        jnp.concatenate([stack_lanes(pose, n.dtype), full.q[3:]]),
        jnp.concatenate([stack_lanes(twist, n.dtype), full.v[3:]]),
    )


def robot_velocities(context: RobotContext, model: Model, v: Any) -> list[Lane]:
    """Convert velocities of the multibody model to full velocities of the robot."""
    n = context.n
    trailers = [f"hitch_{k}" for k in range(1, len(n.bodies))]
    axles = [wheel_joint(i) for i in n.layout.setters]
    own = [v[model.v_slice(name).start] for name in (*trailers, *axles)]
    return [*rotate_back((v[0], v[1]), context.pose), v[2], *own]


def torques(context: RobotContext, model: Model, w: Sequence[Lane]) -> jax.Array:
    """Compute the generalized forces (nv,) of drives and of rolling resistance."""
    n = context.n
    out: list[Lane] = [0.0] * model.nv
    for i, torque in zip(n.layout.setters, shaft_torques(context, w), strict=True):
        out[model.v_slice(wheel_joint(i)).start] = torque
    return stack_lanes(out, n.dtype)
