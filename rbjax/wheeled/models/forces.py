"""Loads of wheels, and torques on their shafts.

A rigid body on equal springs loads its wheels by a plane, N_i = a + b x_i + c y_i. With f_i, the
traction of a wheel per newton of load, and the centre of mass at (x, y) and the height h,

    sum N_i = W,   sum (x_i - x + h f_ix) N_i = 0,   sum (y_i - y + h f_iy) N_i = 0

As f does not depend on N, these equations are linear. Load transfer is exact and has no state.
Wheels at one point, or on one line, cannot carry all moments; the rest is ignored.
(Jazar, *Vehicle Dynamics*, ch. 2; Milliken & Milliken, *Race Car Vehicle Dynamics*, ch. 18)

A trailer is supported by its axle and by its coupling. A robot with trailers has no load transfer,
also on its chassis. The mass of a caster loads the wheels as if it were at the caster's pivot.
"""

from __future__ import annotations

from collections.abc import Sequence

from rbjax.lanes import Lane, add, mul, neg, sub, total
from rbjax.wheeled.kinematics.context import RobotContext
from rbjax.wheeled.kinematics.parameters import Parameters
from rbjax.wheeled.kinematics.planar import Pair, dot, inverse
from rbjax.wheeled.kinematics.velocities import drive_speeds
from rbjax.wheeled.models.equations import Damper


def wheel_loads(n: Parameters, tractions: Sequence[Pair] | None = None) -> list[Lane]:
    """Compute the loads N_i of all wheels, N.

    tractions: of each wheel, along x and y of its body, per newton of load; None for loads at rest.
    """
    out: list[Lane] = [0.0] * len(n.wheels)
    down: list[list[tuple[Lane, Pair]]] = [[] for _ in n.bodies]  # on couplings of each body
    for k in reversed(range(1, len(n.bodies))):
        body, mine = n.bodies[k], [i for i, wheel in enumerate(n.wheels) if wheel.body == k]
        weight, bar = mul(body.mass, n.gravity), body.drawbar
        hung = total(force for force, _ in down[k])
        moment = sub(mul(weight, bar), mul(n.gravity, body.moment[0]))
        moment = add(moment, total(mul(force, sub(bar, p[0])) for force, p in down[k]))
        share = 1.0 / len(mine)
        arm = sub(bar, mul(share, total(n.wheels[i].position[0] for i in mine)))
        axle = mul(moment, inverse(arm))
        for i in mine:
            out[i] = mul(share, axle)
        down[n.ahead(k)].append((sub(add(weight, hung), axle), body.hitch))
    chassis, mine = n.bodies[0], [i for i, wheel in enumerate(n.wheels) if wheel.body == 0]
    weight = mul(chassis.mass, n.gravity)
    whole = add(weight, total(force for force, _ in down[0]))
    places = [n.wheels[i].position for i in mine]
    pulls: list[Pair] = [(0.0, 0.0) for _ in mine]
    if tractions is not None and len(n.bodies) == 1:
        h = chassis.height
        pulls = [(mul(h, tractions[i][0]), mul(h, tractions[i][1])) for i in mine]
    # moments about the origin: (x_i + h f_i - x) N_i, with x the point of action of all weights
    moments = tuple(
        add(mul(n.gravity, chassis.moment[k]), total(mul(force, p[k]) for force, p in down[0]))
        for k in (0, 1)
    )
    at = tuple(mul(m, inverse(whole)) for m in moments)
    support = n.robot.arrangement.support
    if support == 1:
        found = [mul(1.0 / len(mine), whole)] * len(mine)
    elif support == 2:
        found = _on_a_line(places, pulls, at, whole)
    else:
        found = _on_an_area(places, pulls, at, whole)
    for i, load in zip(mine, found, strict=True):
        out[i] = load
    return out


def _on_a_line(places: Sequence[Pair], pulls: Sequence[Pair], at: Pair, whole: Lane) -> list[Lane]:
    first, last = places[0], places[-1]
    line = sub(last[0], first[0]), sub(last[1], first[1])
    along = [dot(line, p) for p in places]
    arms = [
        sub(add(s, dot(line, pull)), dot(line, at)) for s, pull in zip(along, pulls, strict=True)
    ]
    count, s1 = float(len(along)), total(along)
    m0, m1 = total(arms), total(mul(s, m) for s, m in zip(along, arms, strict=True))
    scale = mul(whole, inverse(sub(mul(count, m1), mul(s1, m0))))
    a, b = mul(m1, scale), neg(mul(m0, scale))
    return [add(a, mul(b, s)) for s in along]


def _on_an_area(places: Sequence[Pair], pulls: Sequence[Pair], at: Pair, whole: Lane) -> list[Lane]:
    rows = [
        [sub(add(p[k], pull[k]), at[k]) for p, pull in zip(places, pulls, strict=True)]
        for k in (0, 1)
    ]
    basis = [[1.0] * len(places), [p[0] for p in places], [p[1] for p in places]]

    def summed(row: Sequence[Lane]) -> tuple[Lane, Lane, Lane]:
        a, b, c = (total(mul(x, y) for x, y in zip(row, column, strict=True)) for column in basis)
        return a, b, c

    # (a, b, c) of the plane is orthogonal to both rows of moments: their scaled cross product
    (a, b, c), (d, e, f), unit = summed(rows[0]), summed(rows[1]), summed(basis[0])
    plane = sub(mul(b, f), mul(c, e)), sub(mul(c, d), mul(a, f)), sub(mul(a, e), mul(b, d))
    scale = mul(whole, inverse(total(mul(x, y) for x, y in zip(unit, plane, strict=True))))
    p, q, r = (mul(x, scale) for x in plane)
    return [total((p, mul(q, x), mul(r, y))) for x, y in places]


def shaft_torques(
    context: RobotContext, w: Sequence[Lane], loads: Sequence[Lane] | None = None
) -> list[Lane]:
    """Compute the torque of drives, damping and rolling resistance on each shaft, N m.

    w: the full velocities.
    loads: the loads of the wheels, N; None for loads at rest.
    """
    n = context.n
    rates = n.shaft_rates(w)
    out = [neg(mul(c, rate)) for c, rate in zip(n.damping, rates, strict=True)]
    speeds = drive_speeds(n, rates)
    for j, (drive, split) in enumerate(zip(n.robot.drives, n.splits, strict=True)):
        torque = n.motors[j].torque(context.u[j], speeds[j])
        for i, share in zip(drive.wheels, split, strict=True):
            shaft = n.wheels[i].shaft
            out[shaft] = add(out[shaft], mul(share, torque))
    if n.resistance is not None:
        loads = wheel_loads(n) if loads is None else loads
        for wheel, load in zip(n.wheels, loads, strict=True):
            speed = mul(wheel.radius, rates[wheel.shaft])
            torque = n.resistance.torque(load, wheel.radius, speed)
            out[wheel.shaft] = add(out[wheel.shaft], torque)
    return out


def motor_dampers(context: RobotContext, w: Sequence[Lane]) -> list[Damper]:
    """Compute the linear dampers of the shafts: axle damping, and torque / speed of the motors."""
    n = context.n
    rates = n.shaft_rates(w)
    first, speeds = len(w) - len(rates), drive_speeds(n, rates)
    units = [[1.0 if k == first + i else 0.0 for k in range(len(w))] for i in range(len(rates))]
    out: list[Damper] = list(zip(n.damping, units, strict=True))
    for j, (drive, split) in enumerate(zip(n.robot.drives, n.splits, strict=True)):
        row: list[Lane] = [0.0] * len(w)
        for i, share in zip(drive.wheels, split, strict=True):
            at = first + n.wheels[i].shaft
            row[at] = add(row[at], share)
        out.append((n.motors[j].damping(context.u[j], speeds[j]), row))
    return out
