"""Following a path or a trajectory: pure pursuit, Stanley's law, time-varying LQR.

A path is (n, 3): poses x, y in m and headings in rad, a few to a vehicle's length. The first two
give the twist that the chassis should have; `commands` gives wheel speeds and steering angles for a
twist of any robot. The third gives gains for all controls of a vehicle.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiling import compiled
from rbjax.control.tracking import regulator_along
from rbjax.dynamics.arguments import check_array, check_step, shape_of
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.wheeled.controlled import Vehicle
from rbjax.wheeled.fidelity import Fidelity
from rbjax.wheeled.numbers import stacked
from rbjax.wheeled.planar import Twist, dot, left
from rbjax.wheeled.robot import Robot
from rbjax.wheeled.rolling import Kinematical
from rbjax.wheeled.states import check_vehicle
from rbjax.wheeled.velocities import free_velocities, ideal, place_of, shaft_speed


class Commands(NamedTuple):
    """speeds (number of drives,) rad/s of shafts; angles (number of steerings,) rad."""

    speeds: jax.Array
    angles: jax.Array


def commands(robot: Robot, twist: Any) -> Commands:
    """The shaft speeds and the steering angles at which a robot has a twist.

    A steering points along the velocity of its place, forwards or backwards, whichever is nearer to
    straight ahead. Of a twist that the wheels do not allow at these angles it takes the allowed
    part.

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
    if not isinstance(robot, Robot):
        raise InputError(f"commands: robot is {type(robot).__name__}, expected a Robot")
    twist = check_array("commands", "twist", twist, (3,))
    return _commands(robot, twist)


@compiled
def _commands(robot: Robot, twist: jax.Array) -> Commands:
    dtype = twist.dtype
    bare = Kinematical(robot)
    start = State(jnp.zeros(bare.nq, dtype), jnp.zeros(bare.nv, dtype))
    n, now = bare.instant(start)
    V = Twist(*(twist[i] for i in range(3)))
    q, angles = list(now.q), []
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
    shape = replace(now, q=q).shape
    w = ideal(n, shape, free_velocities(n, shape, V))
    rates = w[2 + len(n.bodies) :]
    speeds = [
        shaft_speed(n, drive.wheels, split, rates)
        for drive, split in zip(robot.drives, n.splits, strict=True)
    ]
    return Commands(stacked(speeds, dtype), stacked(angles, dtype))


def _checked(where: str, path: Any, pose: Any) -> tuple[jax.Array, jax.Array]:
    shape = shape_of(where, "path", path)
    if len(shape) != 2 or shape[1] != 3 or shape[0] < 2:
        raise InputError(f"{where}: path has shape {shape}, expected (n, 3) with n of at least 2")
    path = check_array(where, "path", path, shape)
    return path, check_array(where, "pose", pose, (3,))


def _nearest(path: jax.Array, place: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The index of the segment next to a place, how far along it, and the arc length there."""
    a, edge = path[:-1, :2], path[1:, :2] - path[:-1, :2]
    size = jnp.maximum((edge * edge).sum(-1), jnp.finfo(path.dtype).tiny)
    part = jnp.clip(((place - a) * edge).sum(-1) / size, 0.0, 1.0)
    off = a + part[:, None] * edge - place
    k = (off * off).sum(-1).argmin()
    lengths = jnp.sqrt(size)
    return k, part[k], jnp.cumsum(lengths)[k] - lengths[k] * (1 - part[k])


def pure_pursuit(path: Any, pose: Any, speed: Any, lookahead: Any) -> jax.Array:
    """The twist along the arc to the point of a path that is a distance ahead of the nearest one.

        w = 2 v y / L^2,    (x, y) the point in the robot's axes, L its distance

    Args:
        path: (n, 3).
        pose: (3,), of the chassis.
        speed: v, m/s; below zero it drives backwards along the path.
        lookahead: along the path, m. At its end the path goes on straight.

    Returns:
        (3,): v, 0, w.

    Raises:
        InputError: wrong shapes, values that are not finite.

    Source: Coulter, *Implementation of the pure pursuit path tracking algorithm*, CMU 1992.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> path = jnp.stack([jnp.linspace(0, 5, 50), jnp.zeros(50), jnp.zeros(50)], -1)
        >>> twist = rb.wheeled.pure_pursuit(path, [0.0, 0.5, 0.0], 1.0, 1.0)
        >>> bool(twist[2] < 0)
        True
    """
    path, pose = _checked("pure_pursuit", path, pose)
    return _pure_pursuit(path, pose, jnp.asarray(speed), jnp.asarray(lookahead))


@compiled
def _pure_pursuit(path: jax.Array, pose: jax.Array, speed: Any, lookahead: Any) -> jax.Array:
    edges = path[1:, :2] - path[:-1, :2]
    s = jnp.concatenate([jnp.zeros(1, path.dtype), jnp.cumsum(jnp.sqrt((edges**2).sum(-1)))])
    aim = _nearest(path, pose[:2])[2] + lookahead
    beyond = jnp.maximum(aim - s[-1], 0.0)
    x, y = (jnp.interp(aim, s, path[:, k]) for k in (0, 1))
    last = path[-1, 2]
    x, y = x + beyond * jnp.cos(last) - pose[0], y + beyond * jnp.sin(last) - pose[1]
    across = jnp.cos(pose[2]) * y - jnp.sin(pose[2]) * x
    far = jnp.maximum(x * x + y * y, jnp.finfo(path.dtype).tiny)
    return jnp.stack([speed, jnp.zeros_like(speed), 2 * speed * across / far])


def stanley(
    path: Any, pose: Any, speed: Any, wheelbase: Any, gain: Any = 1.0, soft: Any = 0.5
) -> jax.Array:
    """The twist of Stanley's law for a car, from the heading and the offset of its front axle.

        b = heading error + atan2(k e, soft + |v|),     w = v tan(b) / wheelbase

    e is how far the path is to the left of the middle of the front axle.

    Args:
        path: (n, 3).
        pose: (3,), of the middle of the rear axle.
        speed: v of the rear axle, m/s.
        wheelbase: m.
        gain: k, 1/s.
        soft: m/s.

    Returns:
        (3,): v, 0, w. The angle b is held within 1.2 rad.

    Raises:
        InputError: wrong shapes, values that are not finite.

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
    numbers = (jnp.asarray(x, path.dtype) for x in (speed, wheelbase, gain, soft))
    return _stanley(path, pose, *numbers)


@compiled
def _stanley(
    path: jax.Array, pose: jax.Array, speed: Any, wheelbase: Any, gain: Any, soft: Any
) -> jax.Array:
    ahead = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    front = pose[:2] + wheelbase * ahead
    k, part, _ = _nearest(path, front)
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
    vehicle: Fidelity, states: State, controls: Any, dt: Any, Q: Any, R: Any
) -> jax.Array:
    """Gains K of a time-varying linear quadratic regulator along a trajectory: u + K (z - z_ref).

    z = (q, v) is linearised over each step of `rollout` (rk4), z+ = A z + B u. Backwards from
    P = Q at the end (`rb.control.backward`),

        K = -(R + B^T P B)^-1 B^T P A,    P = Q + A^T P (A + B K)

    Args:
        vehicle: `at(robot, fidelity)`, without tyre states.
        states: q (T + 1, nq), v (T + 1, nv), as `rollout` gives them.
        controls: (T, nu).
        dt: s.
        Q: (nq + nv,), the weights of deviations; zero for what need not be held.
        R: (nu,), above zero, the weights of controls.

    Returns:
        K (T, nu, nq + nv).

    Raises:
        InputError: wrong types or shapes, values that are not finite, tyres that relax.

    Source: Anderson & Moore, *Optimal Control: Linear Quadratic Methods*, ch. 2.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> robot = wheeled.kinds()["differential_drive"].make(caster=None)
        >>> cart = wheeled.at(robot, "kinematical")
        >>> u = jnp.zeros((5, 2))
        >>> path = wheeled.rollout(cart, wheeled.start(cart, twist=[0.5, 0.0, 0.0]), u, 0.1)
        >>> Q = jnp.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.1, 0.1])
        >>> wheeled.tracking_gains(cart, State(path.q, path.v), u, 0.1, Q, jnp.ones(2)).shape
        (5, 2, 7)
    """
    check_vehicle("tracking_gains", vehicle)
    if vehicle.nx:
        raise InputError(
            f"tracking_gains: the vehicle has {vehicle.nx} states of tyres, which no regulator "
            "sees; expected a law of tyres that does not relax"
        )
    steps = shape_of("tracking_gains", "controls", controls)[0]
    size = vehicle.nq + vehicle.nv
    u = check_array("tracking_gains", "controls", controls, (steps, vehicle.nu))
    q = check_array("tracking_gains", "states.q", states.q, (steps + 1, vehicle.nq))
    v = check_array("tracking_gains", "states.v", states.v, (steps + 1, vehicle.nv))
    Q = check_array("tracking_gains", "Q", Q, (size,)).astype(q.dtype)
    R = check_array("tracking_gains", "R", R, (vehicle.nu,)).astype(q.dtype)
    dt = check_step("tracking_gains", "dt", dt, q.dtype)
    return _gains(vehicle, State(q[:-1], v[:-1]), u.astype(q.dtype), dt, Q, R)


@compiled
def _gains(
    vehicle: Fidelity, states: State, u: jax.Array, dt: jax.Array, Q: jax.Array, R: jax.Array
) -> jax.Array:
    system = Vehicle(vehicle)
    along = jax.vmap(lambda state, ctrl: system.linear(0.0, state, ctrl, dt))(states, u)
    Q, R = jnp.diag(Q), jnp.diag(R)
    return -regulator_along(along.A, along.B, Q, R, Q).K
