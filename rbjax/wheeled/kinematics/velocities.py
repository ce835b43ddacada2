"""Velocity kinematics of wheeled robots: twists of bodies, rates of wheels, rolling constraints.

All maps are linear in the velocities. They depend on the shape: the angles of trailers, steerings
and casters. With a shape of `Dual` lanes the same functions compute rates of change.

    contact of a wheel      u = v(p),       p its centre, e its direction, n to its left
    rolling                 r phi' = e . u + tan(roller) n . u
    not sliding sideways    n . u = 0
    caster, trail d         gamma' = n . v(pivot) / d - w,  so that n . u = 0 at its centre
    trailer                 v(coupling) equals the velocity of the same point of the body ahead;
                            the leading wheel of the trailer does not slide sideways
(Olguín Díaz, *3D Motion of Rigid Bodies*, ch. 8; Lynch & Park, *Modern Robotics*, 13.2, 13.3)
"""

from __future__ import annotations

from collections.abc import Sequence
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


class Directions(NamedTuple):
    """Directions that depend on the angles of trailers, steerings and casters."""

    trailers: tuple[Pair, ...]  # the direction of each trailer relative to the body ahead
    wheels: tuple[Pair, ...]  # the direction of each wheel in its body
    leaders: tuple[tuple[Pair, Pair], ...]  # the position and direction of each leading wheel


def shape_of(n: Parameters, angles: Sequence[Lane]) -> Directions:
    """Compute the `Directions` from the angles of trailers, steerings and casters."""
    return shape_along(n, [direction(angle) for angle in angles])


def shape_along(n: Parameters, directions: Sequence[Pair]) -> Directions:
    """Compute the `Directions` from the directions of trailers, steerings and casters."""
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
    return fusion_barrier(Directions(trailers, of_wheels, tuple(leaders)))


def place_of(n: Parameters, leader: Leader) -> Pair:
    """Compute the position of a leading wheel in its body: for a steering, the middle of its
    wheels."""
    if leader.what == "skidding":
        return n.turn_center, 0.0
    if leader.what == "wheel":
        return n.wheels[leader.number].position
    wheels = n.robot.steerings[leader.number].wheels
    share = 1.0 / len(wheels)
    x, y = (total(n.wheels[i].position[k] for i in wheels) for k in (0, 1))
    return mul(share, x), mul(share, y)


def _steered(n: Parameters, wheels: Sequence[int], e: Pair) -> dict[int, Pair]:
    """Compute the direction of each wheel of a steering at the steering angle with direction e."""
    if len(wheels) == 1:
        return {wheels[0]: rotate(e, n.wheels[wheels[0]].heading)}
    # Ackermann: all wheels turn about one point of the fixed axle
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
        # the heading of this wheel may be opposite to the heading of the first wheel
        out[i] = rotate((mul(d[0], scale), mul(d[1], scale)), n.wheels[i].heading)
    return out


def _steering_of(n: Parameters, wheel: int) -> int:
    return next(j for j, s in enumerate(n.robot.steerings) if wheel in s.wheels)


def chassis_twist(n: Parameters, shape: Directions, free: Sequence[Lane]) -> Twist:
    """Compute the twist of the chassis from the free velocities.

    Without a leading wheel the free velocities are the twist. With one, they are the speed along
    this wheel, at the point of its axle nearest to the origin, and the turning rate. With two
    leading wheels there is one free velocity, the speed at the second.
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


def _about_one_center(n: Parameters, shape: Directions) -> Twist:
    """Compute the twist in which both leading wheels roll, with about unit speed at the second one.
    It is the cross product of their constraint rows, which is regular at any steering."""
    (p, e), (q, f) = shape.leaders
    i, j = dot(e, p), dot(f, q)
    apart = sub(q[0], p[0]), sub(q[1], p[1])
    if n.robot.arrangement.steerability == 2:
        scale = inverse_root(dot(apart, apart))
    else:
        scale = inverse(dot(e, apart))
    x, y = (sub(mul(e[k], j), mul(f[k], i)) for k in (0, 1))
    return Twist(x, y, cross(e, f)) * scale


def free_velocities(n: Parameters, shape: Directions, V: Twist) -> list[Lane]:
    """Project a twist onto the free velocities, the inverse of `chassis_twist`."""
    if not shape.leaders:
        return list(V)
    if len(shape.leaders) == 1:
        return [dot(shape.leaders[0][1], (V[0], V[1])), V[2]]
    g = _about_one_center(n, shape)
    size = total(mul(a, a) for a in g)
    return [mul(total(mul(a, b) for a, b in zip(g, V, strict=True)), inverse(size))]


def rolling_velocities(n: Parameters, shape: Directions, free: Sequence[Lane]) -> list[Lane]:
    """Compute the full velocities w = S nu from the free velocities nu of rolling wheels."""
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
    """Compute the twist of trailer k from the velocity v of its coupling, in the trailer's axes,
    and its turning rate w."""
    return Twist(v[0], sub(v[1], mul(w, n.bodies[k].drawbar)), w)


def twists_of(n: Parameters, shape: Directions, w: Sequence[Lane]) -> list[Twist]:
    """Compute the twists of all bodies from the full velocities."""
    twists = [Twist(*w[:3])]
    for k in range(1, len(n.bodies)):
        ahead = twists[n.ahead(k)]
        v = rotate_back(ahead.at(n.bodies[k].hitch), shape.trailers[k - 1])
        twists.append(_behind(n, k, v, add(ahead[2], w[2 + k])))
    return twists


def contact_velocity(n: Parameters, shape: Directions, twists: Sequence[Twist], i: int) -> Pair:
    """Compute the velocity of a wheel's centre along its direction and to its left."""
    wheel = n.wheels[i]
    u = twists[wheel.body].at(wheel.position)
    e = shape.wheels[i]
    return dot(e, u), dot(left(e), u)


def rolling_rate(n: Parameters, shape: Directions, twists: Sequence[Twist], i: int) -> Lane:
    """Compute the rate of a wheel that rolls without slipping."""
    along, across = contact_velocity(n, shape, twists, i)
    if n.wheels[i].kind == "rollers":
        along = add(along, mul(n.wheels[i].slant, across))
    return mul(along, inverse(n.wheels[i].radius))


def caster_rates(n: Parameters, shape: Directions, twists: Sequence[Twist]) -> list[Lane]:
    """Compute the rates of casters relative to their bodies."""
    out = []
    for i in n.layout.caster_wheels:
        across = contact_velocity(n, shape, twists, i)[1]
        out.append(sub(mul(across, inverse(n.wheels[i].trail)), twists[n.wheels[i].body][2]))
    return out


class InertialMotion(NamedTuple):
    """The velocities of all inertias."""

    twists: list[Twist]  # of bodies and of caster forks, in their own axes
    turns: list[tuple[Lane, Lane]]  # pairs (inertia, rate) of rotors


def inertial_motion(
    n: Parameters, shape: Directions, w: Sequence[Lane], casters: Sequence[Lane] | None = None
) -> InertialMotion:
    """Compute the velocities of all inertias from the full velocities.

    casters: the rates of casters, if they are independent; None to compute them.
    """
    twists, rates = twists_of(n, shape, w), n.shaft_rates(w)
    turns = list(zip(n.shafts, rates, strict=True))
    rotors = [j for j, motor in enumerate(n.motors) if not is_zero(motor.inertia)]
    speeds = drive_speeds(n, rates) if rotors else []
    turns += [(n.motors[j].inertia, speeds[j]) for j in rotors]
    casters = caster_rates(n, shape, twists) if casters is None else casters
    forks = []
    for i, rate in zip(n.layout.caster_wheels, casters, strict=True):
        along, across = contact_velocity(n, shape, twists, i)
        forks.append(Twist(along, across, add(rate, twists[n.wheels[i].body][2])))
        if not is_zero(n.wheels[i].yaw_inertia):
            turns.append((n.wheels[i].yaw_inertia, forks[-1][2]))
    return InertialMotion([*twists, *forks], turns)


def drive_speeds(n: Parameters, rates: Sequence[Lane]) -> list[Lane]:
    """Compute the speeds of the drives, W = sum split_i phi'_i, from the rates of shafts."""
    return [
        total(mul(share, rates[n.wheels[i].shaft]) for i, share in zip(x.wheels, s, strict=True))
        for x, s in zip(n.robot.drives, n.splits, strict=True)
    ]


def constraint_rates(n: Parameters, shape: Directions, w: Sequence[Lane]) -> list[Lane]:
    """Compute the constraint velocities A w, m/s, which are zero for rolling wheels. They are the
    lateral velocities of leading wheels and of trailers, and the slip of shafts."""
    twists = twists_of(n, shape, w)
    out = [dot(left(e), twists[0].at(p)) for p, e in shape.leaders]
    for wheel in n.robot.arrangement.trailing:
        out.append(contact_velocity(n, shape, twists, wheel)[1])
    rates = n.shaft_rates(w)
    for shaft, i in enumerate(n.layout.setters):
        r = n.wheels[i].radius
        out.append(sub(mul(r, rolling_rate(n, shape, twists, i)), mul(r, rates[shaft])))
    return out
