"""Which wheeled robots there are, and at which fidelities each runs."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rbjax.errors import InputError, UnknownName
from rbjax.wheeled.models.constrained import Constrained
from rbjax.wheeled.models.robot_model import RobotModel
from rbjax.wheeled.models.rolling import Dynamical, Kinematic, Kinematical, QuasiVelocities
from rbjax.wheeled.models.slipping import Slipping
from rbjax.wheeled.robot import catalogue
from rbjax.wheeled.robot.robot import Robot

_FIDELITIES: tuple[type[RobotModel], ...] = (
    Kinematic,
    Kinematical,
    Dynamical,
    QuasiVelocities,
    Constrained,
    Slipping,
)


@dataclass(frozen=True)
class Kind:
    """A robot by name: `make(**numbers)` builds it; `fidelities` are those at which it runs."""

    name: str
    make: Callable[..., Robot]
    fidelities: tuple[str, ...]


def fidelities() -> dict[str, type[RobotModel]]:
    """All fidelities, the cheapest first: name -> class.

    Example:
        >>> import rbjax as rb
        >>> list(rb.wheeled.fidelities())[0]
        'kinematic'
    """
    return {f.name: f for f in _FIDELITIES}


def kinds() -> dict[str, Kind]:
    """All robots: name -> `Kind`.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["car"].make(wheelbase=2.5)
        >>> robot.arrangement.mobility
        1
    """
    makers: dict[str, Callable[..., Robot]] = {
        "differential_drive": catalogue.differential_drive,
        "unicycle": catalogue.unicycle,
        "omni_3": functools.partial(catalogue.omnidirectional, 3),
        "omni_4": functools.partial(catalogue.omnidirectional, 4),
        "mecanum": catalogue.mecanum,
        "car": catalogue.car,
        "front_drive_car": functools.partial(catalogue.car, drive="front"),
        "bicycle": catalogue.bicycle,
        "tricycle": catalogue.tricycle,
        "skid_steer": catalogue.skid_steer,
        "tractor_trailers": _with_trailers(catalogue.differential_drive, 2, 0.0),
        "car_trailer": _with_trailers(catalogue.car, 1, 0.8, drawbar=3.0, track=1.4, mass=400.0,
                                      inertia=300.0, radius=0.3, wheel_mass=15.0),
    }  # fmt: skip
    names = tuple(fidelities())
    return {name: Kind(name, _named(name, make), names) for name, make in makers.items()}


def _with_trailers(
    make: Callable[..., Robot], number: int, hitch: float, **trailer: Any
) -> Callable[..., Robot]:
    """A robot with trailers; `trailer` are numbers of `kinds.with_trailers`."""

    @functools.wraps(make)
    def both(**numbers: Any) -> Robot:
        return catalogue.with_trailers(make(**numbers), number, hitch, **trailer)

    return both


def _named(kind: str, make: Callable[..., Robot]) -> Callable[..., Robot]:
    """A maker that raises `UnknownName` for a parameter that the kind does not have."""
    valid = list(inspect.signature(make).parameters)

    @functools.wraps(make)
    def named(**numbers: Any) -> Robot:
        for name in numbers:
            if name not in valid:
                raise UnknownName(f"number of a {kind}", name, valid)
        return make(**numbers)

    return named


def at(robot: Robot, fidelity: str, **options: Any) -> RobotModel:
    """A robot at a fidelity.

    Args:
        robot: `Robot`.
        fidelity: a name of `fidelities`.
        options: fields of that fidelity, such as `tyre` of "slipping".

    Returns:
        `RobotModel`.

    Raises:
        InputError: not a robot. UnknownName: no such fidelity or option.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.at(rb.wheeled.kinds()["omni_3"].make(), "kinematical").nv
        3
    """
    known = fidelities()
    if not isinstance(robot, Robot):
        raise InputError(
            f"at: robot is {type(robot).__name__}, expected a Robot, as "
            'rbjax.wheeled.kinds()["car"].make() gives it'
        )
    if not isinstance(fidelity, str) or fidelity not in known:
        raise UnknownName("fidelity", fidelity, known)
    valid = [f.name for f in dataclasses.fields(known[fidelity]) if f.name != "robot"]
    for name in options:
        if name not in valid:
            raise UnknownName(f"option of {fidelity!r}", name, valid)
    return known[fidelity](robot, **options)
