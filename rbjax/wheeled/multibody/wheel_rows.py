"""Constraints of the multibody model of a wheeled robot.

    wheel on the ground     u . s = 0,     u the velocity of the material point in contact
    steering column         b' as given, b'' = 0
    Ackermann's linkage     angle of a wheel = delta(b)
    differential            W = sum split_i phi'_i
With the axle's direction y, to the left, and the ground's normal n, the directions s are

    ahead    y x n                       the wheel rolls
    left     n x (y x n)                 it does not slide sideways
    roller   cos(roller) ahead + sin(roller) left      free rollers: only along their axes
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.constraints import Constraint, Place, Row, along, coordinate
from rbjax.constraints.rows.geometry import Y, Z
from rbjax.constraints.rows.rolling import slip, swept
from rbjax.errors import UnknownName
from rbjax.forces.context import Context, FrameState
from rbjax.forces.place import as_place, check_places
from rbjax.lanes import Lane, Vec3, add, mul, neg
from rbjax.model.leaves import numbers, scalar
from rbjax.model.record import check_number, floats
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import Parameters, parameters_of
from rbjax.wheeled.kinematics.planar import Dual, cross, direction, rate_of, value_of
from rbjax.wheeled.robot.robot import Robot

WAYS = ("ahead", "left", "roller")

Swept = tuple[Vec3, Vec3]  # a direction in world axes, and its rate


class WheelContact(Constraint):
    """Contact of a wheel with the ground: a row for each direction in which its lowest point is
    fixed.

    The multiplier of a row is the force of the ground on the wheel in its direction, N. The
    multiplier of the height is the load. The axle is level.

    Fields:
        a: a `Place` with its origin on the ground and its z the normal.
        b: a `Place` with its origin at the wheel's centre and its y the axle, to the left.
        radius: () m.
        roller: () rad, the angle of the rollers' axes from ahead to the left.
        ways: static, the directions, of "ahead", "left" and "roller".
        touches: static, whether the first row is the height of the lowest point.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.constraints import Place
        >>> from rbjax.wheeled.multibody.wheel_rows import WheelContact
        >>> blade = WheelContact(Place.on(), Place.on(body="box"), 0.1, ways=("left",))
        >>> rb.load("free_body").with_constraints(blade).constraints[0].size
        1
    """

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    radius: jax.Array = eqx.field(converter=floats)
    roller: jax.Array = eqx.field(converter=floats, default_factory=lambda: jnp.asarray(0.0))
    ways: tuple[str, ...] = eqx.field(static=True, default=("ahead", "left"))
    touches: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        check_places(self)
        check_number(self, "radius", positive=True)
        check_number(self, "roller")
        for way in self.ways:
            if way not in WAYS:
                raise UnknownName("way", way, WAYS)

    @property
    def size(self) -> int:
        return len(self.ways) + self.touches

    def rows(self, context: Context) -> Sequence[Row]:
        A, B = self.a.frame(context), self.b.frame(context)
        radius, dtype = scalar(self.radius, context.q.dtype), context.q.dtype
        n, dn = swept(A, Z)
        ways = _ways(A, B)
        if "roller" in self.ways:
            c, s = direction(scalar(self.roller, dtype))
            (ahead, d_ahead), (left, d_left) = ways["ahead"], ways["left"]
            ways["roller"] = ahead * c + left * s, d_ahead * c + d_left * s
        arm = n * neg(radius), dn * neg(radius)
        rows = slip(A, B, arm, [ways[way] for way in self.ways])
        return [along(A, Z, B) - radius, *rows] if self.touches else rows


def _ways(A: FrameState, B: FrameState) -> dict[str, Swept]:
    """Compute the directions ahead and to the left of wheel B on the ground A, with their rates."""
    (n, dn), (y, dy) = swept(A, Z), swept(B, Y)
    ahead, d_ahead = y.cross(n), dy.cross(n) + y.cross(dn)
    return {
        "ahead": (ahead, d_ahead),
        "left": (n.cross(ahead), dn.cross(ahead) + n.cross(d_ahead)),
    }


class SteeringRate(Constraint):
    """A prescribed rate of a hinge, v = rate, a = 0: a row of velocities only."""

    joint: str = eqx.field(static=True)  # the name of the hinge
    rate: jax.Array = eqx.field(converter=floats, default_factory=lambda: jnp.asarray(0.0))  # rad/s
    size = 1

    def __check_init__(self) -> None:
        check_number(self, "rate")

    def rows(self, context: Context) -> Sequence[Row]:
        rate = scalar(self.rate, context.q.dtype)
        return [coordinate(context, self.joint).time_derivative - rate]


class Linkage(Constraint):
    """Ackermann's geometry: the angle of a steered wheel as a function of the column's angle."""

    robot: Robot
    steering: int = eqx.field(static=True)  # index of the steering
    wheel: int = eqx.field(static=True)  # index of the wheel
    joint: str = eqx.field(static=True)  # the hinge of the wheel
    column: str = eqx.field(static=True)  # the hinge of the steering
    size = 1

    def rows(self, context: Context) -> Sequence[Row]:
        b = coordinate(context, self.column)
        n = parameters_of(self.robot, context.q.dtype)
        first, second, angle = linked(n, self.steering, self.wheel, b.value)
        acceleration = add(mul(first, b.acceleration), mul(second, mul(b.rate, b.rate)))
        target = Row(angle, mul(first, b.rate), b.gradient * first, acceleration)
        return [coordinate(context, self.joint) - target]


def linked(n: Parameters, steering: int, wheel: int, b: Lane) -> tuple[Lane, Lane, Lane]:
    """Compute a wheel's angle at the steering angle b, from its direction at zero steering. Return
    the first and second derivative by b, then the angle."""
    layout = n.layout
    q: list[Any] = [0.0] * layout.nq
    q[layout.steerings.start + steering] = Dual(Dual(b, 1.0), Dual(1.0, 0.0))
    e = RobotContext(n, q, [], [], []).shape.wheels[wheel]
    now = tuple(value_of(value_of(x)) for x in e)
    once = tuple(rate_of(value_of(x)) for x in e)
    twice = tuple(rate_of(rate_of(x)) for x in e)
    h = n.wheels[wheel].heading
    sine, cosine = cross(h, now), add(mul(h[0], now[0]), mul(h[1], now[1]))
    return cross(now, once), cross(now, twice), jnp.arctan2(sine, cosine)


class Differential(Constraint):
    """A differential: the angle of the motor's shaft equals the cage angle, sum split_i phi_i."""

    split: jax.Array = eqx.field(converter=floats)  # (k,), the shares of the wheels
    joint: str = eqx.field(static=True)  # the hinge of the shaft
    wheels: tuple[str, ...] = eqx.field(static=True)  # the hinges of the k wheels
    size = 1

    def rows(self, context: Context) -> Sequence[Row]:
        out = coordinate(context, self.joint)
        shares = numbers(self.split, context.q.dtype)
        for wheel, share in zip(self.wheels, shares, strict=True):
            out = out - coordinate(context, wheel) * share
        return [out]
