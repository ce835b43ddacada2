"""Ideal sensors: joints, sites, motion capture, motor currents, and user functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics import forward_kinematics, frame_pose, frame_velocity, integrate
from rbjax.errors import UnknownName
from rbjax.forces.acting import applied_forces
from rbjax.forces.context import Context
from rbjax.forces.inputs import Inputs
from rbjax.lanes import fusion_barrier
from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.motion.field import Field, dynamics_of, free_motion
from rbjax.rotations import quaternion
from rbjax.sensors.columns import Columns
from rbjax.sensors.protocol import register


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


def acceleration(context: Context) -> jax.Array:
    """Return the acceleration v' (nv,) of the model at an instant, computed once per context."""

    def compute() -> jax.Array:
        dynamics = dynamics_of("acceleration", context.model, free_motion, None)
        field, inputs = Field(context.model, dynamics, context.dt), Inputs(context.ctrl)
        a, _ = field.rates(context.t, context.state, inputs)
        return jnp.stack(fusion_barrier(list(a)))

    return context.once(acceleration, compute)


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
        return acceleration(context)


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

    def __call__(self, context: Context) -> jax.Array:
        return Torques()(context) / self.constant


class SiteSensor(Record):
    """Base class of a sensor with three values at a site, given by its name or index.

    of: the SI unit; static.
    """

    of: ClassVar[str]
    site: str | int = eqx.field(static=True)

    def columns(self, model: Model) -> Columns:
        model.site(self.site)
        return Columns(3)

    def names(self, model: Model) -> tuple[str, ...]:
        """List the names of the axes."""
        return "x", "y", "z"

    def unit(self, model: Model) -> str:
        return self.of


@register("position", placed=True)
class Position(SiteSensor):
    """Measure the position p (3,) of a site in the world, as by motion capture of a marker."""

    of = "m"

    def __call__(self, context: Context) -> jax.Array:
        return frame_pose(context.model, context.state.q, site=self.site)[1]


@register("gyro", placed=True)
class Gyro(SiteSensor):
    """Measure the angular velocity R^T w (3,) of a site in its own axes."""

    of = "rad/s"

    def __call__(self, context: Context) -> jax.Array:
        model, state = context.model, context.state
        R, _ = frame_pose(model, state.q, site=self.site)
        return R.T @ frame_velocity(model, state.q, state.v, site=self.site)[:3]


@register("accelerometer", placed=True)
class Accelerometer(SiteSensor):
    """Measure the specific force R^T (p'' - g) (3,) at a site in its own axes.

    A sensor at rest measures g upwards. A sensor in free fall measures zero.
    """

    of = "m/s^2"

    def __call__(self, context: Context) -> jax.Array:
        model, (q, v) = context.model, (context.state.q, context.state.v)
        a = acceleration(context)

        def velocity(s: jax.Array) -> jax.Array:
            at = integrate(model, q, s * v)
            return frame_velocity(model, at, v + s * a, site=self.site)[3:]

        _, rate = jax.jvp(velocity, (jnp.zeros((), q.dtype),), (jnp.ones((), q.dtype),))
        R, _ = frame_pose(model, q, site=self.site)
        return R.T @ (rate - jnp.asarray(model.gravity, q.dtype))


@register("pose", placed=True)
class Pose(Record):
    """Measure [position; quaternion] (7,) of a body or site in the world, as by motion capture.

    name: name of the body, or of a site if no body has the name.
    """

    name: str = eqx.field(static=True)

    def __call__(self, context: Context) -> jax.Array:
        model, q = context.model, context.state.q
        if self.name in model.body_names:
            poses, k = forward_kinematics(model, q), model.body(self.name)
            R, p = poses.R[k], poses.p[k]
        else:
            R, p = frame_pose(model, q, site=self.name)
        return jnp.concatenate([p, quaternion.from_matrix(R)])

    def columns(self, model: Model) -> Columns:
        if self.name not in (*model.body_names, *model.site_names):
            raise UnknownName("body or site", self.name, [*model.body_names, *model.site_names])
        return Columns(7, (3,))

    def names(self, model: Model) -> tuple[str, ...]:
        """List the names of the entries of the position and the quaternion."""
        return "x", "y", "z", "qw", "qx", "qy", "qz"

    def unit(self, model: Model) -> str:
        return "m or rad"


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

    def __call__(self, context: Context) -> jax.Array:
        return self.function(context)

    def columns(self, model: Model) -> Columns:
        return Columns(self.size)

    def unit(self, model: Model) -> str:
        return self.of
