"""Limits of motors, wheels and steering, and motions in time."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance
from rbjax.errors import InputError
from rbjax.model.record import Record
from rbjax.wheeled import RobotModel, TorqueSource
from rbjax.wheeled.fields import check_ranges, number
from rbjax.wheeled.models.rolling import RollingModel


class Limits(Record):
    """Limits of a motion on absolute values. Infinity means no limit.

    Fields:
        torque: () or (drives,), of the drives, N m.
        speed: (), of the origin of the chassis, m/s.
        turn_rate: (), of the chassis, rad/s.
        steering_rate: (), rad/s.
        steering: (), the steering angle, rad; infinity for the largest angle on the path.

    Example:
        >>> Limits(torque=0.5, speed=1.0).torque.shape
        ()
    """

    torque: jax.Array = number()
    speed: jax.Array = number(default=np.inf)
    turn_rate: jax.Array = number(default=np.inf)
    steering_rate: jax.Array = number(default=np.inf)
    steering: jax.Array = number(default=np.inf)

    def __check_init__(self) -> None:
        names = ("torque", "speed", "turn_rate", "steering_rate", "steering")
        check_ranges(self, tables=("torque",), above=dict.fromkeys(names, 0.0))

    def may_be_infinite(self, name: str) -> bool:
        return name != "torque"

    def torques(self, model: RobotModel) -> jax.Array:
        """Return the largest torques (drives,), N m."""
        return jnp.broadcast_to(self.torque, (len(model.robot.drives),))


def check_can_follow(where: str, model: Any, limits: Any) -> None:
    """Raise `InputError` unless a robot has torques for every path, and its limits are valid.

    The robot must roll and have inertia. Its motors must be torque sources, with at least as many
    drives as free velocities. Its steerings must have no lag and a finite rate limit.
    """
    public = 'a robot that rolls and has inertia, as rbjax.wheeled.at(robot, "reduced") gives it'
    instance(where, "model", model, RollingModel, public)
    instance(where, "limits", limits, Limits, "rbjax.planning.Limits")
    robot = model.robot
    drives, nv = len(robot.drives), model.nv
    if jnp.shape(limits.torque) not in ((), (drives,)):
        raise InputError(
            f"{where}: limits.torque has shape {jnp.shape(limits.torque)}, expected () or "
            f"({drives},), one a drive"
        )
    if drives < nv:
        raise InputError(
            f"{where}: {drives} drives for {nv} velocities that the wheels leave free; expected at "
            "least as many drives, or a path has no torques"
        )
    for j, drive in enumerate(robot.drives):
        public = "TorqueSource: the controls are torques"
        instance(where, f"the motor of drives[{j}]", drive.motor, TorqueSource, public)
    for j, steering in enumerate(robot.steerings):
        if steering.lag is not None:
            raise InputError(
                f"{where}: steerings[{j}] has a lag, expected None: its control is a rate"
            )
    known = not isinstance(limits.steering_rate, jax.core.Tracer)
    if robot.steerings and known and not np.isfinite(limits.steering_rate):
        raise InputError(
            f"{where}: limits.steering_rate is infinite, expected a rate in rad/s: this robot "
            "steers"
        )


class Timed(Record):
    """A motion in time, with controls that are constant in each interval. Leading axes are a batch.

    Fields:
        ts: (n + 1,), from 0 and not decreasing, s. Intervals may be empty.
        q: (n + 1, nq), coordinates.
        v: (n + 1, nv), velocities.
        controls: (n, nu), torques of the drives in N m, then rates of the steerings in rad/s.

    Example:
        >>> m = Timed(jnp.array([0.0, 1.0, 3.0]), jnp.zeros((3, 1)), jnp.zeros((3, 1)),
        ...           jnp.array([[3.0], [0.0]]))
        >>> controls, dt = m.sampled(2)
        >>> controls.tolist(), float(dt)
        ([[2.0], [0.0]], 1.5)
    """

    ts: jax.Array
    q: jax.Array
    v: jax.Array
    controls: jax.Array

    @property
    def time(self) -> jax.Array:
        """The duration (...) of the motion, s."""
        return self.ts[..., -1]

    @property
    def durations(self) -> jax.Array:
        """Durations (..., n) of the intervals, s."""
        return self.ts[..., 1:] - self.ts[..., :-1]

    def sampled(self, steps: int) -> tuple[jax.Array, jax.Array]:
        """Resample the controls to (steps, nu) for `wheeled.rollout`. Return them and the step in
        s.

        The samples are means over equal times, which preserves the impulse of every torque. For
        many motions, use `jax.vmap`.
        """
        impulse = jnp.cumsum(self.durations[:, None] * self.controls, 0)
        impulse = jnp.concatenate([jnp.zeros_like(impulse[:1]), impulse])
        dt = self.time / steps
        at = dt * jnp.arange(steps + 1)
        sums = jax.vmap(lambda y: jnp.interp(at, self.ts, y), 1, 1)(impulse)
        return (sums[1:] - sums[:-1]) / dt, dt
