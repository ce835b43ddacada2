"""Fidelities whose wheels roll and do not slide sideways.

    kinematic          v is empty: wheel speeds say all
    kinematical        v = nu, the free velocities: twists are separated, w = S nu
    dynamical          v = nu: multipliers are eliminated from the equations of all velocities
    quasi_velocities   v = nu: the Boltzmann-Hamel equations (quasi_velocities.py)
The last three are equal. The second is the cheapest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from rbjax.lanes import Lane, inner, ldlt, mul, neg, sub, total
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import Parameters
from rbjax.wheeled.kinematics.planar import Twist, duals, rate_of
from rbjax.wheeled.kinematics.velocities import (
    Shape,
    chassis_twist,
    constraint_rates,
    free_velocities,
    rolling_velocities,
    shaft_speed,
)
from rbjax.wheeled.models.equations import (
    Equations,
    columns_of,
    gravity_wrenches,
    projected_equations,
)
from rbjax.wheeled.models.robot_model import RobotModel, motor_dampers, torques_at_rest_loads


class Kinematic(RobotModel):
    """Wheels turn at the free speeds of their motors; the robot has no inertia.

        w = S nu,   W_j(nu) = free speed of drive j at u_j, in least squares over the drives

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

    def full_velocities(self, now: RobotContext) -> list[Lane]:
        n = now.n
        shape = now.shape
        size = n.robot.arrangement.mobility
        columns = []
        for w in columns_of(n, shape, rolling_velocities, size):
            rates = w[2 + len(n.bodies) :]
            columns.append(
                [
                    shaft_speed(n, drive.wheels, split, rates)
                    for drive, split in zip(n.robot.drives, n.splits, strict=True)
                ]
            )
        speeds = [motor.free_speed(u) for motor, u in zip(n.motors, now.u, strict=False)]
        M = [[inner(x, y) for y in columns] for x in columns]
        f = [inner(x, speeds) for x in columns]
        return rolling_velocities(n, shape, ldlt(M).solve(f))

    def accelerations(self, now: RobotContext) -> list[Lane]:
        return []

    def start_velocities(self, now: RobotContext, w: list[Lane]) -> list[Lane]:
        return []


class Rolling(RobotModel):
    """Robots with inertia whose wheels roll: v = nu, the velocities that the wheels leave free."""

    @property
    def nv(self) -> int:
        return self.robot.arrangement.mobility

    def full_velocities(self, now: RobotContext) -> list[Lane]:
        n = now.n
        return rolling_velocities(n, now.shape, now.v)

    def start_velocities(self, now: RobotContext, w: list[Lane]) -> list[Lane]:
        n = now.n
        return free_velocities(n, now.shape, Twist(*w[:3]))

    def ground_forces(self, now: RobotContext) -> list[Lane]:
        """What the ground must do so that wheels roll, M w' - f: by the full velocities, the force
        (2,) on the robot in the chassis' axes, N, moments, and torques on shafts, N m."""
        n = now.n
        w = self.full_velocities(now)
        turning = now.shape_with_rate(w)
        rate = [
            rate_of(x)
            for x in rolling_velocities(n, turning, duals(now.v, self.accelerations(now)))
        ]
        M, f, _ = projected_equations(now, w, identity, w,
            gravity_wrenches(now), torques_at_rest_loads(now, w),
        )  # fmt: skip
        return [sub(inner(row, rate), x) for row, x in zip(M, f, strict=True)]


class Kinematical(Rolling):
    """Dynamics reduced by the kinematical approach: twists and wrenches are separated.

        (S^T M S) nu' = S^T (f - M S' nu),   w = S nu

    (Olguín Díaz, *3D Motion of Rigid Bodies*, ch. 8)

    Example:
        >>> import rbjax as rb
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "kinematical")
        >>> cart.nv, cart.nu
        (2, 2)
    """

    name: ClassVar[str] = "kinematical"

    def accelerations(self, now: RobotContext) -> list[Lane]:
        return self._equations(now, self.full_velocities(now)).accelerations

    def damped_accelerations(self, now: RobotContext, h: Lane) -> list[Lane]:
        w = self.full_velocities(now)
        return self._equations(now, w).damped(motor_dampers(now, w), h)

    def _equations(self, now: RobotContext, w: list[Lane]) -> Equations:
        return projected_equations(now, w, rolling_velocities, now.v,
            gravity_wrenches(now), torques_at_rest_loads(now, w),
        )  # fmt: skip


class Dynamical(Rolling):
    """Dynamics reduced by the dynamical approach: multipliers are eliminated.

        M w' = f + A^T l,   A w' = -A' w,   l = -(A M^-1 A^T)^-1 (A M^-1 f + A' w)

    v' = nu' are the free ones of w'. (Olguín Díaz, *3D Motion of Rigid Bodies*, ch. 8)

    Example:
        >>> import rbjax as rb
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "dynamical")
        >>> cart.nv
        2
    """

    name: ClassVar[str] = "dynamical"

    def accelerations(self, now: RobotContext) -> list[Lane]:
        n = now.n
        w = self.full_velocities(now)
        shape, moved = now.shape, now.shape_with_rate(w)
        M, f, _ = projected_equations(now, w, identity, w,
            gravity_wrenches(now), torques_at_rest_loads(now, w),
        )  # fmt: skip
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
        short = [
            sub(neg(bias[i]), total(mul(c[i], x) for c, x in zip(A, free, strict=True)))
            for i in range(size)
        ]
        l = ldlt(K).solve(short)
        rate = [
            total([x, *(mul(lifted[i][k], l[i]) for i in range(size))]) for k, x in enumerate(free)
        ]
        # nu' = S^+ (w' - S' nu)
        given = chassis_twist(n, moved, now.v)
        V = Twist(*(sub(a, rate_of(b)) for a, b in zip(rate[:3], given, strict=True)))
        return free_velocities(n, shape, V)


def identity(n: Parameters, shape: Shape, w: Sequence[Lane]) -> list[Lane]:
    return list(w)
