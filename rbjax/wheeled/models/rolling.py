"""Fidelities whose wheels roll and do not slide sideways.

    kinematic          v is empty: the speeds of the motors determine the motion
    reduced            v = nu, the free velocities: the equations are projected by w = S nu
    dynamical          v = nu: multipliers are eliminated from the equations of all velocities
    quasi_velocities   v = nu: the Boltzmann-Hamel equations
The last three compute the same motion. "reduced" is the cheapest of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import jax
import jax.numpy as jnp

from rbjax.lanes import Lane, add, inner, ldlt, mul, neg, sub, total
from rbjax.wheeled.kinematics.context import RobotContext, angle_rates, angles_of
from rbjax.wheeled.kinematics.parameters import Parameters, stack_lanes
from rbjax.wheeled.kinematics.planar import Twist, cross, duals, rate_of, value_of
from rbjax.wheeled.kinematics.velocities import (
    Directions,
    caster_rates,
    chassis_twist,
    constraint_rates,
    drive_speeds,
    free_velocities,
    rolling_velocities,
    shape_of,
    twists_of,
)
from rbjax.wheeled.models.equations import (
    ProjectedEquations,
    columns_of,
    kinetic_energy,
    potential_energy,
    projected_equations,
)
from rbjax.wheeled.models.forces import motor_dampers, shaft_torques
from rbjax.wheeled.models.robot_model import RobotModel


class Kinematic(RobotModel):
    """A robot without inertia, whose drives turn at the no-load speeds of their motors.

        w = S nu,   W_j(nu) = no-load speed of drive j at u_j, in least squares over the drives

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "kinematic")
        >>> cart.nv, cart.nu
        (0, 2)
    """

    name: ClassVar[str] = "kinematic"

    @property
    def nv(self) -> int:
        return 0

    def full_velocities(self, context: RobotContext) -> list[Lane]:
        n, shape = context.n, context.shape
        units = columns_of(n, shape, rolling_velocities, n.robot.arrangement.mobility)
        columns = [drive_speeds(n, n.shaft_rates(w)) for w in units]
        speeds = [motor.free_speed(u) for motor, u in zip(n.motors, context.u, strict=False)]
        M = [[inner(x, y) for y in columns] for x in columns]
        f = [inner(x, speeds) for x in columns]
        return rolling_velocities(n, shape, ldlt(M).solve(f))

    def accelerations(self, context: RobotContext) -> list[Lane]:
        return []

    def start_velocities(self, context: RobotContext, w: list[Lane]) -> list[Lane]:
        return []


class RollingModel(RobotModel):
    """Base class of robots with inertia whose wheels roll. v = nu, the free velocities."""

    @property
    def nv(self) -> int:
        return self.robot.arrangement.mobility

    def full_velocities(self, context: RobotContext) -> list[Lane]:
        return rolling_velocities(context.n, context.shape, context.v)

    def start_velocities(self, context: RobotContext, w: list[Lane]) -> list[Lane]:
        return free_velocities(context.n, context.shape, Twist(*w[:3]))

    def ground_forces(self, context: RobotContext) -> list[Lane]:
        """Compute the generalized forces of the ground, M w' - f, that make the wheels roll.

        These are the force on the robot in the chassis' axes, N, the moments, and the torques on
        the shafts, N m.
        """
        w = self.full_velocities(context)
        nu = duals(context.v, self.accelerations(context))
        rate = [rate_of(x) for x in rolling_velocities(context.n, context.shape_with_rate(w), nu)]
        M, f, _ = projected_equations(context, w, identity, w, shaft_torques(context, w))
        return [sub(inner(row, rate), x) for row, x in zip(M, f, strict=True)]


class ReducedModel(RollingModel):
    """Equations of motion projected on the free velocities.

        (S^T M S) nu' = S^T (f - M S' nu),   w = S nu

    (Olguín Díaz, *3D Motion of Rigid Bodies*, ch. 8)

    Example:
        >>> import rbjax as rb
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "reduced")
        >>> cart.nv, cart.nu
        (2, 2)
    """

    name: ClassVar[str] = "reduced"

    def accelerations(self, context: RobotContext) -> list[Lane]:
        return self._equations(context, self.full_velocities(context)).accelerations

    def damped_accelerations(self, context: RobotContext, h: Lane) -> list[Lane]:
        w = self.full_velocities(context)
        return self._equations(context, w).damped(motor_dampers(context, w), h)

    def _equations(self, context: RobotContext, w: list[Lane]) -> ProjectedEquations:
        return projected_equations(
            context, w, rolling_velocities, context.v, shaft_torques(context, w)
        )


class Dynamical(RollingModel):
    """Equations of motion with the multipliers eliminated (the dynamical approach).

        M w' = f + A^T l,   A w' = -A' w,   l = -(A M^-1 A^T)^-1 (A M^-1 f + A' w)

    nu' is computed from w'. (Olguín Díaz, *3D Motion of Rigid Bodies*, ch. 8)

    Example:
        >>> import rbjax as rb
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "dynamical")
        >>> cart.nv
        2
    """

    name: ClassVar[str] = "dynamical"

    def accelerations(self, context: RobotContext) -> list[Lane]:
        n, shape, w = context.n, context.shape, self.full_velocities(context)
        moved = context.shape_with_rate(w)
        M, f, _ = projected_equations(context, w, identity, w, shaft_torques(context, w))
        factors = ldlt(M)
        free = factors.solve(f)
        units = columns_of(n, shape, identity, len(w))
        A = [constraint_rates(n, shape, unit) for unit in units]  # by column
        size = len(A[0])
        bias = [rate_of(x) for x in constraint_rates(n, moved, w)]
        lifted = [factors.solve([column[i] for column in A]) for i in range(size)]  # M^-1 A^T
        K = [
            [total(mul(c[i], x) for c, x in zip(A, lifted[j], strict=True)) for j in range(size)]
            for i in range(size)
        ]
        right = [
            sub(neg(bias[i]), total(mul(c[i], x) for c, x in zip(A, free, strict=True)))
            for i in range(size)
        ]
        l = ldlt(K).solve(right)
        rate = [
            total([x, *(mul(lifted[i][k], l[i]) for i in range(size))]) for k, x in enumerate(free)
        ]
        # nu' = S^+ (w' - S' nu)
        given = chassis_twist(n, moved, context.v)
        V = Twist(*(sub(a, rate_of(b)) for a, b in zip(rate[:3], given, strict=True)))
        return free_velocities(n, shape, V)


class QuasiVelocities(RollingModel):
    """The Boltzmann-Hamel equations, derived from energies. It is the slowest, for comparison only.

    The quasi-velocities w are the chassis' twist (vx, vy, w), and the rates of trailers, shafts and
    casters; s are the angles of trailers and casters. With the kinetic energy T(s, w) and
    p = dT/dw, on the Lie group of the plane,

        p_x' - w p_y = Q_x,   p_y' + w p_x = Q_y,   p_w' + vx p_y - vy p_x = Q_w
        p_s' - dT/ds = Q_s,   p_shaft' = Q_shaft

    The rolling velocities are w = S nu, and S^T times these equations gives nu'.

    Source: Hamel 1904; Neimark & Fufaev, *Dynamics of Nonholonomic Systems*, ch. 3; Olguín Díaz,
    *3D Motion of Rigid Bodies*, ch. 7, 8.

    Example:
        >>> import rbjax as rb
        >>> robot = rb.wheeled.kinds()["differential_drive"].make()
        >>> rb.wheeled.at(robot, "quasi_velocities").nv
        2
    """

    name: ClassVar[str] = "quasi_velocities"

    def accelerations(self, context: RobotContext) -> list[Lane]:
        n, dtype, free = context.n, context.n.dtype, self.full_velocities(context)
        s, ds = (stack_lanes(x, dtype) for x in (angles_of(context), angle_rates(context, free)))
        nu = stack_lanes(context.v, dtype)

        def quasi(s: jax.Array, nu: jax.Array) -> jax.Array:
            shape = shape_of(n, list(s))
            w = rolling_velocities(n, shape, list(nu))
            return stack_lanes([*w, *caster_rates(n, shape, twists_of(n, shape, w))], dtype)

        def energy(s: jax.Array, w: jax.Array) -> jax.Array:
            return jnp.asarray(_kinetic_energy(n, list(s), list(ds), list(w)), dtype)

        w, turning = jax.jvp(lambda s: quasi(s, nu), (s,), (ds,))
        impulse = jax.grad(energy, 1)
        p, by_angles = impulse(s, w), jax.grad(energy)(s, w)

        def impulse_rate(rate: jax.Array) -> jax.Array:
            """Compute the rate p' of the generalized momentum for a rate w' of the velocities."""
            return jax.jvp(impulse, (s, w), (ds, rate))[1]

        carried = jnp.stack([-w[2] * p[1], w[2] * p[0], w[0] * p[1] - w[1] * p[0]])
        Q = self._forces(context, s, free).at[:3].add(-carried)
        k, casters = len(n.bodies) - 1, len(n.layout.caster_wheels)
        Q = Q.at[3 : 3 + k].add(by_angles[:k])
        Q = Q.at[len(w) - casters :].add(by_angles[len(s) - casters :])
        back = jax.vjp(lambda nu: quasi(s, nu), nu)[1]
        f = back(Q - impulse_rate(turning))[0]
        zero = impulse_rate(jnp.zeros_like(w))

        def column(unit: jax.Array) -> jax.Array:
            moved = jax.jvp(lambda nu: quasi(s, nu), (nu,), (unit,))[1]
            return back(impulse_rate(moved) - zero)[0]

        size = range(len(nu))
        columns = [column(unit) for unit in jnp.eye(len(nu), dtype=dtype)]
        M = [[columns[j][i] for j in size] for i in size]
        return ldlt(M).solve([f[i] for i in size])

    def _forces(self, context: RobotContext, s: jax.Array, free: Sequence[Lane]) -> jax.Array:
        """Compute the generalized forces Q: minus the gradient of the potential energy, plus the
        torques on shafts."""
        n, dtype = context.n, context.n.dtype

        def potential(pose: jax.Array, s: jax.Array) -> jax.Array:
            q = [*pose, *s, *context.q[n.layout.shafts.start :]]
            return jnp.asarray(potential_energy(replace(context, q=q)), dtype)

        by_pose, by_angles = jax.grad(potential, (0, 1))(stack_lanes(context.q[:3], dtype), s)
        c, si = context.pose
        x, y = c * by_pose[0] + si * by_pose[1], c * by_pose[1] - si * by_pose[0]
        k, casters = len(n.bodies) - 1, len(n.layout.caster_wheels)
        torques = stack_lanes(shaft_torques(context, free), dtype)
        return jnp.concatenate(
            [-jnp.stack([x, y, by_pose[2]]), -by_angles[:k], torques,
             -by_angles[len(s) - casters :]],
        )  # fmt: skip


def _kinetic_energy(
    n: Parameters, angles: Sequence[Lane], rates: Sequence[Lane], w: Sequence[Lane]
) -> Lane:
    """Compute the kinetic energy T, including the rotation of steered wheels about the vertical."""
    shape, first = shape_of(n, angles), len(w) - len(n.layout.caster_wheels)
    energy, yaw = kinetic_energy(n, shape, w[:first], w[first:]), w[2]
    moved = shape_of(n, duals(angles, rates))
    for i in (i for steering in n.robot.steerings for i in steering.wheels):
        e = moved.wheels[i]
        rate = cross((value_of(e[0]), value_of(e[1])), (rate_of(e[0]), rate_of(e[1])))
        # the inertia of the body includes that of the wheel
        more = add(mul(2.0, mul(yaw, rate)), mul(rate, rate))
        energy = add(energy, mul(0.5, mul(n.wheels[i].yaw_inertia, more)))
    return energy


def identity(n: Parameters, shape: Directions, w: Sequence[Lane]) -> list[Lane]:
    """Return w unchanged: the map from full velocities to themselves."""
    return list(w)
