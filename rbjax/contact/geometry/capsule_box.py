"""Contacts of a sphere and of a capsule with a box.

A sphere touches at the point of the box nearest to its center. A capsule touches at the point of
its axis nearest to the box, and at a second point of the axis. The second point lies in the
direction in which the axis runs along the nearest feature, a corner, an edge or a face of the box.
It is the end of the axis, or the point at which the axis leaves the feature. (Ericson, *Real-Time
Collision Detection*, 5.1.3, 5.1.9; MuJoCo C gives the same contacts.)
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp

from rbjax.contact.geometry.shapes import TINY, Contact, Shape
from rbjax.lanes import Lane, Vec3
from rbjax.lanes.arrays import select

#: the parameter at which a line meets a parallel plane
NEVER = 1e15


class Nearest(NamedTuple):
    """The pair of nearest points of a segment and a box, in the frame of the box.

    Fields:
        square: squared distance, m^2.
        at: the point of the segment, -1 and 1 at the ends.
        along: the point of the edge of the box, -1 and 1 at its corners, if the feature is an edge.
        axis: three flags, the normal of the face or the direction of the edge. All are false if an
            end of the segment is inside of the box.
        corner: signs of the coordinates of the nearest corner, -1 or 1.
        on_edge, on_corner: whether the feature is the interior of an edge, or a corner.
    """

    square: Lane
    at: Lane
    along: Lane
    axis: Vec3
    corner: Vec3
    on_edge: Lane
    on_corner: Lane


def sphere_box(sphere: Shape, box: Shape, reach: Lane) -> list[Contact]:
    """Return the contact of a sphere with the nearest point of a box.

    If the center is inside the box, that is the nearest of the six faces.
    """
    c, r = box.R.T @ (sphere.p - box.p), sphere.size[0]
    nearest = Vec3(*(jnp.clip(x, -s, s) for x, s in zip(c, box.size, strict=True)))
    towards = nearest - c
    gap2 = towards.dot(towards)
    outside = gap2 > TINY * TINY
    gap = jnp.sqrt(jnp.where(outside, gap2, 1.0))

    depth: Lane = jnp.inf
    inward = Vec3.zero()
    for k, sign in product(range(3), (-1.0, 1.0)):
        to_face = jnp.abs(box.size[k] * sign - c[k])
        axis = Vec3(*(-sign if i == k else 0.0 for i in range(3)))
        inward = select(to_face < depth, axis, inward)
        depth = jnp.minimum(depth, to_face)

    n = select(outside, towards * (1 / gap), inward)
    distance = jnp.where(outside, gap - r, -depth - r)
    position = select(outside, (nearest + c + n * r) * 0.5, c + n * (0.5 * (r - depth)))
    return [Contact(distance, box.p + box.R @ position, box.R @ n, distance <= reach)]


def capsule_box(capsule: Shape, box: Shape, reach: Lane) -> list[Contact]:
    """Return up to two contacts of a capsule with a box."""
    half = capsule.axis * capsule.size[1]
    center, h = box.R.T @ (capsule.p - box.p), box.R.T @ half
    near = _nearest(center, h, box.size)
    at, exists = _second(near, center, h, box.size)
    out = []
    for x, known in ((near.at, True), (at, exists)):
        ball = Shape(capsule.p + half * x, capsule.R, capsule.size)
        (found,) = sphere_box(ball, box, reach)
        out.append(found._replace(exists=found.exists & known))
    return out


def _nearest(center: Vec3, h: Vec3, size: Vec3) -> Nearest:
    """Return the nearest points of the segment from center - h to center + h and the box.

    The ends of the segment are compared first. An edge must be nearer by more than rounding.
    """
    eps = jnp.finfo(jnp.result_type(center[0])).eps
    least = jnp.maximum(TINY, 4 * eps * (center.dot(center) + h.dot(h) + size.dot(size)))
    low, no = Vec3(-1.0, -1.0, -1.0), Vec3(False, False, False)
    best = Nearest(jnp.inf, 0.0, 0.0, no, low, False, False)
    for end in (-1.0, 1.0):
        square, beyond, over_face = _end(center + h * end, size)
        found = Nearest(square, end, 0.0, beyond, low, False, False)
        best = select(over_face & (square < best.square), found, best)
    for k in range(3):
        for sign_j, sign_i in product((-1.0, 1.0), repeat=2):
            signs = [sign_i, sign_j]
            signs.insert(k, 0.0)
            found, skew = _edge(center, h, size, k, signs)
            best = select(skew & (found.square < best.square - least), found, best)
    return best


def _end(point: Vec3, size: Vec3) -> tuple[Lane, Vec3, Lane]:
    """Return the squared distance of a point from a box, a flag for each axis whether the point is
    outside of the slab of the box, and whether at most one flag is true."""
    gaps = Vec3(*(jnp.maximum(jnp.abs(x) - s, 0.0) for x, s in zip(point, size, strict=True)))
    beyond = Vec3(*(gap > 0 for gap in gaps))
    x, y, z = beyond
    return gaps.dot(gaps), beyond, ~(x & y | y & z | z & x)


def _edge(
    center: Vec3, h: Vec3, size: Vec3, k: int, signs: Sequence[float]
) -> tuple[Nearest, Lane]:
    """Return the nearest points of a segment and an edge of a box, and whether they are skew.

    The edge is parallel to axis k of the box. It is the points signs * size, with signs[k] = e in
    [-1, 1]. With d from the center of the segment to the center of the edge, the nearest points e
    and t of the two lines are the solution of

        s_k^2 e - s_k h_k t = -s_k d_k
        -s_k h_k e + |h|^2 t = h . d
    """
    d = Vec3(*(s * sign for s, sign in zip(size, signs, strict=True))) - center
    a, b, c = size[k] * size[k], -size[k] * h[k], jnp.maximum(h.dot(h), TINY * TINY)
    u, v = -size[k] * d[k], h.dot(d)
    det = a * c - b * b
    skew = det >= jnp.maximum(TINY, 8 * jnp.finfo(jnp.result_type(det)).eps * a * c)
    inverse = 1 / jnp.where(skew, det, 1.0)
    e, t = (c * u - b * v) * inverse, (a * v - b * u) * inverse
    t = jnp.where(jnp.abs(e) > 1, (v - b * jnp.clip(e, -1.0, 1.0)) / c, t)
    again = jnp.where(jnp.abs(t) > 1, (u - b * jnp.clip(t, -1.0, 1.0)) / a, e)
    # an end of the edge that was nearest to the line of the segment counts as the corner
    on_corner = (jnp.abs(e) > 1) | (jnp.abs(again) > 1)
    upper = jnp.where(jnp.abs(again) > 1, again, e) > 1
    e, t = (jnp.clip(x, -1.0, 1.0) for x in (again, t))
    apart = d - h * t + Vec3(*(size[k] * e if i == k else 0.0 for i in range(3)))
    corner = Vec3(*(jnp.where(upper, 1.0, -1.0) if i == k else signs[i] for i in range(3)))
    axis = Vec3(*(i == k for i in range(3)))
    return Nearest(apart.dot(apart), t, e, axis, corner, ~on_corner, on_corner), skew


def _second(near: Nearest, center: Vec3, h: Vec3, size: Vec3) -> tuple[Lane, Lane]:
    """Return the coordinate of the second contact point on the segment, and whether it exists."""
    # whether the segment in its direction enters the slab of the box along each axis
    into = [(x > 0) != (sign > 0) for x, sign in zip(h, near.corner, strict=True)]
    across = [2 * _ratio(s, jnp.abs(x)) for s, x in zip(size, h, strict=True)]
    by_corner = _from_corner(near, h, into, across)
    by_edge = _from_edge(near, h, into, across)
    by_face = _over_face(near, center, h, size)
    move, exists = select(near.on_corner, by_corner, select(near.on_edge, by_edge, by_face))
    return near.at + move, exists


def _from_corner(near: Nearest, h: Vec3, into: list, across: list) -> tuple[Lane, Lane]:
    """Return the change of the segment's coordinate from a corner to the second point, and whether
    there is a second point.

    One of the two directions of the segment enters the slab of one axis and leaves the two others.
    If the segment is steep along that axis, it follows the edge in that direction. Otherwise it
    follows the face of the two other axes in the opposite direction. There is no second point if
    the segment enters or leaves all three slabs.
    """
    x, y, z = into
    two = x & y & ~z | y & z & ~x | z & x & ~y
    sign = jnp.where(two, -1.0, 1.0)
    square = h.dot(h)
    move: Lane = 0.0
    exists: Lane = False
    for k in range(3):
        i, j = (axis for axis in range(3) if axis != k)
        edge = jnp.minimum(1 - sign * near.at, across[k])
        face = -jnp.minimum(1 + sign * near.at, jnp.minimum(across[i], across[j]))
        entered = (into[k] != into[i]) & (into[k] != into[j])
        move = jnp.where(entered, jnp.where(h[k] * h[k] > 0.5 * square, edge, face), move)
        exists = exists | entered
    return sign * move, exists


def _from_edge(near: Nearest, h: Vec3, into: list, across: list) -> tuple[Lane, Lane]:
    """Return the change of the segment's coordinate from the interior of an edge to the second
    point, and whether there is a second point.

    The segment goes along one of the two faces at the edge if it enters one slab and leaves the
    other. It goes along the face that is less steep to it, in the direction into its slab, until
    the segment, the face or the edge ends.
    """
    move: Lane = 0.0
    exists: Lane = False
    for k in range(3):
        i, j = (axis for axis in range(3) if axis != k)
        by_j = jnp.abs(h[i]) <= jnp.abs(h[j])
        inward = jnp.where(by_j, into[j], into[i])
        way = jnp.where(inward, 1.0, -1.0)
        most = jnp.minimum(1 - way * near.at, jnp.where(by_j, across[j], across[i]))
        upward = jnp.where((h[k] > 0) == inward, 1.0, -1.0)
        most = jnp.minimum(most, 0.5 * across[k] * (1 - upward * near.along))
        move = jnp.where(near.axis[k], way * most, move)
        exists = jnp.where(near.axis[k], into[i] != into[j], exists)
    return move, exists


def _over_face(near: Nearest, center: Vec3, h: Vec3, size: Vec3) -> tuple[Lane, Lane]:
    """Return the change of the segment's coordinate from an end over a face to the second point,
    and whether there is a second point.

    The second point is the other end, or the point of the segment that is over an edge of the face.
    """
    way = jnp.where(near.at < 0, 1.0, -1.0)
    end, direction = center + h * near.at, h * way
    most: Lane = 2.0
    for k, side in product(range(3), (-1.0, 1.0)):
        leaves = _ratio(side * size[k] - end[k], direction[k])
        inner = (leaves > 0) & ~near.axis[k]
        most = jnp.where(inner, jnp.minimum(most, leaves), most)
    x, y, z = near.axis
    return way * most, x | y | z


def _ratio(a: Lane, b: Lane) -> Lane:
    """Return a / b, or a large number if b is zero."""
    valid = jnp.abs(b) > 0
    return jnp.where(valid, a / jnp.where(valid, b, 1.0), NEVER)
