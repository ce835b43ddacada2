"""Odometry: poses of a robot from the angles of its wheels, which roll or slip.

    u = S (J S)^+ phi'           the twist of rolling wheels, from the rates of shafts
    V = u, or V = slip(u)        the twist of the robot
    pose' = pose * exp(V dt)     exact if V is constant between two samples
S is a basis of the twists that the wheels allow at the steering angles. J is the derivative of the
shafts' rates by the twist. Motions are assumed to be quasi-static.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance
from rbjax.compiling import compiled
from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.errors import InputError
from rbjax.lanes import safe_sqrt
from rbjax.lanes.arrays import matmat, matvec
from rbjax.model.record import Record
from rbjax.wheeled.fields import check_ranges, number
from rbjax.wheeled.kinematics.parameters import indices, parameters_of, stack_lanes
from rbjax.wheeled.kinematics.velocities import drive_speeds, rolling_velocities
from rbjax.wheeled.kinematics.velocities import shape_of as shape_of_robot
from rbjax.wheeled.robot.robot import Robot


class HeadingSlip(Record):
    """Model of slip: the twist V of a robot as a function of the twist u of rolling wheels.

        (vx, vy, arm w) = C z,      s = |(ux, uy)|,   psi = atan2(uy, ux)
        z = (arm uw,  s, s cos psi, s sin psi, ..., s sin K psi,
             (s / speed - 1) s (1, cos psi, ..., sin J psi))
    The balance of dry friction depends on the direction of motion and not on its speed, so V is
    homogeneous in u, except for the last terms. The pattern of n evenly spaced wheels has the
    harmonics 2 n - 1 and 2 n + 1: 5 and 7 for three wheels.

    Fields:
        coefficients: C (3, terms).
        arm: (), the size of the robot, m.
        speed: (), m/s.
        harmonics: static, K, 1 or more.
        speed_harmonics: static, J, the harmonics that change with the speed; -1 for none.

    Example:
        >>> import rbjax as rb
        >>> carpet = rb.wheeled.HeadingSlip.none(arm=0.125)
        >>> carpet = carpet.replace(coefficients=0.7 * carpet.coefficients)
        >>> [round(float(x), 3) for x in carpet([0.1, 0.0, 1.0])]
        [0.07, 0.0, 0.7]
    """

    coefficients: jax.Array = number()
    arm: jax.Array = number()
    speed: jax.Array = number(default=0.1)
    harmonics: int = eqx.field(static=True, default=1)
    speed_harmonics: int = eqx.field(static=True, default=-1)

    def __check_init__(self) -> None:
        above = {"arm": 0.0, "speed": 0.0}
        check_ranges(self, tables=("coefficients",), above=above)
        K, J = self.harmonics, self.speed_harmonics
        if not (isinstance(K, int) and isinstance(J, int) and K >= 1 and J >= -1):
            raise InputError(
                f"HeadingSlip: harmonics is {K!r} and speed_harmonics {J!r}, expected "
                "integers of at least 1 and -1"
            )
        due = (3, 1 + (2 * K + 1) + (2 * J + 1 if J >= 0 else 0))
        if jnp.shape(self.coefficients) != due:
            raise InputError(
                f"HeadingSlip: coefficients has shape {jnp.shape(self.coefficients)}, expected "
                f"{due} with harmonics={K} and speed_harmonics={J}"
            )

    @classmethod
    def none(
        cls, arm: Any, harmonics: int = 1, speed_harmonics: int = -1, speed: Any = 0.1
    ) -> HeadingSlip:
        """Make the model of wheels that do not slip, with the robot's twist equal to the rolling
        twist."""
        terms = 1 + (2 * harmonics + 1) + (2 * speed_harmonics + 1 if speed_harmonics >= 0 else 0)
        C = jnp.zeros((3, terms)).at[jnp.arange(3), jnp.array([2, 3, 0])].set(1.0)
        return cls(C, arm, speed, harmonics, speed_harmonics)

    def terms(self, twist: Any) -> jax.Array:
        """Compute the terms z (..., terms) from twists u (..., 3)."""
        u = jnp.asarray(twist)
        s = safe_sqrt((u[..., :2] ** 2).sum(-1))
        some = jnp.where(s > 0, s, 1.0)
        e = jnp.stack([jnp.where(s > 0, u[..., 0] / some, 1.0), u[..., 1] / some], -1)
        waves = [jnp.ones_like(s), e[..., 0], e[..., 1]]
        for _ in range(1, max(self.harmonics, self.speed_harmonics)):
            c, d = waves[-2:]
            waves += [c * e[..., 0] - d * e[..., 1], d * e[..., 0] + c * e[..., 1]]
        out = [self.arm * u[..., 2], *(s * x for x in waves[: 2 * self.harmonics + 1])]
        if self.speed_harmonics >= 0:
            more = (s / self.speed - 1) * s
            out += [more * x for x in waves[: 2 * self.speed_harmonics + 1]]
        return jnp.stack(out, -1)

    def columns(self, twist: Any) -> jax.Array:
        """Compute the derivatives (..., 3, 3 terms) of (vx, vy, arm w) by the flattened
        coefficients."""
        z = self.terms(twist)
        wide = jnp.eye(3, dtype=z.dtype)[:, :, None] * z[..., None, None, :]
        return wide.reshape(*z.shape[:-1], 3, -1)

    def __call__(self, twist: Any) -> jax.Array:
        """Compute the robot's twist (..., 3) from the twist (..., 3) if the wheels did not slip."""
        V = self.terms(twist) @ self.coefficients.T
        return V.at[..., 2].divide(self.arm)


def rolled_twists(robot: Robot, rates: Any, steering: Any = None) -> jax.Array:
    """Compute the twists (..., 3) of rolling wheels from the rates of the drives' shafts.

    The solution is in least squares over the drives.

    Args:
        robot: its drives must determine its motion: at least `arrangement.mobility` of them.
        rates: (..., drives), rad/s. For a differential it is the speed of its cage.
        steering: (..., steerings), the steering angles, rad; None for a robot without steerings.

    Returns:
        (..., 3), m/s, m/s and rad/s.

    Raises:
        InputError: the drives do not determine the motion; a wrong number of rates or of angles.

    Source: Lynch & Park, *Modern Robotics*, 13.4.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["omni_3"].make(arm=0.2, radius=0.05)
        >>> round(float(rb.wheeled.rolled_twists(robot, [4.0, 4.0, 4.0])[2]), 3)
        1.0
        >>> car = rb.wheeled.kinds()["car"].make(wheelbase=2.0, radius=0.3)
        >>> [round(float(x), 3) for x in rb.wheeled.rolled_twists(car, [10.0], [0.463647609])]
        [3.0, 0.0, 0.75]
    """
    _check_robot("rolled_twists", robot, steering)
    shape = shape_of("rolled_twists", "rates", rates)[:-1]
    rates = check_array("rolled_twists", "rates", rates, (*shape, len(robot.drives)))
    count = len(robot.steerings)
    steering = jnp.zeros((*shape, 0)) if steering is None else steering
    steering = check_array("rolled_twists", "steering", steering, (*shape, count))
    return _rolled(robot, rates, steering.astype(rates.dtype))


def _check_robot(where: str, robot: Any, steering: Any) -> None:
    instance(where, "robot", robot, Robot, "a Robot")
    if len(robot.drives) < robot.arrangement.mobility:
        raise InputError(
            f"{where}: the wheels leave {robot.arrangement.mobility} velocities free and "
            f"{len(robot.drives)} are driven, expected at least one drive for each; otherwise the "
            "angles of the drives do not determine the motion"
        )
    if (steering is None) != (not robot.steerings):
        raise InputError(
            f"{where}: steering is {'None' if steering is None else 'given'} and the robot has "
            f"{len(robot.steerings)} steerings; expected their measured angles in rad, one column "
            "each, or None for a robot without steerings"
        )


@compiled
def _rolled(robot: Robot, rates: jax.Array, steering: jax.Array) -> jax.Array:
    n = parameters_of(robot, rates.dtype)
    nv = robot.arrangement.mobility

    def of(rates: jax.Array, angles: jax.Array) -> jax.Array:
        q: list[Any] = [0.0] * robot.layout.nq
        for at, j in enumerate(indices(robot.layout.steerings)):
            q[j] = angles[at]

        def by_free(free: jax.Array) -> jax.Array:
            w = rolling_velocities(
                n, shape_of_robot(n, q[3 : robot.layout.casters.stop]), list(free)
            )
            return stack_lanes([*w[:3], *drive_speeds(n, n.shaft_rates(w))], rates.dtype)

        S = jax.jacfwd(by_free)(jnp.zeros(nv, rates.dtype))
        return matvec(matmat(S[:3], jnp.linalg.pinv(S[3:])), rates)

    batch, count = rates.shape[:-1], steering.shape[-1]
    flat = rates.reshape(-1, rates.shape[-1])
    if not count:  # one matrix for all
        found = jax.vmap(of, (0, None))(flat, jnp.zeros(0, rates.dtype))
    else:
        found = jax.vmap(of)(flat, steering.reshape(-1, count))
    return found.reshape(*batch, 3)


def odometry(
    robot: Robot,
    t: Any,
    angles: Any,
    slip: HeadingSlip | None = None,
    pose: Any = None,
    *,
    steering: Any = None,
) -> jax.Array:
    """Compute the poses of a robot from the angles of its wheels, as measured by encoders.

    Args:
        robot: its drives must determine its motion, as for a differential drive, a car, a tricycle
            or an omnidirectional robot.
        t: (T,), not decreasing, s. Increasing if there is a `slip`, which depends on rates.
        angles: (T, drives), of the drives' shafts, rad. For a differential it is the angle of its
            cage, which is the mean of the angles of its wheels.
        slip: the model of slip; None if the wheels roll.
        pose: (3,), the first pose, x and y in m and yaw in rad; zeros if None.
        steering: (T, steerings), the steering angles, rad; None for a robot without steerings. The
            mean of two samples is used between them.

    Returns:
        (T, 3) poses. The yaw is not wrapped.

    Raises:
        InputError: wrong types or shapes, values that are not finite, decreasing times; drives that
            do not determine the motion.

    Source: Lynch & Park, *Modern Robotics*, 13.4.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> robot = rb.wheeled.kinds()["differential_drive"].make(track=0.4, radius=0.1)
        >>> t = jnp.linspace(0.0, 2.0, 5)
        >>> turned = rb.wheeled.odometry(robot, t, t[:, None] * jnp.array([2.0, -2.0]))
        >>> round(float(turned[-1, 2]), 3)
        2.0
    """
    _check_robot("odometry", robot, steering)
    instance("odometry", "slip", slip, HeadingSlip | None, "a HeadingSlip or None")
    (count,) = shape_of("odometry", "t", t)[:1] or (0,)
    t = _times("odometry", t, rising=slip is not None)
    angles = check_array("odometry", "angles", angles, (count, len(robot.drives)))
    bends = jnp.zeros((count, 0)) if steering is None else steering
    bends = check_array("odometry", "steering", bends, (count, len(robot.steerings)))
    first = check_array("odometry", "pose", jnp.zeros(3) if pose is None else pose, (3,))
    dtype = angles.dtype
    return _poses(robot, t.astype(dtype), angles, bends.astype(dtype), slip, first.astype(dtype))


def _times(where: str, t: Any, rising: bool) -> jax.Array:
    """Check that there are at least two times, which must not decrease or, if `rising`, must
    increase."""
    (count,) = shape_of(where, "t", t)[:1] or (0,)
    t = check_array(where, "t", t, (max(count, 2),))
    if not isinstance(t, jax.core.Tracer):
        step = np.diff(np.asarray(t))
        wrong = np.flatnonzero(step <= 0 if rising else step < 0)
        if len(wrong):
            k = int(wrong[0]) + 1
            raise InputError(
                f"{where}: t[{k}] is {float(t[k])} after {float(t[k - 1])}, expected times that "
                f"{'increase' if rising else 'do not decrease'}; leave out repeated samples, "
                "which numpy.unique(t, return_index=True) finds"
            )
    return t


@compiled
def _poses(
    robot: Robot,
    t: jax.Array,
    angles: jax.Array,
    steering: jax.Array,
    slip: HeadingSlip | None,
    first: jax.Array,
) -> jax.Array:
    # a twist times a time: without slip no time is needed, so equal time stamps are allowed
    step = _rolled(robot, jnp.diff(angles, axis=0), (steering[1:] + steering[:-1]) / 2)
    if slip is not None:
        dt = jnp.diff(t)[:, None]
        some = dt > 0
        step = jnp.where(some, slip(step / jnp.where(some, dt, 1.0)) * dt, step)
    yaw = first[2] + jnp.concatenate([jnp.zeros(1, step.dtype), jnp.cumsum(step[:, 2])])
    chord = _chord(step[:, 2])[:, None] * step[:, :2]
    places = jnp.cumsum(_turned(yaw[:-1] + step[:, 2] / 2, chord), 0)
    places = first[:2] + jnp.concatenate([jnp.zeros((1, 2), places.dtype), places])
    return jnp.concatenate([places, yaw[:, None]], -1)


def mean_twists(t: Any, poses: Any) -> jax.Array:
    """Compute the constant twists (T - 1, 3), in the robot's axes, from each pose to the next.

    It is the inverse of `odometry`, for example for poses measured by a camera.

    Args:
        t: (T,), increasing, s.
        poses: (T, 3), with the yaw not wrapped.

    Returns:
        (T - 1, 3), m/s, m/s and rad/s.

    Raises:
        InputError: wrong shapes, values that are not finite, times that do not increase.

    Example:
        >>> import rbjax as rb
        >>> seen = rb.wheeled.mean_twists([0.0, 2.0], [[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
        >>> [round(float(x), 3) for x in seen[0]]
        [0.2, 0.0, 0.0]
    """
    (count,) = shape_of("mean_twists", "t", t)[:1] or (0,)
    t = _times("mean_twists", t, rising=True)
    poses = check_array("mean_twists", "poses", poses, (count, 3))
    step = jnp.diff(poses, axis=0)
    along = _turned(-(poses[:-1, 2] + step[:, 2] / 2), step[:, :2])
    along = along / _chord(step[:, 2])[:, None]
    return jnp.concatenate([along, step[:, 2:]], -1) / jnp.diff(t)[:, None]


def _turned(angle: jax.Array, v: jax.Array) -> jax.Array:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def _chord(angle: jax.Array) -> jax.Array:
    """Compute the ratio of the chord to the arc, sin(a / 2) / (a / 2)."""
    return jnp.sinc(angle / (2 * jnp.pi))
