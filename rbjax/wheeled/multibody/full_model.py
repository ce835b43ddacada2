"""The multibody model of a wheeled robot: each wheel, knuckle, fork and trailer is a body.

    chassis          "base": planar (x, y, heading), or free
    trailer k        "hitch_k": a vertical hinge at the coupling
    steering j       of one wheel: "steering_j", the vertical hinge of its knuckle;
                     of several: "steering_j", a column, and "knuckle_i" of each wheel
    caster i         "caster_i": the vertical hinge of its fork
    wheel i          "wheel_i": its axle
    differential j   "motor_j": the shaft of a motor that has inertia

The first wheel of a shaft rolls; the others on that shaft turn with it. The rows of all wheels on
one axle are present, so rows may be redundant.

A wheel is a body of its mass, at its centre, with yaw_inertia about all axes across the axle. Its
inertia about the axle is that of the body up to 2 yaw_inertia, the largest of a rigid body; the
rest is armature of its joint. The fork of a caster has the mass and yaw_inertia, and the joint of
its wheel the inertia as armature. A chassis or trailer has its inertia about all three axes.
Steering columns and knuckles have an armature of 1 kg m^2, which has no effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, instance
from rbjax.constraints import Constraint, Gear, KnifeEdge, Place
from rbjax.errors import InputError
from rbjax.lanes import Lane, add, is_literal, is_zero, mul, neg, sub, total
from rbjax.model import WORLD, Model
from rbjax.wheeled.kinematics.parameters import Parameters, parameters_of
from rbjax.wheeled.kinematics.planar import direction, inverse
from rbjax.wheeled.kinematics.velocities import place_of
from rbjax.wheeled.multibody.tree import LEFT, STRAIGHT, BodyTree
from rbjax.wheeled.multibody.wheel_rows import Differential, Linkage, SteeringRate, WheelContact
from rbjax.wheeled.robot.arrangement import Leader
from rbjax.wheeled.robot.robot import Robot

BASES = ("planar", "free", "slides")
#: armature of joints whose motion is prescribed, kg m^2
PRESCRIBED = 1.0


def full_model(robot: Robot, base: str = "planar") -> Model:
    """Make the multibody model of a wheeled robot, with the constraints of its wheels.

    Args:
        robot: `Robot`.
        base: "planar": the chassis moves in the ground's plane. "free": it moves in space, and the
            heights of all wheels are constraints too, whose multipliers are the loads. "slides": as
            "planar", by two slides and a hinge, which MJCF supports.

    Returns:
        A `Model` in the robot's dtype. Its controls are torques in N m, one for each driven shaft,
        named after the first wheel of the shaft. Its steerings move at the rates of `SteeringRate`.
        It has no motors, damping of axles or rolling resistance.

    Raises:
        UnknownName: no such base.
        InputError: a wheel or caster without inertia.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.wheeled.multibody.full_model import full_model
        >>> model = full_model(rb.wheeled.kinds()["differential_drive"].make())
        >>> model.joint_names
        ('base', 'wheel_0', 'wheel_1', 'caster_2', 'wheel_2')
        >>> [type(row).__name__ for row in model.constraints]
        ['WheelContact', 'WheelContact', 'WheelContact']
    """
    instance("full_model", "robot", robot, Robot, "rb.wheeled.Robot")
    dtype = jnp.result_type(*jax.tree.leaves(eqx.filter(robot, eqx.is_inexact_array)))
    model = jax.tree.map(jnp.asarray, model_of(parameters_of(robot, dtype), base))
    return model.astype(dtype)


def model_of(n: Parameters, base: str = "planar", steering_rates: Sequence[Lane] = ()) -> Model:
    """Make the full model from lanes, which keeps structural zeros."""
    choice("base", base, BASES)
    tree = BodyTree(n.dtype)
    chassis = _branch(n, tree, base)
    for j in range(len(n.robot.drives)):
        inertia = _rotor(n, j)
        if not is_zero(inertia):
            rotor = tree.body(f"motor_{j}", chassis)
            tree.joint(f"motor_{j}", "hinge", rotor, LEFT, armature=inertia)
    model = tree.model((*n.downhill, neg(n.gravity)), _motors(n))
    return model.with_constraints(*_rows(n, base, steering_rates))


def wheel_joint(i: int) -> str:
    """Return the name of the joint of a wheel's axle."""
    return f"wheel_{i}"


def knuckle_joint(n: Parameters, i: int) -> tuple[str, int]:
    """Return the name of the hinge of a steered wheel, and the index of its steering."""
    j = next(j for j, s in enumerate(n.robot.steerings) if i in s.wheels)
    return (f"knuckle_{i}" if len(n.robot.steerings[j].wheels) > 1 else f"steering_{j}"), j


def _branch(n: Parameters, tree: BodyTree, base: str, k: int = 0, parent: int = WORLD) -> int:
    """Add a body, its wheels, and the trailers behind it, in depth-first order as in MuJoCo."""
    out = _body(n, tree, base, k, parent)
    for j, steering in enumerate(n.robot.steerings if k == 0 else ()):
        if len(steering.wheels) > 1:
            x, y = place_of(n, Leader("steering", j))
            tree.joint(f"steering_{j}", "hinge", tree.body(f"steering_{j}", out, (x, y, 0.0)),
                       armature=PRESCRIBED)  # fmt: skip
    for i, wheel in enumerate(n.wheels):
        if wheel.body == k:
            _wheel(n, tree, out, i)
    for behind, numbers in enumerate(n.bodies):
        if numbers.ahead == k:
            _branch(n, tree, base, behind, out)
    return out


def _own_height(n: Parameters, k: int) -> Lane:
    """Compute the height of the centre of mass of a body without its wheels."""
    own, whole = n.lane(n.robot.bodies[k].mass), n.bodies[k]
    if is_zero(own):
        return whole.height
    of_wheels = total(
        mul(n.lane(given.mass), wheel.radius)
        for given, wheel in zip(n.robot.wheels, n.wheels, strict=True)
        if wheel.body == k
    )
    return mul(sub(mul(whole.mass, whole.height), of_wheels), inverse(own))


def _body(n: Parameters, tree: BodyTree, base: str, k: int, parent: int) -> int:
    """Add the chassis, or a trailer."""
    body, numbers = n.robot.bodies[k], n.bodies[k]
    at: Sequence[Lane] = (0.0, 0.0, 0.0)
    if k:
        at = sub(numbers.hitch[0], numbers.drawbar), numbers.hitch[1], 0.0
    com, moments = [n.lane(x) for x in body.com], [n.lane(body.inertia)] * 3
    name = f"trailer_{k}" if k else "chassis"
    place = (*com, _own_height(n, k))
    out = tree.body(name, parent, at, STRAIGHT, n.lane(body.mass), place, moments)
    if k:
        tree.joint(f"hitch_{k}", "hinge", out, placement=(numbers.drawbar, 0.0, 0.0))
    elif base == "slides":
        tree.joint("base_x", "slide", out, (1.0, 0.0, 0.0))
        tree.joint("base_y", "slide", out, (0.0, 1.0, 0.0))
        tree.joint("base_turn", "hinge", out)
    else:
        tree.joint("base", base, out)
    return out


def _wheel(n: Parameters, tree: BodyTree, body: int, i: int) -> None:
    """Add a wheel, with its knuckle or fork."""
    given, wheel = n.robot.wheels[i], n.wheels[i]
    mass, yaw, spin = n.lane(given.mass), wheel.yaw_inertia, wheel.inertia
    (x, y), turn = wheel.position, _turned(n.lane(given.heading))
    armature = _geared(n, i)
    if wheel.kind == "caster":
        behind = n.lane(given.behind)
        own = sub(yaw, mul(mass, mul(behind, behind)))
        fork = tree.body(f"fork_{i}", body, (x, y, 0.0), STRAIGHT, mass,
                         (neg(behind), 0.0, wheel.radius), (own, own, own))  # fmt: skip
        _needs_inertia(f"wheels[{i}].yaw_inertia, less mass * behind^2,", own)
        tree.joint(f"caster_{i}", "hinge", fork)
        hub = tree.body(f"wheel_{i}", fork, (neg(wheel.trail), 0.0, wheel.radius))
        armature = add(armature, spin)
    else:
        held, at, turn_here = body, (x, y, wheel.radius), turn
        if wheel.kind == "steered":
            name, _ = knuckle_joint(n, i)
            held = tree.body(f"knuckle_{i}", held, (x, y, 0.0), turn)
            tree.joint(name, "hinge", held, armature=PRESCRIBED)
            at, turn_here = (0.0, 0.0, wheel.radius), STRAIGHT
        own = _least(spin, mul(2.0, yaw))
        hub = tree.body(f"wheel_{i}", held, at, turn_here, mass, moments=(yaw, own, yaw))
        armature = add(armature, sub(spin, own))
    _needs_inertia(f"wheels[{i}].inertia", add(spin, _geared(n, i)))
    tree.joint(wheel_joint(i), "hinge", hub, LEFT, armature=armature)


def _turned(heading: Lane) -> Sequence[Lane]:
    """Compute the quaternion of a rotation about the vertical by the angle `heading`."""
    c, s = direction(mul(0.5, heading))
    return c, 0.0, 0.0, s


def _least(a: Lane, b: Lane) -> Lane:
    return min(a, b) if is_literal(a) and is_literal(b) else jnp.minimum(a, b)


def _geared(n: Parameters, i: int) -> Lane:
    """Compute the inertia of the motors that drive only wheel i, as seen at its axle, kg m^2."""
    out: Lane = 0.0
    for j, (drive, split) in enumerate(zip(n.robot.drives, n.splits, strict=True)):
        if drive.wheels == (i,):
            out = add(out, mul(n.motors[j].inertia, mul(split[0], split[0])))
    return out


def _rotor(n: Parameters, j: int) -> Lane:
    """Return the inertia of a motor that drives several wheels, or 0 otherwise."""
    drive = n.robot.drives[j]
    return n.motors[j].inertia if len(drive.wheels) > 1 else 0.0


def _motors(n: Parameters) -> list[str]:
    """Return the joint names of the first wheels of driven shafts."""
    shafts = {n.wheels[i].shaft for drive in n.robot.drives for i in drive.wheels}
    return [wheel_joint(n.layout.setters[s]) for s in sorted(shafts)]


def _needs_inertia(what: str, x: Lane) -> None:
    if is_literal(x) and not x > 0:
        raise InputError(
            f"full_model: {what} is {x}, expected above zero, because each body has its own "
            "motion; give it an inertia, or use a reduced fidelity, such as 'reduced'"
        )


def _rows(n: Parameters, base: str, steering_rates: Sequence[Lane]) -> list[Constraint]:
    """Make the constraints of the wheels: first one `WheelContact` for each wheel, then shafts,
    steerings and rotors."""
    origin: Any = np.zeros(3)
    straight: Any = np.array(STRAIGHT)
    ground = Place(origin, straight)
    out: list[Constraint] = []
    for i in range(len(n.wheels)):
        hub = Place(origin, straight, body=f"wheel_{i}")
        given = n.robot.wheels[i]
        ways = contact_ways(n, i)
        out.append(WheelContact(ground, hub, given.radius, given.roller, ways, base == "free"))
    for leader in n.robot.arrangement.leaders:
        if leader.what == "skidding":
            point = jnp.stack([n.robot.turn_center, *jnp.zeros(2)])
            ahead: Any = np.array([0.5**0.5, 0.0, 0.5**0.5, 0.0])  # takes z to x
            out.append(KnifeEdge(ground, Place(point, ahead, body="chassis")))
    for i, shaft in enumerate(n.layout.shaft):
        setter = n.layout.setters[shaft]
        if setter != i:
            out.append(Gear(wheel_joint(i), wheel_joint(setter), jnp.asarray(1.0)))
    rates = steering_rates or [0.0] * len(n.robot.steerings)
    for j, (steering, rate) in enumerate(zip(n.robot.steerings, rates, strict=True)):
        column = f"steering_{j}"
        out.append(SteeringRate(column, rate))
        if len(steering.wheels) > 1:
            for i in steering.wheels:
                out.append(Linkage(n.robot, j, i, knuckle_joint(n, i)[0], column))
    for j, drive in enumerate(n.robot.drives):
        if not is_zero(_rotor(n, j)):
            axles = tuple(map(wheel_joint, drive.wheels))
            out.append(Differential(drive.split, f"motor_{j}", axles))
    return out


def contact_ways(n: Parameters, i: int) -> tuple[str, ...]:
    """Return the directions in which wheel i does not slide: names of `WheelContact.ways`."""
    wheel = n.wheels[i]
    sets = n.layout.setters[wheel.shaft] == i
    if wheel.kind == "rollers":
        return ("roller",) if sets else ()
    skids = wheel.skids and wheel.kind == "fixed"
    return (*(["ahead"] if sets else []), *([] if skids else ["left"]))
