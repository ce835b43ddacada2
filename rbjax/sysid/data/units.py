"""Units of recordings, and their conversion to SI."""

from __future__ import annotations

import math

from rbjax.arguments import choice

#: unit -> its value in SI
UNITS = {
    "": 1.0, "1": 1.0, "%": 0.01,
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0,
    "rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "rev": 2 * math.pi,
    "rad/s": 1.0, "deg/s": math.pi / 180, "rev/s": 2 * math.pi, "rpm": math.pi / 30,
    "rad/s^2": 1.0, "deg/s^2": math.pi / 180,
    "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254,
    "m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6,
    "m/s^2": 1.0, "mm/s^2": 1e-3, "g0": 9.80665,
    "N": 1.0, "mN": 1e-3, "kN": 1e3,
    "N m": 1.0, "mN m": 1e-3, "kN m": 1e3,
    "A": 1.0, "mA": 1e-3, "V": 1.0, "mV": 1e-3,
}  # fmt: skip
#: units of a clock
TIME = ("s", "ms", "us", "ns", "min")
_ANGLE, _LENGTH = ("rad", "mrad", "deg", "rev"), ("m", "cm", "mm", "um", "in")
_RATE, _SPEED = ("rad/s", "deg/s", "rev/s", "rpm"), ("m/s", "cm/s", "mm/s", "km/h")
_ACCELERATION = ("m/s^2", "mm/s^2", "g0")
#: joint sensor -> units for a hinge, units for a slide
MOVES = {"q": (_ANGLE, _LENGTH), "v": (_RATE, _SPEED)}
_FORCE, _TORQUE, _CURRENT = ("N", "mN", "kN"), ("N m", "mN m", "kN m"), ("A", "mA")
#: kind of sensor -> valid units, in addition to "" (SI); other sensors may have any unit
OF_SENSORS = {
    "q": (*_ANGLE, *_LENGTH), "v": (*_RATE, *_SPEED),
    "a": ("rad/s^2", "deg/s^2", *_ACCELERATION), "tau": (*_TORQUE, *_FORCE, *_CURRENT),
    "current": _CURRENT, "pose": ("1", *_LENGTH), "position": _LENGTH, "gyro": _RATE,
    "accelerometer": _ACCELERATION, "force": _FORCE, "torque": _TORQUE,
}  # fmt: skip


def in_si(unit: str) -> float:
    """Return the factor that converts a unit to SI.

    Args:
        unit: unit such as "deg", "rpm", "mm", "g0" (standard gravity) or "N m". "" is SI.

    Returns:
        The value of one unit in SI.

    Raises:
        UnknownName: an unknown unit.

    Source: BIPM, *The International System of Units*, 9th edition, 2019.

    Example:
        >>> from rbjax.sysid.data import in_si
        >>> round(60 * in_si("rpm"), 4)
        6.2832
    """
    return UNITS[choice("unit", unit, UNITS)]
