"""Wheeled robots by their usual names.

Lengths are in m, masses in kg, inertias in kg m^2. The chassis' frame is in the middle between the
driven wheels, or on the rear axle of a car. `mass` and `inertia` are of the chassis without wheels.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rbjax.arguments import choice, instance, integer, real_number
from rbjax.errors import UnknownName
from rbjax.wheeled.robot.motors import Motor, TorqueSource
from rbjax.wheeled.robot.robot import Body, Drive, Robot, Steering, Wheel

#: the fields of these classes convert numbers to arrays
_body: Any = Body
_wheel: Any = Wheel


def _check(kind: str, **lengths: Any) -> None:
    """Raise `InputError` unless all lengths are finite numbers above zero."""
    for name, x in lengths.items():
        real_number(kind, name, x, "a length above zero, m", above=0.0, traced=True)


def _disc(radius: float, mass: float) -> dict[str, Any]:
    """Return radius, mass and inertia of a wheel that is a uniform disc."""
    moment = mass * radius**2
    return {"radius": radius, "mass": mass, "inertia": moment / 2, "yaw_inertia": moment / 4}


def _drives(motor: Motor | None, *axles: tuple[int, ...]) -> list[Drive]:
    """Make a drive for each axle, with a differential if the axle has several wheels."""
    return [Drive(wheels, motor or TorqueSource()) for wheels in axles]


def differential_drive(
    track: float = 0.4, radius: float = 0.08, mass: float = 10.0, inertia: float = 0.4,
    com: Any = (0.07, 0.0), wheel_mass: float = 0.5, caster: float | None = 0.2,
    height: float = 0.12, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Make a robot with two driven wheels on one axle, the right one first.

    caster: the distance of a caster ahead of the axle, m; None for no caster.
    """
    _check("differential_drive", track=track, radius=radius)
    wheels = [_wheel([0.0, y], **_disc(radius, wheel_mass)) for y in (-track / 2, track / 2)]
    if caster is not None:
        small = _disc(radius / 2, wheel_mass / 5)
        wheels.append(_wheel([caster, 0.0], trail=radius / 4, kind="caster", **small))
    drives = _drives(motor, (0,), (1,))
    return Robot.of(_body(mass, inertia, com, height), wheels, drives)


def unicycle(
    radius: float = 0.2, mass: float = 5.0, inertia: float = 0.1, wheel_mass: float = 1.0,
    motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Make a robot with one driven wheel, and a small omnidirectional wheel that drives
    sideways."""
    _check("unicycle", radius=radius)
    wheels = [
        _wheel([0.0, 0.0], **_disc(radius, wheel_mass)),
        _wheel([-radius, 0.0], math.pi / 2, kind="rollers", **_disc(radius / 4, wheel_mass / 10)),
    ]
    return Robot.of(_body(mass, inertia, height=radius), wheels, _drives(motor, (0,), (1,)))


def omnidirectional(
    wheels: int | Sequence[float] = 3, arm: float = 0.18, radius: float = 0.05, mass: float = 6.0,
    inertia: float = 0.2, wheel_mass: float = 0.3, height: float = 0.1, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Make a robot with omnidirectional wheels on a circle, each with its heading along the circle.

    wheels: their number, evenly spaced, the first ahead; or the angles of their positions, rad.
    """
    _check("omnidirectional", arm=arm, radius=radius)
    angles = (
        [2 * math.pi * i / wheels for i in range(wheels)] if isinstance(wheels, int) else wheels
    )
    made = [
        _wheel([arm * math.cos(a), arm * math.sin(a)], a + math.pi / 2, kind="rollers",
              **_disc(radius, wheel_mass))
        for a in angles
    ]  # fmt: skip
    drives = _drives(motor, *((i,) for i in range(len(made))))
    return Robot.of(_body(mass, inertia, height=height), made, drives)


def mecanum(
    length: float = 0.47, track: float = 0.3, radius: float = 0.0475, mass: float = 20.0,
    inertia: float = 1.0, wheel_mass: float = 1.4, height: float = 0.1, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Make a robot with four mecanum wheels: front left, front right, rear right, rear left. (Lynch
    & Park, *Modern Robotics*, 13.2, figure 13.5)"""
    _check("mecanum", length=length, track=track, radius=radius)
    places = [(1, 1, -1), (1, -1, 1), (-1, -1, -1), (-1, 1, 1)]
    made = [
        _wheel([x * length / 2, y * track / 2], roller=side * math.pi / 4, kind="rollers",
              **_disc(radius, wheel_mass))
        for x, y, side in places
    ]  # fmt: skip
    drives = _drives(motor, *((i,) for i in range(4)))
    return Robot.of(_body(mass, inertia, height=height), made, drives)


def car(
    wheelbase: float = 2.6, track: float = 1.5, radius: float = 0.3, mass: float = 1100.0,
    inertia: float = 1500.0, com: Any = (1.2, 0.0), wheel_mass: float = 20.0, drive: str = "rear",
    height: float = 0.5, lag: float | None = None, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Make a car with four wheels, the left one of each axle first.

    The front wheels are steered with Ackermann's geometry. `drive` is "rear", "front" or "all";
    each driven axle has a differential.
    """
    _check("car", wheelbase=wheelbase, track=track, radius=radius)
    disc = _disc(radius, wheel_mass)
    wheels = [_wheel([0.0, y], **disc) for y in (track / 2, -track / 2)]
    wheels += [_wheel([wheelbase, y], kind="steered", **disc) for y in (track / 2, -track / 2)]
    axles = {"rear": [(0, 1)], "front": [(2, 3)], "all": [(0, 1), (2, 3)]}
    drives = _drives(motor, *axles[choice("drive", drive, axles)])
    return Robot.of(_body(mass, inertia, com, height), wheels, drives, [Steering((2, 3), lag)])


def bicycle(
    wheelbase: float = 2.6, radius: float = 0.3, mass: float = 1100.0, inertia: float = 1500.0,
    com: Any = (1.2, 0.0), wheel_mass: float = 40.0, drive: str = "rear", height: float = 0.5,
    lag: float | None = None, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Make a car with one wheel on each axle."""
    _check("bicycle", wheelbase=wheelbase, radius=radius)
    disc = _disc(radius, wheel_mass)
    wheels = [_wheel([0.0, 0.0], **disc), _wheel([wheelbase, 0.0], kind="steered", **disc)]
    axles = {"rear": [(0,)], "front": [(1,)], "all": [(0,), (1,)]}
    drives = _drives(motor, *axles[choice("drive", drive, axles)])
    return Robot.of(_body(mass, inertia, com, height), wheels, drives, [Steering((1,), lag)])


def tricycle(
    wheelbase: float = 0.8, track: float = 0.6, radius: float = 0.12, mass: float = 40.0,
    inertia: float = 4.0, com: Any = (0.3, 0.0), wheel_mass: float = 1.5, height: float = 0.3,
    lag: float | None = None, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Make a robot with two fixed rear wheels, left first, and a driven and steered front wheel."""
    _check("tricycle", wheelbase=wheelbase, track=track, radius=radius)
    disc = _disc(radius, wheel_mass)
    wheels = [_wheel([0.0, y], **disc) for y in (track / 2, -track / 2)]
    wheels.append(_wheel([wheelbase, 0.0], kind="steered", **disc))
    drives, steerings = _drives(motor, (2,)), [Steering((2,), lag)]
    return Robot.of(_body(mass, inertia, com, height), wheels, drives, steerings)


def skid_steer(
    length: float = 0.5, track: float = 0.6, radius: float = 0.165, mass: float = 40.0,
    inertia: float = 3.0, com: Any = (0.0, 0.0), wheel_mass: float = 2.6, height: float = 0.2,
    motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Make a robot with four wheels, the right ones first, which skid in turns.

    The wheels of a side are on one shaft. At fidelities without slip, the robot turns on the axis
    x = `turn_center`.
    """
    _check("skid_steer", length=length, track=track, radius=radius)
    disc = _disc(radius, wheel_mass)
    wheels = [
        _wheel([x, y * track / 2], shaft=side, skids=True, **disc)
        for y, side in ((-1, "right"), (1, "left"))
        for x in (length / 2, -length / 2)
    ]
    drives = _drives(motor, (0,), (2,))
    return Robot.of(_body(mass, inertia, com, height), wheels, drives)


def with_trailers(
    robot: Robot, number: int = 1, hitch: float = 0.0, drawbar: float = 1.0, track: float = 0.5,
    radius: float = 0.1, mass: float = 20.0, inertia: float = 1.0, com: Any = (0.1, 0.0),
    wheel_mass: float = 1.0, height: float = 0.2,
) -> Robot:  # fmt: skip
    """Add trailers, one behind the other, each with one axle at its origin.

    Args:
        robot: the robot that pulls.
        number: of trailers.
        hitch: distance of a coupling behind the origin of the body ahead, m; 0 is on the axle.
        drawbar: distance of the coupling ahead of the trailer's origin, m.
        track: distance of the two wheels of an axle, m.
        radius: of the wheels, m.
        mass: of a trailer without wheels, kg.
        inertia: about the vertical through the centre of mass, kg m^2.
        com: (2,), centre of mass, m.
        wheel_mass: kg.
        height: of the centre of mass above the ground, m.

    Returns:
        The `Robot` with trailers.

    Raises:
        InputError: not a `Robot`, a negative number, or a length that is not positive.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.wheeled import with_trailers
        >>> car = rb.wheeled.kinds()["car"].make()
        >>> len(with_trailers(car, 2).bodies)
        3
    """
    where = "with_trailers"
    instance(where, "robot", robot, Robot, "rb.wheeled.Robot")
    integer(where, "number", number, least=0)
    real_number(where, "hitch", hitch, "a length in m", traced=True)
    _check(where, drawbar=drawbar, track=track, radius=radius)
    bodies, wheels = list(robot.bodies), list(robot.wheels)
    ahead = 0
    for _ in range(number):
        behind = {"hitch": [-hitch, 0.0], "drawbar": drawbar, "ahead": ahead}
        ahead = len(bodies)
        bodies.append(_body(mass, inertia, com, height, **behind))
        disc = _disc(radius, wheel_mass)
        wheels += [_wheel([0.0, y], body=ahead, **disc) for y in (track / 2, -track / 2)]
    return robot.replace(bodies=tuple(bodies), wheels=tuple(wheels), arrangement=None)


@dataclass(frozen=True)
class RobotKind:
    """A robot type: its name, and `make(**numbers)`, which builds a robot of it."""

    name: str
    make: Callable[..., Robot]


def kinds() -> dict[str, RobotKind]:
    """Return all robot types: name -> `RobotKind`.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["car"].make(wheelbase=2.5)
        >>> robot.arrangement.mobility
        1
    """
    makers: dict[str, Callable[..., Robot]] = {
        "differential_drive": differential_drive,
        "unicycle": unicycle,
        "omni_3": functools.partial(omnidirectional, 3),
        "omni_4": functools.partial(omnidirectional, 4),
        "mecanum": mecanum,
        "car": car,
        "front_drive_car": functools.partial(car, drive="front"),
        "bicycle": bicycle,
        "tricycle": tricycle,
        "skid_steer": skid_steer,
        "tractor_trailers": _pulling(differential_drive, 2, 0.0),
        "car_trailer": _pulling(car, 1, 0.8, drawbar=3.0, track=1.4, mass=400.0, inertia=300.0,
                                radius=0.3, wheel_mass=15.0),
    }  # fmt: skip
    return {name: RobotKind(name, _named(name, make)) for name, make in makers.items()}


def _pulling(
    make: Callable[..., Robot], number: int, hitch: float, **trailer: Any
) -> Callable[..., Robot]:
    """Return a function that makes a robot with trailers, from a function that makes a robot."""

    @functools.wraps(make)
    def both(**numbers: Any) -> Robot:
        return with_trailers(make(**numbers), number, hitch, **trailer)

    return both


def _named(kind: str, make: Callable[..., Robot]) -> Callable[..., Robot]:
    """Wrap a function that makes a robot, to raise `UnknownName` for a parameter that it does not
    have."""
    valid = list(inspect.signature(make).parameters)

    @functools.wraps(make)
    def named(**numbers: Any) -> Robot:
        for name in numbers:
            if name not in valid:
                raise UnknownName(f"parameter of a {kind}", name, valid)
        return make(**numbers)

    return named
