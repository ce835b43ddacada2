"""The protocol of sensors, and the registry of sensor kinds.

A sensor is a function of a `Context` that returns an array. `@register` adds a new class.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import jax

from rbjax.arguments import flag
from rbjax.errors import InputError, UnknownName
from rbjax.forces.context import Context
from rbjax.model import Model
from rbjax.sensors.columns import Columns


@runtime_checkable
class Sensor(Protocol):
    """An ideal sensor. A user's sensor has these methods; `names` is optional."""

    def __call__(self, context: Context) -> jax.Array:
        """Compute the measured values (n,), traced."""
        ...

    def columns(self, model: Model) -> Columns:
        """Return the number of values, and which of them are quaternions."""
        ...

    def unit(self, model: Model) -> str:
        """Return the SI unit, for messages."""
        ...


C = TypeVar("C", bound=type)


class Kind(NamedTuple):
    """A kind of sensor.

    sensor: class of the sensor.
    placed: whether the sensor is at a body or a site, as in "gyro:imu".
    """

    sensor: Any
    placed: bool


_KINDS: dict[str, Kind] = {}


def kinds() -> dict[str, Kind]:
    """Return all kinds of sensors by name.

    Example:
        >>> import rbjax as rb
        >>> rb.sensors.kinds()["gyro"].placed, "q" in rb.sensors.kinds()
        (True, True)
    """
    return dict(sorted(_KINDS.items()))


def register(name: str, *, placed: bool = False) -> Callable[[C], C]:
    """Register a class as a kind of sensor (a class decorator).

    Args:
        name: name of the kind, used by recordings and `Setup.with_sensors`.
        placed: whether the sensor is at a body or a site. Its name is then "name:PLACE", and the
            class is called with the place. Otherwise the class is called without arguments.

    A class that is defined again, for instance in a notebook, replaces the earlier one.

    Returns:
        The decorator.

    Raises:
        InputError: a name that is not a word, or that belongs to another class.

    Example:
        >>> import rbjax as rb
        >>> @rb.sensors.register("speed")
        ... class Speed(rb.sensors.CustomSensor):
        ...     def __init__(self):
        ...         super().__init__(lambda context: abs(context.state.v[:1]), 1, "rad/s")
        >>> rb.sysid.Setup.of(rb.load("pendulum")).with_sensors("speed").unit("speed")
        'rad/s'
    """
    placed = flag("register", "placed", placed)
    if not isinstance(name, str) or not name.isidentifier():
        raise InputError(f'register: name is {name!r}, expected a word such as "gyro"')

    def add(cls: C) -> C:
        old = _KINDS.get(name)
        if old is not None and old.sensor.__qualname__ != cls.__qualname__:
            raise InputError(
                f"register: {name} is the name of {old.sensor.__qualname__}, expected a new name"
            )
        _KINDS[name] = Kind(cls, placed)
        return cls

    return add


def sensor_of(name: str) -> Sensor:
    """Make the ideal sensor of a name, such as "q" or "gyro:imu".

    Args:
        name: a kind of `kinds()`, with ":PLACE" if it is placed.

    Returns:
        The sensor.

    Raises:
        UnknownName: no registered kind has this name.
        InputError: the kind needs further arguments, such as the volume of "touch".

    Example:
        >>> import rbjax as rb
        >>> rb.sensors.sensor_of("gyro:tool").unit(rb.load("arm7"))
        'rad/s'
    """
    word, _, place = str(name).partition(":")
    kind = _KINDS.get(word)
    if kind is not None and kind.placed == bool(place) and (kind.placed or name == word):
        sensor: Sensor = kind.sensor(place) if kind.placed else kind.sensor()
        return sensor
    known = [f"{name}:NAME" if kind.placed else name for name, kind in kinds().items()]
    raise UnknownName("sensor kind", name, known)
