"""Contacts of a height field with spheres, capsules and boxes.

The surface consists of two triangles for each cell of the grid. A point has one contact, with the
nearest triangle or edge of the nine cells around it, so the work does not depend on the size of the
field. A point that is farther above all corners of these cells than the reach needs no search. If
the nearest point of the whole surface is outside of these cells, the distance is too large. The
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
    found = jax.lax.map(lambda corner: _ball(field, corner, 0.0, reach), stacked)
    return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(corners))]


def _ball(field: Shape, center: Vec3, radius: Lane, reach: Lane) -> Contact:
    """Return the contact of a height field and a sphere, by the center of the sphere."""
    c = field.R.T @ (center - field.p)
    gap, n = _nearest(field.surface, field.size, c, radius + reach)
    inside = (jnp.abs(c[0]) <= field.size[0]) & (jnp.abs(c[1]) <= field.size[1])
    distance, normal = gap - radius, field.R @ n
    position = center - normal * (radius + 0.5 * distance)
    return Contact(distance, position, normal, inside & (distance <= reach))


def _nearest(heights: jax.Array, size: Vec3, c: Vec3, limit: Lane) -> tuple[Lane, Vec3]:
    """Return the signed distance of a point from the surface, and the direction in which it
    increases; a lower bound of the distance and the vertical if the bound is above the limit."""
    rows, columns = heights.shape
    dx, dy = 2 * size[0] / (columns - 1), 2 * size[1] / (rows - 1)
    column, row = _cell((c[0] + size[0]) / dx, columns), _cell((c[1] + size[1]) / dy, rows)
    shape = min(WINDOW, rows), min(WINDOW, columns)
    first = jnp.clip(row - 1, 0, rows - shape[0]), jnp.clip(column - 1, 0, columns - shape[1])
    # the points of the window relative to the point
    x = (first[1] + np.arange(shape[1])).astype(heights.dtype) * dx - size[0] - c[0]
    y = (first[0] + np.arange(shape[0])).astype(heights.dtype) * dy - size[1] - c[1]
    z = jax.lax.dynamic_slice(heights, first, shape) - c[2]
    above = -jax.lax.stop_gradient(z).max()

    def near() -> tuple[jax.Array, Vec3]:
        k = _least(_squares(*jax.lax.stop_gradient((x, y, z, dx, dy))))
        triangles, faces = _features(*shape)
        i, j = (jnp.asarray(t)[k] for t in (triangles[..., 0], triangles[..., 1]))
        p, q, r = (Vec3(x[j[n]], y[i[n]], z[i[n], j[n]]) for n in range(3))
        normal = (q - p).cross(r - p)
        normal = unit(normal * jnp.where(normal[2] < 0, -1.0, 1.0), Vec3(0.0, 0.0, 1.0))
        along, face = q - p, k < faces
        on_edge = p + along * jnp.clip(-p.dot(along) / along.dot(along), 0.0, 1.0)
        point = select(face, normal * normal.dot(p), on_edge)
        # whether the point is below the triangle over or under it
        at = row - first[0], column - first[1]
        h00, h01, h10, h11 = (z[at[0] + a, at[1] + b] for a, b in product((0, 1), repeat=2))
        u, v = -x[at[1]] / dx, -y[at[0]] / dy
        level = h00 + jnp.where(u >= v, u * (h01 - h00) + v * (h11 - h01),
                                v * (h10 - h00) + u * (h11 - h10))  # fmt: skip
        outward = unit(point, normal) * jnp.where(level > 0, 1.0, -1.0)
        n = select(face | (point.dot(point) <= TINY * TINY), normal, outward)
        return -n.dot(point), n

    def far() -> tuple[jax.Array, Vec3]:
        return above, Vec3(*(jnp.full((), i, above.dtype) for i in (0.0, 0.0, 1.0)))

    return jax.lax.cond(above <= limit, near, far)


def _cell(x: Lane, points: int) -> jax.Array:
    """Return the index of the cell of a grid that contains a coordinate x, in cell widths."""
    return jnp.clip(jnp.floor(x), 0, points - 2).astype(jnp.int32)


def _features(rows: int, columns: int) -> tuple[np.ndarray, int]:
    """Return row and column (n, 3, 2) of three corners for each feature of a window, and the number
    of faces. The other features are edges, between the first two corners."""
    cells = list(product(range(rows - 1), range(columns - 1)))
    lower = [((i, j), (i, j + 1), (i + 1, j + 1)) for i, j in cells]
    upper = [((i, j), (i + 1, j + 1), (i + 1, j)) for i, j in cells]
    of_rows = [
        ((i, j), (i, j + 1), (i + 1, j + 1) if i + 1 < rows else (i - 1, j))
        for i, j in product(range(rows), range(columns - 1))
    ]
    of_columns = [
        ((i, j), (i + 1, j), (i + 1, j + 1) if j + 1 < columns else (i, j - 1))
        for i, j in product(range(rows - 1), range(columns))
    ]
    diagonals = [(a, c, b) for a, b, c in lower]
    features = [*lower, *upper, *of_rows, *of_columns, *diagonals]
    return np.array(features, np.int32), 2 * len(cells)


def _squares(x: jax.Array, y: jax.Array, z: jax.Array, dx: Lane, dy: Lane) -> jax.Array:
    """Return the squared distance of the origin from each of `_features`; infinite if its nearest
    point of the plane of a face is not in the face."""
    out = []
    a, b, c, d = z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]
    X, Y, wide, high = x[None, :-1], y[:-1, None], 1 / dx, 1 / dy
    for rise, climb, lower in ((b - a, d - b, True), (d - c, c - a, False)):
        gx, gy = rise * wide, climb * high
        share = 1 / (1 + gx * gx + gy * gy)
        height = a - gx * X - gy * Y  # of the plane over the origin
        down = height * share
        u, v = (-gx * down - X) * wide, (-gy * down - Y) * high
        u, v = (u, v) if lower else (v, u)
        out.append(jnp.where((v >= 0) & (v <= u) & (u <= 1), height * down, jnp.inf))
    for p, along in (
        (Vec3(X, y[:, None], z[:, :-1]), Vec3(dx, 0.0, z[:, 1:] - z[:, :-1])),
        (Vec3(x[None], Y, z[:-1]), Vec3(0.0, dy, z[1:] - z[:-1])),
        (Vec3(X, Y, a), Vec3(dx, dy, d - a)),
    ):
        q = p + along * jnp.clip(-p.dot(along) / along.dot(along), 0.0, 1.0)
        out.append(q.dot(q))
    return jnp.concatenate([square.reshape(-1) for square in out])


def _least(x: jax.Array) -> jax.Array:
    """Return the index of the least number of x (n,), with half of the operations of `argmin`."""
    index = jnp.arange(len(x), dtype=jnp.int32)
    while len(x) > 1:
        n = (len(x) + 1) // 2  # the halves share a number if the length is odd
        other = x[-n:] < x[:n]
        x, index = jnp.where(other, x[-n:], x[:n]), jnp.where(other, index[-n:], index[:n])
    return index[0]
