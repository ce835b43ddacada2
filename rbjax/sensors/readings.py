"""Readings: what a sensor of a robot would show at an instant of a motion.

    gyro = R^T w,      accelerometer = R^T (p'' - g),      current = torque / constant
A `Reading` is a function of a `Moment`, with its columns and its unit. Those of the joints are
called "q", "v", "a", "tau" and "current"; those of a place "pose:NAME" (a body or a site),
"position:SITE", "gyro:SITE" and "accelerometer:SITE"; a user's own is a `Reads`, "other:NAME".
Bias, scale and delay are those of the `Sensor` of the same name in the set-up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.frames import frame_pose, frame_velocity
from rbjax.dynamics.algorithms.kinematics import forward_kinematics
from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.errors import UnknownName
from rbjax.forces.acting import applied_forces
from rbjax.forces.inputs import Inputs
from rbjax.lanes import fusion_barrier
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.field import Field, free_motion, law_of
from rbjax.rotations import quaternion
from rbjax.sensors.columns import Columns


@dataclass(frozen=True)
class Moment:
    """An instant of a motion: t in s after its start, the state, the controls (nu,) that act, the
    set-up, and the step in s of the motion, which force elements see."""

    t: Any
    state: State
    ctrl: jax.Array
    setup: Any
    step: float | None = None

    @property
    def model(self) -> Model:
        return self.setup.model

    @property
    def acceleration(self) -> jax.Array:
        """v' (nv,), by the dynamics."""
        law = law_of("Moment", self.model, free_motion, None)
        field = Field(self.model, law, self.step)
        found = field.rates(self.t, self.state, Inputs(self.ctrl))[0]
        return jnp.stack(fusion_barrier(list(found)))


@runtime_checkable
class Reading(Protocol):
    """What an ideal sensor shows. A user's own has these three methods."""

    def __call__(self, now: Moment) -> jax.Array:
        """The numbers (n,) at an instant, traced."""
        ...

    def columns(self, model: Model) -> Columns:
        """How many numbers there are, and which are quaternions."""
        ...

    def unit(self, model: Model) -> str:
        """In SI."""
        ...


class Positions(Record):
    """q (nq,), attitudes as quaternions."""

    def __call__(self, now: Moment) -> jax.Array:
        return now.state.q

    def columns(self, model: Model) -> Columns:
        return Columns.of_positions(model)

    def unit(self, model: Model) -> str:
        return _of_joints(model, "rad", "m")


class _OfJoints(Record):
    """A number for each velocity coordinate."""

    def columns(self, model: Model) -> Columns:
        return Columns(model.nv)


class Velocities(_OfJoints):
    """v (nv,)."""

    def __call__(self, now: Moment) -> jax.Array:
        return now.state.v

    def unit(self, model: Model) -> str:
        return _of_joints(model, "rad/s", "m/s")


class Accelerations(_OfJoints):
    """v' (nv,), by the dynamics."""

    def __call__(self, now: Moment) -> jax.Array:
        return now.acceleration

    def unit(self, model: Model) -> str:
        return _of_joints(model, "rad/s^2", "m/s^2")


class Torques(_OfJoints):
    """The generalized forces (nv,) of what is actuated: tau = moment^T f(u, l, l') of actuators and
    of force elements that take controls, without springs, dampers and friction."""

    def __call__(self, now: Moment) -> jax.Array:
        driven = applied_forces(now.model, now.state, now.ctrl, now.t)
        return driven - applied_forces(now.model, now.state, None, now.t)

    def unit(self, model: Model) -> str:
        return _of_joints(model, "N m", "N")


class Currents(_OfJoints):
    """Motor currents of the joints: i = tau / constant, in A. constant (nv,) in N m/A at the joint
    can be an unknown: "readings.current.constant"."""

    constant: jax.Array

    def __call__(self, now: Moment) -> jax.Array:
        return Torques()(now) / self.constant

    def unit(self, model: Model) -> str:
        return "A"


class Pose(Record):
    """Position and quaternion (7,) of the frame of a body, or of a site, in the world."""

    name: str = eqx.field(static=True)

    def __call__(self, now: Moment) -> jax.Array:
        R, p = _pose(now, self.name)
        return jnp.concatenate([p, quaternion.from_matrix(R)])

    def columns(self, model: Model) -> Columns:
        if self.name not in (*model.body_names, *model.site_names):
            raise UnknownName("body or site", self.name, [*model.body_names, *model.site_names])
        return Columns(7, (3,))

    def unit(self, model: Model) -> str:
        return "m or rad"


class _AtSite(Record):
    """Three numbers at a site."""

    site: str = eqx.field(static=True)

    def columns(self, model: Model) -> Columns:
        model.site(self.site)
        return Columns(3)


class Position(_AtSite):
    """p (3,) of a site in the world: a marker of motion capture."""

    def __call__(self, now: Moment) -> jax.Array:
        return frame_pose(now.model, now.state.q, site=self.site)[1]

    def unit(self, model: Model) -> str:
        return "m"


class Gyro(_AtSite):
    """The angular velocity R^T w (3,) of a site, in its own axes."""

    def __call__(self, now: Moment) -> jax.Array:
        R, _ = frame_pose(now.model, now.state.q, site=self.site)
        return R.T @ frame_velocity(now.model, now.state.q, now.state.v, site=self.site)[:3]

    def unit(self, model: Model) -> str:
        return "rad/s"


class Accelerometer(_AtSite):
    """The specific force R^T (p'' - g) (3,) at a site, in its own axes. One at rest shows g
    upwards, one in free fall zero."""

    def __call__(self, now: Moment) -> jax.Array:
        model, (q, v) = now.model, (now.state.q, now.state.v)
        a = now.acceleration

        def velocity(s: jax.Array) -> jax.Array:
            at = integrate(model, q, s * v)
            return frame_velocity(model, at, v + s * a, site=self.site)[3:]

        _, rate = jax.jvp(velocity, (jnp.zeros((), q.dtype),), (jnp.ones((), q.dtype),))
        R, _ = frame_pose(model, q, site=self.site)
        return R.T @ (rate - jnp.asarray(model.gravity, q.dtype))

    def unit(self, model: Model) -> str:
        return "m/s^2"


class Reads(Record):
    """A function of a user as a reading.

    Args:
        function: (t, state, setup) -> (size,), traced.
        size: how many numbers it gives.
        of: their unit in SI, for messages.

    Example:
        >>> import rbjax as rb
        >>> height = rb.sysid.Reads(lambda t, state, setup: state.q[2:3], 1, "m")
        >>> setup = rb.sysid.Setup.of(rb.load("free_body")).with_sensors({"other:height": height})
        >>> sorted(setup.sensors)
        ['other:height', 'q', 'v']
    """

    function: Callable[[Any, State, Any], jax.Array] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    of: str = eqx.field(static=True, default="")

    def __call__(self, now: Moment) -> jax.Array:
        return self.function(now.t, now.state, now.setup)

    def columns(self, model: Model) -> Columns:
        return Columns(self.size)

    def unit(self, model: Model) -> str:
        return self.of


JOINTS: dict[str, Reading] = {
    "q": Positions(), "v": Velocities(), "a": Accelerations(), "tau": Torques(),
}  # fmt: skip
PLACED: dict[str, Callable[[str], Reading]] = {
    "pose": Pose, "position": Position, "gyro": Gyro, "accelerometer": Accelerometer,
}  # fmt: skip


def reading_of(sensor: str) -> Reading:
    """The reading of a sensor's name, "gyro:imu".

    Raises:
        UnknownName: a sensor that only the set-up knows, or none.
    """
    kind, _, where = sensor.partition(":")
    if sensor in JOINTS:
        return JOINTS[sensor]
    if where and kind in PLACED:
        return PLACED[kind](where)
    known = [*JOINTS, *(f"{kind}:NAME" for kind in PLACED)]
    raise UnknownName("sensor that needs no reading of its own", sensor, known)


def _pose(now: Moment, name: str) -> tuple[jax.Array, jax.Array]:
    model, q = now.model, now.state.q
    if name not in model.body_names:
        return frame_pose(model, q, site=name)
    poses, k = forward_kinematics(model, q), model.body(name)
    return poses.R[k], poses.p[k]


def _of_joints(model: Model, turning: str, sliding: str) -> str:
    """The unit of joints that turn, slide, or do either."""
    kinds = set(model.topology.joint_kinds)
    if kinds <= {"hinge", "ball", "universal"}:
        return turning
    return sliding if kinds <= {"slide"} else f"{turning} or {sliding}"
