"""Where a robot has gone by the angles of its wheels, rolling or slipping.

    u = J^+ phi'                 the twist at which the wheels would roll, by the rates of shafts
    V = u, or V = slip(u)        the twist of the robot
    pose' = pose * exp(V dt)     exact where V is constant from one sample to the next
It has no dynamics: motions are slow enough for the forces on the ground to balance at each instant.
For robots whose wheels leave all three velocities free, as those with rollers do.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.compiling import compiled
from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.errors import InputError
from rbjax.model.record import Record, check_fields, check_number, floats
from rbjax.wheeled.following import commands
from rbjax.wheeled.robot import Robot


class HeadingSlip(Record):
    """The twist of a robot that slips, by the twist u at which its wheels would roll.

        (vx, vy, arm w) = C z,      s = |(ux, uy)|,   psi = atan2(uy, ux)
        z = (arm uw,  s, s cos psi, s sin psi, ..., s sin K psi,
             (s / speed - 1) s (1, cos psi, ..., sin J psi))
    The balance of dry friction depends on the direction of motion and not on its speed, so V is
    homogeneous in u. The last terms are what departs from that. With K = 1 and without them V is
    linear in u but for the term s. A pattern that comes back at each of n evenly spaced wheels,
    forwards and backwards, has the harmonics 2 n - 1 and 2 n + 1: 5 and 7 of three wheels.

    Fields: coefficients C (3, terms); arm (), m, the size of the robot; speed (), m/s. Static:
    harmonics K, 1 or more; faster J, those that change with the speed, -1 for none.

    Example:
        >>> import rbjax as rb
        >>> carpet = rb.wheeled.HeadingSlip.none(arm=0.125)
        >>> carpet = carpet.replace(coefficients=0.7 * carpet.coefficients)
        >>> [round(float(x), 3) for x in carpet([0.1, 0.0, 1.0])]
        [0.07, 0.0, 0.7]
    """

    coefficients: jax.Array = eqx.field(converter=floats)
    arm: jax.Array = eqx.field(converter=floats)
    speed: jax.Array = eqx.field(converter=floats, default=0.1)
    harmonics: int = eqx.field(static=True, default=1)
    faster: int = eqx.field(static=True, default=-1)

    def __check_init__(self) -> None:
        check_fields(self)
        check_number(self, "arm", positive=True)
        check_number(self, "speed", positive=True)
        K, J = self.harmonics, self.faster
        if not (isinstance(K, int) and isinstance(J, int) and K >= 1 and J >= -1):
            raise InputError(
                f"HeadingSlip: harmonics is {K!r} and faster {J!r}, expected whole numbers of at "
                "least 1 and -1"
            )
        due = (3, 1 + (2 * K + 1) + (2 * J + 1 if J >= 0 else 0))
        if jnp.shape(self.coefficients) != due:
            raise InputError(
                f"HeadingSlip: coefficients has shape {jnp.shape(self.coefficients)}, expected "
                f"{due} with harmonics={K} and faster={J}"
            )

    @classmethod
    def none(cls, arm: Any, harmonics: int = 1, faster: int = -1, speed: Any = 0.1) -> HeadingSlip:
        """Wheels that roll: V = u."""
        terms = 1 + (2 * harmonics + 1) + (2 * faster + 1 if faster >= 0 else 0)
        C = jnp.zeros((3, terms)).at[jnp.arange(3), jnp.array([2, 3, 0])].set(1.0)
        return cls(C, arm, speed, harmonics, faster)

    def terms(self, twist: Any) -> jax.Array:
        """z (..., terms) of twists u (..., 3)."""
        u = jnp.asarray(twist)
        s = _length(u[..., :2])
        some = jnp.where(s > 0, s, 1.0)
        e = jnp.stack([jnp.where(s > 0, u[..., 0] / some, 1.0), u[..., 1] / some], -1)
        waves = [jnp.ones_like(s), e[..., 0], e[..., 1]]
        for _ in range(1, max(self.harmonics, self.faster)):
            c, d = waves[-2:]
            waves += [c * e[..., 0] - d * e[..., 1], d * e[..., 0] + c * e[..., 1]]
        out = [self.arm * u[..., 2], *(s * x for x in waves[: 2 * self.harmonics + 1])]
        if self.faster >= 0:
            more = (s / self.speed - 1) * s
            out += [more * x for x in waves[: 2 * self.faster + 1]]
        return jnp.stack(out, -1)

    def columns(self, twist: Any) -> jax.Array:
        """d(vx, vy, arm w) / d coefficients.ravel(), (..., 3, 3 terms): what `regress` needs."""
        z = self.terms(twist)
        wide = jnp.eye(3, dtype=z.dtype)[:, :, None] * z[..., None, None, :]
        return wide.reshape(*z.shape[:-1], 3, -1)

    def __call__(self, twist: Any) -> jax.Array:
        """V (..., 3) of u (..., 3)."""
        V = self.terms(twist) @ self.coefficients.T
        return V.at[..., 2].divide(self.arm)


def rolled_twists(robot: Robot, rates: Any) -> jax.Array:
    """The twists (..., 3) at which wheels would roll, by the rates of the drives' shafts.

    Rates that no twist has, as four wheels may show, are met in the sense of least squares.

    Args:
        robot: its wheels leave all velocities free.
        rates: (..., drives) rad/s.

    Raises:
        InputError: a robot that cannot move sideways, or is steered; another number of rates.

    Source: Lynch & Park, *Modern Robotics*, 13.4.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["omni_3"].make(arm=0.2, radius=0.05)
        >>> round(float(rb.wheeled.rolled_twists(robot, [4.0, 4.0, 4.0])[2]), 3)
        1.0
    """
    if not isinstance(robot, Robot):
        raise InputError(f"rolled_twists: robot is {type(robot).__name__}, expected a Robot")
    if robot.arrangement.mobility != 3 or len(robot.drives) < 3:
        raise InputError(
            f"rolled_twists: the wheels leave {robot.arrangement.mobility} velocities free and "
            f"{len(robot.drives)} are driven, expected 3 of each at least, as of an "
            'omnidirectional robot; for others use `rollout` of `at(robot, "kinematical")`'
        )
    shape = shape_of("rolled_twists", "rates", rates)
    due = (*shape[:-1], len(robot.drives))
    rates = check_array("rolled_twists", "rates", rates, due)
    return _rolled(robot, rates)


@compiled
def _rolled(robot: Robot, rates: jax.Array) -> jax.Array:
    J = jax.vmap(lambda twist: commands(robot, twist).speeds)(jnp.eye(3, dtype=rates.dtype)).T
    return rates @ jnp.linalg.pinv(J).T


def odometry(
    robot: Robot, t: Any, angles: Any, slip: HeadingSlip | None = None, pose: Any = None
) -> jax.Array:
    """The poses of a robot by the angles of its wheels.

    Args:
        robot: its wheels leave all velocities free.
        t: (T,) s, increasing.
        angles: (T, drives) rad, of the drives' shafts.
        slip: how the ground gives way; None where wheels roll.
        pose: (3,) the first one, x and y in m and yaw in rad; zeros if None.

    Returns:
        (T, 3) poses; the yaw is not wrapped.

    Raises:
        InputError: wrong types or shapes, values that are not finite, and what `rolled_twists`
            refuses.

    Source: Lynch & Park, *Modern Robotics*, 13.4.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> robot = rb.wheeled.kinds()["omni_3"].make(arm=0.2, radius=0.05)
        >>> t = jnp.linspace(0.0, 2.0, 5)
        >>> turned = rb.wheeled.odometry(robot, t, 4.0 * t[:, None] * jnp.ones(3))
        >>> round(float(turned[-1, 2]), 3)
        2.0
    """
    (count,) = shape_of("odometry", "t", t)[:1] or (0,)
    t = check_array("odometry", "t", t, (max(count, 2),))
    angles = check_array("odometry", "angles", angles, (count, len(robot.drives)))
    first = check_array("odometry", "pose", jnp.zeros(3) if pose is None else pose, (3,))
    return _poses(robot, t, angles, slip, first)


@compiled
def _poses(
    robot: Robot, t: jax.Array, angles: jax.Array, slip: HeadingSlip | None, first: jax.Array
) -> jax.Array:
    dt = jnp.diff(t)[:, None]
    V = rolled_twists(robot, jnp.diff(angles, axis=0) / dt)
    step = (V if slip is None else slip(V)) * dt
    yaw = first[2] + jnp.concatenate([jnp.zeros(1, step.dtype), jnp.cumsum(step[:, 2])])
    chord = _chord(step[:, 2])[:, None] * step[:, :2]
    places = jnp.cumsum(_turned(yaw[:-1] + step[:, 2] / 2, chord), 0)
    places = first[:2] + jnp.concatenate([jnp.zeros((1, 2), places.dtype), places])
    return jnp.concatenate([places, yaw[:, None]], -1)


def mean_twists(t: Any, poses: Any) -> jax.Array:
    """The constant twists (T - 1, 3), in the robot's axes, that lead from each pose to the next.

    The inverse of `odometry`: what a camera saw, to be compared with what wheels did.

    Args:
        t: (T,) s, increasing.
        poses: (T, 3), the yaw not wrapped.

    Raises:
        InputError: wrong shapes, values that are not finite.

    Example:
        >>> import rbjax as rb
        >>> seen = rb.wheeled.mean_twists([0.0, 2.0], [[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]])
        >>> [round(float(x), 3) for x in seen[0]]
        [0.2, 0.0, 0.0]
    """
    (count,) = shape_of("mean_twists", "t", t)[:1] or (0,)
    t = check_array("mean_twists", "t", t, (max(count, 2),))
    poses = check_array("mean_twists", "poses", poses, (count, 3))
    step = jnp.diff(poses, axis=0)
    along = _turned(-(poses[:-1, 2] + step[:, 2] / 2), step[:, :2])
    along = along / _chord(step[:, 2])[:, None]
    return jnp.concatenate([along, step[:, 2:]], -1) / jnp.diff(t)[:, None]


def _turned(angle: jax.Array, v: jax.Array) -> jax.Array:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def _chord(angle: jax.Array) -> jax.Array:
    """The chord of an arc over its length, sin(a / 2) / (a / 2)."""
    return jnp.sinc(angle / (2 * jnp.pi))


def _length(v: jax.Array) -> jax.Array:
    square = (v * v).sum(-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
