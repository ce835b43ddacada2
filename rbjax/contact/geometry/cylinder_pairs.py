"""Contacts of a cylinder with a cylinder or a box.

All contacts of a pair have the direction of least overlap as their normal (`separation`). Of each
shape, the face or the line that is most opposed to the other shape is projected along the normal: a
face of the box, a square in the flat end of the cylinder, or a line of its side. The vertices of
the intersection are candidates. Up to four of them are contacts: the deepest one, the one
farthest from it, and those farthest to both sides. If none of them is as deep as the overlap, the
deepest contact is between the nearest points of both shapes, such as two rims.

MuJoCo C computes these contacts by iterations that end at a tolerance (GJK and EPA, ccd_tolerance).
It has the same deepest distance and normal within this tolerance, and other points of a flat
contact. (Sutherland & Hodgman 1974; Ericson, *Real-Time Collision Detection*, 4.4.)
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.geometry.box_box import VERTICES, clip_polygon, repeated
from rbjax.contact.geometry.separation import Direction, Zonoid, least_overlap
from rbjax.contact.geometry.shapes import TINY, Contact, Shape, contact_frame, unit
from rbjax.lanes import Lane, Vec3
from rbjax.lanes.arrays import select

#: sine of the angle between two lines that count as parallel
PARALLEL_LINES = 2e-3
#: a segment is orthogonal to a direction if the cosine is below, and two lengths are equal,
#: relative to the size, in float64 and float32
SMALL = {"float64": 1e-7, "float32": 3e-4}
#: sine of the inclination at which a flat end has a deepest corner
LEVEL = 0.02
#: the flat end of a cylinder faces a direction within 45 degrees
FLAT = math.sqrt(0.5)


def cylinder_cylinder(one: Shape, other: Shape, reach: Lane) -> list[Contact]:
    """Return up to four contacts of two cylinders."""
    return _contacts((one, _cylinder(one)), (other, _cylinder(other)), reach)


def cylinder_box(cylinder: Shape, box: Shape, reach: Lane) -> list[Contact]:
    """Return up to four contacts of a cylinder and a box."""
    return _contacts((cylinder, _cylinder(cylinder)), (box, _box(box)), reach)


def _cylinder(shape: Shape) -> Zonoid:
    return Zonoid([(shape.axis, shape.size[1])], [(shape.axis, shape.size[0])])


def _box(shape: Shape) -> Zonoid:
    return Zonoid(list(zip(shape.R.columns, shape.size, strict=True)), [])


def _contacts(one: tuple[Shape, Zonoid], other: tuple[Shape, Zonoid], reach: Lane) -> list[Contact]:
    """Return up to four contacts of two shapes, each with its segments and discs."""
    (a, A), (b, B) = one, other
    d = b.p - a.p
    found = least_overlap(Zonoid(A.segments + B.segments, A.discs + B.discs), d)
    n, least = found
    small = SMALL[jnp.result_type(least).name]
    size = A.size + B.size
    _, x, y = contact_frame(n)
    frame = _rows(x, y, n)
    faces = _Face.of(A, n, B, d), _Face.of(B, -n, A, -d)
    first, second = (f.seen_from(c - a.p, frame) for f, c in zip(faces, (a.p, b.p), strict=True))
    rounding = size * (64 * jnp.finfo(jnp.result_type(least)).eps)
    corners, gaps, count = _intersection(first, second, rounding)

    index = jnp.arange(VERTICES)
    used = (index < count) & ~repeated(corners, count, size * small)
    gaps = jnp.where(used, gaps, jnp.inf)
    k = jnp.argmin(gaps)
    flat = gaps[k] <= least + size * (0.01 * small)
    nearest = _nearest(A, B, d, found, small)
    spot = jnp.stack([nearest.dot(x), nearest.dot(y), nearest.dot(n)])
    # a vertex at the nearest points has their derivative, and not that of two edges that cross
    off = corners[k] - spot
    single = (off * off).sum() < (1e-4 * size) ** 2
    start = jnp.where(flat & ~single, corners[k], spot)
    distances, points, exist = _spread(corners, gaps, used & (gaps <= reach), start, size * small)
    distances = [jnp.where(flat, gaps[k], least), *distances]
    out = []
    for distance, point, exists in zip(
        distances, [start, *points], [distances[0] <= reach, *exist], strict=True
    ):
        position = a.p + x * point[0] + y * point[1] + n * point[2]
        finite = jnp.where(jnp.isfinite(distance), distance, least)
        out.append(Contact(finite, position, n, exists & (distances[0] <= reach)))
    return out


def _rows(*vectors: Vec3) -> jax.Array:
    """Return vectors as the rows of an array."""
    return jnp.stack([jnp.stack([jnp.asarray(x) for x in v]) for v in vectors])


class _Face(NamedTuple):
    """A plane face with four corners about the center of its shape, or a line as two pairs of equal
    corners.

    Fields:
        corners: (4, 3) m.
        line: whether it is a line.
    """

    corners: jax.Array
    line: Lane

    @classmethod
    def of(cls, shape: Zonoid, m: Vec3, other: Zonoid, d: Vec3) -> _Face:
        """Return the face of a cylinder or box most opposed to a direction m.

        d: vector to the center of the other shape, m.
        """
        if shape.discs:
            for g, s in other.segments:  # to the nearest point of its axis, or of the box
                d = d - g * jnp.clip(d.dot(g), -s, s)
            return cls._of_cylinder(shape, m, d)
        R = _rows(*(g for g, _ in shape.segments))
        s = jnp.stack([jnp.asarray(s, R.dtype) for _, s in shape.segments])
        along = (R * _rows(m)).sum(-1)
        k = jnp.argmax(jnp.abs(along))
        u, w = ((R * s[:, None])[(k + i) % 3] for i in (1, 2))
        center = R[k] * (s[k] * jnp.where(along[k] < 0, -1.0, 1.0))
        corners = [center + u * i + w * j for i, j in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        return cls(jnp.stack(corners), jnp.asarray(False))

    @classmethod
    def _of_cylinder(cls, shape: Zonoid, m: Vec3, towards: Vec3) -> _Face:
        ((a, h),), ((_, r),) = shape.segments, shape.discs
        c = m.dot(a)
        across = m - a * c
        # a corner of the square is deepest, or nearest to the other shape if the end is level
        level = jnp.maximum(1.0 - across.dot(across) / (LEVEL * LEVEL), 0.0)
        nearest = unit(towards - a * a.dot(towards), Vec3(0.0, 0.0, 0.0))
        v = unit(across + nearest * (LEVEL * level), _orthogonal(a)) * r
        w = a.cross(v)
        end = a * (h * jnp.where(c < 0, -1.0, 1.0))
        rim = unit(across, _orthogonal(a)) * r
        square = _rows(end + v, end + w, end - v, end - w)
        side = _rows(rim + a * h, rim - a * h, rim - a * h, rim + a * h)
        line = jnp.abs(c) < FLAT
        return cls(jnp.where(line, side, square), line)

    def seen_from(self, center: Vec3, frame: jax.Array) -> _Face:
        """Return the face in the axes of a contact, with the normal last."""
        points = self.corners + _rows(center)
        return _Face((points[:, None, :] * frame[None]).sum(-1), self.line)


def _orthogonal(a: Vec3) -> Vec3:
    """Return a unit vector orthogonal to a."""
    return contact_frame(a)[1]


def _intersection(
    first: _Face, second: _Face, least: Lane
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the vertices (8, 3) of the intersection of two projected faces, midway between them,
    the gaps between the faces there, and the number of vertices."""
    # the face that is cut may be a line
    cut, other = select(second.line, (second, first), (first, second))
    lines = first.line & second.line
    p = other.corners
    q = jnp.roll(p, -1, 0)
    edges = q[:, :2] - p[:, :2]
    area = (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()
    turn = jnp.where(area < 0, -1.0, 1.0)
    inward = jnp.stack([-edges[:, 1], edges[:, 0]], -1) * turn
    # between two lines only the ends cut, and only if they are parallel
    along = p[1] - p[0]
    ends = jnp.stack([along, -along, -along, along])[:, :2]
    inward = jnp.where(lines, ends, inward)
    points = jnp.where(lines, p[jnp.array([0, 1, 1, 0])], p)

    polygon = jnp.concatenate([cut.corners, jnp.zeros((VERTICES - 4, 3), p.dtype)])
    count = jnp.int32(4)

    def halved(k: Lane, cut: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        length = jnp.sqrt((inward[k] ** 2).sum() + TINY)
        inside = ((cut[0][:, :2] - points[k, :2]) * inward[k]).sum(-1) / length
        polygon, count = clip_polygon(*cut, inside + least)
        return polygon, count.astype(jnp.int32)

    polygon, count = jax.lax.fori_loop(0, 4, halved, (polygon, count))
    across = cut.corners[1] - cut.corners[0]
    sine = jnp.abs(across[0] * along[1] - across[1] * along[0])
    skew = sine > PARALLEL_LINES * jnp.sqrt((across[:2] ** 2).sum() * (along[:2] ** 2).sum())
    count = jnp.where(lines & skew, 0, count)

    height = _height(other.corners, lines, polygon[:, :2])
    gap = (height - polygon[:, 2]) * jnp.where(second.line, -1.0, 1.0)
    middle = 0.5 * (polygon[:, 2] + height)
    return jnp.concatenate([polygon[:, :2], middle[:, None]], -1), gap, count


def _height(corners: jax.Array, line: Lane, at: jax.Array) -> jax.Array:
    """Return the height of a face or line at points (n, 2) of the plane."""
    u, w = corners[1] - corners[0], corners[3] - corners[0]
    off = at - corners[0, :2]
    det = u[0] * w[1] - u[1] * w[0]
    det = jnp.where(jnp.abs(det) > TINY * TINY, det, 1.0)
    s = (off[:, 0] * w[1] - off[:, 1] * w[0]) / det
    t = (u[0] * off[:, 1] - u[1] * off[:, 0]) / det
    on_line = (off * u[:2]).sum(-1) / jnp.maximum((u[:2] ** 2).sum(), TINY * TINY)
    return corners[0, 2] + jnp.where(line, on_line * u[2], s * u[2] + t * w[2])


def _spread(
    corners: jax.Array, gaps: jax.Array, exist: jax.Array, start: jax.Array, least: Lane
) -> tuple[list[Lane], list[jax.Array], list[Lane]]:
    """Return the vertex farthest from the start, and those farthest to both sides."""
    off = corners[:, :2] - start[:2]
    far = jnp.where(exist, (off * off).sum(-1), -1.0)
    k = jnp.argmax(far)
    side = off[:, 1] * off[k, 0] - off[:, 0] * off[k, 1]
    length = jnp.sqrt(jnp.maximum(far[k], 0.0))
    chosen, there = [k], [far[k] > least * least]
    for sign in (1.0, -1.0):
        area = jnp.where(exist, sign * side, -1.0)
        i = jnp.argmax(area)
        chosen.append(i)
        there.append(there[0] & (area[i] > least * length))
    return [gaps[i] for i in chosen], [corners[i] for i in chosen], there


def _nearest(A: Zonoid, B: Zonoid, d: Vec3, found: Direction, small: Lane) -> Vec3:
    """Return the midpoint between the nearest points of two shapes, from the center of the first.

    If a segment is orthogonal to the normal, the shapes touch along an edge, and its nearest point
    is computed. If they touch at a face, the point of the other shape is projected onto it.
    """
    n = found.n
    (p, u, s, on_a), (q, w, t, on_b) = _edge(A, n, small), _edge(B, -n, small)
    q = q + d
    between = q - p
    between = between - n * between.dot(n)
    cosine, bu, bw = u.dot(w), between.dot(u), between.dot(w)
    i = jnp.clip((bu - cosine * bw) / jnp.maximum(1 - cosine * cosine, 1e-12), -s, s)
    j = jnp.clip(cosine * i - bw, -t, t)
    i = jnp.clip(cosine * j + bu, -s, s)
    p, q = p + u * i, q + w * j
    half = n * (0.5 * n.dot(q - p))
    return select(on_a, q - half, select(on_b, p + half, (p + q) * 0.5))


def _edge(shape: Zonoid, n: Vec3, small: Lane) -> tuple[Vec3, Vec3, Lane, Lane]:
    """Return center, direction and half length of the edge at the farthest point of a shape, and
    whether a face is there. A face counts with its center."""
    cosines = [jnp.abs(n.dot(g)) for g, _ in shape.segments]
    u, s, least = shape.segments[0][0], shape.segments[0][1], cosines[0]
    for (g, length), c in list(zip(shape.segments, cosines, strict=True))[1:]:
        u, s, least = select(c < least, (g, length, c), (u, s, least))
    face: Lane = False
    for g, _ in shape.segments:  # all faces are orthogonal to a segment
        across = n.cross(g)
        face = face | (across.dot(across) < small * small)
    edge = (least < small) & ~face
    p = shape.farthest(n)
    p = select(face, n * shape.support(n), p - u * jnp.where(edge, p.dot(u), 0.0))
    return p, u, jnp.where(edge, s, 0.0), face
