"""How a robot's velocities follow from each other: twists of bodies, rates of wheels, rows.

Everything is linear in the velocities, and depends on the shape: the angles of trailers, steerings
and casters. A shape of `Dual` lanes gives rates too, so the same functions serve accelerations.

    contact of a wheel      u = v(p),       p its centre, e its direction, n to its left
    rolling                 r phi' = e . u + tan(roller) n . u
    not sliding sideways    n . u = 0
    caster, trail d         gamma' = n . v(pivot) / d - w,  so that n . u = 0 at its centre
    trailer                 v(coupling) is that of the body ahead;  its leading wheel does not slide
(Olguín Díaz, *3D Motion of Rigid Bodies*, ch. 8; Lynch & Park, *Modern Robotics*, 13.2, 13.3)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from rbjax.lanes import Lane, add, fusion_barrier, is_zero, mul, neg, sub, total
from rbjax.wheeled.kinematics.parameters import Parameters, indices
from rbjax.wheeled.kinematics.planar import (
    Pair,
    Twist,
    cross,
    direction,
    dot,
    inverse,
    inverse_root,
    left,
    rotate,
    rotate_back,
)
from rbjax.wheeled.robot.arrangement import Leader


class Shape(NamedTuple):
    """Directions that depend on the coordinates: of trailers against the body ahead, and of wheels
    in their bodies."""

    trailers: tuple[Pair, ...]
    wheels: tuple[Pair, ...]
    leaders: tuple[tuple[Pair, Pair], ...]  # place and direction


def shape_of(n: Parameters, angles: Sequence[Lane]) -> Shape:
    """The shape at the angles of trailers, steerings and casters."""
    return shape_along(n, [direction(angle) for angle in angles])


def shape_along(n: Parameters, directions: Sequence[Pair]) -> Shape:
    """The shape at the directions of trailers, steerings and casters."""
    layout = n.layout
    of = dict(enumerate(directions, start=3))
    trailers = tuple(of[i] for i in indices(layout.trailers))
    steerings = [of[i] for i in indices(layout.steerings)]
    casters = dict(zip(layout.caster_wheels, indices(layout.casters), strict=True))
    wheels = {i: wheel.heading for i, wheel in enumerate(n.wheels)}
    for i, at in casters.items():
        wheels[i] = of[at]
    for steering, e in zip(n.robot.steerings, steerings, strict=True):
        wheels.update(_steered(n, steering.wheels, e))
    leaders = []
    for leader in n.robot.arrangement.leaders:
        ahead: Pair = (1.0, 0.0)
        if leader.what == "wheel":
            ahead = n.wheels[leader.number].heading
        elif leader.what == "steering":
            first = n.robot.steerings[leader.number].wheels[0]
            ahead = rotate(steerings[leader.number], n.wheels[first].heading)
        if leader.backward:
            ahead = neg(ahead[0]), neg(ahead[1])
        leaders.append((place_of(n, leader), ahead))
    of_wheels = tuple(wheels[i] for i in range(len(n.wheels)))
    return fusion_barrier(Shape(trailers, of_wheels, tuple(leaders)))


def place_of(n: Parameters, leader: Leader) -> Pair:
    """The place of a row that leads: of a steering of several wheels, their middle."""
    if leader.what == "skidding":
        return n.turn_center, 0.0
    if leader.what == "wheel":
        return n.wheels[leader.number].position
    wheels = n.robot.steerings[leader.number].wheels
    share = 1.0 / len(wheels)
    x, y = (total(n.wheels[i].position[k] for i in wheels) for k in (0, 1))
    return mul(share, x), mul(share, y)


def _steered(n: Parameters, wheels: Sequence[int], e: Pair) -> dict[int, Pair]:
    """Directions of the wheels of one steering whose angle has the direction e."""
    if len(wheels) == 1:
        return {wheels[0]: rotate(e, n.wheels[wheels[0]].heading)}
    # Ackermann: each rolls along its velocity as all turn about one point of the fixed axle
    leaders = n.robot.arrangement.leaders
    fixed = next((x for x in leaders if x.what != "steering"), None)
    middle = place_of(n, Leader("steering", _steering_of(n, wheels[0])))
    ahead = n.wheels[wheels[0]].heading
    base = place_of(n, fixed) if fixed is not None else (0.0, 0.0)
    length = dot(ahead, (sub(middle[0], base[0]), sub(middle[1], base[1])))
    out = {}
    for i in wheels:
        p = n.wheels[i].position
        far = dot(left(ahead), (sub(p[0], middle[0]), sub(p[1], middle[1])))
        along = dot(ahead, (sub(p[0], base[0]), sub(p[1], base[1])))
        d = sub(e[0], mul(mul(far, e[1]), inverse(length))), mul(mul(along, e[1]), inverse(length))
        scale = inverse_root(dot(d, d))
        # its own heading may be the opposite of the first one's
        out[i] = rotate((mul(d[0], scale), mul(d[1], scale)), n.wheels[i].heading)
    return out


def _steering_of(n: Parameters, wheel: int) -> int:
    return next(j for j, s in enumerate(n.robot.steerings) if wheel in s.wheels)


def chassis_twist(n: Parameters, shape: Shape, free: Sequence[Lane]) -> Twist:
    """The twist of the chassis by the velocities that its wheels leave free.

    No row leads: free is the twist. One leads: the velocity along its wheel, at the point of its
    axle next to the origin, and the turning rate. Two lead: the speed at the second wheel.
    """
    if not shape.leaders:
        return Twist(*free)
    if len(shape.leaders) == 1:
        (place, e) = shape.leaders[0]
        along = dot(e, place)
        v, w = free
        x, y = mul(along, e[0]), mul(along, e[1])
        return Twist(add(mul(e[0], v), mul(w, y)), sub(mul(e[1], v), mul(w, x)), w)
    g = _about_one_center(n, shape)
    return g * free[0]


def _about_one_center(n: Parameters, shape: Shape) -> Twist:
    """The twist whose rows of both leaders vanish, of about unit speed at the second.

    It is the cross product of the rows, so it is regular at any steering.
    """
    (p, e), (q, f) = shape.leaders
    i, j = dot(e, p), dot(f, q)
    apart = sub(q[0], p[0]), sub(q[1], p[1])
    if n.robot.arrangement.steerability == 2:
        scale = inverse_root(dot(apart, apart))
    else:
        scale = inverse(dot(e, apart))
    x, y = (sub(mul(e[k], j), mul(f[k], i)) for k in (0, 1))
    return Twist(x, y, cross(e, f)) * scale


def free_velocities(n: Parameters, shape: Shape, V: Twist) -> list[Lane]:
    """The free velocities of a twist that the wheels allow: the inverse of `chassis_twist`."""
    if not shape.leaders:
        return list(V)
    if len(shape.leaders) == 1:
        return [dot(shape.leaders[0][1], (V[0], V[1])), V[2]]
    g = _about_one_center(n, shape)
    size = total(mul(a, a) for a in g)
    return [mul(total(mul(a, b) for a, b in zip(g, V, strict=True)), inverse(size))]


def rolling_velocities(n: Parameters, shape: Shape, free: Sequence[Lane]) -> list[Lane]:
    """The full velocities w by the free ones, where no wheel slides."""
    V = chassis_twist(n, shape, free)
    twists, rates = [V], []
    for k, wheel in enumerate(n.robot.arrangement.trailing, start=1):
        body = n.bodies[k]
        v = rotate_back(twists[n.ahead(k)].at(body.hitch), shape.trailers[k - 1])
        e, p = shape.wheels[wheel], n.wheels[wheel].position
        arm = dot(e, (sub(p[0], body.drawbar), p[1]))
        w = neg(mul(dot(left(e), v), inverse(arm)))
        rates.append(sub(w, twists[n.ahead(k)][2]))
        twists.append(_behind(n, k, v, w))
    return [*V, *rates, *(rolling_rate(n, shape, twists, i) for i in n.layout.setters)]


def _behind(n: Parameters, k: int, v: Pair, w: Lane) -> Twist:
    """The twist of a trailer by the velocity of its coupling, in its axes, and its turning rate."""
    return Twist(v[0], sub(v[1], mul(w, n.bodies[k].drawbar)), w)


def twists_of(n: Parameters, shape: Shape, w: Sequence[Lane]) -> list[Twist]:
    """The twists of all bodies by the full velocities."""
    twists = [Twist(*w[:3])]
    for k in range(1, len(n.bodies)):
        ahead = twists[n.ahead(k)]
        v = rotate_back(ahead.at(n.bodies[k].hitch), shape.trailers[k - 1])
        twists.append(_behind(n, k, v, add(ahead[2], w[2 + k])))
    return twists


def contact_velocity(n: Parameters, shape: Shape, twists: Sequence[Twist], i: int) -> Pair:
    """The velocity of a wheel's centre along its direction and to its left."""
    wheel = n.wheels[i]
    u = twists[wheel.body].at(wheel.position)
    e = shape.wheels[i]
    return dot(e, u), dot(left(e), u)


def rolling_rate(n: Parameters, shape: Shape, twists: Sequence[Twist], i: int) -> Lane:
    """The rate of a wheel that rolls."""
    along, across = contact_velocity(n, shape, twists, i)
    if n.wheels[i].kind == "rollers":
        along = add(along, mul(n.wheels[i].slant, across))
    return mul(along, inverse(n.wheels[i].radius))


def caster_rates(n: Parameters, shape: Shape, twists: Sequence[Twist]) -> list[Lane]:
    """The rates of casters against their bodies."""
    out = []
    for i in n.layout.caster_wheels:
        across = contact_velocity(n, shape, twists, i)[1]
        out.append(sub(mul(across, inverse(n.wheels[i].trail)), twists[n.wheels[i].body][2]))
    return out


@dataclass(frozen=True)
class Motion:
    """What carries inertia: twists of bodies and forks, and rates with the inertias that turn at
    them."""

    twists: list[Twist]
    turns: list[tuple[Lane, Lane]]  # inertia, rate


def inertial_motion(n: Parameters, shape: Shape, w: Sequence[Lane]) -> Motion:
    """All that moves, by the full velocities."""
    twists = twists_of(n, shape, w)
    rates = w[2 + len(n.bodies) :]
    turns = list(zip(n.shafts, rates, strict=True))
    for drive, motor, split in zip(n.robot.drives, n.motors, n.splits, strict=True):
        if not is_zero(motor.inertia):
            turns.append((motor.inertia, shaft_speed(n, drive.wheels, split, rates)))
    forks = fork_twists(n, shape, twists, caster_rates(n, shape, twists))
    for i, fork in zip(n.layout.caster_wheels, forks, strict=True):
        if not is_zero(n.wheels[i].yaw_inertia):
            turns.append((n.wheels[i].yaw_inertia, fork[2]))
    return Motion([*twists, *forks], turns)


def fork_twists(
    n: Parameters, shape: Shape, twists: Sequence[Twist], rates: Sequence[Lane]
) -> list[Twist]:
    """The twists of casters' forks at their pivots, in their own axes, by the rates of casters."""
    out = []
    for i, rate in zip(n.layout.caster_wheels, rates, strict=True):
        along, across = contact_velocity(n, shape, twists, i)
        out.append(Twist(along, across, add(rate, twists[n.wheels[i].body][2])))
    return out


def shaft_speed(
    n: Parameters, wheels: Sequence[int], split: Sequence[Lane], rates: Sequence[Lane]
) -> Lane:
    """The speed of a drive: W = sum split_i phi'_i."""
    return total(
        mul(share, rates[n.wheels[i].shaft]) for i, share in zip(wheels, split, strict=True)
    )


def constraint_rates(n: Parameters, shape: Shape, w: Sequence[Lane]) -> list[Lane]:
    """What vanishes where wheels roll: rates of rows that lead, of trailers', of shafts."""
    twists = twists_of(n, shape, w)
    out = [dot(left(e), twists[0].at(p)) for p, e in shape.leaders]
    for wheel in n.robot.arrangement.trailing:
        out.append(contact_velocity(n, shape, twists, wheel)[1])
    rates = w[2 + len(n.bodies) :]
    for shaft, i in enumerate(n.layout.setters):
        r = n.wheels[i].radius
        out.append(sub(mul(r, rolling_rate(n, shape, twists, i)), mul(r, rates[shaft])))
    return out
