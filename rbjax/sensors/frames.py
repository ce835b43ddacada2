"""Sensors of a frame: pose, axes, velocity and acceleration, in the world or in another frame.

    framepos      R_r^T (p - p_r)
    framequat     q_r^* q
    frame?axis    R_r^T R e
    framelinvel   R_r^T (v - v_r - w_r x (p - p_r))
    frameangvel   R_r^T (w - w_r)
    framelinacc   p'' - g
    frameangacc   w'
R, p, v, w are those of the frame, and the index r those of the reference; without a reference they
are in world axes. (MuJoCo, *XML reference*, sensor.)
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax

from rbjax.forces.context import Context, FrameState
from rbjax.lanes import Vec3
from rbjax.model import Frame, Model
from rbjax.model.leaves import numbers
from rbjax.rotations import quaternion
from rbjax.sensors.attitude import attitude
from rbjax.sensors.fixed import AXES, QUATERNION, FrameSensor, named_frame, reading
from rbjax.sensors.protocol import register
from rbjax.sensors.solution import solution_of


class RelativeFrameSensor(FrameSensor):
    """Base class of a sensor of a frame relative to a reference.

    reference: frame of the reference, as `frame`; None for the world; static.
    """

    reference: Any = eqx.field(static=True, default=None)

    def check(self, model: Model) -> None:
        super().check(model)
        if self.reference is not None:
            FrameSensor(self.reference).check(model)

    def base(self, context: Context) -> FrameState | None:
        """Return the frame of the reference at an instant, or None."""
        if self.reference is None:
            return None
        return context.frame(named_frame(context.model, self.reference))


@register("position", placed=True)
@register("framepos", placed=True)
class Position(RelativeFrameSensor):
    """Measure the position p (3,) of a frame, as by motion capture of a marker.

    It is in world axes, or in the frame of the reference.
    """

    of = "m"

    def __call__(self, context: Context) -> jax.Array:
        base, p = self.base(context), self.at(context).position
        return reading(context, p if base is None else base.rotation.T @ (p - base.position))


@register("framequat", placed=True)
class Attitude(RelativeFrameSensor):
    """Measure the attitude of a frame as a quaternion (4,), (w, x, y, z)."""

    labels, attitudes, of, clipped = QUATERNION, (0,), "1", ""

    def __call__(self, context: Context) -> jax.Array:
        turn = attitude(context, named_frame(context.model, self.frame))
        if self.reference is not None:
            w, x, y, z = attitude(context, named_frame(context.model, self.reference))
            turn = quaternion.product([w, -x, -y, -z], turn)
        return reading(context, turn)


class FrameAxis(RelativeFrameSensor):
    """Base class of a sensor of an axis (3,) of a frame. index: 0, 1 or 2 for x, y or z; static."""

    index: ClassVar[int] = 0
    clipped = ""

    def __call__(self, context: Context) -> jax.Array:
        base, axis = self.base(context), self.at(context).rotation.columns[self.index]
        return reading(context, axis if base is None else base.rotation.T @ axis)


@register("framexaxis", placed=True)
class FrameXAxis(FrameAxis):
    """Measure the x axis (3,) of a frame."""


@register("frameyaxis", placed=True)
class FrameYAxis(FrameAxis):
    """Measure the y axis (3,) of a frame."""

    index = 1


@register("framezaxis", placed=True)
class FrameZAxis(FrameAxis):
    """Measure the z axis (3,) of a frame."""

    index = 2


@register("framelinvel", placed=True)
class LinearVelocity(RelativeFrameSensor):
    """Measure the velocity (3,) of the origin of a frame, in world axes or seen from a reference.

    R_r^T (v - v_r - w_r x (p - p_r)), the rate of `Position` with the same reference.
    """

    of = "m/s"

    def __call__(self, context: Context) -> jax.Array:
        base, own = self.base(context), self.at(context)
        if base is None:
            return reading(context, own.velocity)
        carried = base.velocity + base.angular_velocity.cross(own.position - base.position)
        return reading(context, base.rotation.T @ (own.velocity - carried))


@register("frameangvel", placed=True)
class AngularVelocity(RelativeFrameSensor):
    """Measure the angular velocity (3,) of a frame, in world axes or relative to a reference."""

    of = "rad/s"

    def __call__(self, context: Context) -> jax.Array:
        base, w = self.base(context), self.at(context).angular_velocity
        if base is None:
            return reading(context, w)
        return reading(context, base.rotation.T @ (w - base.angular_velocity))


@register("framelinacc", placed=True)
class LinearAcceleration(FrameSensor):
    """Measure the acceleration less gravity, p'' - g (3,), of the origin of a frame, world axes."""

    of = "m/s^2"

    def __call__(self, context: Context) -> jax.Array:
        moving = self.at(solution_of(context).accelerated)
        return reading(context, moving.acceleration - gravity(context))


@register("frameangacc", placed=True)
class AngularAcceleration(FrameSensor):
    """Measure the angular acceleration w' (3,) of a frame in world axes."""

    of = "rad/s^2"

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, self.at(solution_of(context).accelerated).angular_acceleration)


@register("pose", placed=True)
class Pose(FrameSensor):
    """Measure [position; quaternion] (7,) of a frame in the world, as by motion capture.

    frame: an `rb.Frame`, or the name of a body, or of a site if no body has the name; static.
    """

    labels, attitudes, of = (*AXES, *QUATERNION), (3,), "m or rad"

    def check(self, model: Model) -> None:
        FrameSensor(self._named(model)).check(model)

    def __call__(self, context: Context) -> jax.Array:
        named = self._named(context.model)
        return reading(context, [*context.frame(named).position, *attitude(context, named)])

    def _named(self, model: Model) -> Frame:
        return named_frame(model, self.frame, body_first=True)


def gravity(context: Context) -> Vec3:
    """Return the acceleration of gravity in world axes."""
    return Vec3(*numbers(context.model.gravity, context.q.dtype))
