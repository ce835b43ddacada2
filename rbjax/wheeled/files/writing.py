"""`write_mjcf`: write a wheeled robot on a plane as an MJCF file.

The bodies and joints are the bodies and joints of `full_model(robot, "free")`, in the same order.
In addition the file has

    wheel i      a shape about its centre that touches only the plane "ground"
    drive j      an actuator with the motor's law, on the axle of its wheel, or on the fixed tendon
                 W = sum split_i phi'_i of a differential
    steering j   a servo of the rate, with the gain k = inertia / steering_time,
                     k (u - b')             without a lag
                     k ((u - b) / lag - b') with one
    linkage      Ackermann's geometry as a polynomial of degree 4
    shafts       wheels on one shaft, and the rotor of a differential, as equalities
    resistance   rolling resistance as friction loss of axles, at the loads at rest, or as rolling
                 friction of contacts, which follows the loads

MuJoCo's contacts are soft. With solref = (T, 1), solimp = d and b = 2 / (d T), a wheel

    sinks by   g (1 - d) T^2 under the weight,
    creeps at  f R / b under a traction f, with R proportional to (1 - d) / impratio,
    slides at  J' v / b, that is speed * turning rate / b across the wheel in a curve, because the
               rows enforce J v' = -b J v.

All three vanish as T -> 0. T is at least twice the timestep. A trailer's hinge transmits pitch and
roll moments; the coupling of `forces` does not.
"""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, instance, real_number
from rbjax.constraints import Gear, JointPolynomial
from rbjax.errors import InputError, UnsupportedFeature
from rbjax.loading.write.draft import Draft, text
from rbjax.loading.write.mjcf import compile_mjcf, make_draft, serialize
from rbjax.model import Model
from rbjax.wheeled.kinematics.parameters import Parameters, parameters_of
from rbjax.wheeled.models.forces import wheel_loads
from rbjax.wheeled.multibody.full_model import full_model, knuckle_joint, wheel_joint
from rbjax.wheeled.multibody.wheel_rows import linked
from rbjax.wheeled.robot.motors import DCMotor, Motor, SpeedServo, TorqueSource
from rbjax.wheeled.robot.robot import Robot

SHAPES = ("ellipsoid", "cylinder", "sphere", "capsule")
RESISTANCES = ("axles", "contacts")
#: MJCF's <option>; the pyramidal cone, MuJoCo's default, creeps more across than along
OPTION = {"integrator": "implicitfast", "cone": "elliptic", "impratio": 10.0}
_DEGREE = 4  # of MJCF's polynomials
_NODES = 33  # number of points of the fit
_HARMLESS = "masses or moments raised"  # of columns and knuckles, which have armature


def write_mjcf(
    robot: Robot,
    path: str | Path | None = None,
    *,
    wheel: str = "ellipsoid",
    width: float = 0.25,
    friction: float = 1.0,
    resistance: str = "axles",
    solref: Sequence[float] = (0.02, 1.0),
    solimp: Sequence[float] = (0.9, 0.95, 0.001),
    steering_range: float = 0.6,
    steering_time: float = 0.01,
    **option: Any,
) -> str:
    """Write a robot on a plane as an MJCF file, for MuJoCo and MJX, with the robot's controls.

    At qpos0 all wheels just touch the plane. `full_model_state` computes the velocities of all
    joints, for the initial state of a motion.

    Args:
        robot: `Robot`, with known values and without rollers.
        path: a file to write to; None only returns the text.
        wheel: "ellipsoid" touches in one point; "cylinder" and "capsule" along a line, by two
            points or more, which scrub as the robot turns; "sphere" in one, even if it leans far.
        width: the width of a wheel divided by its radius.
        friction: the coefficient of sliding friction.
        resistance: how rolling resistance is written: "axles", a friction loss; "contacts", rolling
            friction (condim 6), which MuJoCo's cone reduces under traction.
        solref, solimp: MuJoCo's softness of contacts and of equalities.
        steering_range: the joint limit of a steering with Ackermann's linkage, rad, and the range
            in which the polynomial is fitted. A comment in the file gives the error of the fit.
        steering_time: the time constant of the servos of steerings, s; at least the timestep for
            the explicit integrators "Euler" and "RK4".
        option: attributes of MJCF's <option>, such as timestep, integrator, cone, impratio.

    Returns:
        The text.

    Raises:
        UnsupportedFeature: wheels with rollers; a motor that MJCF does not have.
        UnknownName: no such shape, or no such way of writing the rolling resistance.
        InputError: numbers out of range, or traced; a wheel or caster without inertia.
        ModelError: MuJoCo rejects the file.

    Source: MuJoCo, *Computation*, solver parameters.

    Example:
        >>> import mujoco
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["differential_drive"].make()
        >>> model = mujoco.MjModel.from_xml_string(rb.wheeled.write_mjcf(robot, friction=0.8))
        >>> model.nu, model.nv
        (2, 10)
    """
    choice("way of writing rolling resistance", resistance, RESISTANCES)
    _check(robot, wheel, width=width, friction=friction, steering_range=steering_range,
           steering_time=steering_time)  # fmt: skip
    n = parameters_of(robot, jnp.result_type(float))
    full = full_model(robot, "free")
    rigid = [row for row in full.constraints if isinstance(row, Gear)]
    linkages, error = _linkages(n, float(steering_range))
    draft = make_draft(full.replace(constraints=(*rigid, *linkages)))
    touch = {"solref": text(solref), "solimp": text(solimp), "friction": text(friction)}
    for key, value in (OPTION | option).items():
        draft.option.set(key, text(value))
    rolling = 0.0
    if robot.resistance is not None and resistance == "contacts":
        rolling, touch["condim"] = _own(n.robot.resistance.coefficient), "6"
    _write_ground(draft, n, wheel, float(width), touch, rolling)
    _write_drives(draft, n)
    _write_steerings(draft, n, float(steering_range), float(steering_time))
    _write_resistance(draft, n, resistance == "axles")
    lost = [note for note in draft.notes if not note.startswith(_HARMLESS)]
    if linkages:
        draft.note(f"Ackermann's linkage within {error:.1g} rad")
    out = serialize(draft)
    compile_mjcf(out)
    if lost:
        warnings.warn(f"wheeled.write_mjcf: {'; '.join(lost)}", stacklevel=2)
    if path is not None:
        Path(path).write_text(out, encoding="utf-8")
    return out


def _check(robot: Any, wheel: str, **positive: Any) -> None:
    instance("wheeled.write_mjcf", "robot", robot, Robot, "a Robot")
    choice("shape of a wheel", wheel, SHAPES)
    for name, x in positive.items():
        real_number("wheeled.write_mjcf", name, x, above=0.0)
    if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(robot)):
        raise InputError(
            "wheeled.write_mjcf: got a traced robot, expected concrete values; call it outside of "
            "jit, vmap and grad"
        )
    rolling = [i for i, x in enumerate(robot.wheels) if x.kind == "rollers"]
    if rolling:
        raise UnsupportedFeature(
            f"wheeled.write_mjcf: wheels {rolling} have rollers. MuJoCo's friction has directions "
            "of the contact, which do not turn with a wheel, so rollers would have to be bodies; "
            'use rb.wheeled.at(robot, "slipping"), or write a robot without rollers'
        )


def _linkages(n: Parameters, reach: float) -> tuple[list[JointPolynomial], float]:
    """Fit polynomials from the angle of a steering column to the angles of its wheels.

    Return the polynomials, and the largest error in rad. reach: the largest column angle, rad.
    """
    out, worst = [], 0.0
    nodes = reach * np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    powers = nodes[:, None] ** np.arange(1, _DEGREE + 1)
    for j, steering in enumerate(n.robot.steerings):
        for i in steering.wheels if len(steering.wheels) > 1 else ():
            angles = np.asarray(linked(n, j, i, jnp.asarray(nodes))[2], np.float64)
            terms: np.ndarray = np.linalg.lstsq(powers, angles)[0]
            worst = max(worst, float(np.abs(powers @ terms - angles).max()))
            column = f"steering_{j}"
            out.append(JointPolynomial(knuckle_joint(n, i)[0], column, jnp.asarray([0.0, *terms])))
    return out, worst


def _write_ground(
    draft: Draft, n: Parameters, shape: str, width: float, touch: dict[str, str], rolling: float
) -> None:
    """Write the plane, the shapes of wheels, and visible boxes of bodies.

    rolling: the coefficient of rolling resistance of the contacts.
    """
    default = ET.Element("default")
    draft.root.insert(2, default)  # behind compiler and option
    ET.SubElement(default, "equality", solref=touch["solref"], solimp=touch["solimp"])
    # wheels touch only the ground, with their own parameters
    ways = {"contype": "1", "conaffinity": "0", "priority": "1", "rgba": "0.15 0.15 0.15 1"}
    axle = {"zaxis": "0 1 0"} if shape in ("cylinder", "capsule") else {}
    ET.SubElement(ET.SubElement(default, "default", {"class": "wheel"}), "geom",
                  {"type": shape} | axle | touch | ways)  # fmt: skip
    seen = {"contype": "0", "conaffinity": "0", "rgba": "0.2 0.4 0.7 0.6"}
    ET.SubElement(ET.SubElement(default, "default", {"class": "body"}), "geom", seen)
    ET.SubElement(draft.world, "light", pos="0 0 10")
    ground = {"name": "ground", "type": "plane", "size": "0 0 1", "rgba": "0.8 0.8 0.8 1"}
    ET.SubElement(draft.world, "geom", ground | {"contype": "0", "conaffinity": "1"})
    for i, made in enumerate(n.robot.wheels):
        r = _own(made.radius)
        half = width * r / 2
        line = (r, half)
        size = {"ellipsoid": (r, half, r), "sphere": (r,)}.get(shape, line)
        body = draft.model.body(f"wheel_{i}")
        given = {"class": "wheel"}
        if rolling:
            given["friction"] = f"{touch['friction']} 0 {text(rolling * r)}"
        draft.add(body, "geom", name=f"wheel_{i}", size=text(size), **given)
    for k, body in enumerate(n.robot.bodies):
        mine = [w for w in n.robot.wheels if w.body == k]
        places = np.array([[0.0, 0.0], *(np.asarray(w.position) for w in mine)])
        if k:
            places = np.vstack([places, [body.drawbar, 0.0]])
        low, high = places.min(0), places.max(0)
        thick = max(float(w.radius) for w in mine) / 4
        middle, half = (low + high) / 2, np.maximum((high - low) / 2, thick)
        at = draft.model.body(f"trailer_{k}" if k else "chassis")
        draft.add(at, "geom", type="box", pos=text([*middle, float(body.height)]),
                  size=text([*half, thick]), **{"class": "body"})  # fmt: skip


def _write_drives(draft: Draft, n: Parameters) -> None:
    """Write one actuator for each drive, and delete the actuators of the full model."""
    draft.actuator.clear()
    for j, drive in enumerate(n.robot.drives):
        name, axles = f"drive_{j}", [wheel_joint(i) for i in drive.wheels]
        split = np.asarray(drive.split)
        law = _law(draft, drive.motor, f"motor of {name}")
        if len(axles) == 1:
            ends = {"joint": axles[0], "gear": text(split[0])}
        else:
            ends = {"tendon": name}
            _write_cage(draft, name, axles, split)
            rotor = f"motor_{j}"
            if rotor in draft.model.joint_names:
                _write_cage(draft, rotor, [rotor], np.ones(1))
                turns = {"tendon1": rotor, "tendon2": name, "polycoef": "0 1 0 0 0"}
                ET.SubElement(draft.equality, "tendon", turns)
        ET.SubElement(draft.actuator, "general", {"name": name} | ends | law)


def _write_cage(draft: Draft, name: str, axles: list[str], split: np.ndarray) -> None:
    """Write the fixed tendon of a differential: its length is sum split_i phi_i of axle angles."""
    cage = ET.SubElement(draft.tendon, "fixed", name=name)
    for axle, share in zip(axles, split, strict=True):
        ET.SubElement(cage, "joint", joint=axle, coef=text(share))


def _law(draft: Draft, motor: Motor, name: str) -> dict[str, str]:
    """Return the MJCF attributes of a motor: its torque as gain u + bias Omega, and its limits."""
    limits: dict[str, str] = {}
    if type(motor) not in (TorqueSource, SpeedServo, DCMotor):
        raise UnsupportedFeature(
            f"wheeled.write_mjcf: {name} is {type(motor).__name__}, which MJCF does not have; "
            "expected TorqueSource, SpeedServo or DCMotor"
        )
    limited = {"limit": "forcerange", "battery": "ctrlrange"}
    for field, attribute in limited.items():
        end = _own(getattr(motor, field, np.inf))
        if np.isfinite(end):
            limits[attribute] = f"{text(-end)} {text(end)}"
            draft.note(f"{name}: it saturates at a corner, not as tanh")
    given: Any = motor
    if isinstance(motor, SpeedServo):
        gain, bias = _own(given.gain), -_own(given.gain)
    elif isinstance(motor, DCMotor):
        k, R = _own(given.gear * given.torque_constant), _own(given.resistance)
        gain, bias = k / R, -(k * k / R + _own(given.friction))
    else:
        gain, bias = 1.0, 0.0
    return _affine(gain, 0.0, bias) | limits


def _affine(gain: Any, by_length: Any, by_rate: Any) -> dict[str, str]:
    """Return the MJCF attributes of the force gain u + by_length l + by_rate l'."""
    law = {"gainprm": text(gain)}
    if by_length or by_rate:
        terms = " ".join(map(text, (0.0, by_length, by_rate)))
        law |= {"biastype": "affine", "biasprm": terms}
    return law


def _own(x: Any) -> Any:
    """Convert a number to a numpy scalar of its dtype, so that `text` writes the fewest digits."""
    return np.asarray(x)[()]


def _write_steerings(draft: Draft, n: Parameters, reach: float, time: float) -> None:
    """Write a servo of the rate of each steering."""
    model: Model = draft.model
    for j, steering in enumerate(n.robot.steerings):
        name = f"steering_{j}"
        turned = {name, *(knuckle_joint(n, i)[0] for i in steering.wheels)}
        inertia = sum(float(model.joints.armature[model.v_slice(x).start]) for x in turned)
        gain, stiffness = inertia / time, 0.0
        damping = gain
        if steering.lag is not None:
            gain = stiffness = gain / _own(steering.lag)
        law = _affine(gain, 0.0 - stiffness, -damping)
        ET.SubElement(draft.actuator, "general", {"name": name, "joint": name} | law)
        if len(turned) > 1:
            draft.joints[model.joint(name)].set("range", text([-reach, reach]))


def _write_resistance(draft: Draft, n: Parameters, axles: bool) -> None:
    """Write the damping of axles, and rolling resistance as friction of axles at the loads at
    rest."""
    for i, given in enumerate(n.robot.wheels):
        if _own(given.damping):
            joint = draft.joints[draft.model.joint(wheel_joint(i))]
            joint.set("damping", text(_own(given.damping)))
    if n.robot.resistance is None or not axles:
        return
    c = _own(n.robot.resistance.coefficient)
    for i, (given, load) in enumerate(zip(n.robot.wheels, wheel_loads(n), strict=True)):
        torque = c * np.maximum(_own(load), 0) * _own(given.radius)
        draft.joints[draft.model.joint(wheel_joint(i))].set("frictionloss", text(torque))
