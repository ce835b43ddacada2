"""Contacts of a height field with spheres, capsules and boxes.

The surface consists of two triangles for each cell of the grid. A point has one contact, with the
nearest triangle of the nine cells around it, so the work does not depend on the size of the field.
If the nearest point of the whole surface is outside of these cells, the distance is too large. The
distance is negative below the surface, to any depth. There is no contact outside of the rectangle
of the field. A sphere has the contact of its center, a capsule those of its two ends, and a box
those of its corners. MuJoCo C has a contact for each triangular prism in reach instead, with sides
between the cells. (Ericson, *Real-Time Collision Detection*, 5.1.5.)
"""

from __future__ import annotations

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.geometry.shapes import TINY, Contact, Shape, unit
from rbjax.lanes import Lane, Vec3
from rbjax.lanes.arrays import select

#: points of the window in each direction
WINDOW = 4


def field_sphere(field: Shape, sphere: Shape, reach: Lane) -> list[Contact]:
    """Return the contact of a height field and a sphere."""
    return [_ball(field, sphere.p, sphere.size[0], reach)]


def field_capsule(field: Shape, capsule: Shape, reach: Lane) -> list[Contact]:
    """Return the contacts of a height field and the end spheres of a capsule."""
    half = capsule.axis * capsule.size[1]
    ends = (capsule.p + half, capsule.p - half)
    return [_ball(field, end, capsule.size[0], reach) for end in ends]


def field_box(field: Shape, box: Shape, reach: Lane) -> list[Contact]:
    """Return the contacts of a height field and the corners of a box."""
    sides = [c * s for c, s in zip(box.R.columns, box.size, strict=True)]
    corners = [
        box.p + sides[0] * sx + sides[1] * sy + sides[2] * sz
        for sz, sy, sx in product((-1.0, 1.0), repeat=3)
    ]
    stacked = Vec3(*(jnp.stack([corner[i] for corner in corners]) for i in range(3)))
    found = jax.vmap(lambda corner: _ball(field, corner, 0.0, reach))(stacked)
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(corners))]


def _ball(field: Shape, center: Vec3, radius: Lane, reach: Lane) -> Contact:
    """Return the contact of a height field and a sphere, by the center of the sphere."""
    c = field.R.T @ (center - field.p)
    gap, n = _nearest(field.surface, field.size, c)
    inside = (jnp.abs(c[0]) <= field.size[0]) & (jnp.abs(c[1]) <= field.size[1])
    distance, normal = gap - radius, field.R @ n
    position = center - normal * (radius + 0.5 * distance)
    return Contact(distance, position, normal, inside & (distance <= reach))


def _nearest(heights: jax.Array, size: Vec3, c: Vec3) -> tuple[Lane, Vec3]:
    """Return the signed distance of a point from the surface, and the direction in which it
    increases."""
    rows, columns = heights.shape
    dx, dy = 2 * size[0] / (columns - 1), 2 * size[1] / (rows - 1)
    column, row = _cell((c[0] + size[0]) / dx, columns), _cell((c[1] + size[1]) / dy, rows)
    shape = min(WINDOW, rows), min(WINDOW, columns)
    first = jnp.clip(row - 1, 0, rows - shape[0]), jnp.clip(column - 1, 0, columns - shape[1])
    window = jax.lax.dynamic_slice(heights, first, shape).reshape(-1)
    i, j = _triangles(*shape)
    # corners of the triangles relative to the point, lanes of length n
    corners = [
        Vec3(
            (first[1] + j[:, k]).astype(heights.dtype) * dx - size[0] - c[0],
            (first[0] + i[:, k]).astype(heights.dtype) * dy - size[1] - c[1],
            window[i[:, k] * shape[1] + j[:, k]] - c[2],
        )
        for k in range(3)
    ]
    point, normal, over = _nearest_of_triangle(*corners)
    k = jnp.argmin(point.dot(point))
    q, normal, over = (jax.tree.map(lambda x: x[k], x) for x in (point, normal, over))

    # whether the point is below the triangle over or under it
    here = [(row - first[0] + a) * shape[1] + column - first[1] + b for a, b in _CELL]
    h00, h01, h10, h11 = (window[x] for x in here)
    u = (c[0] + size[0]) / dx - column
    v = (c[1] + size[1]) / dy - row
    level = h00 + jnp.where(u >= v, u * (h01 - h00) + v * (h11 - h01),
                            v * (h10 - h00) + u * (h11 - h10))  # fmt: skip
    sign = jnp.where(c[2] < level, -1.0, 1.0)
    n = select(over | (q.dot(q) <= TINY * TINY), normal, unit(q, normal) * -sign)
    return -n.dot(q), n


#: row and column of the four points of a cell
_CELL = ((0, 0), (0, 1), (1, 0), (1, 1))


def _cell(x: Lane, points: int) -> jax.Array:
    """Return the index of the cell of a grid that contains a coordinate x, in cell widths."""
    return jnp.clip(jnp.floor(x), 0, points - 2).astype(jnp.int32)


def _triangles(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and column indices (n, 3) of the corners of all triangles of a grid window."""
    corners = []
    for i, j in product(range(rows - 1), range(columns - 1)):
        a, b, c, d = ((i + di, j + dj) for di, dj in _CELL)
        corners += [(a, b, d), (a, d, c)]
    indices = np.array(corners, np.int32)
    return indices[..., 0], indices[..., 1]


def _nearest_of_triangle(a: Vec3, b: Vec3, c: Vec3) -> tuple[Vec3, Vec3, Lane]:
    """Return the point of a triangle nearest to the origin, and the normal of the triangle.

    The third value is whether the point is in the interior. The triangle is counterclockwise.
    """
    cross = (b - a).cross(c - a)
    area = jnp.sqrt(cross.dot(cross))
    normal = cross * (1 / area)
    # signs of the volumes that the origin, projected on the plane, makes with the sides
    sides = ((a, b), (b, c), (c, a))
    over = True
    for p, q in sides:
        over = over & (normal.dot(p.cross(q)) > 0)
    point = normal * normal.dot(a)
    best: Lane = jnp.where(over, point.dot(point), jnp.inf)
    for p, q in sides:
        along = q - p
        t = jnp.clip(-p.dot(along) / along.dot(along), 0.0, 1.0)
        near = p + along * t
        square = near.dot(near)
        nearer = ~over & (square < best)
        point, best = select(nearer, (near, square), (point, best))
    return point, normal, over
