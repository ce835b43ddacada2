"""The Boltzmann-Hamel equations: dynamics from energies, in quasi-velocities.

The quasi-velocities w are the chassis' twist (vx, vy, w), and the rates of trailers, shafts and
casters. Their kinetic energy T(s, w) is written before any rolling condition is put in; s are the
angles of trailers and casters. With p = dT/dw, on the Lie group of the plane,

    p_x' - w p_y = Q_x,   p_y' + w p_x = Q_y,   p_w' + vx p_y - vy p_x = Q_w
    p_s' - dT/ds = Q_s,   p_shaft' = Q_shaft

and rolling wheels leave w = S nu, so that S^T of these equations gives nu'. T and the potential
energy are differentiated as they stand; nothing of `equations` is used but what momentum is.
(Hamel 1904; Neimark & Fufaev, *Dynamics of Nonholonomic Systems*, ch. 3; Olguín Díaz, *3D Motion
of Rigid Bodies*, ch. 7, 8)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import jax
import jax.numpy as jnp

from rbjax.lanes import Lane, add, inner, ldlt, mul, total
from rbjax.wheeled.kinematics.context import RobotContext, angle_rates, angles_of
from rbjax.wheeled.kinematics.parameters import Parameters, stack_lanes
from rbjax.wheeled.kinematics.planar import cross, duals, rate_of, value_of
from rbjax.wheeled.kinematics.velocities import (
    caster_rates,
    fork_twists,
    rolling_velocities,
    shaft_speed,
    shape_of,
    twists_of,
)
from rbjax.wheeled.models.equations import momentum
from rbjax.wheeled.models.robot_model import potential_energy, torques_at_rest_loads
from rbjax.wheeled.models.rolling import Rolling


class QuasiVelocities(Rolling):
    """Dynamics by the Boltzmann-Hamel equations: v = nu. For comparison; it is the slowest.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["differential_drive"].make()
        >>> rb.wheeled.at(robot, "quasi_velocities").nv
        2
    """

    name: ClassVar[str] = "quasi_velocities"

    def accelerations(self, now: RobotContext) -> list[Lane]:
        n = now.n
        dtype = n.dtype
        free = self.full_velocities(now)
        s, ds = (stack_lanes(x, dtype) for x in (angles_of(now), angle_rates(now, free)))
        nu = stack_lanes(now.v, dtype)
        steering = ds  # only its part of the steerings is used

        def quasi(s: jax.Array, nu: jax.Array) -> jax.Array:
            shape = shape_of(n, list(s))
            w = rolling_velocities(n, shape, list(nu))
            return stack_lanes([*w, *caster_rates(n, shape, twists_of(n, shape, w))], dtype)

        def energy(s: jax.Array, w: jax.Array) -> jax.Array:
            return jnp.asarray(_kinetic(n, list(s), list(steering), list(w)), dtype)

        w, turning = jax.jvp(lambda s: quasi(s, nu), (s,), (ds,))
        impulse = jax.grad(energy, 1)
        p, pull = impulse(s, w), jax.grad(energy)(s, w)

        def left(rate: jax.Array) -> jax.Array:
            """p' where w' is this."""
            return jax.jvp(impulse, (s, w), (ds, rate))[1]

        carried = jnp.stack([-w[2] * p[1], w[2] * p[0], w[0] * p[1] - w[1] * p[0]])
        due = self._loads(now, s, free).at[:3].add(-carried)
        k, casters = len(n.bodies) - 1, len(n.layout.caster_wheels)
        due = due.at[3 : 3 + k].add(pull[:k])
        due = due.at[len(w) - casters :].add(pull[len(s) - casters :])
        back = jax.vjp(lambda nu: quasi(s, nu), nu)[1]
        f = back(due - left(turning))[0]
        zero = left(jnp.zeros_like(w))
        units = jnp.eye(len(nu), dtype=dtype)

        def column(unit: jax.Array) -> jax.Array:
            moved = jax.jvp(lambda nu: quasi(s, nu), (nu,), (unit,))[1]
            return back(left(moved) - zero)[0]

        columns = [column(unit) for unit in units]
        M = [[columns[j][i] for j in range(len(nu))] for i in range(len(nu))]
        return ldlt(M).solve([f[i] for i in range(len(nu))])

    def _loads(self, now: RobotContext, s: jax.Array, free: Sequence[Lane]) -> jax.Array:
        """Q: the gradient of the potential energy, and the torques on shafts."""
        n = now.n
        dtype = n.dtype
        pose = stack_lanes(now.q[:3], dtype)

        def potential(pose: jax.Array, s: jax.Array) -> jax.Array:
            q = [*pose, *s, *now.q[n.layout.shafts.start :]]
            return jnp.asarray(potential_energy(replace(now, q=q)), dtype)

        by_pose, by_angles = jax.grad(potential, (0, 1))(pose, s)
        c, si = now.pose
        x, y = c * by_pose[0] + si * by_pose[1], c * by_pose[1] - si * by_pose[0]
        torques = torques_at_rest_loads(now, free)
        k, casters = len(n.bodies) - 1, len(n.layout.caster_wheels)
        return jnp.concatenate(
            [
                -jnp.stack([x, y, by_pose[2]]),
                -by_angles[:k],
                stack_lanes(torques, dtype),
                -by_angles[len(s) - casters :],
            ]
        )


def _kinetic(
    n: Parameters, angles: Sequence[Lane], turning: Sequence[Lane], w: Sequence[Lane]
) -> Lane:
    """T, with the turning of steered wheels and of casters about the vertical."""
    casters = n.layout.caster_wheels
    shape = shape_of(n, angles)
    full = w[: len(w) - len(casters)]
    twists = twists_of(n, shape, full)
    shafts = full[2 + len(n.bodies) :]
    twice = [inner(V, momentum(body, V)) for body, V in zip(n.bodies, twists, strict=True)]
    twice += [mul(i, mul(rate, rate)) for i, rate in zip(n.shafts, shafts, strict=True)]
    for drive, motor, split in zip(n.robot.drives, n.motors, n.splits, strict=True):
        speed = shaft_speed(n, drive.wheels, split, shafts)
        twice.append(mul(motor.inertia, mul(speed, speed)))
    forks = fork_twists(n, shape, twists, w[len(w) - len(casters) :])
    for i, fork, V in zip(casters, n.forks, forks, strict=True):
        twice.append(mul(n.wheels[i].yaw_inertia, mul(V[2], V[2])))
        twice.append(inner(V, momentum(fork, V)))
    moved = shape_of(n, duals(angles, turning))
    for steering in n.robot.steerings:
        for i in steering.wheels:
            e = moved.wheels[i]
            rate = cross((value_of(e[0]), value_of(e[1])), (rate_of(e[0]), rate_of(e[1])))
            yaw = twists[n.wheels[i].body][2]
            # the body's own inertia has that of the wheel, which turns with it
            more = add(mul(2.0, mul(yaw, rate)), mul(rate, rate))
            twice.append(mul(n.wheels[i].yaw_inertia, more))
    return mul(0.5, total(twice))
