"""The shortest path from one point to another around a sphere or a cylinder.

In the plane of the path the geom is a circle of radius r. Two points at the distances l_0, l_1 from
its centre, with the angle G between them, are connected by two straight pieces and an arc:

    L = s_0 + s_1 + r F,      s_i = sqrt(l_i^2 - r^2),      F = G + asin(r/l_0) + asin(r/l_1) - pi

F is the angle of the arc; the path is straight if F < 0. On the other side of the circle G becomes
2 pi - G. If the side site is inside the geom the path touches the circle from inside, at the point
of reflection of the shortest path, with the angle of incidence t (Alhazen's problem):

    L = s_0 + s_1 - 2 r cos t + r sin t F(t),        s_i = sqrt(l_i^2 - r^2 sin^2 t)
    F(t) = G + asin(r sin(t) / l_0) + asin(r sin(t) / l_1) - 2 t = 0

F is decreasing and concave, so Newton's method from t = pi/2 converges monotonically. t = pi/2 is
the path on the outside, and dL/dt = r cos t F = 0 in both cases, so one formula serves both. With n
the normal of the plane in the sense of the path, the directions of the straight pieces are

    e_0 = (-s_0 a + r sin t  n x a) / l_0^2,        e_1 = (s_1 b + r sin t  n x b) / l_1^2

for the points a, b relative to the centre. Around a cylinder, a and b are perpendicular to its axis
z, the path is a helix, and its length is sqrt(L^2 + (z . (p_1 - p_0))^2).

Side sites, as in MuJoCo: a side site opposite to the sector between the two points sends the path
to the other side of the circle, also if the straight line misses it. Otherwise it has no effect.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from rbjax.forces.reach import distance
from rbjax.lanes import Lane, Vec3, is_literal, safe_sqrt, sub
from rbjax.rotations.coefficients import where

_STEPS = 12  # of Newton's method; 7 are enough unless a point is within 1e-4 r of the surface
_PARALLEL = 1e-15  # |a x b| in m^2 below which MuJoCo takes another normal


class Wrapped(NamedTuple):
    """A path between two points.

    length: m.
    first, last: directions at the start and at the end, from start to end.
    """

    length: Lane
    first: Vec3
    last: Vec3


def wrapped(
    start: Vec3,
    end: Vec3,
    radius: Lane,
    *,
    axis: Vec3 | None = None,
    side: Vec3 | None = None,
    inside: Any = False,
    dtype: Any = float,
) -> Wrapped:
    """Compute the shortest path from start to end around a sphere or a cylinder.

    Args:
        start, end, side: positions relative to the centre of the geom, m, in any axes.
        radius: m.
        axis: unit vector of the axis of a cylinder; None for a sphere.
        side: position of the side site, or None.
        inside: whether the side site is inside the geom: a bool if it is known while tracing.
        dtype: of the computation.
    """
    line = end - start
    straight, inverse = distance(line, dtype)
    direction = line * inverse
    rise: Lane = 0.0
    if axis is not None:
        rise = line.dot(axis)
        start, end = (x - axis * x.dot(axis) for x in (start, end))
        side = None if side is None else side - axis * side.dot(axis)
    r = jnp.asarray(radius, dtype)
    rr, aa, bb, ab = (
        r * r,
        *(jnp.asarray(x, dtype) for x in (start.dot(start), end.dot(end), start.dot(end))),
    )
    normal, sine = _plane(start, end, axis, dtype)
    outside = (aa >= rr) & (bb >= rr)
    angle = jnp.arctan2(sine, where(outside, ab, jnp.ones_like(ab)))  # G
    s0, s1 = safe_sqrt(aa - rr), safe_sqrt(bb - rr)
    arc = angle + jnp.arctan2(r, s0) + jnp.arctan2(r, s1) - jnp.pi
    hits = arc > 0
    sense: Lane = 1.0
    cosine: Lane = 0.0
    wraps, rho = outside & hits, r
    if side is not None and inside is not True:
        sa, sb = side.dot(start), side.dot(end)
        far = (ab * sb > bb * sa) & (ab * sa > aa * sb)
        if not isinstance(inside, bool):
            far = far & ~inside
        wraps = outside & (hits | far)
        arc = where(far, arc + (2 * jnp.pi - 2 * angle), arc)
        sense = where(far, -jnp.ones_like(rr), jnp.ones_like(rr))
    if side is not None and inside is not False:
        touches = (aa > rr) & (bb > rr) & ~hits
        regular = [
            where(touches, x, y) for x, y in ((aa, 4 * rr), (bb, 4 * rr), (angle, jnp.ones_like(r)))
        ]
        t = _incidence(r, jnp.sqrt(regular[0]), jnp.sqrt(regular[1]), regular[2])
        if inside is not True:
            t = where(inside, t, jnp.full_like(t, jnp.pi / 2))
            touches = where(inside, touches, wraps)
        wraps = touches
        # cos(pi/2) is not zero in floating point
        cosine = jnp.cos(t) if inside is True else where(inside, jnp.cos(t), jnp.zeros_like(t))
        rho = r * jnp.sin(t)
        s0, s1 = safe_sqrt(aa - rho * rho), safe_sqrt(bb - rho * rho)
        turned = angle + jnp.arctan2(rho, s0) + jnp.arctan2(rho, s1) - 2 * t
        arc = turned if inside is True else where(inside, turned, arc)
    length = s0 + s1 + rho * arc
    if not is_literal(cosine):
        length = length - 2 * r * cosine
    around = normal * (rho if is_literal(sense) else sense * rho)
    first = (around.cross(start) - start * s0) * (1 / _above(aa, rr))
    last = (around.cross(end) + end * s1) * (1 / _above(bb, rr))
    if axis is not None:
        helix = jnp.sqrt(_above(length * length + rise * rise, 0.0))
        first, last = ((x * length + axis * rise) * (1 / helix) for x in (first, last))
        length = helix
    return Wrapped(
        where(wraps, length, straight),
        Vec3(*(where(wraps, x, y) for x, y in zip(first, direction, strict=True))),
        Vec3(*(where(wraps, x, y) for x, y in zip(last, direction, strict=True))),
    )


def _plane(a: Vec3, b: Vec3, axis: Vec3 | None, dtype: Any) -> tuple[Vec3, Lane]:
    """Compute the unit normal of the plane of a and b, and |a x b|."""
    cross = a.cross(b)
    if axis is not None:
        along = jnp.asarray(cross.dot(axis), dtype)
        sign = where(along < 0, -jnp.ones_like(along), jnp.ones_like(along))
        return axis * sign, along * sign
    square = jnp.asarray(cross.dot(cross), dtype)
    some = square > _PARALLEL * _PARALLEL
    root = jnp.sqrt(where(some, square, jnp.ones_like(square)))
    # a and b on one line through the centre: a x (1, 1, 1 without the largest entry of a)
    x, y, z = (jnp.abs(jnp.asarray(x, dtype)) for x in a)
    second, third = (y > x) & (y > z), (z > x) & (z > y)
    other = a.cross(Vec3(*(jnp.asarray(x, dtype) for x in (second | third, ~second, ~third))))
    _, inverse = distance(other, dtype)
    normal = Vec3(*(where(some, x / root, y * inverse) for x, y in zip(cross, other, strict=True)))
    return normal, where(some, root, jnp.zeros_like(square))


def _incidence(r: Lane, l0: Lane, l1: Lane, angle: Lane) -> Lane:
    """Solve F(t) = 0 for the angle of incidence t of a tendon that touches a circle from inside.

    r, l0, l1: radius, and distances of both points from the centre. angle: between these points.
    The derivatives follow from two Newton steps at the solution, of which the first is exact to
    first order.
    """

    def step(t: Lane, a: Lane, b: Lane, angle: Lane) -> Lane:
        sine, cosine = jnp.sin(t), jnp.cos(t)
        x, y = safe_sqrt(1 - (a * sine) ** 2), safe_sqrt(1 - (b * sine) ** 2)
        value = angle + jnp.arctan2(a * sine, x) + jnp.arctan2(b * sine, y) - 2 * t
        slope = cosine * (a / _above(x, 0.0) + b / _above(y, 0.0)) - 2
        return t - value / where(slope < 0, slope, -jnp.ones_like(slope))

    a, b = r / l0, r / l1
    fixed = lax.stop_gradient((a, b, angle))
    start = jnp.full_like(angle, jnp.pi / 2)
    t = lax.fori_loop(0, _STEPS, lambda _, t: step(t, *fixed), start)
    t = step(lax.stop_gradient(t), a, b, angle)
    return step(t, a, b, angle)


def _above(x: Lane, low: Lane) -> Lane:
    """Return x if it is positive and not below a lower limit, else 1, as a divisor."""
    return where((x >= low) & (x > 0), x, jnp.ones_like(x))


def is_inside(side: Vec3, radius: Lane) -> Any:
    """Check whether a side site is nearer to the centre of the geom than its radius, as MuJoCo does
    for spheres and cylinders. The answer is a bool if it is known while tracing."""
    nearer: Any = sub(side.dot(side), radius * radius) < 0
    return bool(nearer) if not isinstance(nearer, jax.Array) else nearer
