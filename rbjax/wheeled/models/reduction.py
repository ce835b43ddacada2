"""The terms of the equations of motion of a rolling robot.

    reduced equations      w = S nu,    M nu' + C nu = B tau + f
    with multipliers       A w = 0,     M w' + C w = B tau + f + A^T l
w are the full velocities, and nu the free velocities of rolling wheels. M' - 2 C is skew. With J
the Jacobians of the bodies' twists and p their momenta,

    C = sum J^T (M J' + G J),   G V = (-w p_y, w p_x, vx p_y - vy p_x),   G skew
(Olguín Díaz, *3D Motion of Rigid Bodies*, 8.2, 8.3)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import instance
from rbjax.compiling import compiled
from rbjax.display import displayed
from rbjax.lanes.arrays import matvec
from rbjax.model import State
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import Parameters, stack_lanes
from rbjax.wheeled.kinematics.planar import Twist, rate_of
from rbjax.wheeled.kinematics.velocities import (
    constraint_rates,
    drive_speeds,
    inertial_motion,
    rolling_velocities,
)
from rbjax.wheeled.models.equations import (
    Velocities,
    columns_of,
    momentum,
    motion_and_rate,
    projected_equations,
)
from rbjax.wheeled.models.forces import shaft_torques
from rbjax.wheeled.models.robot_model import check_robot_model, check_state_and_controls
from rbjax.wheeled.models.rolling import RollingModel, identity


@displayed
class Reduced(NamedTuple):
    """Terms of the reduced equations of motion M nu' + C nu = B tau + f, with w = S nu.

    Fields:
        S: (nw, nv), the map from free velocities nu to full velocities w.
        M: (nv, nv), mass matrix.
        C: (nv, nv), Coriolis matrix.
        B: (nv, drives), the map from torques of drives to generalized forces.
        f: (nv,), all other forces: gravity, damping of shafts, rolling resistance, steering.
        tau: (drives,), the torques of the drives, N m.
    """

    S: jax.Array
    M: jax.Array
    C: jax.Array
    B: jax.Array
    f: jax.Array
    tau: jax.Array


@displayed
class Undetermined(NamedTuple):
    """Terms of the equations of motion M w' + C w = B tau + f + A^T l, with A w = 0.

    Fields:
        A: (rows, nw), the constraints in m/s: no lateral velocity of leading wheels and trailers,
            and no slip of shafts.
        M: (nw, nw), mass matrix.
        C: (nw, nw), Coriolis matrix.
        B: (nw, drives), the map from torques of drives to generalized forces.
        f: (nw,), all other forces: gravity, damping of shafts, rolling resistance, steering.
        tau: (drives,), the torques of the drives, N m.
        multipliers: l (rows,), the forces of the ground, N.
    """

    A: jax.Array
    M: jax.Array
    C: jax.Array
    B: jax.Array
    f: jax.Array
    tau: jax.Array
    multipliers: jax.Array


def reduced(model: RollingModel, state: State, ctrl: Any = None) -> Reduced:
    """Compute the terms of the reduced equations of motion.

    Args:
        model: a model of a rolling robot, `at(robot, "reduced")`.
        state: q (nq,), v = nu (nv,).
        ctrl: (nu,), the controls as for `rates`; zeros if None.

    Returns:
        `Reduced(S, M, C, B, f, tau)`, in SI units.

    Raises:
        InputError: a robot that slips or has no inertia, wrong shapes.

    Source: Olguín Díaz, *3D Motion of Rigid Bodies*, 8.3.

    Example:
        >>> import rbjax as rb
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "reduced")
        >>> terms = rb.wheeled.reduced(cart, rb.wheeled.start(cart))
        >>> terms.M.shape, terms.S.shape[1]
        ((2, 2), 2)
    """
    return _reduced(model, *_checked("reduced", model, state, ctrl))


def undetermined(model: RollingModel, state: State, ctrl: Any = None) -> Undetermined:
    """Compute the terms of the equations of motion with Lagrange multipliers, and the multipliers.

        M w' + C w = B tau + f + A^T l,      A w = 0
    The rolling constraints are not eliminated (the dynamical approach). w are all velocities.

    Args:
        model: a model of a rolling robot, `at(robot, "reduced")`.
        state: q (nq,), v = nu (nv,).
        ctrl: (nu,), the controls as for `rates`; zeros if None.

    Returns:
        `Undetermined(A, M, C, B, f, tau, multipliers)`.

    Raises:
        InputError: a robot that slips or has no inertia, wrong shapes.

    Source: Olguín Díaz, *3D Motion of Rigid Bodies*, 8.2.

    Example:
        >>> import rbjax as rb
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "reduced")
        >>> terms = rb.wheeled.undetermined(cart, rb.wheeled.start(cart))
        >>> terms.A.shape[0] == terms.multipliers.shape[0]
        True
    """
    return _undetermined(model, *_checked("undetermined", model, state, ctrl))


def _checked(where: str, model: Any, state: Any, ctrl: Any) -> tuple[State, jax.Array]:
    check_robot_model(where, model)
    public = 'a robot that rolls and has inertia, as rbjax.wheeled.at(robot, "reduced")'
    instance(where, "model", model, RollingModel, public)
    return check_state_and_controls(where, model, state, ctrl)


@compiled
def _reduced(model: RollingModel, state: State, u: jax.Array) -> Reduced:
    context = model.context(state, u)
    w = model.full_velocities(context)
    S = _matrix(columns_of(context.n, context.shape, rolling_velocities, model.nv), context.n)
    return Reduced(S, *_terms(context, w, rolling_velocities, context.v))


@compiled
def _undetermined(model: RollingModel, state: State, u: jax.Array) -> Undetermined:
    context = model.context(state, u)
    n, w = context.n, model.full_velocities(context)
    M, C, B, f, tau = _terms(context, w, identity, w)
    units = columns_of(n, context.shape, identity, len(w))
    A = _matrix([constraint_rates(n, context.shape, unit) for unit in units], n)
    rates = constraint_rates(n, context.shape_with_rate(w), w)
    bias = stack_lanes([rate_of(x) for x in rates], n.dtype)  # A' w
    free = jnp.linalg.solve(M, matvec(B, tau) + f - matvec(C, stack_lanes(w, n.dtype)))
    l = jnp.linalg.solve(A @ jnp.linalg.solve(M, A.T), -bias - matvec(A, free))
    return Undetermined(A, M, C, B, f, tau, l)


def _matrix(columns: Sequence[Sequence[Any]], n: Parameters) -> jax.Array:
    return jnp.stack([stack_lanes([*column], n.dtype) for column in columns], 1)


def _terms(
    context: RobotContext, w: Sequence[Any], velocities: Velocities, nu: Sequence[Any]
) -> tuple[jax.Array, ...]:
    """Compute the mass matrix M, Coriolis matrix C, input matrix B, other forces f, and drive
    torques.

    They are in the velocities nu, which `velocities` maps to the full velocities w.
    """
    n, size, dtype = context.n, len(nu), context.n.dtype
    units = [[1.0 if i == j else 0.0 for i in range(size)] for j in range(size)]
    shape = context.shape_with_rate(w)
    parts = [motion_and_rate(n, shape, velocities, unit) for unit in units]
    twists = inertial_motion(n, context.shape, w).twists
    basis = (Twist(1.0, 0.0, 0.0), Twist(0.0, 1.0, 0.0), Twist(0.0, 0.0, 1.0))
    C = jnp.zeros((size, size), dtype)
    for k, (body, V) in enumerate(zip(n.rigid, twists, strict=True)):
        J, dJ = (_matrix([x.twists[k] for x in side], n) for side in zip(*parts, strict=True))
        inertia = _matrix([[*momentum(body, unit)] for unit in basis], n)
        x, y, _ = momentum(body, V)
        G = _matrix([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]], n)  # by column
        C = C + J.T @ (inertia @ dJ + G @ J)
    for i, (inertia, _) in enumerate(parts[0][0].turns):
        j, dj = (
            stack_lanes([x.turns[i][1] for x in side], dtype) for side in zip(*parts, strict=True)
        )
        C = C + inertia * jnp.outer(j, dj)
    columns = columns_of(n, context.shape, velocities, size)
    B = _matrix([drive_speeds(n, n.shaft_rates(column)) for column in columns], n).T
    speeds = drive_speeds(n, n.shaft_rates(w))
    torques = [motor.torque(u, x) for motor, u, x in zip(n.motors, context.u, speeds, strict=False)]
    tau = stack_lanes(torques, dtype)
    M, right, _ = projected_equations(context, w, velocities, nu, shaft_torques(context, w))
    f = stack_lanes(right, dtype) + matvec(C, stack_lanes(nu, dtype)) - matvec(B, tau)
    return _matrix(M, n), C, B, f, tau
