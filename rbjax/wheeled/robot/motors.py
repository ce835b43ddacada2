"""Motors of wheels: torque on a shaft as a function of command and speed, and power.

    TorqueSource    tau = u
    SpeedServo      tau = L tanh(k (u - Omega) / L)
    DCMotor         V = V_b tanh(u / V_b),   i = (V - n K Omega) / R,   tau = n K i - b Omega

Omega is the speed of the driven shaft, behind a gear of ratio n. The input power is
P = tau Omega + Q, with the heat Q. For a DCMotor P = V i and Q = R i^2 + b Omega^2.
"""

from __future__ import annotations

import abc
import math
from typing import ClassVar

import jax
import jax.numpy as jnp

from rbjax.errors import InputError
from rbjax.lanes import Lane
from rbjax.model.record import Record
from rbjax.wheeled.fields import check_ranges, number


class Motor(Record):
    """Base class of motors. A subclass defines `torque`, `free_speed`, `command_for` and `heat`.

    Class fields:
        unit: of the command.
        positive: names of the fields that must be above zero.
        nonnegative: names of the fields that must be at least zero.
        unlimited: the name of the field that may be infinite.
    """

    unit: ClassVar[str]
    positive: ClassVar[tuple[str, ...]] = ()
    nonnegative: ClassVar[tuple[str, ...]] = ()
    unlimited: ClassVar[str] = ""

    def __check_init__(self) -> None:
        above, least = (dict.fromkeys(x, 0.0) for x in (self.positive, self.nonnegative))
        check_ranges(self, above=above, least=least)

    def may_be_infinite(self, name: str) -> bool:
        return name == self.unlimited

    @property
    def inertia(self) -> Lane:
        """The inertia that the rotor adds to the shaft, kg m^2."""
        return 0.0

    @property
    def command_range(self) -> tuple[Lane, Lane]:
        """The smallest and the largest command below saturation."""
        return -math.inf, math.inf

    @abc.abstractmethod
    def torque(self, u: Lane, speed: Lane) -> Lane:
        """Compute the torque on the shaft, N m, for the command u and the shaft's speed, rad/s."""

    @abc.abstractmethod
    def free_speed(self, u: Lane) -> Lane:
        """Compute the no-load speed, rad/s, at which `torque` is zero."""

    def command_for(self, speed: Lane) -> Lane:
        """Compute the command whose no-load speed is `speed`, rad/s."""
        raise InputError(
            f"{type(self).__name__} does not define `command_for(speed)`, the inverse of "
            "`free_speed`; give the class this method, or compute the controls yourself"
        )

    def damping(self, u: Lane, speed: Lane) -> Lane:
        """Compute the damping torque / (no-load speed - speed), N m s/rad."""
        return 0.0

    def heat(self, u: Lane, speed: Lane) -> Lane:
        """Compute the power lost in the motor and its gear, W."""
        return 0.0

    def power_in(self, u: Lane, speed: Lane) -> Lane:
        """Compute the input power, W; negative if the motor brakes and recovers power."""
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
    """A speed controller without losses: the command is the speed, rad/s.

        tau = L tanh(k (u - Omega) / L),    k (u - Omega) for an infinite L

    Fields:
        gain: k (), N m s/rad, above 0.
        limit: L (), N m, above 0.

    Example:
        >>> import rbjax as rb
        >>> round(float(rb.wheeled.SpeedServo(0.5, 2.0).torque(10.0, 9.9)), 4)
        0.05
    """

    unit = "rad/s"
    positive = ("gain", "limit")
    unlimited = "limit"
    gain: jax.Array = number()
    limit: jax.Array = number(default=math.inf)

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

    The rotor adds n^2 J to the inertia of the shaft. The motor of a MuJoCo file, with inductance,
    temperature and cogging, is `rbjax.forces.actuators.dc_motor.DCMotor`.

    Fields, all ():
        resistance: R, ohm, above 0.
        torque_constant: K, N m/A, which is also V s/rad.
        gear: n.
        battery: V_b, V, the limit of the voltage, above 0; infinite for none.
        friction: b, N m s/rad at the shaft.
        rotor_inertia: J, kg m^2, before the gear.

    Source: Corke, *Robotics, Vision and Control*, 9.1; Dhaouadi & Abu Hatab, Adv. Robot. Autom. 2,
    2013, eq. 46-50, for a differential drive.

    Example:
        >>> import rbjax as rb
        >>> motor = rb.wheeled.DCMotor(2.0, 0.05, gear=20.0)
        >>> float(motor.torque(12.0, 0.0)), float(motor.free_speed(12.0))
        (6.0, 12.0)
    """

    unit = "V"
    positive = ("resistance", "torque_constant", "battery")
    nonnegative = ("friction", "rotor_inertia")
    unlimited = "battery"
    resistance: jax.Array = number()
    torque_constant: jax.Array = number()
    gear: jax.Array = number(default=1.0)
    battery: jax.Array = number(default=math.inf)
    friction: jax.Array = number(default=0.0)
    rotor_inertia: jax.Array = number(default=0.0)

    @property
    def command_range(self) -> tuple[Lane, Lane]:
        """Plus and minus three times the battery voltage. There V is within 0.5 % of its limit."""
        return -3 * self.battery, 3 * self.battery

    @property
    def inertia(self) -> Lane:
        return self.gear * self.gear * self.rotor_inertia

    @property
    def _constant(self) -> Lane:
        """The torque constant at the shaft: gear ratio times motor constant, N m/A."""
        return self.gear * self.torque_constant

    def current(self, u: Lane, speed: Lane) -> Lane:
        """Compute the current i, A."""
        return (limited(u, self.battery) - self._constant * speed) / self.resistance

    def torque(self, u: Lane, speed: Lane) -> Lane:
        return self._constant * self.current(u, speed) - self.friction * speed

    def damping(self, u: Lane, speed: Lane) -> Lane:
        return self._constant * self._constant / self.resistance + self.friction

    def free_speed(self, u: Lane) -> Lane:
        k = self._constant
        return k * limited(u, self.battery) / (self.resistance * self.friction + k * k)

    def command_for(self, speed: Lane) -> Lane:
        """Compute the command, clipped to `command_range`."""
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
    """Limit a number smoothly: L tanh(x / L); x if L is infinite.

    >>> float(limited(3.0, jnp.array(jnp.inf))), round(float(limited(300.0, jnp.array(2.0))), 6)
    (3.0, 2.0)
    """
    ends = jnp.isfinite(limit)
    width = jnp.where(ends, limit, 1.0)
    return jnp.where(ends, width * jnp.tanh(x / width), x)
