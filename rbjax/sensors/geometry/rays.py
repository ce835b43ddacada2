"""Intersections of a ray with primitive shapes, in closed form.

    sphere, ellipsoid, side of a cylinder:   a s^2 + 2 b s + c = 0, the least root s >= 0
    plane, face, end:                        s = (offset - p) / d, within the bounds of the face
The ray is p + s d with s >= 0, in the frame of the shape. s is infinite if the ray does not meet
the shape. From inside a ray meets the far wall. A plane is met from its front only.

Source: Ericson, *Real-Time Collision Detection*, 5.3; MuJoCo, *XML reference*, rangefinder.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from rbjax.lanes import Lane, Vec3
from rbjax.lanes.arrays import select

#: a discriminant or a speed below it counts as zero
LEAST = 1e-15


class Hit(NamedTuple):
    """The parameter s of the first intersection (infinite for none), and the outward normal."""

    s: Lane
    normal: Vec3


Intersection = Callable[[Vec3, Vec3, Vec3], Hit]
_NONE = Vec3(0.0, 0.0, 0.0)


def sphere(p: Vec3, d: Vec3, size: Vec3) -> Hit:
    """Return the hit of a sphere of radius size[0]."""
    near, far, real = _roots(d.dot(d), p.dot(d), p.dot(p) - size[0] * size[0])
    s = _first(near, far, real)
    return Hit(s, (p + d * _finite(s)) * (1 / size[0]))


def ellipsoid(p: Vec3, d: Vec3, size: Vec3) -> Hit:
    """Return the hit of an ellipsoid with the semi-axes size."""
    inverse = Vec3(*(1 / x for x in size))
    p1, d1 = p.entrywise(inverse), d.entrywise(inverse)
    s = _first(*_roots(d1.dot(d1), p1.dot(d1), p1.dot(p1) - 1.0))
    return Hit(s, _unit((p1 + d1 * _finite(s)).entrywise(inverse)))


def plane(p: Vec3, d: Vec3, size: Vec3) -> Hit:
    """Return the hit of the plane z = 0 with the half sides size[0], size[1]; 0 for infinite."""
    steep = d[2] < -LEAST
    s = -p[2] / jnp.where(steep, d[2], -1.0)
    inside = steep & (s >= 0)
    for k in (0, 1):
        inside &= (size[k] <= 0) | (jnp.abs(p[k] + s * d[k]) <= size[k])
    return Hit(jnp.where(inside, s, jnp.inf), Vec3(0.0, 0.0, 1.0))


def box(p: Vec3, d: Vec3, size: Vec3) -> Hit:
    """Return the hit of a box with the half sides size."""
    best = Hit(jnp.full_like(p[0], jnp.inf), _NONE)
    for k in range(3):
        for side in (-1.0, 1.0):
            normal = Vec3(*(side if i == k else 0.0 for i in range(3)))
            best = _nearer(best, _face(p, d, size, k, side), normal)
    return best


def cylinder(p: Vec3, d: Vec3, size: Vec3) -> Hit:
    """Return the hit of a cylinder of radius size[0] and half length size[1] along z."""
    radius, half = size[0], size[1]
    best = Hit(jnp.full_like(p[0], jnp.inf), _NONE)
    for side in (-1.0, 1.0):
        steep = jnp.abs(d[2]) > LEAST
        s = (side * half - p[2]) / jnp.where(steep, d[2], 1.0)
        x, y = p[0] + s * d[0], p[1] + s * d[1]
        inside = steep & (s >= 0) & (x * x + y * y <= radius * radius)
        best = _nearer(best, jnp.where(inside, s, jnp.inf), Vec3(0.0, 0.0, side))
    return _side(best, p, d, radius, half)


def capsule(p: Vec3, d: Vec3, size: Vec3) -> Hit:
    """Return the hit of a capsule of radius size[0] and half length size[1] along z."""
    radius, half = size[0], size[1]
    best = Hit(jnp.full_like(p[0], jnp.inf), _NONE)
    for side in (-1.0, 1.0):
        centered = Vec3(p[0], p[1], p[2] - side * half)
        roots = _roots(d.dot(d), centered.dot(d), centered.dot(centered) - radius * radius)
        for s in roots[:2]:
            beyond = side * (p[2] + s * d[2]) >= half
            inside = roots[2] & (s >= 0) & beyond
            normal = (centered + d * s) * (1 / radius)
            best = _nearer(best, jnp.where(inside, s, jnp.inf), normal)
    return _side(best, p, d, radius, half)


#: kind of geom -> intersection with a ray in its frame
INTERSECTIONS: dict[str, Intersection] = {
    "plane": plane,
    "sphere": sphere,
    "capsule": capsule,
    "ellipsoid": ellipsoid,
    "cylinder": cylinder,
    "box": box,
}


def _roots(a: Lane, b: Lane, c: Lane) -> tuple[Lane, Lane, Lane]:
    """Return both roots of a s^2 + 2 b s + c, and whether they are real."""
    square = b * b - a * c
    real = (square >= LEAST) & (a > LEAST)
    root = jnp.sqrt(jnp.where(real, square, 1.0))
    over = 1 / jnp.where(real, a, 1.0)
    return (-b - root) * over, (-b + root) * over, real


def _first(near: Lane, far: Lane, real: Lane) -> Lane:
    """Return the smaller root that is not negative, or infinity."""
    s = jnp.where(near >= 0, near, jnp.where(far >= 0, far, jnp.inf))
    return jnp.where(real, s, jnp.inf)


def _face(p: Vec3, d: Vec3, size: Vec3, k: int, side: float) -> Lane:
    """Return s at which a ray p + s d meets the face of a box with normal `side` e_k, or inf."""
    steep = jnp.abs(d[k]) > LEAST
    s = (side * size[k] - p[k]) / jnp.where(steep, d[k], 1.0)
    inside = steep & (s >= 0)
    for i in {0, 1, 2} - {k}:
        inside &= jnp.abs(p[i] + s * d[i]) <= size[i]
    return jnp.where(inside, s, jnp.inf)


def _side(best: Hit, p: Vec3, d: Vec3, radius: Lane, half: Lane) -> Hit:
    """Return the nearer one of `best` and the hit of the round side of a cylinder or capsule."""
    a, b = d[0] * d[0] + d[1] * d[1], p[0] * d[0] + p[1] * d[1]
    near, far, real = _roots(a, b, p[0] * p[0] + p[1] * p[1] - radius * radius)
    for s in (near, far):
        inside = real & (s >= 0) & (jnp.abs(p[2] + s * d[2]) <= half)
        normal = Vec3((p[0] + s * d[0]) / radius, (p[1] + s * d[1]) / radius, 0.0)
        best = _nearer(best, jnp.where(inside, s, jnp.inf), normal)
    return best


def _nearer(best: Hit, s: Lane, normal: Vec3) -> Hit:
    closer = s < best.s
    return Hit(jnp.where(closer, s, best.s), select(closer, normal, best.normal))


def _finite(s: Lane) -> Lane:
    return jnp.where(jnp.isfinite(s), s, 0.0)


def _unit(v: Vec3) -> Vec3:
    square = v.dot(v)
    some = square > 0
    return v * jnp.where(some, 1 / jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
