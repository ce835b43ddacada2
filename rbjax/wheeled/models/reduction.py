"""The terms of the equations of a rolling robot, by both approaches of the book.

    kinematical    w = S nu,    M nu' + C nu = B tau + f
    dynamical      A w = 0,     M w' + C w = B tau + f + A^T l
w are the full velocities: the chassis' twist (vx, vy, w) in its own axes, the rates of trailers
against the body ahead, the rates of shafts. nu are those that the wheels leave free. C is such that
M' - 2 C is skew: with J the twists of the bodies by the velocities, p their momenta,

    C = sum J^T (M J' + G J),   G V = (-w p_y, w p_x, vx p_y - vy p_x),   G skew
(Olguín Díaz, *3D Motion of Rigid Bodies*, 8.2, 8.3)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.compiling import compiled
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.lanes.arrays import matvec
from rbjax.model import State
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import Parameters, stack_lanes
from rbjax.wheeled.kinematics.planar import Twist, rate_of
from rbjax.wheeled.kinematics.velocities import (
    constraint_rates,
    inertial_motion,
    rolling_velocities,
    shaft_speed,
)
from rbjax.wheeled.models.equations import (
    Velocities,
    columns_of,
    gravity_wrenches,
    momentum,
    motion_and_rate,
    projected_equations,
)
from rbjax.wheeled.models.robot_model import torques_at_rest_loads
from rbjax.wheeled.models.rolling import Rolling, identity
from rbjax.wheeled.models.states import check_state, check_vehicle


class Reduced(NamedTuple):
    """M nu' + C nu = B tau + f, with w = S nu.

    Fields:
        S: (nw, nv), the full velocities by the free ones.
        M, C: (nv, nv), mass matrix and Coriolis matrix.
        B: (nv, drives), the forces by the torques of the drives.
        f: (nv,), all other forces: gravity, damping of shafts, rolling resistance, steering.
        tau: (drives,), the torques of the drives, N m.
    """

    S: jax.Array
    M: jax.Array
    C: jax.Array
    B: jax.Array
    f: jax.Array
    tau: jax.Array


class Undetermined(NamedTuple):
    """M w' + C w = B tau + f + A^T l, with A w = 0.

    Fields:
        A: (rows, nw), the constraints: leading wheels and trailers do not slide sideways (m/s),
            shafts roll (m/s).
        M, C: (nw, nw). B: (nw, drives). f: (nw,). tau: (drives,). As those of `Reduced`.
        multipliers: l (rows,), the forces of the ground in N.
    """

    A: jax.Array
    M: jax.Array
    C: jax.Array
    B: jax.Array
    f: jax.Array
    tau: jax.Array
    multipliers: jax.Array


def reduced(vehicle: Rolling, state: State, controls: Any = None) -> Reduced:
    """Compute the terms of the reduced equations of motion: the kinematical approach.

    Args:
        vehicle: a robot that rolls, `at(robot, "kinematical")`.
        state: q (nq,), v = nu (nv,).
        controls: (nu,), as `rates` takes them; zeros if None.

    Returns:
        `Reduced(S, M, C, B, f, tau)`.

    Raises:
        InputError: a vehicle that slips or has no inertia, wrong shapes.

    Source: Olguín Díaz, *3D Motion of Rigid Bodies*, 8.3.

    Example:
        >>> import rbjax as rb
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "kinematical")
        >>> terms = rb.wheeled.reduced(cart, rb.wheeled.start(cart))
        >>> terms.M.shape, terms.S.shape[1]
        ((2, 2), 2)
    """
    return _reduced(vehicle, *_checked("reduced", vehicle, state, controls))


def undetermined(vehicle: Rolling, state: State, controls: Any = None) -> Undetermined:
    """Compute the terms of the equations of motion with undetermined multipliers, and the
    multipliers: the dynamical approach.

    Args: as `reduced`.

    Returns:
        `Undetermined(A, M, C, B, f, tau, multipliers)`.

    Raises:
        InputError: a vehicle that slips or has no inertia, wrong shapes.

    Source: Olguín Díaz, *3D Motion of Rigid Bodies*, 8.2.

    Example:
        >>> import rbjax as rb
        >>> cart = rb.wheeled.at(rb.wheeled.kinds()["differential_drive"].make(), "kinematical")
        >>> terms = rb.wheeled.undetermined(cart, rb.wheeled.start(cart))
        >>> terms.A.shape[0] == terms.multipliers.shape[0]
        True
    """
    return _undetermined(vehicle, *_checked("undetermined", vehicle, state, controls))


def _checked(where: str, vehicle: Any, state: Any, controls: Any) -> tuple[State, jax.Array]:
    check_vehicle(where, vehicle)
    if not isinstance(vehicle, Rolling):
        raise InputError(
            f"{where}: vehicle is {type(vehicle).__name__}, expected a robot that rolls and has "
            'inertia, as rbjax.wheeled.at(robot, "kinematical") gives it'
        )
    state = check_state(where, vehicle, state)
    u = jnp.zeros(vehicle.nu) if controls is None else controls
    return state, check_array(where, "controls", u, (vehicle.nu,)).astype(state.q.dtype)


@compiled
def _reduced(vehicle: Rolling, state: State, u: jax.Array) -> Reduced:
    now = vehicle.context(state, u)
    n = now.n
    w = vehicle.full_velocities(now)
    S = _matrix(columns_of(n, now.shape, rolling_velocities, vehicle.nv), n)
    return Reduced(S, *_terms(now, w, rolling_velocities, now.v))


@compiled
def _undetermined(vehicle: Rolling, state: State, u: jax.Array) -> Undetermined:
    now = vehicle.context(state, u)
    n = now.n
    w = vehicle.full_velocities(now)
    M, C, B, f, tau = _terms(now, w, identity, w)
    units = columns_of(n, now.shape, identity, len(w))
    A = _matrix([constraint_rates(n, now.shape, unit) for unit in units], n)
    bias = stack_lanes(
        [rate_of(x) for x in constraint_rates(n, now.shape_with_rate(w), w)], n.dtype
    )  # A' w
    free = jnp.linalg.solve(M, matvec(B, tau) + f - matvec(C, stack_lanes(w, n.dtype)))
    l = jnp.linalg.solve(A @ jnp.linalg.solve(M, A.T), -bias - matvec(A, free))
    return Undetermined(A, M, C, B, f, tau, l)


def _matrix(columns: Sequence[Sequence[Any]], n: Parameters) -> jax.Array:
    return jnp.stack([stack_lanes([*column], n.dtype) for column in columns], 1)


def _terms(
    now: RobotContext, w: Sequence[Any], velocities: Velocities, nu: Sequence[Any]
) -> tuple[jax.Array, ...]:
    """M, C, B, f and tau for velocities nu."""
    n = now.n
    size, dtype = len(nu), n.dtype
    units = [[1.0 if i == j else 0.0 for i in range(size)] for j in range(size)]
    turning = now.shape_with_rate(w)
    parts = [motion_and_rate(n, turning, velocities, unit) for unit in units]
    twists = inertial_motion(n, now.shape, w).twists
    C = jnp.zeros((size, size), dtype)
    for k, (body, V) in enumerate(zip(n.rigid, twists, strict=True)):
        J, dJ = (_matrix([x.twists[k] for x in side], n) for side in zip(*parts, strict=True))
        basis = (Twist(1.0, 0.0, 0.0), Twist(0.0, 1.0, 0.0), Twist(0.0, 0.0, 1.0))
        inertia = _matrix([[*momentum(body, unit)] for unit in basis], n)
        x, y, _ = momentum(body, V)
        G = _matrix([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]], n)  # by column
        C = C + J.T @ (inertia @ dJ + G @ J)
    for i in range(len(parts[0][0].turns)):
        j, dj = (
            stack_lanes([x.turns[i][1] for x in side], dtype) for side in zip(*parts, strict=True)
        )
        C = C + parts[0][0].turns[i][0] * jnp.outer(j, dj)
    rates = [column[2 + len(n.bodies) :] for column in columns_of(n, now.shape, velocities, size)]
    drives = list(zip(n.robot.drives, n.motors, n.splits, now.u, strict=False))
    B = jnp.stack(
        [
            stack_lanes([shaft_speed(n, drive.wheels, split, x) for x in rates], dtype)
            for drive, _, split, _ in drives
        ],
        1,
    )
    speeds = w[2 + len(n.bodies) :]
    tau = stack_lanes(
        [
            motor.torque(u, shaft_speed(n, drive.wheels, split, speeds))
            for drive, motor, split, u in drives
        ],
        dtype,
    )
    loads = torques_at_rest_loads(now, w)
    M, right, _ = projected_equations(now, w, velocities, nu, gravity_wrenches(now), loads)
    f = stack_lanes(right, dtype) + matvec(C, stack_lanes(nu, dtype)) - matvec(B, tau)
    return _matrix(M, n), C, B, f, tau
