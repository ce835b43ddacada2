"""The coordinates of a robot along a path, and the torques that a motion along it requires.

A path is a chain of twists. The path length s counts m, and rad times the robot's reach r:
ds = |(a, b, r phi)|. The robot's free velocities are nu = g(s) s', and its steerings turn at
b(s)' s'. So its torques are linear in s'' and in x = s'^2,

    tau = A(s) s'' + B(s) x + C(s),      nu' = g s'' + (dg/ds) x

A, B and C follow from the equations of the reduced model, evaluated at nu' = 0 and at unit
torques. If there are more drives than free velocities, the torques have the least norm in units of
their limits.

If neighbouring steps have nearly the same direction, g and b change linearly from the middle of a
step to the middle of the next, so corners are rounded within a step. Elsewhere the robot stops: at
a reversal, or between driving and turning on the spot. At stops and at the start, it steers while
it stands still.

Source: Bobrov, Dubowsky & Gibson, IJRR 4 (1985) 3, section 2; Lynch & Park, *Modern Robotics*, 9.4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import safe_sqrt
from rbjax.lanes.arrays import largest
from rbjax.model import State
from rbjax.planning.paths.path import Path
from rbjax.planning.timing.limits import Limits
from rbjax.wheeled.kinematics.parameters import stack_lanes
from rbjax.wheeled.models.robot_model import RobotModel, with_twist
from rbjax.wheeled.motion.following import commands

TURN = 0.5  # the cosine of the largest change of direction that is rounded: 60 degrees
PARTS = 4  # Runge-Kutta steps that integrate the coordinates over one step of the path
#: for each stage, the fraction of the step and the weight
RK4 = np.array([0.0, 0.5, 0.5, 1.0]), np.array([1.0, 2.0, 2.0, 1.0]) / 6


class Sides(NamedTuple):
    """Robot and torque coefficients at one end of each of n steps of a path."""

    q: jax.Array  # (n, nq), coordinates
    nu: jax.Array  # (n, nv), free velocities per s'
    twist: jax.Array  # (n, 3), twist of the chassis per s'
    A: jax.Array  # (n, drives), the coefficients A, B and C of the torques
    B: jax.Array
    C: jax.Array


class DrivenPath(NamedTuple):
    """The steps of a path with the robot's coordinates and torques."""

    size: jax.Array  # (n,), lengths ds
    stops: jax.Array  # (n,), whether the robot stands still before the step
    #: (n, steerings), the steering motion before the step, while it stands still, rad
    turns: jax.Array
    bends: jax.Array  # (n, steerings), db/ds
    first: Sides  # `Sides` at the beginnings of the steps
    last: Sides  # `Sides` at the ends of the steps


def rk4(slope: Callable, y: jax.Array, h: jax.Array) -> jax.Array:
    """Integrate one Runge-Kutta step of y' = slope(y, fraction of the step), with scanned
    stages."""

    def stage(carry, weights):
        k, total = carry
        part, weight = weights
        k = slope(y + h * part * k, part)
        return (k, total + weight * k), None

    zero = jnp.zeros_like(y)
    weights = tuple(x.astype(y.dtype) for x in RK4)
    return y + h * jax.lax.scan(stage, (zero, zero), weights)[0][1]


def torques_for(model: RobotModel, limits: Limits, q, v, rates, turning) -> jax.Array:
    """Compute the torques (drives,) for velocity rates (nv,) and given steering rates."""
    drives = len(model.robot.drives)

    def accelerations(tau):
        context = model.context(State(q, v), jnp.concatenate([tau, turning]))
        return stack_lanes(model.accelerations(context), q.dtype)

    none = jnp.zeros(drives, q.dtype)
    most = limits.torques(model).astype(q.dtype)
    short = rates - accelerations(none)
    G = jax.jacfwd(accelerations)(none) * most
    if drives == model.nv:
        return most * jnp.linalg.solve(G, short)
    return most * (G.T @ jnp.linalg.solve(G @ G.T, short))


def drive_along(model: RobotModel, limits: Limits, path: Path) -> DrivenPath:
    """Compute the coordinates and torque coefficients along one path, with steerings initially
    straight. Steps of zeros have no effect."""
    robot, steps = model.robot, path.steps
    steerings, dtype = robot.layout.steerings, path.steps.dtype
    one = jnp.ones((), dtype)
    unit = jnp.stack([one, one, reach_of(model, dtype)])
    size = safe_sqrt(((steps * unit) ** 2).sum(-1))
    moves = size > 0
    twist = steps / jnp.where(moves, size, 1.0)[:, None]
    # a step of zeros copies the direction of the previous step, so it has no effect
    twist = _held(twist, moves)
    before, after = jnp.roll(twist, 1, 0), jnp.roll(twist, -1, 0)
    cosine = (before * twist * unit**2).sum(-1)
    stops = (cosine < TURN).at[0].set(True)
    # at the begins and at the ends of steps: two rows
    ends = jnp.stack(
        [
            jnp.where(stops[:, None], twist, (before + twist) / 2),
            jnp.where(jnp.roll(stops, -1)[:, None], twist, (twist + after) / 2),
        ]
    )
    angles = _angles(model, ends)
    straight = jnp.zeros_like(angles[0, :1])
    turns = angles[0] - jnp.concatenate([straight, angles[1, :-1]])
    turns = jnp.where(stops[:, None], turns, 0.0)
    width = jnp.where(moves, size, 1.0)[:, None]
    bends = jnp.where(moves[:, None], (angles[1] - angles[0]) / width, 0.0)

    def velocities(twist, angle):
        q = jnp.zeros(model.nq, dtype).at[steerings].set(angle)
        return with_twist(model, q, twist).v

    nu = jax.vmap(jax.vmap(velocities))(ends, angles)
    start = jnp.zeros(model.nq, dtype).at[:3].set(path.start.astype(dtype))
    q = _coordinates(model, start, size, turns, bends, nu)
    slope = (nu[1] - nu[0]) / width

    def linear(q, nu, slope, bend):
        def torques(rate, x):
            root = jnp.sqrt(x)
            rates = nu * rate + slope * x
            return torques_for(model, limits, q, nu * root, rates, bend * root)

        units = jnp.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], dtype)
        C, A, B = jax.vmap(torques)(*units)
        return A - C, B - C, C

    both = jax.vmap(jax.vmap(linear), (0, 0, None, None))(q, nu, slope, bends)
    sides = [Sides(*(x[i] for x in (q, nu, ends, *both))) for i in (0, 1)]
    return DrivenPath(size, stops, turns, bends, *sides)


def reach_of(model: RobotModel, dtype) -> jax.Array:
    """Compute the largest distance of a wheel of the chassis from its origin, m."""
    places = [jnp.asarray(w.position, dtype) for w in model.robot.wheels if w.body == 0]
    return jnp.maximum(largest(safe_sqrt((jnp.stack(places) ** 2).sum(-1))), 1e-2)


def _held(rows: jax.Array, known: jax.Array) -> jax.Array:
    """Replace each row (k,) that is not known by the last known row before it, or by the first
    known row."""
    at = jnp.where(known, jnp.arange(len(known)), -1)
    at = jax.lax.cummax(at)
    return rows[jnp.where(at < 0, jnp.argmax(known), at)]


def _angles(model: RobotModel, twists: jax.Array) -> jax.Array:
    if not model.robot.steerings:
        return jnp.zeros((*twists.shape[:-1], 0), twists.dtype)
    return jax.vmap(jax.vmap(lambda x: commands(model.robot, x).angles))(twists)


def _coordinates(model: RobotModel, start, size, turns, bends, nu) -> jax.Array:
    """Integrate the coordinates along the path: (2, n, nq), at the begin and end of each step."""
    at = model.robot.layout.steerings
    drives = jnp.zeros(len(model.robot.drives), start.dtype)

    def slope(q, v, bend):
        context = model.context(State(q, v), jnp.concatenate([drives, bend]))
        return stack_lanes(model.coordinate_rates(context), q.dtype)

    def over(q, step):
        size, turn, bend, nu0, nu1 = step
        q = first = q.at[at].add(turn)

        def part(q, i):
            def rates(q, part):
                return slope(q, nu0 + (nu1 - nu0) * (i + part) / PARTS, bend)

            return rk4(rates, q, size / PARTS), None

        q, _ = jax.lax.scan(part, q, jnp.arange(PARTS, dtype=q.dtype))
        return q, jnp.stack([first, q])

    q = jax.lax.scan(over, start, (size, turns, bends, *nu))[1]
    return jnp.swapaxes(q, 0, 1)
