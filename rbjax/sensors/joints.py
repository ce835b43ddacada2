"""Sensors of joints: one value per dof, values of one joint, and functions of a user.

    jointpos q,   jointvel v,   ballquat q / |q|,   ballangvel w
    jointlimitpos     d = q - lower or upper - q, if d < margin, else 0;   jointlimitvel  d'
A limit sensor reads the first end that is near, as in MuJoCo. The coordinate of a ball is minus the
angle of its rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import integer, real_array, real_number
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.forces.acting import applied_forces
from rbjax.forces.context import Context
from rbjax.forces.joints.limits import is_infinite
from rbjax.lanes import Lane, inner, safe_sqrt
from rbjax.lanes.arrays import select
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.model.record import Record
from rbjax.rotations import quaternion
from rbjax.sensors.columns import Columns
from rbjax.sensors.fixed import AXES, QUATERNION, FixedSensor, reading
from rbjax.sensors.protocol import register
from rbjax.sensors.solution import solution_of


class JointSensor(Record):
    """Base class of a sensor with one value per dof.

    units: units of a rotating and of a sliding joint; static.
    """

    units: ClassVar[tuple[str, str]]

    def columns(self, model: Model) -> Columns:
        return Columns(model.nv)

    def names(self, model: Model) -> tuple[str, ...]:
        """List the joint name of each value, with an index if the joint has several."""
        return _joint_columns(model, velocity=True)

    def unit(self, model: Model) -> str:
        kinds = set(model.topology.joint_kinds)
        if kinds <= {"hinge", "ball", "universal"}:
            return self.units[0]
        return self.units[1] if kinds <= {"slide"} else " or ".join(dict.fromkeys(self.units))


def _joint_columns(model: Model, *, velocity: bool) -> tuple[str, ...]:
    """List the names of the entries of q or v: "joint", or "joint[k]" if a joint has several."""
    names: list[str] = []
    for joint in model.joint_names:
        part = model.v_slice(joint) if velocity else model.q_slice(joint)
        size = part.stop - part.start
        names += [joint] if size == 1 else [f"{joint}[{k}]" for k in range(size)]
    return tuple(names)


@register("q")
class Positions(JointSensor):
    """Measure q (nq,); attitudes are quaternions."""

    units = ("rad", "m")

    def __call__(self, context: Context) -> jax.Array:
        return context.state.q

    def columns(self, model: Model) -> Columns:
        return Columns(model.nq, model.topology.quaternion_starts)

    def names(self, model: Model) -> tuple[str, ...]:
        """List the joint name of each value, with an index if the joint has several."""
        return _joint_columns(model, velocity=False)


@register("v")
class Velocities(JointSensor):
    """Measure v (nv,)."""

    units = ("rad/s", "m/s")

    def __call__(self, context: Context) -> jax.Array:
        return context.state.v


@register("a")
class Accelerations(JointSensor):
    """Measure v' (nv,), computed by the dynamics."""

    units = ("rad/s^2", "m/s^2")

    def __call__(self, context: Context) -> jax.Array:
        return solution_of(context).acceleration


@register("tau")
class Torques(JointSensor):
    """Measure the generalized forces (nv,) of actuators and of force elements that use controls.

    tau = moment^T f(u, l, l'). Springs, dampers and friction are not included.
    """

    units = ("N m", "N")

    def __call__(self, context: Context) -> jax.Array:
        model, state, t = context.model, context.state, context.t
        return applied_forces(model, state, context.ctrl, t) - applied_forces(model, state, None, t)


class Currents(JointSensor):
    """Measure the motor currents of the joints, i = tau / constant, in A.

    constant: (nv,) N m/A at the joint. It can be identified: "readings.current.constant".
    """

    units = ("A", "A")
    constant: jax.Array

    def __check_init__(self) -> None:
        if not isinstance(self.constant, jax.core.Tracer):
            values = real_array("Currents", "constant", self.constant, "numbers (nv,) in N m/A")
            if not values.all():
                raise InputError("Currents: constant has a 0, expected N m/A of each dof")

    def columns(self, model: Model) -> Columns:
        if (shape := jnp.shape(self.constant)) not in ((), (model.nv,)):
            raise InputError(
                f"Currents: constant has shape {shape}, expected ({model.nv},), one of each dof"
            )
        return super().columns(model)

    def __call__(self, context: Context) -> jax.Array:
        return Torques()(context) / jnp.asarray(self.constant, context.q.dtype)


class OneJointSensor(FixedSensor):
    """Base class of a sensor of one joint. joint: name or index; static.

    kinds: kinds of joints that have such a sensor; static.
    units: units of a rotating and of a sliding joint; static.
    """

    kinds: ClassVar[tuple[str, ...]] = ()
    units: ClassVar[tuple[str, str]] = ("", "")
    joint: str | int = eqx.field(static=True)

    def check(self, model: Model) -> None:
        kind = model.topology.joint_kinds[model.joint(self.joint)]
        size = model.topology.joints[model.joint(self.joint)].nv
        if kind not in self.kinds if self.kinds else size != 1:
            expected = " or ".join(self.kinds) or "a joint of one coordinate"
            name = model.joint_names[model.joint(self.joint)]
            raise InputError(
                f"{type(self).__name__}: joint {name!r} is a {kind} joint, expected {expected}"
            )

    def unit(self, model: Model) -> str:
        kind = model.topology.joint_kinds[model.joint(self.joint)]
        return self.units[kind == "slide"]


@register("jointpos", placed=True)
class JointPosition(OneJointSensor):
    """Measure the coordinate q of a joint."""

    units = ("rad", "m")

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, context.joint(self.joint).q[:1])


@register("jointvel", placed=True)
class JointVelocity(OneJointSensor):
    """Measure the velocity v of a joint."""

    units = ("rad/s", "m/s")

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, context.joint(self.joint).v[:1])


@register("jointactuatorfrc", placed=True)
class JointActuatorForce(OneJointSensor):
    """Measure the generalized force of all actuators on a joint, within its force range."""

    units = ("N m", "N")

    def __call__(self, context: Context) -> jax.Array:
        at = context.joint(self.joint).start
        return Torques()(context)[at : at + 1]


@register("ballquat", placed=True)
class BallQuaternion(OneJointSensor):
    """Measure the unit quaternion (4,) of a ball joint."""

    kinds, units, labels = ("ball",), ("1", "1"), QUATERNION
    attitudes, clipped = (0,), ""

    def __call__(self, context: Context) -> jax.Array:
        q = context.joint(self.joint).q
        scale = 1 / jnp.sqrt(inner(q, q))
        return reading(context, [x * scale for x in q])


@register("ballangvel", placed=True)
class BallAngularVelocity(OneJointSensor):
    """Measure the angular velocity (3,) of a ball joint in the axes of its body."""

    kinds, units, labels = ("ball",), ("rad/s", "rad/s"), AXES

    def __call__(self, context: Context) -> jax.Array:
        return reading(context, context.joint(self.joint).v)


class JointLimitSensor(OneJointSensor):
    """Base class of a sensor of the limit of a hinge, slide or ball.

    margin: distance from a limit, rad or m, below which the sensor reads it; static.
    """

    kinds = ("hinge", "slide", "ball")
    margin: float = eqx.field(static=True, default=0.0)

    def __check_init__(self) -> None:
        real_number(type(self).__name__, "margin", self.margin)

    def ends(self, context: Context) -> list[tuple[Lane, list[Lane]]]:
        """Return the distance to each end of the range, and the gradient of the distance."""
        joint, index = context.joint(self.joint), context.model.joint(self.joint)
        limits = table(context.model.joints.range, context.q.dtype)
        low, high = (lane(limits[:, k], index) for k in (0, 1))
        if joint.kind == "ball":
            turn = quaternion.log_lanes(list(joint.q))
            square = inner(turn, turn)
            some, angle = square > 0, safe_sqrt(square)
            scale = jnp.where(some, -1 / jnp.where(some, angle, 1.0), 0.0)
            return [] if is_infinite(high) else [(high - angle, [x * scale for x in turn])]
        found: list[tuple[Lane, list[Lane]]] = []
        if not is_infinite(low):
            found.append((joint.q[0] - low, [1.0]))
        if not is_infinite(high):
            found.append((high - joint.q[0], [-1.0]))
        return found

    def nearest(self, context: Context, value: Callable[[Lane, list[Lane]], Lane]) -> jax.Array:
        """Return value(distance, gradient) at an end of the range within the margin, or zero."""
        out: Any = jnp.zeros((), context.q.dtype)
        for distance, slope in reversed(self.ends(context)):
            out = select(distance < self.margin, value(distance, slope), out)
        return reading(context, [out])


@register("jointlimitpos", placed=True)
class JointLimitPosition(JointLimitSensor):
    """Measure the distance of a joint to its limit, less the margin; zero if it is positive."""

    units = ("rad", "m")

    def __call__(self, context: Context) -> jax.Array:
        return self.nearest(context, lambda distance, _: distance - self.margin)


@register("jointlimitvel", placed=True)
class JointLimitVelocity(JointLimitSensor):
    """Measure the rate of the distance of a joint to its limit; zero outside of the margin."""

    units = ("rad/s", "m/s")

    def __call__(self, context: Context) -> jax.Array:
        v = context.joint(self.joint).v
        return self.nearest(context, lambda _, slope: inner(slope, v))


class CustomSensor(Record):
    """A sensor defined by a function of a `Context`.

    Args:
        function: (context) -> (size,), traced.
        size: number of values.
        of: SI unit of the values, for messages.

    Example:
        >>> import rbjax as rb
        >>> height = rb.sensors.CustomSensor(lambda context: context.state.q[2:3], 1, "m")
        >>> setup = rb.sysid.Setup.of(rb.load("free_body")).with_sensors({"other:height": height})
        >>> sorted(setup.sensors)
        ['other:height', 'q', 'v']
    """

    function: Callable[[Context], jax.Array] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    of: str = eqx.field(static=True, default="")

    def __check_init__(self) -> None:
        check_takes("CustomSensor", "function", self.function, "context")
        integer("CustomSensor", "size", self.size, least=1)

    def __call__(self, context: Context) -> jax.Array:
        return self.function(context)

    def columns(self, model: Model) -> Columns:
        return Columns(self.size)

    def unit(self, model: Model) -> str:
        return self.of
