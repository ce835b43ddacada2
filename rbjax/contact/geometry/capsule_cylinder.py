"""Contacts of a capsule with a cylinder.

The first contact is at the point of the capsule's axis nearest to the cylinder, where the slope of
the distance along the axis changes sign. If a part of the axis is over a flat end of the cylinder,
the far end of the part is a second contact. MuJoCo C has the second contact only if the axis is
within 6 degrees of the plane of the flat end.

An axis that enters the cylinder leaves it along the shortest of three ways: through either flat
end, or through the side. (Ericson, *Real-Time Collision Detection*, 5.1.9.)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.contact.geometry.shapes import TINY, Contact, Shape, unit
from rbjax.lanes import Lane, Vec3
from rbjax.lanes.arrays import select

#: halvings of the interval of the nearest point
HALVINGS = 40
#: a part of an axis is a point if it is shorter, relative to the axis
SHORT = 1e-6


def capsule_cylinder(capsule: Shape, cylinder: Shape, reach: Lane) -> list[Contact]:
    """Return up to two contacts of a capsule with a cylinder."""
    c, u = cylinder.R.T @ (capsule.p - cylinder.p), cylinder.R.T @ capsule.axis
    r, h, R, s = cylinder.size[0], cylinder.size[1], capsule.size[0], capsule.size[1]
    low, high = _over_end(c, u, r, s)
    t = _nearest(c, u, r, h, s)
    flat = (t > low) & (t < high) & (jnp.abs((c + u * t)[2]) >= h)
    t = jnp.where(flat, low, t)
    other = jnp.where(t - low < high - t, high, low)

    first = _at(c + u * t, r, h, R)
    crossing = first[0] <= TINY - R
    first = select(crossing, _leaving(c, u, r, h, R, s), first)
    second = _at(c + u * other, r, h, R)
    long = (high - low > SHORT * s) & (jnp.abs(other - t) > SHORT * s)
    beyond = jnp.abs((c + u * other)[2]) > h
    out = []
    for (distance, outward, p), known in ((first, True), (second, long & beyond & ~crossing)):
        position = cylinder.p + cylinder.R @ (p - outward * (R + 0.5 * distance))
        normal = cylinder.R @ -outward
        out.append(Contact(distance, position, normal, (distance <= reach) & known))
    return out


def _towards(p: Vec3, r: Lane, h: Lane) -> tuple[Vec3, Vec3]:
    """Return the vector from the nearest point of a cylinder to p, and the unit outward normal
    there."""
    square = p[0] * p[0] + p[1] * p[1]
    away = square > r * r
    rho = jnp.sqrt(jnp.where(away, square, 1.0))
    over = jnp.where(away, 1.0 - r / rho, 0.0)
    z = p[2] - jnp.clip(p[2], -h, h)
    gap = Vec3(p[0] * over, p[1] * over, z)
    return gap, unit(gap, Vec3(0.0, 0.0, jnp.where(p[2] < 0, -1.0, 1.0)))


def _at(p: Vec3, r: Lane, h: Lane, R: Lane) -> tuple[Lane, Vec3, Vec3]:
    """Return distance, outward normal and center of the contact of a ball about p with a cylinder.

    p is outside of the cylinder, which has radius r and half-length h. R: radius of the ball.
    """
    gap, outward = _towards(p, r, h)
    return gap.dot(outward) - R, outward, p


def _nearest(c: Vec3, u: Vec3, r: Lane, h: Lane, s: Lane) -> Lane:
    """Return t in [-s, s] such that the point c + t u of a segment is nearest to a cylinder.

    Bisection finds the zero of the slope of the squared distance, which is convex in t. A last
    step of Newton's method gives the result the derivative of the implicit function.
    """

    still = jax.lax.stop_gradient((c, u, r, h, s))

    def halve(_, ends: tuple) -> tuple:
        (c, u, r, h, _), (low, high) = still, ends
        middle = 0.5 * (low + high)
        rising = _towards(c + u * middle, r, h)[0].dot(u) > 0
        return jnp.where(rising, low, middle), jnp.where(rising, middle, high)

    end = still[4] + 0 * still[0][0]
    t = 0.5 * sum(jax.lax.fori_loop(0, HALVINGS, halve, (-end, end)))
    p = c + u * t
    slope = _towards(p, r, h)[0].dot(u)
    square = p[0] * p[0] + p[1] * p[1]
    away, beyond = square > r * r, jnp.abs(p[2]) > h
    rho2 = jnp.where(away, square, 1.0)
    rho = jnp.sqrt(rho2)
    along = (p[0] * u[0] + p[1] * u[1]) / rho
    flat = u[0] * u[0] + u[1] * u[1]
    curvature = jnp.where(away, flat * (1 - r / rho) + along * along * (r / rho), 0.0)
    curvature = curvature + jnp.where(beyond, u[2] * u[2], 0.0)
    curved = curvature > 1e-9
    step = jnp.where(curved, slope / jnp.where(curved, curvature, 1.0), 0.0)
    return jnp.clip(t - step, -s, s)


def _over_end(c: Vec3, u: Vec3, r: Lane, s: Lane) -> tuple[Lane, Lane]:
    """Return the interval of the coordinate along a segment in which it is within the radius r of
    the axis of a cylinder. The interval is empty, (0, 0), if there is none."""
    A = u[0] * u[0] + u[1] * u[1]
    B, C = c[0] * u[0] + c[1] * u[1], c[0] * c[0] + c[1] * c[1] - r * r
    inclined = A > TINY
    A = jnp.where(inclined, A, 1.0)
    root = B * B - A * C
    hit = inclined & (root > 0)
    half = jnp.sqrt(jnp.where(hit, root, 1.0)) / A
    low, high = jnp.clip(-B / A - half, -s, s), jnp.clip(-B / A + half, -s, s)
    return jnp.where(hit, low, 0.0), jnp.where(hit, high, 0.0)


def _leaving(c: Vec3, u: Vec3, r: Lane, h: Lane, R: Lane, s: Lane) -> tuple[Lane, Vec3, Vec3]:
    """Return distance, outward normal and deepest point of a capsule whose axis enters a cylinder.

    c, u, s: center, direction and half-length of the axis. R: radius of the capsule.
    """
    side = jnp.where(c[2] < 0, -1.0, 1.0)
    t = jnp.where(side * u[2] > 0, -s, s)
    through_end = side * (c + u * t)[2] - h, Vec3(0.0, 0.0, side), c + u * t
    A = u[0] * u[0] + u[1] * u[1]
    inclined = A > TINY
    t = jnp.clip(-(c[0] * u[0] + c[1] * u[1]) / jnp.where(inclined, A, 1.0), -s, s)
    p = c + u * jnp.where(inclined, t, 0.0)
    across = unit(Vec3(-u[1], u[0], 0.0 * u[0]), Vec3(1.0, 0.0, 0.0))
    outward = unit(Vec3(p[0], p[1], 0.0 * p[0]), across)
    through_side = p.dot(outward) - r, outward, p
    found = select(through_end[0] > through_side[0], through_end, through_side)
    return found[0] - R, found[1], found[2]
