"""Newton-Euler equations of a wheeled robot, projected on any set of velocities; energies.

With twists V_k = J_k nu of the bodies and rates r_i = j_i nu of the rotors,

    M = sum J_k^T M_k J_k + sum I_i j_i^T j_i
    f = sum J_k^T (F_k - M_k V_k' - C_k) + sum j_i^T (t_i - I_i r_i')      at nu' = 0
    M nu' = f

M_k is the inertia of a body about its own origin, in its own axes, and C_k = w x (momentum). This
is the principle of virtual power (Jourdain; Kane).
(Olguín Díaz, *3D Motion of Rigid Bodies*, ch. 8)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from rbjax.lanes import Lane, add, fusion_barrier, inner, is_zero, ldlt, mul, neg, sub, total
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import BodyParameters, Parameters
from rbjax.wheeled.kinematics.planar import (
    Twist,
    cross,
    dot,
    rate_of,
    rotate,
    rotate_back,
    value_of,
)
from rbjax.wheeled.kinematics.velocities import Directions, InertialMotion, inertial_motion

#: (parameters, shape, nu) -> full velocities
Velocities = Callable[[Parameters, Directions, Sequence[Lane]], list[Lane]]


#: a coefficient c, N s/m or N m s/rad, and a row d; the generalized force is -c d d^T w
Damper = tuple[Lane, Sequence[Lane]]


class ProjectedEquations(NamedTuple):
    """Equations of motion M nu' = f in some velocities nu."""

    M: list[list[Lane]]  # the mass matrix, by row
    f: list[Lane]  # the right side
    columns: list[list[Lane]]  # the full velocities of each unit velocity of nu

    @property
    def accelerations(self) -> list[Lane]:
        """The accelerations nu', the solution of M nu' = f."""
        return ldlt(self.M).solve(self.f)

    def damped(self, dampers: Sequence[Damper], h: Lane) -> list[Lane]:
        """Solve (M + h D) nu' = f, with the damping matrix D = sum c d d^T.

        dampers: pairs of a coefficient c and a row d of full velocities, projected onto nu.
        """
        M = [list(row) for row in self.M]
        for c, d in dampers:
            moved = [inner(d, column) for column in self.columns]
            for a, x in enumerate(moved):
                for b in range(a + 1):
                    M[a][b] = M[b][a] = add(M[a][b], mul(mul(h, c), mul(x, moved[b])))
        return ldlt(M).solve(self.f)


def momentum(body: BodyParameters, V: Twist) -> Twist:
    """Compute the linear momentum of a body, and its angular momentum about its origin."""
    (x, y, w), (a, b) = V, body.moment
    return Twist(
        sub(mul(body.mass, x), mul(w, b)),
        add(mul(body.mass, y), mul(w, a)),
        add(mul(body.inertia, w), sub(mul(a, y), mul(b, x))),
    )


def _gyroscopic(body: BodyParameters, V: Twist) -> Twist:
    """Compute the gyroscopic wrench of a body: the force w x p, and the moment v x p about its
    origin."""
    p, w = momentum(body, V), V[2]
    return Twist(neg(mul(w, p[1])), mul(w, p[0]), cross((V[0], V[1]), (p[0], p[1])))


def gravity_wrenches(context: RobotContext) -> list[Twist]:
    """Compute the wrench of gravity along the ground on each body and fork, in its own axes."""
    n, shape = context.n, context.shape
    if is_zero(n.downhill[0]) and is_zero(n.downhill[1]):
        return [Twist(0.0, 0.0, 0.0)] * len(n.rigid)
    falls = [rotate_back(n.downhill, context.pose)]
    for k in range(1, len(n.bodies)):
        falls.append(rotate_back(falls[n.ahead(k)], shape.trailers[k - 1]))
    for i in n.layout.caster_wheels:
        falls.append(rotate_back(falls[n.wheels[i].body], shape.wheels[i]))
    return [
        Twist(mul(body.mass, x), mul(body.mass, y), cross(body.moment, (x, y)))
        for body, (x, y) in zip(n.rigid, falls, strict=True)
    ]


def columns_of(
    n: Parameters, shape: Directions, velocities: Velocities, size: int
) -> list[list[Lane]]:
    """Compute the columns of S in w = S nu. Column i is w if nu is the i-th unit vector."""
    units = [[1.0 if i == j else 0.0 for i in range(size)] for j in range(size)]
    return [velocities(n, shape, unit) for unit in units]


def projected_equations(
    context: RobotContext,
    w: Sequence[Lane],
    velocities: Velocities,
    nu: Sequence[Lane],
    torques: Sequence[Lane],
    forces: Sequence[Twist] | None = None,
) -> ProjectedEquations:
    """Project the equations of motion on velocities nu, with full velocities w = velocities(nu).

    torques: on each shaft, N m. forces: the wrench on each body and fork, in its own axes about its
        origin; None for gravity.
    """
    n = context.n
    forces = gravity_wrenches(context) if forces is None else forces
    columns = columns_of(n, context.shape, velocities, len(nu))
    parts = [inertial_motion(n, context.shape, column) for column in columns]
    moves, gains = motion_and_rate(n, context.shape_with_rate(w), velocities, nu)
    loads = [
        F - momentum(body, A) - _gyroscopic(body, V)
        for body, F, V, A in zip(n.rigid, forces, moves.twists, gains.twists, strict=True)
    ]
    for body, moment in _steering_torques(context, w):
        loads[body] = loads[body] - Twist(0.0, 0.0, moment)
    driving = [*torques, *([0.0] * (len(gains.turns) - len(torques)))]
    turning = [
        sub(t, mul(inertia, rate)) for t, (inertia, rate) in zip(driving, gains.turns, strict=True)
    ]
    pushed = [[momentum(b, V) for b, V in zip(n.rigid, p.twists, strict=True)] for p in parts]
    M: list[list[Lane]] = [[0.0] * len(nu) for _ in nu]
    for a, part in enumerate(parts):
        for b in range(a + 1):
            entry = total(inner(V, P) for V, P in zip(part.twists, pushed[b], strict=True))
            for (inertia, x), (_, y) in zip(part.turns, parts[b].turns, strict=True):
                entry = add(entry, mul(inertia, mul(x, y)))
            M[a][b] = M[b][a] = entry
    f = [
        add(
            total(inner(V, F) for V, F in zip(part.twists, loads, strict=True)),
            total(mul(x, t) for (_, x), t in zip(part.turns, turning, strict=True)),
        )
        for part in parts
    ]
    M, f = fusion_barrier((M, f))
    return ProjectedEquations(M, f, columns)


def motion_and_rate(
    n: Parameters, shape: Directions, velocities: Velocities, nu: Sequence[Lane]
) -> tuple[InertialMotion, InertialMotion]:
    """Compute the velocities of all inertias at nu, and their rates at nu' = 0.

    shape: `Dual` lanes, the shape with its rate.
    """
    both = inertial_motion(n, shape, velocities(n, shape, nu))
    now, rate = (
        InertialMotion(
            [Twist(*map(part, V)) for V in both.twists], [(i, part(x)) for i, x in both.turns]
        )
        for part in (value_of, rate_of)
    )
    return now, rate


def _steering_torques(context: RobotContext, w: Sequence[Lane]) -> list[tuple[int, Lane]]:
    """Compute the reaction moments of wheels of Ackermann steerings, as pairs (body, moment). At a
    constant steering rate such wheels still accelerate about the vertical."""
    n = context.n
    uneven = [
        i
        for steering in n.robot.steerings
        if len(steering.wheels) > 1
        for i in steering.wheels
        if not is_zero(n.wheels[i].yaw_inertia)
    ]
    if not uneven:
        return []
    shape, out = context.shape_with_two_rates(w), []
    for i in uneven:
        e = shape.wheels[i]
        here = tuple(value_of(value_of(x)) for x in e)
        twice = tuple(rate_of(rate_of(x)) for x in e)
        out.append((n.wheels[i].body, mul(n.wheels[i].yaw_inertia, cross(here, twice))))
    return out


def kinetic_energy(
    n: Parameters, shape: Directions, w: Sequence[Lane], casters: Sequence[Lane] | None = None
) -> Lane:
    """Compute the kinetic energy of bodies, wheels and motors.

    casters: rates of the casters if they are independent, see `inertial_motion`.
    """
    parts = inertial_motion(n, shape, w, casters)
    bodies = total(
        inner(V, momentum(body, V)) for body, V in zip(n.rigid, parts.twists, strict=True)
    )
    return mul(0.5, add(bodies, total(mul(i, mul(rate, rate)) for i, rate in parts.turns)))


def potential_energy(context: RobotContext) -> Lane:
    """Compute the potential energy of gravity on the slope."""
    n, poses, energy = context.n, context.bodies(), 0.0
    for body, (origin, e) in zip(n.bodies, poses, strict=True):
        fall = add(mul(body.mass, dot(n.downhill, origin)), dot(n.downhill, rotate(body.moment, e)))
        energy = sub(energy, fall)
    for i, fork in zip(n.layout.caster_wheels, n.forks, strict=True):
        _, e = poses[n.wheels[i].body]
        moment = rotate(fork.moment, rotate(context.shape.wheels[i], e))
        energy = sub(energy, dot(n.downhill, moment))
    return energy
