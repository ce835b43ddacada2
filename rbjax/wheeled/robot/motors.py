"""Motors of wheels: the torque that a command makes on a shaft at its speed, and what it costs.

    TorqueSource    tau = u
    SpeedServo      tau = L tanh(k (u - Omega) / L)
    DCMotor         V = V_b tanh(u / V_b),   i = (V - n K Omega) / R,   tau = n K i - b Omega

Omega is the speed of the driven shaft, behind a gear of ratio n. What comes in is torque and heat,

    P = tau Omega + Q,          DCMotor: P = V i,   Q = R i^2 + b Omega^2

and the rotor adds n^2 J to the inertia of the shaft. `forces.dc_motor` is the motor of a MuJoCo
file, with inductance, temperature and cogging.
"""

from __future__ import annotations

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.lanes import Lane
from rbjax.model.record import Record, check_number, floats
from rbjax.wheeled.tyres.tyre import check_above, check_at_least


def _number(**given: Any) -> Any:
    return eqx.field(converter=floats, **given)


class Motor(Record):
    """A motor of a shaft. A subclass defines `torque`, `free_speed`, `command_for` and `heat`.

    Class field: unit, the unit of the command.
    """

    unit: ClassVar[str]

    @property
    def inertia(self) -> Lane:
        """What it adds to the inertia of the shaft, kg m^2."""
        return 0.0

    @property
    def command_range(self) -> tuple[Lane, Lane]:
        """The smallest and the largest command that make a difference."""
        return -math.inf, math.inf

    @abc.abstractmethod
    def torque(self, u: Lane, speed: Lane) -> Lane:
        """The torque on the shaft, N m, of a command u at the shaft's speed, rad/s."""

    @abc.abstractmethod
    def free_speed(self, u: Lane) -> Lane:
        """The speed without load, rad/s: where `torque` is zero."""

    def command_for(self, speed: Lane) -> Lane:
        """The command whose free speed is `speed`, rad/s: the inverse of `free_speed`. Only
        `Commands.controls` uses it."""
        raise InputError(
            f"{type(self).__name__} does not define `command_for(speed)`, the inverse of "
            "`free_speed`; give the class this method, or compute the controls yourself"
        )

    def damping(self, u: Lane, speed: Lane) -> Lane:
        """By how much the torque falls for each rad/s towards the free speed, N m s/rad: the secant
        torque / (free speed - speed)."""
        return 0.0

    def heat(self, u: Lane, speed: Lane) -> Lane:
        """The power that is lost in the motor and its gear, W."""
        return 0.0

    def power_in(self, u: Lane, speed: Lane) -> Lane:
        """The power that it takes in, W; negative where it brakes and gives back."""
        return self.torque(u, speed) * speed + self.heat(u, speed)


class TorqueSource(Motor):
    """An ideal motor: the command is the torque, N m.

    Example:
        >>> import rbjax as rb
        >>> rb.wheeled.TorqueSource().torque(2.0, 10.0), rb.wheeled.TorqueSource().heat(2.0, 10.0)
        (2.0, 0.0)
    """

    unit = "N m"

    def torque(self, u: Lane, speed: Lane) -> Lane:
        return u

    def free_speed(self, u: Lane) -> Lane:
        raise InputError(
            "TorqueSource has no free speed: its torque is the same at any speed; a SpeedServo or "
            "a DCMotor has one: rbjax.wheeled.kinds()[...].make(motor=SpeedServo(gain))"
        )

    def command_for(self, speed: Lane) -> Lane:
        return self.free_speed(speed)  # it raises


class SpeedServo(Motor):
    """A drive that holds a speed: the command is that speed, rad/s. It is without losses.

        tau = L tanh(k (u - Omega) / L),    k (u - Omega) for an endless L

    Fields: gain k (), N m s/rad, above 0; limit L (), N m, above 0.

    Example:
        >>> import rbjax as rb
        >>> round(float(rb.wheeled.SpeedServo(0.5, 2.0).torque(10.0, 9.9)), 4)
        0.05
    """

    unit = "rad/s"
    gain: jax.Array = _number()
    limit: jax.Array = _number(default=math.inf)

    def __check_init__(self) -> None:
        _check_numbers(self, "gain", "limit")

    def may_be_endless(self, name: str) -> bool:
        return name == "limit"

    def torque(self, u: Lane, speed: Lane) -> Lane:
        return limited(self.gain * (u - speed), self.limit)

    def damping(self, u: Lane, speed: Lane) -> Lane:
        short = u - speed
        some = jnp.abs(short) > 1e-6
        return jnp.where(some, self.torque(u, speed) / jnp.where(some, short, 1.0), self.gain)

    def free_speed(self, u: Lane) -> Lane:
        return u

    def command_for(self, speed: Lane) -> Lane:
        return speed


class DCMotor(Motor):
    """A motor with a gear on a battery: the command is the voltage, V.

        V = V_b tanh(u / V_b),   i = (V - n K Omega) / R,   tau = n K i - b Omega

    Fields, all (): resistance R, ohm, above 0; torque_constant K, N m/A, which is also V s/rad;
    gear n; battery V_b, V, the limit of the voltage, above 0, infinite for none; friction b, N m
    s/rad at the shaft; rotor_inertia J, kg m^2, before the gear.

    Source: Corke, *Robotics, Vision and Control*, 9.1; Dhaouadi & Abu Hatab, Adv. Robot. Autom. 2,
    2013, eq. 46-50, for a differential drive.

    Example:
        >>> import rbjax as rb
        >>> motor = rb.wheeled.DCMotor(2.0, 0.05, gear=20.0)
        >>> float(motor.torque(12.0, 0.0)), float(motor.free_speed(12.0))
        (6.0, 12.0)
    """

    unit = "V"
    resistance: jax.Array = _number()
    torque_constant: jax.Array = _number()
    gear: jax.Array = _number(default=1.0)
    battery: jax.Array = _number(default=math.inf)
    friction: jax.Array = _number(default=0.0)
    rotor_inertia: jax.Array = _number(default=0.0)

    def __check_init__(self) -> None:
        _check_numbers(self, "resistance", "torque_constant", "battery")
        check_at_least(self, friction=0.0, rotor_inertia=0.0)

    def may_be_endless(self, name: str) -> bool:
        return name == "battery"

    @property
    def command_range(self) -> tuple[Lane, Lane]:
        """Three times the battery: there V is within 0.5 % of its limit."""
        return -3 * self.battery, 3 * self.battery

    @property
    def inertia(self) -> Lane:
        return self.gear * self.gear * self.rotor_inertia

    @property
    def _constant(self) -> Lane:
        """n K, at the shaft."""
        return self.gear * self.torque_constant

    def current(self, u: Lane, speed: Lane) -> Lane:
        """i, A."""
        return (limited(u, self.battery) - self._constant * speed) / self.resistance

    def torque(self, u: Lane, speed: Lane) -> Lane:
        return self._constant * self.current(u, speed) - self.friction * speed

    def damping(self, u: Lane, speed: Lane) -> Lane:
        return self._constant * self._constant / self.resistance + self.friction

    def free_speed(self, u: Lane) -> Lane:
        k = self._constant
        return k * limited(u, self.battery) / (self.resistance * self.friction + k * k)

    def command_for(self, speed: Lane) -> Lane:
        """The command, clipped to `command_range`: the battery allows no higher speed."""
        k = self._constant
        volts = speed * (self.resistance * self.friction + k * k) / k
        ends = jnp.isfinite(self.battery)
        full = jnp.where(ends, self.battery, 1.0)
        most = math.tanh(3.0)
        return jnp.where(ends, full * jnp.arctanh(jnp.clip(volts / full, -most, most)), volts)

    def heat(self, u: Lane, speed: Lane) -> Lane:
        i = self.current(u, speed)
        return self.resistance * i * i + self.friction * speed * speed

    def power_in(self, u: Lane, speed: Lane) -> Lane:
        return limited(u, self.battery) * self.current(u, speed)


def limited(x: Lane, limit: jax.Array) -> Lane:
    """L tanh(x / L), smooth and below L; x where L is infinite.

    >>> float(limited(3.0, jnp.array(jnp.inf))), round(float(limited(300.0, jnp.array(2.0))), 6)
    (3.0, 2.0)
    """
    ends = jnp.isfinite(limit)
    width = jnp.where(ends, limit, 1.0)
    return jnp.where(ends, width * jnp.tanh(x / width), x)


def _check_numbers(motor: Motor, *above_zero: str) -> None:
    for name in vars(motor):
        check_number(motor, name)
    check_above(motor, **dict.fromkeys(above_zero, 0.0))
