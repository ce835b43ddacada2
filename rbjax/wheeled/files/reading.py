"""A wheeled robot from a robot file: MJCF or URDF, with the names of its wheels' joints.

The file is held at one configuration, at which its wheels stand on level ground.

    file_joints    which joints are wheels, steerings, casters, hitches
    file_wheels    wheels: places, radii, inertias
    file_bodies    chassis and trailers: frames, masses
    file_drives    the file's actuators, or a user's motors
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError, UnsupportedFeature, listed
from rbjax.loading.at_rest import at_rest
from rbjax.wheeled.files.bodies import View, bodies_of, clean, view_of
from rbjax.wheeled.files.drives import drives_of
from rbjax.wheeled.files.joints import Patterns, Roles, roles
from rbjax.wheeled.files.wheels import FileWheel, LeftOut, file_wheels
from rbjax.wheeled.robot.robot import Robot, Steering, Wheel

_SHOWN = 12  # of what is left out


def from_file(
    source: Any,
    wheels: Patterns,
    *,
    steerings: Sequence[str | Sequence[str]] = (),
    casters: Patterns = (),
    trailers: Patterns = (),
    skids: bool | Patterns = False,
    rollers: Mapping[str, float] | None = None,
    drives: Any = None,
    shafts: Mapping[str, Patterns] | None = None,
    radius: float | Mapping[str, float] | None = None,
    lag: float | None = None,
    q: Any = None,
    frame: str | None = None,
    tolerance: float = 0.01,
    strict: bool = False,
) -> Robot:
    """A wheeled robot from an MJCF or URDF file whose wheel joints are named.

    Names are those of hinges of the file, or glob patterns such as "*_wheel". All joints that are
    not named are held. The ground is level and touches all wheels.

    Signs are the file's: a wheel's rate, the torque on it, the control of its drive and its angle
    in q are those of its joint. Its heading is where it rolls at a positive rate, so it is pi for a
    wheel whose axle points to the right; only a caster's wheel turns at a positive rate where it
    rolls ahead of its pivot. Angles of steerings, trailers and casters are positive to the left
    whatever the file's axis; those of steerings and trailers are zero at the configuration that is
    held. Each wheel's `shaft` is the name of its joint.

    Args:
        source: what `rbjax.load` takes.
        wheels: hinges of wheels, those of casters with them.
        steerings: vertical hinges of steered wheels; a tuple of several is one steering with
            Ackermann's geometry.
        casters: vertical hinges of casters.
        trailers: vertical hinges at which trailers are coupled.
        skids: wheels that may slide sideways, or True for all of a skid-steer robot. It turns on
            the axis through their middle. Steered wheels, casters and rollers among them do not.
        rollers: wheels of free rollers, with the angle of the rollers' axes from the heading to the
            left, rad.
        drives: what turns the wheels: names; a tuple of names for wheels behind one differential;
            or a mapping of these to motors. None: the file's torque and speed actuators on wheels;
            if it has none, a torque on each wheel that is no caster's.
        shafts: names of shafts, with the wheels that turn together on each.
        radius: m, of all wheels or by name. None: the farthest point from the axle of each wheel's
            shapes, collision shapes if there are any.
        lag: s, of all steerings, see `Steering`.
        q: the configuration: None, that of the file; a keyframe's name; values of joints by name;
            or (nq,).
        frame: a body or site whose x axis is ahead, and above whose origin the chassis' frame lies
            on the ground. None: the body on which all else hangs.
        tolerance: angles in rad, and heights as parts of the largest radius, up to which the ground
            is level, axles lie and steerings stand.
        strict: raise instead of warning about what the robot leaves out of the file.

    Returns:
        `Robot`. What it cannot have and approximates is listed in a warning: wheels that are not
        even about their axles; steered wheels whose centre, or centre of mass with the knuckle, is
        off the axis of the steering; friction losses and springs. Not taken: ranges of joints,
        limits of controls and of the forces on joints, actuators of steerings.

    Raises:
        ModelError: the source cannot be read.
        UnknownName: no hinge has a name; the message lists them.
        InputError: a joint that is no hinge, a steering without its wheel, an axle that leans, a
            wheel without a shape, wheels that do not stand on one plane, an actuator without a law
            here.
        UnsupportedFeature: with `strict=True`, the list of what would be left out.

    Example:
        >>> import rbjax as rb
        >>> wheel = '''<body name="%s" pos="0 %s 0.1"><joint name="%s" axis="0 1 0"/>
        ...     <geom type="cylinder" size="0.1 0.02" euler="90 0 0" mass="1"/></body>'''
        >>> cart = rb.wheeled.from_file(
        ...     '<mujoco><worldbody><body name="cart"><freejoint/>'
        ...     '<geom type="box" size="0.3 0.2 0.05" pos="0.1 0 0.2" mass="8"/>'
        ...     + wheel % ("l", 0.25, "left") + wheel % ("r", -0.25, "right")
        ...     + "</body></worldbody></mujoco>", ["left", "right"])
        >>> cart.arrangement.mobility, round(float(cart.wheels[0].radius), 3)
        (2, 0.1)
    """
    if not (isinstance(tolerance, (int, float)) and 0 < tolerance < 1):
        raise InputError(f"from_file: tolerance is {tolerance!r}, expected a number from 0 to 1")
    rest = at_rest(source, q)
    named = roles(rest, wheels, steerings, casters, trailers)
    out = LeftOut()
    slanted = _by_wheel(named, "rollers", rollers or {})
    sizes = _by_wheel(named, "radius", radius) if isinstance(radius, Mapping) else radius
    found = file_wheels(named, sizes, slanted, tolerance, out)
    skidding = named.wheels_named("skids", "*" if skids is True else skids or ())
    groups = _mapping("shafts", shafts or {})
    on = {j: x for x, group in groups.items() for j in named.wheels_named("shafts", group)}
    view = view_of(named, found, frame, tolerance)
    bodies = bodies_of(view, found, out)
    made = [
        _wheel(view, w, slanted.get(w.joint, 0.0), w.joint in skidding,
               on.get(w.joint, named.name(w.joint)))
        for w in found
    ]  # fmt: skip
    sliding = [wheel.position[0] for wheel in made if wheel.skids]
    gravity, slope = _gravity(view)
    robot = Robot.of(
        bodies,
        made,
        drives_of(named, found, drives, out),
        [Steering(tuple(map(named.steered, group)), lag) for group in named.steerings],
        gravity=gravity,
        slope=slope,
        turn_center=float(np.mean(sliding)) if sliding else 0.0,
    )
    _check_shafts(robot)
    if out.found:
        text = f"from_file: left out of the robot: {listed(out.found, _SHOWN)}"
        if strict:
            raise UnsupportedFeature(f"{text}. Take strict=False to go without.")
        warnings.warn(text, stacklevel=2)
    return jax.tree.map(lambda x: jnp.asarray(x, float), robot)


def _by_wheel(named: Roles, what: str, given: Mapping[str, float]) -> dict[int, float]:
    """Parameters by joints, of numbers by names."""
    pairs = _mapping(what, given).items()
    return {j: value for name, value in pairs for j in named.wheels_named(what, name)}


def _mapping(what: str, given: Any) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise InputError(f"from_file: {what} is {given!r}, expected a mapping by names or patterns")
    return given


def _wheel(view: View, w: FileWheel, roller: float, skids: bool, shaft: str) -> Wheel:
    k = view.roles.body(w.joint)
    same = ("radius", "inertia", "mass", "yaw_inertia", "trail", "behind", "damping")
    numbers: dict[str, Any] = {name: getattr(w, name) for name in same}
    numbers |= {"position": clean(view.seen(w.place, k)[:2]), "roller": roller}
    if w.kind != "caster":
        numbers["heading"] = view.angle(w.ahead)
    skids = skids and w.kind == "fixed"  # steered wheels and rollers hold it as they do
    return Wheel(**numbers, kind=w.kind, body=k, shaft=shaft, skids=skids)


def _gravity(view: View) -> tuple[float, np.ndarray]:
    """Its size, and the slope on which the level ground of the file is."""
    g = view.turn.T @ view.roles.rest.gravity
    if g[2] > 0 or (g[2] == 0 and g.any()):
        raise InputError(
            f"from_file: gravity is {view.roles.rest.gravity}, expected that it points down, or 0"
        )
    return float(np.linalg.norm(g)), clean(g[:2] / (-g[2] or 1.0))


def _check_shafts(robot: Robot) -> None:
    """Refuse wheels that turn together in opposite directions."""
    for i, shaft in enumerate(robot.layout.shaft):
        first = robot.wheels[robot.layout.setters[shaft]]
        wheel = robot.wheels[i]
        if wheel.kind != "caster" and np.cos(float(wheel.heading - first.heading)) < 0:
            raise InputError(
                f"from_file: wheels {i} and {robot.layout.setters[shaft]} turn on the shaft "
                f"{wheel.shaft!r}, and the axles of their joints point in opposite directions; "
                "turn one in the file, or leave the shaft out"
            )
