"""Wheeled robots by their usual names.

Lengths in m, masses in kg, inertias in kg m^2. The chassis' frame is in the middle between driven
wheels, or on the rear axle of a car. `mass` and `inertia` are of the chassis without its wheels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from rbjax.arguments import instance, integer, real_number
from rbjax.errors import InputError, UnknownName
from rbjax.wheeled.robot.motors import Motor, TorqueSource
from rbjax.wheeled.robot.robot import Body, Drive, Robot, Steering, Wheel


def _check(kind: str, **lengths: Any) -> None:
    """Raise if a length of a robot is not a finite number above zero."""
    for name, x in lengths.items():
        if isinstance(x, jax.core.Tracer):  # `Robot` rejects it
            continue
        try:
            number = np.ndim(x) == 0 and not isinstance(x, (str, bytes))
            fits = number and 0 < float(x) < math.inf
        except (TypeError, ValueError, OverflowError):
            fits = False
        if not fits:
            raise InputError(f"{kind}({name}=...): got {x!r}, expected a length above zero, m")


def _body(mass: Any, inertia: Any, com: Any = (0.0, 0.0), height: Any = 0.1, **k: Any) -> Body:
    return Body(mass, inertia, com, height, **k)


def _wheel(position: Any, heading: Any = 0.0, **numbers: Any) -> Wheel:
    return Wheel(position, heading, **numbers)


def _tyred(radius: float, mass: float, inertia: float | None = None) -> dict[str, Any]:
    """Numbers of a wheel: a disc, unless its inertia is given."""
    spin = mass * radius**2 / 2 if inertia is None else inertia
    return {"radius": radius, "mass": mass, "inertia": spin, "yaw_inertia": mass * radius**2 / 4}


def differential_drive(
    track: float = 0.4, radius: float = 0.08, mass: float = 10.0, inertia: float = 0.4,
    com: Any = (0.07, 0.0), wheel_mass: float = 0.5, caster: float | None = 0.2,
    height: float = 0.12, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Two driven wheels on one axle, the right one first. `caster` is the distance of a caster
    ahead of the axle; None for no caster."""
    _check("differential_drive", track=track, radius=radius)
    wheels = [_wheel([0.0, y], **_tyred(radius, wheel_mass)) for y in (-track / 2, track / 2)]
    if caster is not None:
        small = _tyred(radius / 2, wheel_mass / 5)
        wheels.append(_wheel([caster, 0.0], trail=radius / 4, kind="caster", **small))
    return Robot.of(_body(mass, inertia, com, height), wheels, _each(2, motor))


def unicycle(
    radius: float = 0.2, mass: float = 5.0, inertia: float = 0.1, wheel_mass: float = 1.0,
    yaw: Motor | None = None, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """One driven wheel, and a small omnidirectional wheel behind it that is driven sideways."""
    _check("unicycle", radius=radius)
    wheels = [
        _wheel([0.0, 0.0], **_tyred(radius, wheel_mass)),
        _wheel([-radius, 0.0], math.pi / 2, kind="rollers", **_tyred(radius / 4, wheel_mass / 10)),
    ]
    drives = [Drive((0,), motor or TorqueSource()), Drive((1,), yaw or motor or TorqueSource())]
    return Robot.of(_body(mass, inertia, height=radius), wheels, drives)


def omnidirectional(
    wheels: int | Sequence[float] = 3, arm: float = 0.18, radius: float = 0.05, mass: float = 6.0,
    inertia: float = 0.2, wheel_mass: float = 0.3, height: float = 0.1, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Omnidirectional wheels on a circle, each rolling along it.

    wheels: how many, evenly spaced, the first ahead; or the angles of their places, rad.
    """
    _check("omnidirectional", arm=arm, radius=radius)
    angles = (
        [2 * math.pi * i / wheels for i in range(wheels)] if isinstance(wheels, int) else wheels
    )
    made = [
        _wheel([arm * math.cos(a), arm * math.sin(a)], a + math.pi / 2, kind="rollers",
              **_tyred(radius, wheel_mass))
        for a in angles
    ]  # fmt: skip
    return Robot.of(_body(mass, inertia, height=height), made, _each(len(made), motor))


def mecanum(
    length: float = 0.47, track: float = 0.3, radius: float = 0.0475, mass: float = 20.0,
    inertia: float = 1.0, wheel_mass: float = 1.4, height: float = 0.1, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Four mecanum wheels: front left, front right, rear right, rear left.

    (Lynch & Park, *Modern Robotics*, 13.2, figure 13.5)
    """
    _check("mecanum", length=length, track=track, radius=radius)
    places = [(1, 1, -1), (1, -1, 1), (-1, -1, -1), (-1, 1, 1)]
    made = [
        _wheel([x * length / 2, y * track / 2], roller=side * math.pi / 4, kind="rollers",
              **_tyred(radius, wheel_mass))
        for x, y, side in places
    ]  # fmt: skip
    return Robot.of(_body(mass, inertia, height=height), made, _each(4, motor))


def car(
    wheelbase: float = 2.6, track: float = 1.5, radius: float = 0.3, mass: float = 1100.0,
    inertia: float = 1500.0, com: Any = (1.2, 0.0), wheel_mass: float = 20.0, drive: str = "rear",
    height: float = 0.5, lag: float | None = None, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Four wheels, the front ones steered with Ackermann's geometry, rear or front ones driven
    through a differential, or all by two."""
    _check("car", wheelbase=wheelbase, track=track, radius=radius)
    disc = _tyred(radius, wheel_mass)
    wheels = [_wheel([0.0, y], **disc) for y in (track / 2, -track / 2)]
    wheels += [_wheel([wheelbase, y], kind="steered", **disc) for y in (track / 2, -track / 2)]
    drives = _driven({"rear": [(0, 1)], "front": [(2, 3)], "all": [(0, 1), (2, 3)]}, drive, motor)
    body = _body(mass, inertia, com, height)
    return Robot.of(body, wheels, drives, [Steering((2, 3), lag)])


def bicycle(
    wheelbase: float = 2.6, radius: float = 0.3, mass: float = 1100.0, inertia: float = 1500.0,
    com: Any = (1.2, 0.0), wheel_mass: float = 40.0, drive: str = "rear", height: float = 0.5,
    lag: float | None = None, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """A car reduced to one wheel an axle."""
    _check("bicycle", wheelbase=wheelbase, radius=radius)
    disc = _tyred(radius, wheel_mass)
    wheels = [_wheel([0.0, 0.0], **disc), _wheel([wheelbase, 0.0], kind="steered", **disc)]
    drives = _driven({"rear": [(0,)], "front": [(1,)], "all": [(0,), (1,)]}, drive, motor)
    body = _body(mass, inertia, com, height)
    return Robot.of(body, wheels, drives, [Steering((1,), lag)])


def tricycle(
    wheelbase: float = 0.8, track: float = 0.6, radius: float = 0.12, mass: float = 40.0,
    inertia: float = 4.0, com: Any = (0.3, 0.0), wheel_mass: float = 1.5, height: float = 0.3,
    lag: float | None = None, motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """A driven and steered front wheel, and two fixed wheels behind it."""
    _check("tricycle", wheelbase=wheelbase, track=track, radius=radius)
    disc = _tyred(radius, wheel_mass)
    wheels = [_wheel([0.0, y], **disc) for y in (track / 2, -track / 2)]
    wheels.append(_wheel([wheelbase, 0.0], kind="steered", **disc))
    drives = [Drive((2,), motor or TorqueSource())]
    return Robot.of(_body(mass, inertia, com, height), wheels, drives, [Steering((2,), lag)])


def skid_steer(
    length: float = 0.5, track: float = 0.6, radius: float = 0.165, mass: float = 40.0,
    inertia: float = 3.0, com: Any = (0.0, 0.0), wheel_mass: float = 2.6, height: float = 0.2,
    motor: Motor | None = None,
) -> Robot:  # fmt: skip
    """Four wheels, those of a side on one shaft, that skid as the robot turns.

    Where wheels may not slip, it turns on the axis at x = `turn_center` of `Robot`.
    """
    _check("skid_steer", length=length, track=track, radius=radius)
    disc = _tyred(radius, wheel_mass)
    wheels = [
        _wheel([x, y * track / 2], shaft=side, skids=True, **disc)
        for y, side in ((-1, "right"), (1, "left"))
        for x in (length / 2, -length / 2)
    ]
    drives = [Drive((i,), motor or TorqueSource()) for i in (0, 2)]
    return Robot.of(_body(mass, inertia, com, height), wheels, drives)


def with_trailers(
    robot: Robot, number: int = 1, hitch: float = 0.0, drawbar: float = 1.0, track: float = 0.5,
    radius: float = 0.1, mass: float = 20.0, inertia: float = 1.0, com: Any = (0.1, 0.0),
    wheel_mass: float = 1.0, height: float = 0.2,
) -> Robot:  # fmt: skip
    """A robot with trailers, one behind the other, each with one axle in its origin.

    hitch: how far behind a body's origin the next is coupled; 0 is on the axle.
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
        disc = _tyred(radius, wheel_mass)
        wheels += [_wheel([0.0, y], body=ahead, **disc) for y in (track / 2, -track / 2)]
    return robot.replace(bodies=tuple(bodies), wheels=tuple(wheels), arrangement=None)


def _each(n: int, motor: Motor | None) -> list[Drive]:
    return [Drive((i,), motor or TorqueSource()) for i in range(n)]


def _driven(
    axles: dict[str, list[tuple[int, ...]]], drive: str, motor: Motor | None
) -> list[Drive]:
    """A motor with a differential for each driven axle."""
    if drive not in axles:
        raise UnknownName("drive", drive, axles)
    return [Drive(wheels, motor or TorqueSource()) for wheels in axles[drive]]
