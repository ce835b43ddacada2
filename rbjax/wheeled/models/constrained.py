"""The fidelity of all bodies and all wheels' rows: nothing is reduced, multipliers are solved for.

    M a + b = tau + G^T l,     G a = -(...),     of `full_model`
It uses only the multibody dynamics and the constraints of this package, so it checks the
reduced fidelities (`rolling`), and its multipliers are the forces of the ground on the wheels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.constraints import Formulation
from rbjax.constraints.equations.constrained_motion import constrained_motion
from rbjax.constraints.equations.projection import project_state
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError, UnknownName
from rbjax.lanes import Lane, add, mul, sub
from rbjax.model import Model, State
from rbjax.wheeled.kinematics.context import RobotContext, coordinate_rates, steering_rates
from rbjax.wheeled.kinematics.parameters import indices, stack_lanes
from rbjax.wheeled.kinematics.planar import Pair, direction, rotate_back
from rbjax.wheeled.kinematics.velocities import shaft_speed
from rbjax.wheeled.models.robot_model import RobotModel, torques_at_rest_loads
from rbjax.wheeled.models.states import check_state, check_vehicle
from rbjax.wheeled.multibody.full_model import (
    BASES,
    contact_ways,
    knuckle_joint,
    model_of,
    wheel_joint,
)
from rbjax.wheeled.multibody.wheel_rows import linked


class Constrained(RobotModel):
    """A multibody model of all parts, its wheels held by rows: v = w, the full velocities.

        M a + b = tau + G^T l,   G a = -(G' v + ...)

    Rates are taken where the velocities obey the rows: `full` puts them there by the least change
    in the norm of the mass matrix, and `project` does so to the state after a step.

    Fields: robot. Static: formulation, one of `rbjax.constraints.formulations`.

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
        if not isinstance(self.formulation, Formulation):
            raise InputError(
                f"Constrained: formulation is {type(self.formulation).__name__}, expected one of "
                "rbjax.constraints.formulations(), such as Formulation()"
            )

    @property
    def nv(self) -> int:
        return self.robot.layout.nw

    def full_velocities(self, now: RobotContext) -> list[Lane]:
        model, state = full_state(now, now.v)
        return robot_velocities(now, model, project_state(model, 0.0, state, positions=False).v)

    def project(self, now: RobotContext) -> list[Lane]:
        """v put on the rows, after a step."""
        return self.full_velocities(now)

    def start_velocities(self, now: RobotContext, w: list[Lane]) -> list[Lane]:
        return list(w)

    def accelerations(self, now: RobotContext) -> list[Lane]:
        w = self.full_velocities(now)
        model, state = full_state(now, w)
        tau = torques(now, model, w)
        a = robot_velocities(now, model, self.formulation(model, 0.0, state, tau, {}))
        # (R V)' = R (V' + w x V)
        a[0], a[1] = add(a[0], mul(w[2], w[1])), sub(a[1], mul(w[2], w[0]))
        return a

    def wheel_forces(self, now: RobotContext) -> list[Pair]:
        """The force of the ground on each wheel, ahead and to the left of it, in N.

        Rows of wheels on one axle are redundant: of all forces that do, those of the least norm, in
        the measure of `rbjax.constraints.multipliers`. Of wheels on one shaft the first rolls, and
        has their force. What keeps skidding wheels on their axis is `skidding_force`.
        """
        n = now.n
        out, l, at = [], self._multipliers(now), 0
        for i in range(len(n.wheels)):
            ways = contact_ways(n, i)
            force = dict(zip(ways, [l[at + k] for k in range(len(ways))], strict=True))
            at += len(ways)
            if "roller" in force:
                c, s = direction(n.lane(n.robot.wheels[i].roller))
                force = {"ahead": mul(c, force["roller"]), "left": mul(s, force["roller"])}
            out.append((force.get("ahead", 0.0), force.get("left", 0.0)))
        return out

    def skidding_force(self, now: RobotContext) -> Lane:
        """The force to the left on the axis on which skidding wheels turn, N; 0 if none skids."""
        n = now.n
        if not any(leader.what == "skidding" for leader in n.robot.arrangement.leaders):
            return 0.0
        return self._multipliers(now)[sum(len(contact_ways(n, i)) for i in range(len(n.wheels)))]

    def _multipliers(self, now: RobotContext) -> jax.Array:
        w = self.full_velocities(now)
        model, state = full_state(now, w)
        return constrained_motion(model, 0.0, state, torques(now, model, w), {})[1]


def full_state(now: RobotContext, w: Sequence[Lane]) -> tuple[Model, State]:
    """The multibody model, its steerings turning as they do now, and its state at velocities w."""
    n = now.n
    layout, rates = n.layout, coordinate_rates(now, w)
    steering = steering_rates(now)
    model = model_of(n, steering_rates=steering)
    names = {f"hitch_{k}": at for k, at in enumerate(indices(layout.trailers), start=1)}
    names |= {f"steering_{j}": at for j, at in enumerate(indices(layout.steerings))}
    names |= {
        f"caster_{i}": at
        for i, at in zip(layout.caster_wheels, indices(layout.casters), strict=True)
    }
    names |= {wheel_joint(i): layout.shafts.start + x.shaft for i, x in enumerate(n.wheels)}
    q, v = (
        {name: now.q[at] for name, at in names.items()},
        {k: rates[at] for k, at in names.items()},
    )
    for i, wheel in enumerate(n.wheels):
        if wheel.kind == "steered":
            name, j = knuckle_joint(n, i)
            if name not in q:
                slope, _, q[name] = linked(n, j, i, now.q[layout.steerings.start + j])
                v[name] = mul(slope, steering[j])
    shafts = slice(layout.shafts.start, layout.shafts.stop)
    for j, (drive, split) in enumerate(zip(n.robot.drives, n.splits, strict=True)):
        turned_by = [shaft_speed(n, drive.wheels, split, x[shafts]) for x in (now.q, rates)]
        q[f"motor_{j}"], v[f"motor_{j}"] = turned_by
    others = model.joint_names[1:]
    return model, State(
        stack_lanes([*now.q[:3], *(q[name] for name in others)], n.dtype),
        stack_lanes([*rates[:3], *(v[name] for name in others)], n.dtype),
    )


def full_model_state(
    vehicle: RobotModel, state: State, controls: Any = None, base: str = "planar"
) -> State:
    """The state of `full_model(robot, base)` in which a vehicle moves as it does.

    Args:
        vehicle: `at(robot, fidelity)`.
        state: q (nq,), v (nv,).
        controls: (nu,); those of steerings say how fast these turn. None: zeros.
        base: "planar", "free" or "slides".

    Returns:
        `State` of the multibody model; of a free base at the height at which its wheels just touch.

    Raises:
        InputError: wrong types or shapes, values that are not finite. UnknownName: no such base.

    Example:
        >>> import rbjax as rb
        >>> from rbjax import wheeled
        >>> cart = wheeled.at(wheeled.kinds()["differential_drive"].make(), "kinematical")
        >>> state = wheeled.start(cart, twist=[0.4, 0.0, 0.0])
        >>> full = wheeled.full_model_state(cart, state, base="free")
        >>> full.q.shape, [round(x, 3) for x in full.v[6:8].tolist()]
        ((11,), [5.0, 5.0])
    """
    check_vehicle("full_model_state", vehicle)
    if base not in BASES:
        raise UnknownName("base", base, BASES)
    state = check_state("full_model_state", vehicle, state)
    given = jnp.zeros(vehicle.nu) if controls is None else controls
    u = check_array("full_model_state", "controls", given, (vehicle.nu,)).astype(state.q.dtype)
    now = vehicle.context(state, u)
    n = now.n
    full = full_state(now, vehicle.full_velocities(now))[1]
    if base != "free":
        return full
    turn = direction(0.5 * full.q[2])
    pose = [full.q[0], full.q[1], 0.0, turn[0], 0.0, 0.0, turn[1]]
    twist = [full.v[0], full.v[1], 0.0, 0.0, 0.0, full.v[2]]
    return State(
        jnp.concatenate([stack_lanes(pose, n.dtype), full.q[3:]]),
        jnp.concatenate([stack_lanes(twist, n.dtype), full.v[3:]]),
    )


def robot_velocities(now: RobotContext, model: Model, v: Any) -> list[Lane]:
    """Those of the robot, of velocities of the multibody model: the chassis' in its own axes."""
    n = now.n
    trailers = [f"hitch_{k}" for k in range(1, len(n.bodies))]
    axles = [wheel_joint(i) for i in n.layout.setters]
    own = [v[model.v_slice(name).start] for name in (*trailers, *axles)]
    return [*rotate_back((v[0], v[1]), now.pose), v[2], *own]


def torques(now: RobotContext, model: Model, w: Sequence[Lane]) -> jax.Array:
    """Generalized forces (nv,) of drives and of rolling resistance, at the axles of shafts."""
    n = now.n
    out: list[Lane] = [0.0] * model.nv
    for i, torque in zip(n.layout.setters, torques_at_rest_loads(now, w), strict=True):
        out[model.v_slice(wheel_joint(i)).start] = torque
    return stack_lanes(out, n.dtype)
