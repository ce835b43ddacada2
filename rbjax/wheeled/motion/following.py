"""Path and trajectory following: pure pursuit, Stanley's law, time-varying LQR.

A path is (n, 3): poses x, y in m and headings in rad, several per length of the robot.
`pure_pursuit` and `stanley` compute a twist of the chassis, `commands` converts it to wheel speeds
and steering angles, and `tracking_gains` computes gains for all controls.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, real_number
from rbjax.compiling import compiled
from rbjax.control.linear.tracking import regulator_along
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_array, check_step, shape_of
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.wheeled.kinematics.parameters import stack_lanes, with_lanes
from rbjax.wheeled.kinematics.planar import Twist, dot, left
from rbjax.wheeled.kinematics.velocities import (
    drive_speeds,
    free_velocities,
    place_of,
    rolling_velocities,
)
from rbjax.wheeled.models.robot_model import RobotModel, check_robot_model
from rbjax.wheeled.models.rolling import ReducedModel
from rbjax.wheeled.motion.control_system import RobotSystem
from rbjax.wheeled.robot.robot import Robot


@displayed
class Commands(NamedTuple):
    """Speeds of drives and angles of steerings. `controls` converts them to controls.

    Fields:
        speeds: (drives,), of the shafts, rad/s.
        angles: (steerings,), rad.
    """

    speeds: jax.Array
    angles: jax.Array

    def controls(self, robot: Robot) -> jax.Array:
        """Compute the controls (nu,) of a robot for these speeds and angles.

        For each drive it is the motor command, in its `unit`, whose no-load speed is the shaft's
        speed. For each steering it is the angle, rad.

        Raises:
            InputError: a `TorqueSource`, which has no no-load speed; a steering without `lag`,
                whose control is a rate.

        Example:
            >>> import rbjax as rb
            >>> motor = rb.wheeled.DCMotor(2.0, 0.05, gear=20.0)
            >>> robot = rb.wheeled.kinds()["differential_drive"].make(radius=0.1, motor=motor)
            >>> found = rb.wheeled.commands(robot, [0.5, 0.0, 0.0])
            >>> found.speeds.round(6).tolist(), found.controls(robot).round(6).tolist()
            ([5.0, 5.0], [5.0, 5.0])
        """
        instance("controls", "robot", robot, Robot, "a Robot")
        for j, steering in enumerate(robot.steerings):
            if steering.lag is None:
                raise InputError(
                    f"controls: steerings[{j}] has no lag, so its control is a rate in rad/s and "
                    "not an angle; give the steering a lag, or control the rate by the angle error"
                )
        dtype = self.speeds.dtype
        speeds = [
            with_lanes(drive.motor, dtype).command_for(self.speeds[j])
            for j, drive in enumerate(robot.drives)
        ]
        return jnp.concatenate([stack_lanes(speeds, dtype), self.angles])


def commands(robot: Robot, twist: Any) -> Commands:
    """Compute the shaft speeds and the steering angles of a robot for a twist of the chassis.

    A steering points along the velocity at its position, forwards or backwards, whichever is closer
    to straight ahead. The twist is projected onto the twists that the wheels allow at these angles.

    Args:
        robot: `Robot`.
        twist: (3,), vx and vy in m/s in the chassis' axes, the turning rate in rad/s.

    Returns:
        `Commands`.

    Raises:
        InputError: wrong types or shapes, values that are not finite.

    Source: Lynch & Park, *Modern Robotics*, 13.2, 13.3.

    Example:
        >>> import rbjax as rb
        >>> car = rb.wheeled.kinds()["car"].make(wheelbase=2.0)
        >>> found = rb.wheeled.commands(car, [1.0, 0.0, 0.5])
        >>> round(float(found.angles[0]), 6)
        0.785398
    """
    instance("commands", "robot", robot, Robot, "a Robot")
    return _commands(robot, check_array("commands", "twist", twist, (3,)))


@compiled
def _commands(robot: Robot, twist: jax.Array) -> Commands:
    dtype = twist.dtype
    model = ReducedModel(robot)
    context = model.context(State(jnp.zeros(model.nq, dtype), jnp.zeros(model.nv, dtype)))
    n = context.n
    V = Twist(*(twist[i] for i in range(3)))
    q, angles = list(context.q), []
    for j, steering in enumerate(robot.steerings):
        leader = next(
            (x for x in robot.arrangement.leaders if x.what == "steering" and x.number == j), None
        )
        wheel = n.wheels[steering.wheels[0]]
        place = wheel.position if leader is None else place_of(n, leader)
        u = V.at(place)
        ahead, side = dot(wheel.heading, u), dot(left(wheel.heading), u)
        still = (ahead == 0) & (side == 0)
        sign = jnp.where(ahead < 0, -1.0, 1.0).astype(dtype)
        angle = jnp.arctan2(sign * side, jnp.where(still, 1.0, sign * ahead))
        angles.append(angle)
        q[n.layout.steerings.start + j] = angle
    shape = replace(context, q=q).shape
    w = rolling_velocities(n, shape, free_velocities(n, shape, V))
    speeds = drive_speeds(n, n.shaft_rates(w))
    return Commands(stack_lanes(speeds, dtype), stack_lanes(angles, dtype))


def _number(where: str, name: str, value: Any, dtype: Any, above: float = -math.inf) -> jax.Array:
    """Convert a number to the dtype. Raise `InputError` if it is known and not above the bound."""
    real_number(where, name, value, traced=True, above=above)
    return jnp.asarray(value, dtype)


def _checked(where: str, path: Any, pose: Any) -> tuple[jax.Array, jax.Array]:
    shape = shape_of(where, "path", path)
    if len(shape) != 2 or shape[1] != 3 or shape[0] < 2:
        raise InputError(f"{where}: path has shape {shape}, expected (n, 3) with n of at least 2")
    path = check_array(where, "path", path, shape)
    return path, check_array(where, "pose", pose, (3,))


def _nearest(path: jax.Array, place: jax.Array) -> tuple[jax.Array, ...]:
    """Find the point of a path nearest to a given point. Return the index of its segment, its
    fraction along the segment, its arc length, and whether it is the end of the path."""
    a, edge = path[:-1, :2], path[1:, :2] - path[:-1, :2]
    size = jnp.maximum((edge * edge).sum(-1), jnp.finfo(path.dtype).tiny)
    part = jnp.clip(((place - a) * edge).sum(-1) / size, 0.0, 1.0)
    off = a + part[:, None] * edge - place
    k = (off * off).sum(-1).argmin()
    lengths = jnp.where(size > jnp.finfo(path.dtype).tiny, jnp.sqrt(size), 0.0)
    s = jnp.cumsum(lengths)
    along = s[k] - lengths[k] * (1 - part[k])
    return k, part[k], along, along >= s[-1] * (1 - 4 * jnp.finfo(path.dtype).eps)


def pure_pursuit(path: Any, pose: Any, speed: Any, lookahead: Any) -> jax.Array:
    """Compute the twist of pure pursuit, along the arc to a point ahead on the path.

        w = 2 v y / L^2,    (x, y) the point in the robot's axes, L its distance

    Args:
        path: (n, 3), poses.
        pose: (3,), of the chassis.
        speed: v, m/s. If it is negative, the robot drives along the path backwards.
        lookahead: the distance of the point along the path from the nearest point, m, above zero.
            The path continues straight beyond its end.

    Returns:
        (3,): v, 0, w. It is zero if the nearest point is the end of the path: the robot stops.

    Raises:
        InputError: wrong shapes, values that are not finite, a lookahead of zero.

    Source: Coulter, *Implementation of the pure pursuit path tracking algorithm*, CMU 1992.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> path = jnp.stack([jnp.linspace(0, 5, 50), jnp.zeros(50), jnp.zeros(50)], -1)
        >>> twist = rb.wheeled.pure_pursuit(path, [0.0, 0.5, 0.0], 1.0, 1.0)
        >>> bool(twist[2] < 0)
        True
    """
    path, pose = _checked("pure_pursuit", path, pose)
    speed = _number("pure_pursuit", "speed", speed, path.dtype)
    lookahead = _number("pure_pursuit", "lookahead", lookahead, path.dtype, 0.0)
    return _pure_pursuit(path, pose.astype(path.dtype), speed, lookahead)


@compiled
def _pure_pursuit(path: jax.Array, pose: jax.Array, speed: Any, lookahead: Any) -> jax.Array:
    edges = path[1:, :2] - path[:-1, :2]
    s = jnp.concatenate([jnp.zeros(1, path.dtype), jnp.cumsum(jnp.sqrt((edges**2).sum(-1)))])
    _, _, along, ends = _nearest(path, pose[:2])
    aim = along + lookahead
    beyond = jnp.maximum(aim - s[-1], 0.0)
    x, y = (jnp.interp(aim, s, path[:, k]) for k in (0, 1))
    # the direction of the path at its end; a robot that drives backwards looks the other way
    moves = (edges**2).sum(-1) > 0
    last = jnp.where(moves, jnp.arange(len(edges)), 0).max()
    way = edges[last] / jnp.maximum(jnp.sqrt((edges[last] ** 2).sum()), jnp.finfo(s.dtype).tiny)
    x, y = x + beyond * way[0] - pose[0], y + beyond * way[1] - pose[1]
    across = jnp.cos(pose[2]) * y - jnp.sin(pose[2]) * x
    far = jnp.maximum(x * x + y * y, (NEAREST * lookahead) ** 2)  # a path may return to the robot
    speed = jnp.where(ends, 0.0, speed)
    return jnp.stack([speed, jnp.zeros_like(speed), 2 * speed * across / far])


#: the least distance L of the target point of pure pursuit, as a fraction of the lookahead
NEAREST = 0.1


def stanley(
    path: Any, pose: Any, speed: Any, wheelbase: Any, gain: Any = 1.0, soft: Any = 0.5
) -> jax.Array:
    """Compute the twist of Stanley's law for a car, from the heading and offset of its front axle.

        b = heading error + atan2(k e, soft + |v|),     w = v tan(b) / wheelbase

    e is the distance of the path to the left of the middle of the front axle.

    Args:
        path: (n, 3), poses.
        pose: (3,), of the middle of the rear axle.
        speed: v of the rear axle, m/s, at least zero. `pure_pursuit` drives backwards too. A
            negative traced speed counts as zero.
        wheelbase: m, above zero.
        gain: k, 1/s, above zero.
        soft: m/s, above zero.

    Returns:
        (3,): v, 0, w. The angle b is clipped to 1.2 rad. The result is zero if the end of the path
        is its nearest point to the rear axle: the car stops.

    Raises:
        InputError: wrong shapes, values that are not finite, numbers outside their range.

    Source: Hoffmann, Tomlin, Montemerlo & Thrun, *Autonomous automobile trajectory tracking for
    off-road driving*, ACC 2007.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> path = jnp.stack([jnp.linspace(0, 5, 50), jnp.zeros(50), jnp.zeros(50)], -1)
        >>> twist = rb.wheeled.stanley(path, [0.0, 0.5, 0.0], 1.0, 2.0)
        >>> bool(twist[2] < 0)
        True
    """
    path, pose = _checked("stanley", path, pose)
    v = _number("stanley", "speed", speed, path.dtype)
    if not isinstance(v, jax.core.Tracer) and not np.asarray(v) >= 0:
        raise InputError(
            f"stanley: speed is {speed}, expected at least 0: steering by the front axle is "
            "unstable backwards; pure_pursuit takes speeds below zero"
        )
    given = {"wheelbase": wheelbase, "gain": gain, "soft": soft}
    numbers = (_number("stanley", name, x, path.dtype, 0.0) for name, x in given.items())
    return _stanley(path, pose.astype(path.dtype), v, *numbers)


@compiled
def _stanley(
    path: jax.Array, pose: jax.Array, speed: Any, wheelbase: Any, gain: Any, soft: Any
) -> jax.Array:
    ahead = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    front = pose[:2] + wheelbase * ahead
    k, part, *_ = _nearest(path, front)
    speed = jnp.where(_nearest(path, pose[:2])[3], 0.0, jnp.maximum(speed, 0.0))
    turn = _wrapped(path[k + 1, 2] - path[k, 2])
    heading = path[k, 2] + part * turn
    off = path[k, :2] + part * (path[k + 1, :2] - path[k, :2]) - front
    e = jnp.cos(heading) * off[1] - jnp.sin(heading) * off[0]
    angle = _wrapped(heading - pose[2]) + jnp.arctan2(gain * e, soft + jnp.abs(speed))
    angle = jnp.clip(angle, -1.2, 1.2)
    return jnp.stack([speed, jnp.zeros_like(speed), speed * jnp.tan(angle) / wheelbase])


def _wrapped(angle: jax.Array) -> jax.Array:
    return jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def tracking_gains(
    model: RobotModel, states: State, ctrl: Any, dt: Any, Q: Any, R: Any
) -> jax.Array:
    """Compute the gains K of a time-varying linear quadratic regulator: u - K (z - z_ref).

    z = (q, v) is linearised over each step of `rollout` (rk4), z+ = A z + B u. Backwards from
    P = Q at the end,

        K = (R + B^T P B)^-1 B^T P A,    P = Q + A^T P (A - B K)

    Args:
        model: `at(robot, fidelity)`, without tyre states.
        states: q (T + 1, nq), v (T + 1, nv), the reference states from `rollout`.
        ctrl: (T, nu), the reference controls.
        dt: the step, s.
        Q: (nq + nv,), the weights of deviations; zero for free coordinates.
        R: (nu,), the weights of controls, above zero.

    Returns:
        K (T, nu, nq + nv).

    Raises:
        InputError: wrong types or shapes, values that are not finite, tyres that relax.

    Source: Anderson & Moore, *Optimal Control: Linear Quadratic Methods*, ch. 2.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> robot = wheeled.kinds()["differential_drive"].make(caster=None)
        >>> cart = wheeled.at(robot, "reduced")
        >>> u = jnp.zeros((5, 2))
        >>> path = wheeled.rollout(cart, wheeled.start(cart, twist=[0.5, 0.0, 0.0]), u, 0.1)
        >>> Q = jnp.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.1, 0.1])
        >>> wheeled.tracking_gains(cart, State(path.q, path.v), u, 0.1, Q, jnp.ones(2)).shape
        (5, 2, 7)
    """
    where = "tracking_gains"
    check_robot_model(where, model)
    if model.nx:
        raise InputError(
            f"{where}: the model has {model.nx} states of tyres, which the regulator does not "
            "measure; expected a tyre law that does not relax"
        )
    shape = shape_of(where, "ctrl", ctrl)
    steps = shape[0] if len(shape) == 2 else 1
    u = check_array(where, "ctrl", ctrl, (steps, model.nu))
    instance(where, "states", states, State, "State(q, v)")
    q = check_array(where, "states.q", states.q, (steps + 1, model.nq))
    v = check_array(where, "states.v", states.v, (steps + 1, model.nv))
    Q = check_array(where, "Q", Q, (model.nq + model.nv,)).astype(q.dtype)
    R = check_array(where, "R", R, (model.nu,)).astype(q.dtype)
    dt = check_step(where, "dt", dt, q.dtype)
    return _gains(model, State(q[:-1], v[:-1]), u.astype(q.dtype), dt, Q, R)


@compiled
def _gains(
    model: RobotModel, states: State, u: jax.Array, dt: jax.Array, Q: jax.Array, R: jax.Array
) -> jax.Array:
    system = RobotSystem(model)
    along = jax.vmap(lambda state, ctrl: system.linear(0.0, state, ctrl, dt))(states, u)
    Q, R = jnp.diag(Q), jnp.diag(R)
    return regulator_along(along.A, along.B, Q, R, Q).K
